"""`active_design`: calibration pours that are chosen: where θ shows in what is to be deployed, and never the same
twice for nothing.
"""

from __future__ import annotations

import itertools
import math
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import CalibrationQuery, Data, DesignQuestion, PosteriorQuestion
from actors.optimizer.suggest import propose
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.calibration.active_design import CLOSE, ActiveDesign, joint_contexts
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.requests import Failed, Pour, Simulate, Slots
from orchestrator.runs.stages import POURS, known_simulations, measured_pours, stages_of
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, StrategyHarness, replay
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from tests.orchestrator.learning.calibration.test_continuous_calibration_nuisances import (
    SEARCHED,
    TRUTH,
    spilled,
    written,
)
from tests.support.plans import calibration_plan, deployment_plan

NARROW = replace(SCENE, name="deployment-narrow", fixed={"height": 0.07})


def slope(space: Space, made: tuple[tuple[float, ...], ...] = ()) -> Any:
    """A spillage of θ times the action, so that only large actions tell θ; simulated all over."""
    grid = [(t, a) for t in np.linspace(0.0, 1.0, 7) for a in np.linspace(0.0, 1.0, 7)]
    data = Data(tuple((float(t), float(a)) for t, a in grid), tuple(-float(t * a) for t, a in grid))
    candidates = tuple((float(a),) for a in np.linspace(0.0, 1.0, 11))
    weighed = PosteriorQuestion(made, tuple(0.4 * a for (a,) in made), 0.02, 64)
    design = DesignQuestion(candidates, ((0.8,), (0.9,)))
    return propose(CalibrationQuery(space, data, count=0, contexts=((0.9,),), posterior=weighed, design=design))


def test_a_pour_is_worth_most_where_it_tells_theta_and_little_where_one_was_made() -> None:
    space = Space((Axis("friction", 0.0, 1.0),))
    before = slope(space)
    assert int(np.argmax(before.gains)) >= 8
    assert before.gains[0] < 0.05 * max(before.gains)
    after = slope(space, ((1.0,),))
    assert after.uncertainty < 0.3 * before.uncertainty
    assert max(after.gains) < 0.3 * max(before.gains)
    assert before.uncertainty == pytest.approx(0.85**2 / 12, rel=0.3)  # of an even θ


def plans(**changes: Any) -> Any:
    values = {"actions": ACTIONS, "parameters": SEARCHED, "fixed_parameters": {}, "pour_count": 6, "holdout": 1}
    plan = calibration_plan(simulations=30, design="active", design_simulations=40, **values | changes)
    return plan, deployment_plan(scenes=(NARROW,), actions=ACTIONS)


def truth(action: Action, _: SimulationParameters, rng: np.random.Generator) -> float:
    return spilled(action, TRUTH, rng)


@pytest.fixture(scope="module")
def played() -> tuple[ActiveDesign, StrategyHarness]:
    strategy = ActiveDesign(*plans(), 3)
    return strategy, StrategyHarness(spilled, truth).run(strategy)


def test_it_simulates_what_is_to_be_deployed_and_then_pours_what_it_chose(
    played: tuple[ActiveDesign, StrategyHarness],
) -> None:
    strategy, play = played
    kinds = [type(request) for request in play.asked]
    assert kinds[:40] == [Simulate] * 40
    assert {request.scene for request in play.simulations[:40]} == {SCENE.name, NARROW.name}
    splits = [pour.split for pour in strategy.measured]
    assert (splits.count("train"), splits.count("test")) == (5, 1)
    chosen = {pour.action for pour in strategy.measured if pour.split == "train"}
    assert len(chosen) >= 3
    known = [decision.values["variance"] for decision in strategy.decisions if "variance" in decision.values]
    assert known[-1] < 0.5 * known[0]


@pytest.mark.slow
def test_what_it_simulated_is_not_thrown_away(played: tuple[ActiveDesign, StrategyHarness]) -> None:
    strategy, _ = played
    plan, _ = plans()
    results = {POURS: strategy.result()}
    plan = replace(plan, known=known_simulations(plan, results))
    assert len(plan.known) == 20 + 5 * 8  # at candidates, and of each chosen pour
    measured = [scored.pour for scored in measured_pours(plan, results)]
    calibration = ContinuousBayesianCalibration(plan, measured, 1)
    play = StrategyHarness(spilled).run(calibration)
    assert len(play.simulations) == 30
    first = next(r for r in play.asked if getattr(r, "purpose", "") == "calibrate" and not isinstance(r, Simulate))
    assert len(first.query.data) >= 20
    low, high = calibration.result().found.posterior.region["receiver_x"]
    assert low <= TRUTH.receiver_x <= high


def test_it_asks_for_the_same_when_it_is_replayed(played: tuple[ActiveDesign, StrategyHarness]) -> None:
    assert replay(ActiveDesign(*plans(), 3), played[1]) == played[1].asked


def test_an_action_that_cannot_be_made_is_replaced_by_the_next_best() -> None:
    refused: list[Action] = []

    def answer(request: Any) -> Any:
        if isinstance(request, Pour) and len(refused) < 2:
            refused.append(request.action)
            return Failed("invalid_action", "cups touch")
        return None

    strategy = ActiveDesign(*plans(holdout=0, pour_count=3), 3)
    StrategyHarness(spilled, truth, answer=answer).run(strategy)
    assert len(strategy.measured) == 3
    assert refused[0] != refused[1]
    assert not {pour.action for pour in strategy.measured} & set(refused)


def test_it_pours_even_where_no_simulation_comes_to_anything() -> None:
    strategy = ActiveDesign(*plans(holdout=0, pour_count=3), 3)
    StrategyHarness(lambda *_: float("nan"), truth).run(strategy)
    assert len(strategy.measured) == 3
    assert "too few simulations" in " ".join(decision.text for decision in strategy.decisions)


@pytest.mark.parametrize("searched", [SEARCHED, Space((Axis("friction", 0.0, 0.6),))])
def test_no_pour_is_chosen_in_which_the_cups_may_touch_as_they_stand(searched: Space) -> None:
    # The weighed pours show that the receiver stands nearer than the arm assumes; then near actions are no longer safe.
    truth_at, near = -0.012, 0.085

    def answer(request: Any) -> Any:
        if isinstance(request, Simulate) and request.action.x_offset + request.parameters.receiver_x < near:
            return Failed("invalid_action", "cups touch")
        return Failed("pour_failed", "cups touch") if isinstance(request, Pour) and touches(request.action) else None

    def touches(action: Action) -> bool:
        return action.x_offset + truth_at < near

    nearer = SimulationParameters(receiver_x=truth_at)
    strategy = ActiveDesign(*plans(holdout=0, pour_count=5, parameters=searched), 3)
    play = StrategyHarness(spilled, lambda a, _, rng: spilled(a, nearer, rng), answer=answer).run(strategy)
    lost = [touches(request.action) for request in play.asked if isinstance(request, Pour)]
    if searched is SEARCHED:
        assert not any(lost[1:])
        assert any("the cups touch in" in decision.text for decision in strategy.decisions)
    else:  # nothing that is searched moves the bench: nothing can be known, and nothing more is simulated
        assert len(play.simulations) == 40
    failed = [a for a in (r.action for r in play.asked if isinstance(r, Pour)) if touches(a)]
    points = [ACTIONS.encode({name: getattr(action, name) for name in ACTIONS.names}) for action in failed]
    assert all(math.dist(a, b) > CLOSE for a, b in itertools.combinations(points, 2))


def test_dimensions_that_differ_between_scenes_are_the_surrogates() -> None:
    tilting = Space((Axis("angular_velocity", 20 * DEG, 90 * DEG), Axis("max_angle", 70 * DEG, 125 * DEG)))
    contexts = joint_contexts([(SCENE, tilting), (NARROW, ACTIONS)])
    axes = {axis.name: (axis.lower, axis.upper) for axis in contexts.space.axes}
    assert axes["angular_velocity"] == pytest.approx((15 * DEG, 120 * DEG))
    assert axes["x_offset"] == pytest.approx((0.08, 0.15))
    assert axes["height"] == pytest.approx((0.05, 0.07))
    assert {"max_angle", "scene1"} <= axes.keys()
    assert "hold_time" not in axes


def test_a_campaign_asks_for_it_with_one_key(tmp_path: Path) -> None:
    path = written(tmp_path, "friction: [0, 0.3], receiver_x: {measured: 0 mm, tolerance: 5 mm}")
    path.write_text(path.read_text().replace("{count: 8}", "{count: 8, design: active, simulations: 24}"))
    plan = load_campaign(path)
    assert plan.calibration is not None
    assert (plan.calibration.design, plan.calibration.design_simulations) == ("active", 24)
    strategy = stages_of(plan)[0].build({}, 1)
    assert isinstance(strategy, ActiveDesign)
    assert len(strategy.ask(Slots(100, 1))) == 24
    path.write_text(path.read_text().replace("design: active, ", ""))
    with pytest.raises(ConfigError, match="belongs to 'design: active'"):
        load_campaign(path)


def test_if_the_cups_may_touch_in_all_pours_it_makes_those_in_which_they_touch_least() -> None:
    def answer(request: Any) -> Any:
        if isinstance(request, Simulate) and (request.action.x_offset < 0.115 or request.parameters.receiver_x < 0.0):
            return Failed("invalid_action", "cups touch")
        return None

    strategy = ActiveDesign(*plans(holdout=0, pour_count=3), 3)
    StrategyHarness(spilled, truth, answer=answer).run(strategy)
    assert len(strategy.measured) == 3
    assert all(pour.action.x_offset > 0.115 for pour in strategy.measured)
