"""`continuous_calibration`: a bench that is not as it was told: its nuisances are searched, found, and carried on."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from orchestrator.campaigns.file_loading import load_campaign, load_parameters, load_posterior
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.calibration.action_prior import drawn_worlds
from orchestrator.learning.calibration.calibration_base import described
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.campaign_plan import MeasuredPour, NormalPrior
from orchestrator.reports.publishing import theta_file
from orchestrator.runs.strategy_harness import SCENE, StrategyHarness
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from tests.support.plans import calibration_plan

ACTIONS = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG), Axis("x_offset", 0.08, 0.15)))
SEARCHED = Space((Axis("receiver_x", -0.015, 0.015), Axis("speed_factor", 0.9, 1.1)))
TRUTH = SimulationParameters(receiver_x=0.008)


def spilled(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
    """A jet that reaches the farther the faster it is: what matters is how far beside the receiver it lands."""
    speed = action.angular_velocity * theta.speed_factor / DEG
    beside = action.x_offset + theta.receiver_x - (0.09 + 0.0004 * (speed - 15))
    return float(np.clip(1 - np.exp(-((beside / 0.03) ** 2)) + 0.005 * rng.standard_normal(), 0.0, 1.0))


def calibrated(seed: int = 1, **changes: Any) -> Any:
    rng = np.random.default_rng(seed)
    pours = []
    for _ in range(12):
        action = SCENE.action(ACTIONS.draw(rng))
        pours.append(MeasuredPour(action, spilled(action, TRUTH, rng), 0.98, "train"))
    plan = calibration_plan(actions=ACTIONS, parameters=SEARCHED, fixed_parameters={}, simulations=40, **changes)
    strategy = ContinuousBayesianCalibration(plan, pours, seed)
    StrategyHarness(spilled).run(strategy)
    return strategy.result()


@pytest.fixture(scope="module")
def found() -> Any:
    return calibrated().found


@pytest.mark.slow
def test_where_the_receiver_stands_is_found_and_bounded(found: Any) -> None:
    low, high = found.posterior.region["receiver_x"]
    assert low <= 0.008 <= high
    assert high - low < 0.012
    assert abs(found.theta.receiver_x - 0.008) < 0.004


@pytest.mark.slow
def test_what_was_measured_beforehand_narrows_what_the_pours_leave_open(found: Any) -> None:
    measured = calibrated(parameter_prior=(NormalPrior("speed_factor", 1.0, 0.005),)).found
    wide, narrow = (one.posterior.region["speed_factor"] for one in (found, measured))
    assert narrow[1] - narrow[0] < 0.02 < wide[1] - wide[0]
    assert narrow[0] < 1.0 < narrow[1]


@pytest.mark.slow
def test_the_theta_file_carries_nuisances_to_whoever_plans_with_it(found: Any, tmp_path: Path) -> None:
    import json

    path = tmp_path / "theta.json"
    path.write_text(json.dumps(theta_file(found)))
    assert load_parameters(path) == found.theta
    rows = load_posterior(path, 20)
    assert len({row.receiver_x for row in rows}) > 10


@pytest.mark.slow
def test_benches_are_drawn_from_the_posterior_and_what_it_leaves_unsaid_from_tolerances(found: Any) -> None:
    complete = [SimulationParameters.from_values({**found.theta.model_dump(), **row}) for row in found.posterior.thetas]
    benches = drawn_worlds(found.theta, 256, 3, posterior=complete, known=SEARCHED.names)
    assert benches == drawn_worlds(found.theta, 256, 3, posterior=complete, known=SEARCHED.names)
    assert {bench.receiver_x for bench in benches} <= {theta.receiver_x for theta in complete}
    sides = np.array([bench.receiver_y for bench in benches])
    assert abs(sides.mean()) < 0.0003
    assert sides.std() == pytest.approx(0.003, rel=0.1)
    alone = drawn_worlds(SimulationParameters(receiver_x=0.03), 64, 0)
    assert max(bench.receiver_x for bench in alone) == 0.03  # not beyond the bounds
    assert {bench.friction for bench in alone} == {0.0}


def test_people_read_nuisances_in_their_units() -> None:
    text = described({"friction": 0.1, "receiver_x": 0.0032, "tilt_zero": 0.5 * DEG})
    assert text == "friction 0.1  receiver_x 3.2 mm  tilt_zero 0.5 deg"


CAMPAIGN = """
name: bench
laboratory: {{name: numbers, mode: virtual, bench: {{liquid: {{particles: 500}}}}}}
liquid: {{name: water, mass: 200 g}}
pourer: {vessels}/beaker.yaml
receiver: {vessels}/tumbler.yaml
simulator: {{parameters: {{{parameters}}}}}
motion: {{max_angle: 120 deg, height: 60 mm}}
actions: {{angular_velocity: [20 deg/s, 100 deg/s], x_offset: [100 mm, 130 mm]}}
calibration: {{strategy: {strategy}, simulations: 20, pours: {{count: 8}}}}
"""


def written(folder: Path, parameters: str, strategy: str = "C4") -> Path:
    vessels = Path(__file__).parents[4] / "configs" / "vessels"
    path = folder / "campaign.yaml"
    path.write_text(CAMPAIGN.format(vessels=vessels, parameters=parameters, strategy=strategy))
    return path


def test_a_measured_value_with_its_tolerance_is_a_prior(tmp_path: Path) -> None:
    plan = load_campaign(
        written(tmp_path, "receiver_x: {measured: 1 mm, tolerance: 2 mm}, friction: [0, 0.3], tilt_zero: 0.5 deg")
    )
    calibration = plan.calibration
    assert calibration is not None
    assert calibration.parameter_prior == (NormalPrior("receiver_x", pytest.approx(0.001), pytest.approx(0.002)),)
    axis = next(axis for axis in calibration.parameters.axes if axis.name == "receiver_x")
    assert (axis.lower, axis.upper) == pytest.approx((-0.005, 0.007))
    assert calibration.fixed_parameters["tilt_zero"] == pytest.approx(0.5 * DEG)
    assert plan.parameters.receiver_x == pytest.approx(0.001)
    wide = load_campaign(written(tmp_path, "receiver_x: {measured: 1 mm, tolerance: 2 mm, range: [-4 mm, 2 mm]}"))
    assert wide.calibration is not None
    assert wide.calibration.parameters.axes[0].upper == pytest.approx(0.002)


@pytest.mark.parametrize(
    ("written_as", "said"),
    [
        ("receiver_x: {measured: 1 mm}", "has no 'tolerance'; add for example 'tolerance: 5 mm'"),
        ("receiver_x: {tolerance: 1 mm}", "has a tolerance of nothing; add for example 'measured: 0 mm'"),
        ("receiver_x: {measured: 1 mm, tolerance: -1 mm}", "-1 mm should be above 0"),
        ("receiver_x: {measured: 1 deg, tolerance: 1 mm}", "an angle"),
        (
            "receiver_x: {measured: 5 mm, tolerance: 1 mm, range: [-1 mm, 2 mm]}",
            "outside the range beside it, -1 … 2 mm",
        ),
        ("receiver_x: {value: 5 mm, tolerance: 1 mm}", "unknown key"),
        ("receiver_x: {scale: linear}", "names nothing to search"),
        ("receiver_x: 40 mm", "outside -30 … 30 mm"),
        ("reciever_x: [-1 mm, 1 mm]", "did you mean 'receiver_x'?"),
    ],
)
def test_what_is_wrong_with_a_measured_value_is_said_once(tmp_path: Path, written_as: str, said: str) -> None:
    with pytest.raises(ConfigError) as caught:
        load_campaign(written(tmp_path, f"{written_as}, friction: [0, 0.3]"))
    assert said in str(caught.value)
    assert len(caught.value.problems) == 1, str(caught.value)


def test_only_c4_weighs_what_was_measured(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="belongs to C4; C3 takes all values for alike"):
        load_campaign(written(tmp_path, "receiver_x: {measured: 1 mm, tolerance: 2 mm}", "C3"))


def test_a_nuisance_of_the_bench_is_no_key_of_its_hidden_liquid(tmp_path: Path) -> None:
    path = written(tmp_path, "friction: [0, 0.3]")
    path.write_text(path.read_text().replace("{particles: 500}", "{particles: 500, receiver_x: 3 mm}"))
    with pytest.raises(ConfigError, match="unknown key"):
        load_campaign(path)
