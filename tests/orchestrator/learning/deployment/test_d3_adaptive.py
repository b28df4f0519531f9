"""`d3`: D3 with its own model: what it says of the simulator, limits that it keeps, and when it ends."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from actors.optimizer.questions import DiscrepancyFound, PourQuery, SceneEvidence
from orchestrator.learning.campaign_plan import CalibrationEvidence
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.deployment.model_monitoring import (
    Believed,
    RiskLimitSettings,
    Rules,
    SimulatorMonitor,
    StopSettings,
    displacement,
    offset_priors,
)
from orchestrator.learning.deployment.real_pours import DeploymentTrial
from orchestrator.learning.requests import Suggest
from orchestrator.learning.stage_result import StageResult
from orchestrator.runs.stages import DEPLOYMENT, with_offsets
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA, StrategyHarness
from sim_engine.liquids import SimulationParameters
from sim_engine.search_space import Axis, Space
from tests.support import plans
from tests.support.plans import deployment_plan
from tests.support.toy_spillage import narrow_cup, narrow_cup_biased


def upside_down(action: Any, theta: Any, rng: Any) -> float:
    return 1.0 - 0.8 * narrow_cup(action, theta, rng)


def adaptive(seed: int = 1, **changes: Any) -> Hybrid:
    plan = deployment_plan(**{"model": "adaptive", "simulations_per_pour": 1, **changes})
    strategy = plan.settings.build(plan, SCENE, THETA, seed)
    assert isinstance(strategy, Hybrid)
    return strategy


def losses(strategy: Hybrid) -> list[float]:
    return [pour.loss for pour in strategy.result().weighed if pour.loss is not None]


def said(strategy: Hybrid) -> list[str]:
    return [decision.text for decision in strategy.decisions if decision.urgent]


def believed(strategy: Hybrid) -> Believed:
    trust = strategy.result().model_check
    assert isinstance(trust, Believed)
    return trust


@pytest.mark.slow
def test_after_every_pour_it_says_how_far_the_simulator_is_to_be_trusted() -> None:
    strategy = adaptive(pours=3)
    StrategyHarness(narrow_cup_biased, narrow_cup, beside=2).run(strategy)
    after = [text for text in said(strategy) if text.startswith("after pour")]
    assert [text.split(" the simulator ")[0] for text in after] == ["after pour 1", "after pour 2", "after pour 3"]
    assert "that it does not describe this bench" in after[-1]
    trust = believed(strategy)
    assert [one.pour for one in trust.after][-3:] == [1, 2, 3]
    assert not trust.alarm
    assert trust.after[-1].ignorance < 0.08


def test_every_pour_is_announced_with_the_band_that_its_row_has() -> None:
    strategy = adaptive(pours=2)
    StrategyHarness(narrow_cup).run(strategy)
    announced = [
        decision for decision in strategy.decisions if "  predicted " in decision.text and "/2 " in decision.text
    ]
    for pour, decision in zip(strategy.result().pours, announced, strict=True):
        assert pour.predicted_interval == (decision.values["low"], decision.values["high"])
        assert "nine pours in ten lie between" in decision.text
        assert 0.0 <= pour.predicted_interval[0] < pour.predicted_interval[1] <= 1.0


def test_prior_simulations_are_not_made_at_one_place() -> None:
    strategy = adaptive(4, pours=1, prior_simulations=24)
    StrategyHarness(narrow_cup).run(strategy)
    points = np.array([ACTIONS.encode(one.action_si) for one in strategy.result().simulated[:24]])
    near = np.linalg.norm(points[:, None] - points[None], axis=2) < 0.02
    assert near.sum(axis=1).max() <= 3


def test_the_last_prior_simulations_are_made_for_the_first_pour() -> None:
    strategy = adaptive(4, pours=1, prior_simulations=24)
    StrategyHarness(narrow_cup).run(strategy)
    (poured,) = strategy.result().weighed
    points = np.array([ACTIONS.encode(one.action_si) for one in strategy.result().simulated[:24]])
    away = np.linalg.norm(points - ACTIONS.encode(poured.action_si), axis=1)
    assert (away[16:] < 0.25).sum() >= 3, "the others are where the hypotheses disagree"
    assert losses(strategy)[0] < 0.05


@pytest.mark.parametrize(
    ("model", "good_from", "expected"),
    [("adaptive", 1, 9), ("adaptive", 14, 18), ("adaptive", 999, 72), ("residual", 14, 9)],
)
def test_simulations_go_on_while_none_is_good(model: str, good_from: int, expected: int) -> None:
    made = 0

    def found_late(action: Any, theta: Any, rng: Any) -> float:
        nonlocal made
        made += 1
        return 0.95 if made < good_from else 0.02

    strategy = adaptive(1, pours=1, prior_simulations=9, simulations_per_pour=0, model=model)
    StrategyHarness(found_late, narrow_cup).run(strategy)
    assert len(strategy.result().simulated) == expected
    assert strategy.progress().of_simulations == expected
    told = [one.text for one in strategy.decisions if "they go on, up to 72 instead of 9" in one.text]
    assert len(told) == (expected > 9)


@pytest.mark.slow
def test_a_bench_that_changes_is_noticed_and_said() -> None:
    poured = 0

    def changing(action: Any, theta: Any, rng: Any) -> float:
        nonlocal poured
        poured += 1
        x = action.x_offset + (0.0 if poured <= 4 else 0.02)
        return narrow_cup(replace(action, x_offset=x), theta, rng)

    strategy = adaptive(1, pours=7, prior_simulations=24)
    StrategyHarness(narrow_cup, changing).run(strategy)
    assert any(text.startswith("since pour 5 the bench behaves differently") for text in said(strategy))
    trust = believed(strategy)
    assert trust.changed_since == 5
    assert "since pour 5" in trust.text
    assert losses(strategy)[-1] < 0.1


@pytest.mark.slow
def test_a_bench_that_drifts_is_followed() -> None:
    poured = 0

    def drifting(action: Any, theta: Any, rng: Any) -> float:
        nonlocal poured
        poured += 1
        return narrow_cup(replace(action, x_offset=action.x_offset + 0.001 * poured), theta, rng)

    strategy = adaptive(1, pours=16, prior_simulations=24)
    StrategyHarness(narrow_cup, drifting).run(strategy)
    assert np.mean(losses(strategy)[10:]) < 0.1


def test_a_drift_is_said_once_and_how_fast() -> None:
    monitor = SimulatorMonitor(Rules(None, "go on", None, None), ACTIONS, 1.0, [])
    still = DiscrepancyFound(0.01, (0.0, 0.0), (0.1, 0.1), 1.0)
    for latest in (still, replace(still, drifts=(0.0, 0.003)), replace(still, drifts=(0.0, 0.004))):
        monitor.record(latest, [])
    assert [decision.text for decision in monitor.decisions if decision.urgent] == [
        "the bench drifts: with every pour, it is as if x_offset were about 0.2 mm more than before; "
        "older pours count less"
    ]


def test_on_a_drifting_bench_a_change_is_said_once_and_none_after_the_drift() -> None:
    monitor = SimulatorMonitor(Rules(None, "go on", None, None), ACTIONS, 1.0, [])
    still = DiscrepancyFound(0.01, (0.0, 0.0), (0.1, 0.1), 1.0)
    pours = [DeploymentTrial(number, (0.5, 0.5), {}, None, 0.01, cost=0.1) for number in range(1, 41)]
    # Since pour 21, dated again after an answer without a change; a drift; and a change that the drift explains.
    answers = {22: (2, None), 23: (None, None), 25: (5, None), 27: (3, None), 30: (None, (0.0, 0.003)), 38: (2, None)}
    for made, (since, drifts) in answers.items():
        monitor.record(replace(still, since_change=since, drifts=drifts), pours[:made])
    said = [decision.text for decision in monitor.decisions if not decision.text.startswith("after pour")]
    assert [text.split(":")[0] for text in said] == ["since pour 21 the bench behaves differently", "the bench drifts"]
    assert "since pour 37 the bench behaves differently" in monitor.text  # the present state is not concealed


def test_a_second_change_long_after_the_first_is_said() -> None:
    monitor = SimulatorMonitor(Rules(None, "go on", None, None), ACTIONS, 1.0, [])
    still = DiscrepancyFound(0.01, (0.0, 0.0), (0.1, 0.1), 1.0)
    pours = [DeploymentTrial(number, (0.5, 0.5), {}, None, 0.01, cost=0.1) for number in range(1, 41)]
    for made, since in {6: 2, 20: 2}.items():
        monitor.record(replace(still, since_change=since), pours[:made])
    assert [decision.text[:13] for decision in monitor.decisions if decision.text.startswith("since")] == [
        "since pour 5 ",
        "since pour 19",
    ]


def test_a_result_with_what_was_said_survives_its_file() -> None:
    strategy = adaptive(pours=2)
    StrategyHarness(narrow_cup).run(strategy)
    result = strategy.result()
    assert StageResult.KINDS[result.kind].model_validate_json(result.model_dump_json()) == result


def test_a_simulator_that_says_nothing_of_the_bench_is_found_out_and_gone_on_without() -> None:
    strategy = adaptive(2, pours=6)
    StrategyHarness(upside_down, narrow_cup).run(strategy)
    trust = believed(strategy)
    assert trust.alarm
    assert any("weighted accordingly" in text for text in said(strategy))
    assert "wrong here" in trust.text
    assert len(losses(strategy)) == 6


@pytest.mark.slow
def test_it_ends_when_no_further_pour_is_worth_it_and_says_how_many_were_saved() -> None:
    strategy = adaptive(pours=12, stop=StopSettings(min_gain=0.01))
    StrategyHarness(narrow_cup).run(strategy)
    made = len(losses(strategy))
    assert made < 12
    assert min(losses(strategy)) < 0.05
    assert any(f"{12 - made} pours saved" in text for text in said(strategy))
    assert strategy.progress().pours == strategy.progress().of_pours == made
    without = adaptive(pours=12)
    StrategyHarness(narrow_cup).run(without)
    assert len(losses(without)) == 12


def test_good_enough_is_the_end() -> None:
    strategy = adaptive(pours=12, good_enough=0.06)
    StrategyHarness(narrow_cup).run(strategy)
    ended = strategy.result().ended
    assert ended is not None
    assert ended.startswith("good enough")
    recommended = strategy.result().recommended
    assert recommended is not None
    assert recommended.predicted_loss <= 0.06


@pytest.mark.slow
@pytest.mark.parametrize("seed", range(3))
def test_a_limit_is_kept_by_every_pour_after_the_first_good_one(seed: int) -> None:
    strategy = adaptive(seed, pours=8, risk_limit=RiskLimitSettings(loss=0.15, probability=0.05, fallback="stop"))
    StrategyHarness(narrow_cup_biased, narrow_cup).run(strategy)
    found = losses(strategy)
    good = next(i for i, loss in enumerate(found) if loss <= 0.15)
    assert max(found[good:]) <= 0.15


@pytest.mark.slow
@pytest.mark.parametrize("limit", [None, RiskLimitSettings()])
def test_with_a_limit_pours_are_made_for_what_they_tell_once_one_has_kept_it(limit: Any) -> None:
    play = StrategyHarness(narrow_cup).run(adaptive(pours=3, risk_limit=limit))
    asked = [one.query.discrepancy for one in play.asked if isinstance(one, Suggest) and one.purpose == "pour"]
    problems = [one for one in asked if one is not None]
    assert [one.lookahead for one in problems] == [limit is None or one.limit is not None for one in problems]
    assert (problems[0].lookahead, problems[-1].lookahead) == (limit is None, True)


@pytest.mark.slow
@pytest.mark.parametrize("otherwise", ["stop", "go on"])
def test_a_limit_that_can_not_be_kept_is_said_before_the_pour(otherwise: Any) -> None:
    limit = RiskLimitSettings(loss=0.02, probability=0.001, fallback=otherwise)
    strategy = adaptive(pours=6, risk_limit=limit)
    StrategyHarness(narrow_cup, lambda a, t, r: 0.0).run(strategy)  # good once, and too noisy to promise it again
    told = [text for text in said(strategy) if "no action is known to keep the limit" in text]
    assert told
    assert (len(losses(strategy)) == 6) == (otherwise == "go on")


def evidence(spill: Any, seed: int = 3) -> CalibrationEvidence:
    """Twelve weighed pours that a simulator of another receiver predicted, or missed."""
    rng = np.random.default_rng(seed)
    points = [tuple(map(float, row)) for row in rng.random((12, 2))]
    simulated = [narrow_cup(SCENE.action(ACTIONS.decode(point)), THETA, rng) for point in points]
    pours = SceneEvidence(tuple(points), tuple(spill(c) for c in simulated), tuple(simulated), 0.4)
    return CalibrationEvidence((pours,), ("12 calibration pours", "not used: 2 pours of another liquid"))


def test_with_a_calibration_the_limit_holds_for_the_first_pour_which_is_expected_to_lose_little() -> None:
    plan = deployment_plan(model="adaptive", simulations_per_pour=1, pours=1, risk_limit=RiskLimitSettings())
    strategy = Hybrid(replace(plan, evidence=evidence(lambda c: c)), SCENE, THETA, 1)
    play = StrategyHarness(narrow_cup).run(strategy)
    pour = next(r.query for r in play.asked if isinstance(r, Suggest) and r.purpose == "pour")
    assert isinstance(pour, PourQuery)
    assert pour.discrepancy is not None
    assert pour.discrepancy.limit is not None
    texts = [decision.text for decision in strategy.decisions]
    assert texts[:2] == ["12 calibration pours", "not used: 2 pours of another liquid"]
    assert not [text for text in texts if "supports the risk limit" in text]
    (first,) = strategy.result().pours
    assert first.predicted is not None
    assert first.predicted < 0.06


def test_without_a_calibration_a_limit_that_does_not_hold_yet_is_said_before_the_first_pour() -> None:
    strategy = adaptive(pours=1, risk_limit=RiskLimitSettings())
    StrategyHarness(narrow_cup).run(strategy)
    (text,) = [text for text in said(strategy) if "no calibration or prior supports the risk limit" in text]
    order = [decision.text for decision in strategy.decisions]
    assert order.index(text) < next(i for i, line in enumerate(order) if line.startswith("pour 1/1"))


@pytest.mark.parametrize(("otherwise", "pours"), [("stop", 0), ("go on", 1)])
def test_where_the_calibration_shows_that_no_first_pour_keeps_the_limit_the_fallback_decides(
    otherwise: Any, pours: int
) -> None:
    limit = RiskLimitSettings(loss=0.05, probability=0.01, fallback=otherwise)
    plan = deployment_plan(model="adaptive", simulations_per_pour=1, pours=1, risk_limit=limit)
    missed = evidence(lambda c: min(max(1.0 - c, 0.0), 1.0))
    strategy = Hybrid(replace(plan, evidence=missed), SCENE, THETA, 1)
    StrategyHarness(narrow_cup).run(strategy)
    assert [text for text in said(strategy) if "no action is known to keep the limit" in text]
    assert len(losses(strategy)) == pours


def test_rules_of_one_model_are_refused_with_another() -> None:
    class Heard:
        any = False

        def __init__(self) -> None:
            self.at: list[Any] = []

        def add(self, text: str, *at: Any, key: bool = False, of: str = "") -> None:
            self.at.append(at)

    heard = Heard()
    deployment_plan(model="residual", stop=StopSettings(), good_enough=0.01).settings.check(heard)
    assert heard.at == [("stop",), ("good_enough",)]


# -- the bench -------------------------------------------------------------------------------------------------------


def test_how_far_a_bench_may_be_off_follows_from_units() -> None:
    speed, offset = offset_priors(ACTIONS)
    assert offset.shift == pytest.approx(0.010 / 0.07)
    assert (speed.shift, speed.factor) == (0.0, 0.05)
    assert speed.origin == pytest.approx(15 / 105)


def test_a_displacement_is_where_the_simulator_does_what_the_bench_does() -> None:
    bench = SimulationParameters(receiver_x=0.007, receiver_z=0.002, tilt_zero=0.01, speed_factor=1.1)
    actions = Space((*ACTIONS.axes, Axis("height", 0.03, 0.1), Axis("max_angle", 1.0, 2.0)))
    moved = displacement(SimulationParameters(), bench, actions)
    commanded = {"angular_velocity": 1.0, "x_offset": 0.1, "height": 0.05, "max_angle": 1.5}
    unit = actions.encode(commanded) * np.array(moved.scales) + np.array(moved.shifts)
    done = actions.decode(unit)
    assert done == pytest.approx({"angular_velocity": 1.1, "x_offset": 0.107, "height": 0.048, "max_angle": 1.51})


@pytest.mark.slow
def test_what_was_learnt_with_one_receiver_is_known_for_the_next() -> None:
    plan = deployment_plan(model="adaptive", pours=4, simulations_per_pour=1)
    first = adaptive(pours=4)
    StrategyHarness(narrow_cup_biased, narrow_cup).run(first)
    learnt = first.result()
    assert isinstance(learnt, Deployed)
    again = Deployed.model_validate_json(learnt.model_dump_json())
    told = with_offsets(plan, {DEPLOYMENT + "first": again}, THETA)
    assert len(told.bench) == 64
    second = Hybrid(told, SCENE, THETA, 2)
    played = StrategyHarness(narrow_cup_biased, narrow_cup).run(second)
    pour = next(r.query for r in played.asked if isinstance(r, Suggest) and r.purpose == "pour")
    assert pour.discrepancy is not None
    assert pour.discrepancy.drawn == told.bench
    assert with_offsets(replace(plan, settings=plan.settings.model_copy(update={"model": "residual"})),
                      {DEPLOYMENT + "first": again}, THETA).bench == ()  # fmt: skip


def test_a_calibration_that_searched_where_the_receiver_stands_is_known_too() -> None:
    best = SimulationParameters(receiver_x=0.004)
    rows = [{"receiver_x": 0.004 + d} for d in (-0.001, 0.0, 0.001)]
    found = plans.calibrated(best, rows)
    assert found.found is not None
    found = found.model_copy(update={"found": found.found.model_copy(update={"searched": ("receiver_x",)})})
    told = with_offsets(deployment_plan(model="adaptive"), {"calibration": found}, best)
    shifts = np.array([one.shifts[1] for one in told.bench]) * 0.07
    assert np.abs(shifts).max() == pytest.approx(0.001)
    nothing = plans.calibrated(best, rows)  # it searched something else
    assert with_offsets(deployment_plan(model="adaptive"), {"calibration": nothing}, best).bench == ()
