"""`d1`: D1 under errors of execution: what it chooses, what it asks for, and how that is replayed and read."""

from __future__ import annotations

import asyncio
import json
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import RiskQuery, Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.disturbances import Disturbances, RiskSettings
from orchestrator.learning.requests import Failed, Simulate, Suggest
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.single_action import RepeatedSimulation
from orchestrator.records.codec import decode_request, decode_result, encode_request, encode_result
from orchestrator.runs.stages import with_posterior
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA, StrategyHarness, executed, replay
from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.scene import PoseError
from sim_engine.search_space import Axis, Space
from tests.support import plans, toy_campaign
from tests.support.killed_runs import die_at
from tests.support.plans import deployment_plan
from tests.support.toy_campaign import ToyLaboratory, logical_record, toy_plan
from tests.support.toy_spillage import quiet_valleys, two_valleys

ERRORS = PoseError(x=8e-3, speed_factor=0.03)


def risky(seed: int = 0, *, risk: RiskSettings | None = None, **changes: Any) -> OneShotPlanning:
    values = {"pours": 0, "iterations": 12, "simulations_per_iteration": 3, **changes}
    plan = deployment_plan(strategy="D1", risk=risk or plans.risk("expected", pose_error=ERRORS), **values)
    return OneShotPlanning(plan, SCENE, THETA, seed)


def place(strategy: OneShotPlanning) -> float:
    assert strategy.best_values is not None
    return (strategy.best_values["x_offset"] - 0.08) / 0.07


def true_losses(values: dict[str, float], count: int = 4000) -> np.ndarray:
    rng, action = np.random.default_rng(9), SCENE.action(values)
    errors = [PoseError(x=8e-3 * a, speed_factor=1 + 0.03 * b) for a, b in rng.standard_normal((count, 2))]
    return np.array([quiet_valleys(executed(action, error)) for error in errors])


@pytest.mark.slow
def test_under_errors_the_broad_valley_is_chosen_and_without_them_the_narrow_one() -> None:
    plain = OneShotPlanning(deployment_plan(strategy="D1", pours=0, iterations=18, initial_samples=6), SCENE, THETA, 2)
    StrategyHarness(two_valleys).run(plain)
    assert abs(place(plain) - 0.25) < 0.06
    for risk in (plans.risk("expected", pose_error=ERRORS), plans.risk("cvar", 0.9, ERRORS)):
        strategy = risky(2, risk=risk)
        StrategyHarness(two_valleys).run(strategy)
        assert abs(place(strategy) - 0.7) < 0.1, risk.measure


@pytest.mark.parametrize("level", [0.0, 0.8])
def test_what_is_promised_under_errors_is_what_comes(level: float) -> None:
    strategy = risky(1, risk=plans.risk("cvar" if level else "expected", level or 0.9, ERRORS))
    StrategyHarness(two_valleys).run(strategy)
    result: Any = strategy.result()
    losses = np.sort(true_losses(result.recommended.action_si))
    assert result.risk.expected == pytest.approx(losses.mean(), abs=0.04)
    assert result.risk.spread == pytest.approx(losses.std(), abs=0.05)
    assert result.recommended.predicted_loss == pytest.approx(losses[int(level * len(losses)) :].mean(), abs=0.06)
    assert result.recommended.predicted_scatter > 0.8 * losses.std()
    assert decode_result(json.loads(json.dumps(encode_result(result), allow_nan=False))) == result


def test_each_action_is_simulated_as_planned_and_under_errors_within_the_budget() -> None:
    played = StrategyHarness(two_valleys, slots=3).run(risky(iterations=6, simulations_per_iteration=4))
    assert len(played.simulations) == 24
    by_action: dict[Any, list[Simulate]] = {}
    for request in played.simulations:
        by_action.setdefault(request.action, []).append(request)
    assert all(len(same) == 4 for same in by_action.values())
    assert all([r.pose_error is None for r in same] == [True, False, False, False] for same in by_action.values())
    errors = [r.pose_error for r in played.simulations if r.pose_error is not None]
    assert len(set(errors)) == len(errors)
    assert all(error.y == 0.0 and error.tilt == 0.0 for error in errors)  # nothing else was said to go wrong
    assert np.std([error.x for error in errors]) == pytest.approx(8e-3, rel=0.35)


def test_all_actions_are_compared_under_the_same_errors() -> None:
    played = StrategyHarness(two_valleys).run(risky(iterations=6))
    asked = {r.query.risk for r in played.asked if isinstance(r, Suggest) and isinstance(r.query, RiskQuery)}
    assert len(asked) == 1


def test_the_same_seed_asks_the_same_and_a_replay_repeats_it() -> None:
    def play(order: str = "first") -> StrategyHarness:
        return StrategyHarness(two_valleys, order=order, slots=3).run(risky(3, iterations=6, pours=1))

    first = play()
    assert first.pours
    assert play().asked == first.asked
    late = play("last")
    assert (late.simulations, late.pours) == (first.simulations, first.pours)
    assert [r for r in late.asked if isinstance(r, Suggest)] == [r for r in first.asked if isinstance(r, Suggest)]
    assert replay(risky(3, iterations=6, pours=1), first) == first.asked
    written = [json.loads(json.dumps(encode_request(request))) for request in first.asked]
    assert [decode_request(one) for one in written] == first.asked


def test_the_pour_is_predicted_with_the_spread_of_the_errors() -> None:
    played = StrategyHarness(two_valleys).run(risky(1, pours=1))
    (pour,) = played.pours
    assert pour.predicted is not None
    assert pour.predicted.scatter is not None
    losses = true_losses({name: getattr(pour.action, name) for name in ACTIONS.names})
    assert pour.predicted.mean == pytest.approx(losses.mean(), abs=0.04)
    assert pour.predicted.scatter > 0.8 * losses.std()


def touching_below(limit: float) -> Any:
    """Cups touch where the executed distance is too small."""

    def spill(action: Any, theta: Any, rng: np.random.Generator) -> float:
        if action.x_offset < limit:
            raise ValueError("cups touch")
        return float(min(0.05 + 8.0 * (action.x_offset - limit), 1.0))

    return spill


@pytest.mark.slow
def test_cups_that_touch_under_an_error_are_a_risk_and_those_that_touch_as_planned_no_action() -> None:
    """Without errors the best place is right at the contact; with them well away from it."""
    strategy = risky(0, iterations=14)
    played = StrategyHarness(touching_below(0.1)).run(strategy)
    assert strategy.best_values is not None
    assert strategy.best_values["x_offset"] > 0.1 + 0.8 * ERRORS.x
    told = [(r, o) for r, o in played.told if isinstance(r, Simulate) and isinstance(o, Failed)]
    assert any(r.pose_error is not None and r.action.x_offset > 0.1 for r, _ in told)
    queries = [r.query for r in played.asked if isinstance(r, Suggest) and isinstance(r.query, RiskQuery)]
    costs = [c for query in queries for c in query.data.costs]
    assert max(costs) == 1.0
    plain = OneShotPlanning(deployment_plan(strategy="D1", pours=0, iterations=20), SCENE, THETA, 0)
    StrategyHarness(touching_below(0.1)).run(plain)
    assert plain.best_values is not None
    assert plain.best_values["x_offset"] < strategy.best_values["x_offset"]


@pytest.mark.slow
@pytest.mark.parametrize("errors", [ERRORS, PoseError(x=8e-3, tilt=1 * DEG, speed_factor=0.0)])
def test_where_every_action_touches_nothing_is_recommended(errors: PoseError) -> None:
    strategy = risky(iterations=4, pours=1, risk=plans.risk("expected", pose_error=errors))
    played = StrategyHarness(touching_below(1.0)).run(strategy)
    assert not played.pours
    assert strategy.best_values is None
    assert "touch" in str(strategy.result().gave_up)


def test_lost_simulations_are_left_out() -> None:
    def flaky(action: Any, theta: Any, rng: np.random.Generator) -> float:
        return float("nan") if rng.random() < 0.3 else two_valleys(action, theta, rng)

    strategy = risky(4)
    StrategyHarness(flaky).run(strategy)
    assert strategy.best_values is not None


def test_errors_and_thetas_are_drawn_as_they_were_said_to_be() -> None:
    thetas = tuple(SimulationParameters(cohesion=0.01 * i, particles=500 * 2**i) for i in range(4))
    errors = PoseError(x=2e-3, y=1e-3, tilt=1 * DEG, speed_factor=0.02)
    plan = plans.risk("expected", pose_error=errors, theta="posterior")
    draws = Disturbances(plan, ACTIONS, THETA, 5, thetas).draws(512)
    for name, centre in (("x", 0.0), ("y", 0.0), ("tilt", 0.0), ("speed_factor", 1.0)):
        values = np.array([getattr(draw.error, name) for draw in draws])
        spread = getattr(errors, name)
        assert values.mean() == pytest.approx(centre, abs=0.05 * spread)
        assert values.std() == pytest.approx(spread, rel=0.05)
    assert [sum(draw.parameters == theta for draw in draws) for theta in thetas] == [128] * 4
    again = Disturbances(plan, ACTIONS, THETA, 5, thetas).draws(8)
    assert again == draws[:8]
    assert Disturbances(plan, ACTIONS, THETA, 6, thetas).draws(8) != again


def test_an_error_is_to_the_surrogate_the_action_that_was_executed() -> None:
    plan = plans.risk("expected", pose_error=PoseError(x=5e-3, y=1e-3, speed_factor=0.1))
    values = {"angular_velocity": 60 * DEG, "x_offset": 0.11, "y_offset": 0.01}
    sideways = Space((*ACTIONS.axes, Axis("y_offset", -0.02, 0.02)))
    logarithmic = Space((Axis("angular_velocity", 15 * DEG, 120 * DEG, "log"), *sideways.axes[1:]))
    for space in (sideways, logarithmic):
        disturbances = Disturbances(plan, space, THETA, 0)
        for draw in disturbances.draws(8):
            action = executed(SCENE.action(values), draw.error)
            expected = space.encode({name: getattr(action, name) for name in space.names})
            assert disturbances.executed(tuple(space.encode(values)), draw) == pytest.approx(expected)


def test_an_error_of_what_is_not_searched_is_a_coordinate_beside_the_action() -> None:
    plan = plans.risk("expected", pose_error=PoseError(y=1e-3, tilt=1 * DEG, speed_factor=0.0))
    disturbances = Disturbances(plan, ACTIONS, THETA, 0)
    for draw in disturbances.draws(8):
        assert draw.error is not None
        *seen, y, tilt = disturbances.executed((0.3, 0.4), draw)
        assert seen == [0.3, 0.4]
        assert (y, tilt) == pytest.approx((0.5 + draw.error.y / 1e-3 / 8.0, 0.5 + draw.error.tilt / DEG / 8.0))


def test_thetas_of_the_calibration_before_are_borne_and_a_campaign_without_says_so() -> None:
    def spill(action: Any, theta: SimulationParameters, rng: np.random.Generator) -> float:
        return min(two_valleys(action, theta, rng) + 4.0 * theta.cohesion, 1.0)

    plan = deployment_plan(strategy="D1", pours=0, risk=plans.risk(pose_error=ERRORS, theta="posterior"))
    calibrated = plans.calibrated(THETA, [{"cohesion": 0.001 * i} for i in range(100)])
    informed = with_posterior(plan, {"calibration": calibrated})
    assert 50 <= len(informed.thetas) <= 100
    strategy = risky(risk=informed.settings.risk, thetas=informed.thetas)  # type: ignore[attr-defined]
    played = StrategyHarness(spill).run(strategy)
    assert len({request.parameters.cohesion for request in played.simulations}) > 10
    result: Any = strategy.result()
    assert result.risk.expected > true_losses(result.recommended.action_si).mean() + 0.1  # mean cohesion costs 0.2
    pointless = plans.calibrated(THETA)
    with pytest.raises(RunError, match="C4"):
        with_posterior(plan, {"calibration": pointless})


def test_a_prediction_bears_the_errors_and_counts_cups_that_touch_as_the_worst() -> None:
    action = SCENE.action({"angular_velocity": 60 * DEG, "x_offset": 0.11})
    errors = [PoseError(x=x) for x in (-2e-3, 0.0, 2e-3, 4e-3)]
    strategy = RepeatedSimulation(Costing(Loss(), SCENE, THETA), action, 4, 1, errors=errors)

    def spill(executed_action: Any, theta: Any, rng: Any) -> float:
        if executed_action.x_offset < 0.109:
            raise ValueError("cups touch")
        return float(100.0 * (executed_action.x_offset - 0.109))

    played = StrategyHarness(spill).run(strategy)
    assert [request.pose_error for request in played.simulations] == errors
    result: Any = strategy.result()
    assert (result.touching, result.simulations_lost) == (1, 0)
    assert result.over_seeds["loss"].mean == pytest.approx((1.0 + 0.1 + 0.3 + 0.5) / 4)
    assert result.over_seeds["spilled"].count == 3


def test_a_simulation_that_was_asked_for_with_an_error_is_made_with_it() -> None:
    from tests.support.toy_campaign import ToySimulators

    async def run() -> Any:
        import asyncio

        from orchestrator.runs.request_executor import Deadlines, RequestExecutor

        class Laboratory:
            simulators = ToySimulators()

        lanes = RequestExecutor(Laboratory(), {"cup": SCENE}, Deadlines(), 0.0)  # type: ignore[arg-type]
        error = PoseError(x=1e-3)
        action = SCENE.action({"angular_velocity": 1.0})
        for request in (Simulate("cup", action, THETA, 1), Simulate("cup", action, THETA, 1, "plan", error)):
            await lanes.simulate(request, record=False, started=lambda: None)
        await asyncio.sleep(0)
        return [task.pose_error for task in Laboratory.simulators.tasks]

    import asyncio

    assert asyncio.run(run()) == [None, PoseError(x=1e-3)]


class ProposingOptimizer(toy_campaign.ToyOptimizer):
    """The real optimiser, without an actor."""

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        self.asked += 1
        return propose(query)


def run_risk(directory: Path, *, resume: bool = False) -> Any:
    risk = plans.risk("cvar", 0.8, ERRORS)
    deployment = plans.deployment(
        "D1",
        scenes=(toy_campaign.SCENE,),
        actions=toy_campaign.SPACE,
        loss=Loss(),
        pours=1,
        iterations=4,
        risk=risk,
    )
    plan = toy_plan(directory, deployment=deployment, on_unknown="repeat")
    laboratory = ToyLaboratory(optimizer=ProposingOptimizer())
    return asyncio.run(toy_campaign.run_toy(directory, laboratory, plan=plan, stages=None, resume=resume))


@pytest.mark.slow
def test_killed_on_the_way_it_makes_the_requests_it_would_have_made(tmp_path: Path) -> None:
    result = run_risk(tmp_path / "undisturbed").results["deployment:cup"]
    assert result.risk.measure == "cvar"
    expected = logical_record(tmp_path / "undisturbed")
    for point in (10, 20, 30, 40):
        directory = tmp_path / str(point)
        child = os.fork()
        if child == 0:
            try:
                die_at(point, after_commit=True)
                run_risk(directory)
            finally:
                os._exit(1)
        _, status = os.waitpid(child, 0)
        assert os.WIFSIGNALED(status), f"it ended before write {point}"
        assert run_risk(directory, resume=True).state == "finished"
        assert logical_record(directory) == expected, f"killed at write {point}"
