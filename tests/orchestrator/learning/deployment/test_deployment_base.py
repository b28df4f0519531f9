"""`deployment_base`: D1, D2 and D3 on worlds whose spillage is a formula."""

import json
import math

import numpy as np
import pytest

from actors.optimizer.questions import Data
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.deployment.d1 import OneShotPlanning
from orchestrator.learning.deployment.d2 import RealOnly
from orchestrator.learning.deployment.d3 import Hybrid
from orchestrator.learning.deployment.deployment_ledger import MAX_REFUSED
from orchestrator.learning.requests import Failed, Pour, Poured, Simulate, Suggest
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import encode_result
from orchestrator.runs.strategy_harness import ACTIONS, SCENE, THETA, StrategyHarness, replay
from sim_engine.outcome import Loss, PourMeasurement
from tests.support.plans import deployment_plan
from tests.support.toy_spillage import narrow_cup, narrow_cup_biased

STRATEGIES = {"D1": OneShotPlanning, "D2": RealOnly, "D3": Hybrid}


def make(name, seed=0, **changes):
    return STRATEGIES[name](deployment_plan(strategy=name, **changes), SCENE, THETA, seed)


def quiet_spill(values):
    class Quiet:
        def standard_normal(self):
            return 0.0

    return narrow_cup(SCENE.action(values), THETA, Quiet())


@pytest.mark.parametrize("name", STRATEGIES)
def test_a_campaign_stays_in_its_box_keeps_its_budget_and_reports_json(name):
    strategy = make(name, pours=5)
    assert isinstance(strategy, Strategy)
    played = StrategyHarness(narrow_cup).run(strategy)
    assert len(played.pours) == (1 if name == "D1" else 5)
    assert len(played.simulations) == {"D1": 30, "D2": 0, "D3": 20}[name]
    for request in (*played.pours, *played.simulations):
        assert ACTIONS.contains(
            {"angular_velocity": request.action.angular_velocity, "x_offset": request.action.x_offset}
        )
    result = strategy.result()
    assert json.loads(json.dumps(encode_result(result), allow_nan=False))["strategy"] == name
    assert (strategy.progress().simulations_left, strategy.progress().pours_left) == (0, 0)
    assert set(result.recommended.action) == {"angular_velocity_deg_s", "x_offset_mm"}
    assert 15 <= result.recommended.action["angular_velocity_deg_s"] <= 120
    assert np.array(result.map.mean).shape == (25, 25)


@pytest.mark.parametrize("name", STRATEGIES)
def test_same_seed_same_requests_and_a_replay_repeats_them(name):
    def campaign(order="first", seed=3):
        return StrategyHarness(narrow_cup, narrow_cup_biased, order=order, slots=3).run(
            make(name, seed, pours=3, simulations_per_pour=2)
        )

    first = campaign()
    assert campaign().asked == first.asked
    late = campaign("last")
    assert (late.simulations, late.pours) == (first.simulations, first.pours)
    assert campaign(seed=4).asked != first.asked
    assert replay(make(name, 3, pours=3, simulations_per_pour=2), first) == first.asked


@pytest.mark.slow
def test_with_a_right_simulator_the_first_pours_of_d3_spill_less_than_those_of_d2():
    first = {
        name: np.mean([StrategyHarness(narrow_cup).run(make(name, seed, pours=3)).real_spills for seed in range(4)])
        for name in ("D2", "D3")
    }
    assert first["D3"] < 0.5 * first["D2"]


@pytest.mark.slow
def test_pours_improve_on_a_simulator_that_is_somewhat_wrong():
    firsts, bests = [], []
    for seed in range(3):
        spills = StrategyHarness(narrow_cup_biased, narrow_cup).run(make("D3", seed, pours=8)).real_spills
        firsts.append(spills[0])
        bests.append(min(spills))
    assert np.mean(bests) < 0.5 * np.mean(firsts)


def test_d1_recommends_an_action_that_spills_little_and_needs_no_pour():
    values = []
    for seed in range(3):
        strategy = make("D1", seed, pours=0)
        assert StrategyHarness(narrow_cup).run(strategy).pours == []
        values.append(quiet_spill(strategy.best_values))
        result = strategy.result()
        assert abs(result.recommended.predicted_loss - values[-1]) < 0.1
        assert result.recommended.predicted_deviation > 0.0
    assert np.mean(values) < 0.05


def test_d1_averages_its_simulations_of_an_action():
    played = StrategyHarness(narrow_cup).run(make("D1", iterations=6, simulations_per_iteration=3))
    actions = [r.action for r in played.simulations]
    assert len(actions) == 18
    assert len(set(actions)) == 6
    assert len({r.seed for r in played.simulations}) == 18


def test_d1_predicts_the_spillage_of_its_action_whatever_it_minimised():
    strategy = make("D1", pours=0, loss=Loss(name="grams"))
    told = StrategyHarness(lambda *pour: 0.1 + 0.5 * narrow_cup(*pour)).run(strategy).told
    result = strategy.result()
    chosen = SCENE.action(result.recommended.action_si)
    simulated = [o.outcome.fractions for r, o in told if isinstance(r, Simulate) and r.action == chosen]
    assert len(simulated) == 2
    assert result.recommended.predicted_spillage == pytest.approx(np.mean([f.spilled / f.poured for f in simulated]))
    assert result.recommended.predicted_loss > 10 * result.recommended.predicted_spillage  # in grams of 200


@pytest.mark.slow
def test_a_zero_mean_pours_worse_than_a_constant_one():
    # to a zero mean everything unexplored is perfect, so that it tries the corners of the plateau one by one
    spills = {
        mean: np.mean(
            [StrategyHarness(narrow_cup).run(make("D2", s, pours=15, mean=mean)).real_spills[6:] for s in range(8)]
        )
        for mean in ("constant", "zero")
    }
    assert spills["constant"] < spills["zero"]


def test_d3_asks_for_a_pour_and_the_simulations_beside_it_together():
    strategy = make("D3", pours=4, simulations_per_pour=2)
    played = StrategyHarness(narrow_cup, slots=2).run(strategy)
    assert [r.purpose for r in played.simulations] == ["prior"] * 20 + ["refine"] * 8
    pour = next(i for i, r in enumerate(played.asked) if isinstance(r, Pour))
    assert [type(r) for r in played.asked[pour : pour + 3]] == [Pour, Simulate, Simulate]
    questions = [r.query for r in played.asked if isinstance(r, Suggest) and r.purpose == "pour"]
    assert [len(q.simulated) for q in questions] == [20, 22, 24, 26]
    assert [len(q.data) for q in questions] == [0, 1, 2, 3]


def test_failed_simulations_and_pours_never_poison_a_fit():
    def flaky(action, theta, rng):
        return math.nan if rng.random() < 0.3 else narrow_cup(action, theta, rng)

    for name in STRATEGIES:
        played = StrategyHarness(flaky).run(make(name, 2, pours=6))
        queries = [r.query for r in played.asked if isinstance(r, Suggest)]
        costs = [c for query in queries for c in getattr(query, "data", Data()).costs]
        assert all(math.isfinite(c) and c <= 1.0 for c in costs)


def test_a_failed_pour_counts_and_enters_the_data_as_the_worst():
    def second_fails(request):
        lost = isinstance(request, Pour) and request.number == 2
        return Failed("pour_failed", "the operator knocked the cup over") if lost else None

    strategy = make("D2", pours=4)
    played = StrategyHarness(narrow_cup, answer=second_fails).run(strategy)
    assert [r.number for r in played.pours] == [1, 2, 3, 4]
    final = [r for r in played.asked if isinstance(r, Suggest)][-1].query
    assert len(final.data) == 4
    row = strategy.result().pours[1]
    assert (row.status, row.loss) == ("failed", 1.0)


@pytest.mark.parametrize(
    ("name", "changes", "warns"),
    [
        ("D2", {}, True),
        ("D3", {"model": "adaptive"}, True),
        ("D3", {"model": "residual"}, False),
    ],
)
def test_a_pour_that_went_wrong_is_a_warning_of_more_near_it_but_not_in_the_paper(name, changes, warns):
    def second_touches_third_is_not_weighed(request):
        number = request.number if isinstance(request, Pour) else 0
        nothing = PourMeasurement(SCENE.liquid.mass, math.nan, 0.0)
        return {2: Failed("pour_failed", "cups touch after all"), 3: Poured(nothing)}.get(number)

    strategy = make(name, pours=5, **changes)
    played = StrategyHarness(narrow_cup, answer=second_touches_third_is_not_weighed).run(strategy)
    assert [pour.status for pour in strategy.result().pours].count("failed") == 2
    second = ACTIONS.encode(played.pours[1].action.values())
    last = [request for request in played.asked if isinstance(request, Suggest)][-1].query
    assert [pytest.approx(point) for point in last.failed] == ([second] if warns else [])


@pytest.mark.slow
def test_touching_vessels_are_avoided_and_cost_no_pour():
    def touches_when_near(action, theta, rng):
        if action.x_offset < 0.10:
            raise ValueError("cups touch; x_offset ≥ 100 mm would clear it")
        return narrow_cup(action, theta, rng)

    strategy = make("D2", 1, pours=8)
    played = StrategyHarness(touches_when_near).run(strategy)
    result = strategy.result()
    assert result.refused_pours > 0
    assert len(played.real_spills) == 8
    numbers = [r.number for r in result.pours]
    assert sorted(set(numbers)) == numbers, "a refused pour keeps its number"
    assert [r.status for r in result.pours].count("weighed") == 8
    hybrid = make("D3", 1, pours=4, model="adaptive")
    StrategyHarness(touches_when_near).run(hybrid)
    assert hybrid.result().refused_pours <= 1  # simulations have told most of it
    assert hybrid.best_values["x_offset"] >= 0.10


def test_a_space_without_a_possible_action_ends_with_an_explanation():
    def never(action, theta, rng):
        raise ValueError("cups touch")

    strategy = make("D2", pours=3)
    played = StrategyHarness(never).run(strategy)
    assert len(played.pours) == MAX_REFUSED
    assert "refused as invalid" in strategy.result().gave_up


def test_a_simulator_that_is_wrong_raises_the_alarm_and_a_right_one_does_not():
    def upside_down(action, theta, rng):
        return 1.0 - narrow_cup(action, theta, rng)

    wrong, right = make("D3", 1, pours=5), make("D3", 1, pours=5)
    StrategyHarness(upside_down, narrow_cup).run(wrong)
    StrategyHarness(narrow_cup).run(right)
    assert wrong.result().model_check.alarm
    assert not right.result().model_check.alarm


@pytest.mark.parametrize(
    ("loss", "worst"),
    [(Loss(), 1.0), (Loss(retained_weight=3.0), 3.0), (Loss(name="normalised"), 1.0), (Loss(name="grams"), 200.0)],
)
def test_the_worst_loss_is_as_bad_as_spilling_or_keeping_everything(loss, worst):
    costing = Costing(loss, SCENE, THETA)
    assert costing.worst == pytest.approx(worst)
    kept = PourMeasurement(loaded=0.2, spilled=0.0, retained=0.2)
    if loss.name == "normalised":  # undefined, and not pouring is not a solution
        assert costing.poured(kept, SCENE.action({"angular_velocity": 1.0})) == worst


def test_an_answer_nobody_asked_for_is_refused():
    strategy = make("D3")
    with pytest.raises(ValueError, match="not asked for"):
        strategy.tell(Pour("cup", SCENE.action({"angular_velocity": 1.0}), 1, 1), Poured(PourMeasurement(1, 0, 0)))


def wide_region(action, _, rng):
    """Nothing is lost between 40 and 110 deg/s, except for scatter; a little less at the fast end."""
    speed = math.degrees(action.angular_velocity)
    lost = 0.005 * max(40.0 - speed, speed - 110.0, 0.0)
    return float(np.clip(lost + 1e-5 * (120.0 - speed) + 2e-4 * abs(rng.standard_normal()), 0.0, 1.0))


@pytest.mark.parametrize("name", STRATEGIES)
def test_of_actions_that_lose_nothing_a_slow_one_is_recommended_with_the_width_of_the_region(name):
    strategy = make(name, seed=1, pours=10)
    StrategyHarness(wide_region).run(strategy)
    recommended = strategy.result().recommended
    low, high = recommended.equal_ranges["angular_velocity"]
    assert math.degrees(high - low) > 30.0
    assert low <= recommended.action_si["angular_velocity"] <= low + 0.62 * (high - low)
    assert recommended.predicted_loss < 0.005
