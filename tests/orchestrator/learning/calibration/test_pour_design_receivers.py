"""`pour_design`: calibration pours into several receivers: made by turns, told apart by the surrogate, and all of
them count.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.calibration.pour_design import StratifiedDesign
from orchestrator.learning.requests import Simulate
from orchestrator.runs.stages import POURS, measured_pours, scenes_of
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, SCENE, StrategyHarness
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from sim_engine.vessel.shapes import cylinder
from tests.orchestrator.learning.calibration.test_continuous_calibration_nuisances import written
from tests.support.plans import calibration_plan

WIDE = replace(SCENE, name="calibration-wide", receiver=cylinder("wide", inner_radius=0.05, inner_height=0.1))
THIRD = replace(SCENE, name="calibration-third")
SEARCHED = Space((Axis("friction", 0.0, 0.4), Axis("receiver_x", -0.01, 0.01)))
TRUTH = SimulationParameters(friction=0.3, receiver_x=0.006)


def spilled(request: Any, theta: SimulationParameters) -> float:
    """Friction shows in the first receiver, where the second one stands shows only there."""
    if request.scene == SCENE.name:
        return float(0.1 + theta.friction * request.action.angular_velocity / 4)
    return float(0.3 + 20 * theta.receiver_x + 0.05 * request.action.angular_velocity)


def played(strategy: Any) -> Any:
    """With a liquid that knows the scene, which a plain toy function does not see."""
    scene: list[Any] = []

    def answer(request: Any) -> None:
        scene[:] = [request]

    def amount(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
        truth = theta if isinstance(scene[0], Simulate) else TRUTH
        return spilled(scene[0], truth)

    StrategyHarness(amount, amount, answer=answer).run(strategy)
    return strategy


@pytest.fixture(scope="module")
def design() -> StratifiedDesign:
    return played(StratifiedDesign((SCENE, WIDE), CALIBRATION_ACTIONS, 12, 2, 0))  # type: ignore[no-any-return]


def test_pours_go_into_all_receivers_by_turns(design: StratifiedDesign) -> None:
    by_split = [(pour.split, pour.scene) for pour in design.measured]
    assert by_split.count(("train", SCENE.name)) == by_split.count(("train", WIDE.name)) == 5
    assert by_split.count(("test", SCENE.name)) == by_split.count(("test", WIDE.name)) == 1
    assert [pour.scene for pour in design.result().measured] == [scene for _, scene in by_split]


@pytest.mark.slow
def test_what_each_receiver_tells_is_put_together(design: StratifiedDesign) -> None:
    plan = calibration_plan(parameters=SEARCHED, fixed_parameters={}, simulations=36, further=(WIDE,))
    measured = [scored.pour for scored in measured_pours(plan, {POURS: design.result()})]
    assert {pour.scene for pour in measured} == {SCENE.name, WIDE.name}
    strategy = played(ContinuousBayesianCalibration(plan, measured, 1))
    region = strategy.result().found.posterior.region
    assert region["friction"][0] <= 0.3 <= region["friction"][1]
    assert region["receiver_x"][0] <= 0.006 <= region["receiver_x"][1]
    assert np.ptp(region["friction"]) < 0.2
    assert np.ptp(region["receiver_x"]) < 0.01


@pytest.mark.parametrize("scenes", [(SCENE,), (SCENE, WIDE), (SCENE, WIDE, THIRD)])
def test_a_point_of_the_surrogate_is_one_action_in_one_scene(scenes: tuple[Any, ...]) -> None:
    contexts = Contexts(CALIBRATION_ACTIONS, scenes)
    points = [contexts.at((0.25, 0.75), i) for i in range(len(scenes))]
    assert len(set(points)) == len(scenes)
    assert {len(point) for point in points} == {contexts.space.dimension}
    for point, scene in zip(points, scenes, strict=True):
        found, action = contexts.request(point)
        assert found is scene
        assert action == scene.action(CALIBRATION_ACTIONS.decode((0.25, 0.75)))


def test_several_receivers_are_written_as_a_list(tmp_path: Path) -> None:
    path = written(tmp_path, "friction: [0, 0.3]")
    vessels = Path(__file__).parents[4] / "configs" / "vessels"
    both = f"receivers: [{vessels}/tumbler.yaml, {vessels}/cone.yaml], pours: {{count: 8}}"
    path.write_text(path.read_text().replace("pours: {count: 8}", both))
    plan = load_campaign(path)
    assert plan.calibration is not None
    assert [scene.receiver.name for scene in plan.calibration.scenes] == ["tumbler", "cone"]
    assert {"calibration", "calibration-cone"} <= scenes_of(plan).keys()
    path.write_text(path.read_text().replace("cone.yaml", "tumbler.yaml"))
    with pytest.raises(ConfigError, match="is called 'tumbler' already"):
        load_campaign(path)
