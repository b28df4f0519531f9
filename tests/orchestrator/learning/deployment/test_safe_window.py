"""`safe_window`: the safe window: inside the true one, checked where it ends, shown, and gone on with after a kill."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.disturbances import RiskSettings
from orchestrator.learning.deployment.safe_window import ROUNDS, SafeWindow
from orchestrator.learning.requests import Failed, Simulate
from orchestrator.reports.loss_units import loss_unit
from orchestrator.reports.run_figures import draw_figures
from orchestrator.reports.wording import risk_line, window_line
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA, StrategyHarness, executed
from sim_engine.outcome import Loss
from sim_engine.scene import PoseError
from tests.support import plans, toy_campaign
from tests.support.example_results import changed, is_picture
from tests.support.killed_runs import die_at
from tests.support.plans import deployment_plan
from tests.support.toy_campaign import ToyLaboratory, logical_record, toy_plan
from tests.support.toy_spillage import quiet_valleys, two_valleys

ERRORS = PoseError(x=8e-3, speed_factor=0.03)
CENTRE = (0.5, 0.7)


def planned(seed: int, tolerance: float, risk: RiskSettings | None = None, spill: Any = two_valleys) -> dict[str, Any]:
    plan = deployment_plan(
        strategy="D1", pours=0, iterations=12, simulations_per_iteration=3, risk=risk, window=plans.window(tolerance)
    )
    strategy = OneShotPlanning(plan, SCENE, THETA, seed)
    StrategyHarness(spill).run(strategy)
    return strategy.result()


def true_loss(values: dict[str, float], risk: RiskSettings | None) -> float:
    action = SCENE.action(values)
    if risk is None:
        return quiet_valleys(action)
    rng = np.random.default_rng(3)
    errors = [PoseError(x=8e-3 * a, speed_factor=1 + 0.03 * b) for a, b in rng.standard_normal((300, 2))]
    losses = np.sort([quiet_valleys(executed(action, error)) for error in errors])
    return float(losses[int(risk.tail * len(losses)) :].mean())


@pytest.mark.parametrize(
    ("tolerance", "risk", "slack"),
    [
        (0.2, None, 0.01),
        (0.3, plans.risk("expected", pose_error=ERRORS), 0.04),
        (0.7, plans.risk("cvar", 0.8, ERRORS), 0.08),
    ],
    ids=["executed exactly", "expected", "cvar"],
)
def test_the_window_lies_within_the_true_one_and_is_no_sliver_of_it(
    tolerance: float, risk: RiskSettings | None, slack: float
) -> None:
    result = planned(1, tolerance, risk)
    window, action = result.window, result.recommended.action_si
    axis = ACTIONS.axes[ACTIONS.names.index("x_offset")]
    ends = window.axes["x_offset"]
    inside = [true_loss({**action, "x_offset": x}, risk) for x in np.linspace(ends.low, ends.high, 15)]
    assert max(inside) <= tolerance + slack
    everywhere = np.linspace(axis.lower, axis.upper, 36)
    truly = [x for x in everywhere if true_loss({**action, "x_offset": x}, risk) <= tolerance]
    around = [x for x in truly if abs(x - action["x_offset"]) < 0.02]
    assert ends.high - ends.low > 0.5 * (max(around) - min(around))


def test_every_end_was_simulated_and_all_simulations_are_counted() -> None:
    window = planned(2, 0.2).window
    for name, ends in window.axes.items():
        checked = {round(c.action_si[name], 9) for c in window.checks if c.axis == name and c.inside}
        assert {round(ends.low, 9), round(ends.high, 9)} <= checked
    assert window.simulations == 3 * len(window.checks)
    assert all(check.loss <= 0.2 for check in window.checks if check.inside)


def test_an_end_that_fails_its_check_is_moved_inwards() -> None:
    """The surrogate sees no wall at 146 mm, where nobody had simulated; the checks do."""
    window = SafeWindow(ACTIONS, CENTRE, 0.1)
    window.outline([0.05] * len(window.places))
    rounds = 0
    while checks := window.next_checks():
        rounds += 1
        for check in checks:
            value = ACTIONS.decode(check.point)["x_offset"]
            window.judge(check, 0.5 if value > 0.146 else 0.05)
    ends: Any = window.result(0).axes
    assert 0.144 < ends["x_offset"].high <= 0.146
    assert ends["x_offset"].low == pytest.approx(0.08)
    assert ends["x_offset"].cut_off == ("low",)
    assert rounds <= ROUNDS


def test_a_hole_halfway_cuts_the_window_though_the_end_passed() -> None:
    window = SafeWindow(ACTIONS, CENTRE, 0.1)
    window.outline([0.05] * len(window.places))
    while checks := window.next_checks():
        for check in checks:
            window.judge(check, 0.5 if 0.135 < ACTIONS.decode(check.point)["x_offset"] < 0.145 else 0.05)
    ends: Any = window.result(0).axes
    assert ends["x_offset"].high <= 0.135


def test_without_an_answer_nothing_is_called_safe() -> None:
    window = SafeWindow(ACTIONS, CENTRE, 0.1)
    window.outline([0.05] * len(window.places))
    for check in window.next_checks():
        window.judge(check, None)
    assert window.next_checks() == []
    assert window.closed
    assert window.result(0).axes == {}


def test_where_the_action_itself_spills_more_there_is_no_window_and_it_says_so() -> None:
    window = planned(1, 0.01, spill=lambda *pour: 0.05 + 0.9 * two_valleys(*pour)).window
    assert window.axes == {}
    assert "none; the loss of the action itself exceeds 1.00 %" in window_line(window, loss_unit(Loss()))


def test_the_luck_of_few_errors_is_allowed_for() -> None:
    window = SafeWindow(ACTIONS, CENTRE, 0.1)
    window.outline([0.05] * len(window.places))
    window.allow_for([0.05] * len(window.places), [0.02] * len(window.places))
    for check in window.next_checks():
        window.judge(check, 0.08)  # these few spill 0.03 less than all would
    assert window.result(0).axes == {}


def test_cups_that_touch_are_outside() -> None:
    plan = deployment_plan(strategy="D1", pours=0, iterations=8, window=plans.window(0.9))
    strategy = OneShotPlanning(plan, SCENE, THETA, 1)

    def touching(request: Any) -> Any:
        far = isinstance(request, Simulate) and request.purpose == "window" and request.action.x_offset > 0.135
        return Failed("invalid_action", "cups touch") if far else None

    StrategyHarness(two_valleys, answer=touching).run(strategy)
    window: Any = strategy.result().window
    assert window.axes["x_offset"].high <= 0.135
    touched = [check for check in window.checks if check.action_si["x_offset"] > 0.135]
    assert touched
    assert all(check.loss is None and not check.inside for check in touched)


def test_a_plan_without_a_window_asks_for_what_it_always_did() -> None:
    def asked(tolerance: float | None) -> list[Any]:
        plan = deployment_plan(strategy="D1", pours=0, iterations=6, window=plans.window(tolerance))
        return StrategyHarness(two_valleys).run(OneShotPlanning(plan, SCENE, THETA, 1)).asked

    plain, checked = asked(None), asked(0.3)
    assert checked[: len(plain)] == plain
    assert all(request.purpose == "window" for request in checked[len(plain) :])


@pytest.mark.slow
def test_the_window_is_told_and_drawn(tmp_path: Path) -> None:
    result = planned(1, 0.5, plans.risk("cvar", 0.5, ERRORS))
    text = window_line(result.window, loss_unit(Loss()))
    assert f"checked by {result.window.simulations} simulations" in text
    low, high = (1e3 * getattr(result.window.axes["x_offset"], way) for way in ("low", "high"))
    assert f"x offset {low:.4g} … {high:.4g} mm" in text
    assert "CVaR 50 %" in risk_line(result.risk, loss_unit(Loss()))
    deployment = deployment_plan(strategy="D1", pours=0, window=plans.window(0.3))
    plan = toy_plan(tmp_path, deployment=deployment)
    drawn = draw_figures(tmp_path, plan, {"deployment:cup": result})
    assert is_picture(drawn["safe window cup"])
    mapless = changed(result, map=None)
    assert is_picture(draw_figures(tmp_path, plan, {"deployment:cup": mapless})["safe window cup"])


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
        window=plans.window(0.3),
    )
    plan = toy_plan(directory, deployment=deployment, on_unknown="repeat")
    laboratory = ToyLaboratory(optimizer=ProposingOptimizer())
    return asyncio.run(toy_campaign.run_toy(directory, laboratory, plan=plan, stages=None, resume=resume))


@pytest.mark.slow
def test_killed_on_the_way_it_makes_the_requests_it_would_have_made(tmp_path: Path) -> None:
    result = run_risk(tmp_path / "undisturbed").results["deployment:cup"]
    assert result.window.checks
    assert result.risk.measure == "cvar"
    expected = logical_record(tmp_path / "undisturbed")
    for point in (15, 40, 70, 100):
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
