"""`suggest`: averaging over the ways in which a simulator can be wrong, and pours chosen by what they lose on the
way.
"""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.distance import cdist

from actors.optimizer import knowledge_gradient
from actors.optimizer.knowledge_gradient import predicted_minimum
from actors.optimizer.prediction_intervals import highest_density_intervals
from actors.optimizer.questions import (
    BenchOffset,
    Data,
    Limit,
    MinimumQuery,
    ModelDiscrepancy,
    OffsetPrior,
    PourQuery,
    SceneEvidence,
    SuggestionQuery,
)
from actors.optimizer.suggest import propose
from actors.optimizer.surrogate_models import QueryArrays, fit
from orchestrator.records.codec import canonical, from_json, to_json
from sim_engine.search_space import Axis, Space

PLANE = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))
PRIORS = (OffsetPrior(shift=0.14), OffsetPrior(factor=0.05, origin=0.2))
ASK = tuple((x, y) for x in (0.15, 0.4, 0.65, 0.9) for y in (0.1, 0.35, 0.6, 0.85))
MOVED = (0.12, 0.0)


def data_of(points, costs) -> Data:
    return Data(tuple(tuple(map(float, p)) for p in points), tuple(map(float, costs)))


def cup(points):
    """Nothing lost in a valley, all far from it."""
    radius = np.linalg.norm(np.atleast_2d(points) - (0.35, 0.6), axis=1)
    return 1.0 - np.exp(-((6.0 * np.maximum(radius - 0.08, 0.0)) ** 1.5))


def displaced(points):
    """What a simulator says that sees the receiver elsewhere."""
    return cup(np.atleast_2d(points) - MOVED)


def shelf(points):
    """Next to nothing lost on half of the box, and nearly the same all over it; all beyond an edge."""
    y = np.atleast_2d(points)[:, 1]
    return 0.066 + 0.9 * np.clip(0.35 - y, 0.0, 0.35) / 0.35


def asked(simulator, poured, **changes):
    """A query after 60 simulations and some pours."""
    simulated = np.random.default_rng(1).random((60, 2))
    query = PourQuery(
        PLANE,
        data_of(poured, cup(poured)) if len(poured) else Data(),
        simulated=data_of(simulated, simulator(simulated)),
        discrepancy=ModelDiscrepancy(PRIORS, pours_left=10),
    )
    return replace(query, **changes)


def error(answer):
    return float(np.sqrt(np.mean((np.array(answer.predictions) - cup(ASK)) ** 2)))


def averaged(question):
    """The hypotheses as that question weighs them."""
    return fit(question, QueryArrays.of(question)).averaged


POURED = [(0.47, 0.6), (0.3, 0.75), (0.42, 0.45), (0.2, 0.5)]


def calibrated(weighed, power=0.4):
    """Twelve pours into another receiver, simulated as `cup`, and weighed as another function says."""
    points = np.random.default_rng(5).random((12, 2))
    return (SceneEvidence(tuple(map(tuple, points)), tuple(weighed(points)), tuple(cup(points)), power),)


def first_pour(calibration):
    discrepancy = ModelDiscrepancy(PRIORS, pours_left=10, calibration=calibration)
    return propose(asked(cup, [], acquisition="least_loss", discrepancy=discrepancy))


def width(answer):
    return answer.bands[0][1] - answer.bands[0][0]


def test_pours_that_the_simulator_predicted_narrow_what_the_first_pour_is_expected_to_lose():
    without, known = first_pour(None), first_pour(calibrated(cup))
    assert known.means[0] < 0.25 * without.means[0]
    assert width(known) < 0.3 * width(without)
    assert known.discrepancy.uninformative < 0.01
    assert width(known) < width(first_pour(calibrated(cup, power=0.1))) < width(without)


def test_pours_that_the_simulator_missed_widen_what_the_first_pour_may_lose():
    def missed(points):
        return np.clip(cup(points) + 0.15 * np.sin(9.0 * points[:, 0]), 0.0, 1.0)

    assert width(first_pour(calibrated(missed))) > 2.0 * width(first_pour(calibrated(cup)))
    contradicted = first_pour(calibrated(lambda points: 1.0 - cup(points), power=1.0))
    assert contradicted.discrepancy.uninformative > 0.5


def test_after_a_calibration_errors_are_small_where_the_simulator_predicts_a_small_loss():
    places = np.random.default_rng(5).random((400, 2))
    small, larger = places[cup(places) < 0.002], places[(cup(places) > 0.1) & (cup(places) < 0.3)]
    for calibration, least in ((calibrated(cup, power=1.0), 1.5), (None, 0.9)):
        discrepancy = ModelDiscrepancy(PRIORS, pours_left=10, calibration=calibration)
        deviations = averaged(asked(cup, [], discrepancy=discrepancy)).components
        ratio = np.median(deviations(larger)[1]) / np.median(deviations(small)[1])
        assert least < ratio < least + 1.0


def test_pours_into_the_same_receiver_show_where_the_simulator_misses_and_another_one_does_not_share_it():
    best = np.array([[0.4, 0.6]])

    def spot(points):
        """More is lost next to the best simulated action."""
        return np.clip(cup(points) + 0.3 * np.exp(-(((points - best) / 0.15) ** 2).sum(axis=1)), 0.0, 1.0)

    points = np.concatenate([np.random.default_rng(5).random((20, 2)), best])
    expected = {}
    for power in (1.0, 0.84):
        pours = SceneEvidence(tuple(map(tuple, points)), tuple(spot(points)), tuple(cup(points)), power)
        discrepancy = ModelDiscrepancy(PRIORS, pours_left=10, calibration=(pours,))
        expected[power] = float(averaged(asked(cup, [], discrepancy=discrepancy)).predict(best)[0][0])
    assert expected[1.0] == pytest.approx(spot(best)[0], rel=0.2)
    assert expected[0.84] < 0.7 * spot(best)[0]


def test_pours_of_an_earlier_campaign_count_less_and_together_with_a_calibration_more():
    known, earlier = calibrated(cup), (replace(calibrated(cup)[0], misled=0.2),)
    without, doubted, trusted, both = (first_pour(pours) for pours in (None, earlier, known, known + earlier))
    assert trusted.means[0] < doubted.means[0] < 0.4 * without.means[0]
    shares = [answer.discrepancy.uninformative for answer in (without, doubted, trusted, both)]
    assert shares[1] == pytest.approx(0.2 * shares[0], rel=0.1)  # with this probability they say nothing
    assert shares[3] < 0.3 * shares[2]
    with pytest.raises(ValueError, match=r"misled = 1\.2 is outside"):
        first_pour((replace(known[0], misled=1.2),))


def test_of_actions_that_look_alike_the_first_pour_is_the_one_that_is_safest_without_calibration(monkeypatch):
    def gutter(points):
        """Next to nothing lost along a valley: a little less towards its far end, where it is narrow."""
        x, y = np.atleast_2d(points).T
        outside = np.maximum(np.abs(y - 0.5) - 0.1 * (1.2 - x), 0.0)
        return 0.02 * (1.0 - x) + 1.0 - np.exp(-((6.0 * outside) ** 1.5))

    points = np.random.default_rng(5).random((12, 2))
    known = (SceneEvidence(tuple(map(tuple, points)), tuple(gutter(points)), tuple(gutter(points)), 0.99),)
    discrepancy = ModelDiscrepancy(PRIORS, pours_left=10, calibration=known)
    question = asked(gutter, [], acquisition="least_loss", discrepancy=discrepancy)
    chosen, without = propose(question), propose(replace(question, discrepancy=replace(discrepancy, calibration=None)))
    monkeypatch.setattr(knowledge_gradient, "RESOLUTION", 0.0)
    greedy = propose(question)
    assert np.linalg.norm(np.subtract(chosen.points[0], without.points[0])) < 0.15
    assert np.linalg.norm(np.subtract(greedy.points[0], without.points[0])) > 0.3
    assert chosen.means[0] < greedy.means[0] + 0.01  # it costs no more than the resolution of a loss


@pytest.mark.parametrize("lost", [0.6, 0.98])
@pytest.mark.parametrize("power", [0.84, 1.0])
def test_after_one_pour_that_a_calibration_did_not_expect_it_is_doubted_as_without_calibration(power, lost):
    place = first_pour(calibrated(cup, power=power)).points[0]
    without, known = (
        propose(asked(cup, [], data=data_of([place], [lost]), acquisition="least_loss", discrepancy=discrepancy))
        for discrepancy in (
            ModelDiscrepancy(PRIORS, pours_left=9),
            ModelDiscrepancy(PRIORS, pours_left=9, calibration=calibrated(cup, power=power)),
        )
    )
    if power < 1.0:  # in the same receiver something has changed, rather than that the simulator knows nothing
        assert known.discrepancy.uninformative > 0.7 * without.discrepancy.uninformative
    assert max(known.discrepancy.deviations) > 0.7 * max(without.discrepancy.deviations)
    assert width(known) > 0.7 * width(without)


def test_pours_of_a_calibration_without_their_simulations_are_refused():
    known = replace(calibrated(cup)[0], simulated=(0.1,))
    with pytest.raises(ValueError, match="calibration: two pours at least"):
        first_pour((known,))


def test_pours_tell_by_how_much_the_receiver_is_displaced():
    answer = propose(asked(displaced, POURED, count=0))
    found = answer.discrepancy
    assert found.shifts[0] == pytest.approx(MOVED[0], abs=2.5 * found.deviations[0])
    assert found.deviations[0] < 0.5 * propose(asked(displaced, [], count=0)).discrepancy.deviations[0]


def test_pours_that_no_displacement_explains_make_the_simulator_uninformative():
    poured = [(0.9, 0.1), (0.1, 0.1), (0.35, 0.6), (0.9, 0.9), (0.6, 0.3)]
    right = propose(asked(cup, poured, count=0)).discrepancy
    wrong = propose(asked(lambda x: 1.0 - 0.8 * cup(x), poured, count=0)).discrepancy
    before = propose(asked(cup, [], count=0)).discrepancy
    assert before.uninformative == pytest.approx(0.08)
    assert right.uninformative < 0.02
    assert wrong.uninformative > 0.9


def test_after_a_pour_that_lost_all_in_place_of_little_the_next_goes_where_the_simulator_sees_most_lost():
    question = asked(lambda x: 1.0 - 0.8 * cup(x), [], acquisition="least_loss", count=1)
    first = propose(question).points[0]
    assert cup(first)[0] > 0.9
    second = propose(
        replace(question, data=data_of([first], cup(first)), discrepancy=ModelDiscrepancy(PRIORS, pours_left=9))
    )
    assert cup(second.points[0])[0] < 0.1
    assert second.discrepancy.uninformative > 0.5


@pytest.mark.parametrize(("simulated_width", "factor"), [(1.4, 1.1), (0.7, 0.97)])
def test_pours_tell_that_the_valley_is_narrower_or_wider_than_simulated(simulated_width, factor):
    def widened(points):
        return cup((0.35, 0.6) + (np.atleast_2d(points) - (0.35, 0.6)) / simulated_width)

    hypotheses, weights = averaged(asked(widened, [*POURED, (0.35, 0.6), (0.5, 0.6), (0.25, 0.7)])).heaviest
    found = float(np.exp(weights @ hypotheses.widths / weights.sum()))
    assert (found > factor) if simulated_width > 1.0 else (found < factor)


def test_a_pour_where_hypotheses_differ_promises_more_than_one_where_all_is_lost_anyway():
    model = averaged(asked(displaced, [(0.9, 0.1)]))
    everywhere = np.random.default_rng(0).random((200, 2))
    now = float(model.predict(everywhere)[0].min())
    slope, plateau = predicted_minimum(model, np.array([(0.6, 0.6), (0.95, 0.05)]), everywhere)
    assert slope < 0.8 * now
    assert plateau == pytest.approx(now, rel=0.05)


def test_the_first_pour_goes_where_least_is_lost_however_many_follow():
    question = asked(shelf, [], acquisition="least_loss")
    everywhere = tuple((x, y) for x in np.linspace(0, 1, 21) for y in np.linspace(0, 1, 21))
    grid = replace(question, count=0, predict_at=everywhere)
    assert propose(question).means[0] < min(propose(grid).predictions) + 0.001


def test_before_any_pour_the_simulator_is_expected_to_be_nearly_right():
    first = propose(asked(cup, [], acquisition="least_loss"))
    assert cup(first.points[0])[0] < 0.01
    assert first.means[0] < 0.28  # 0.30 if it were as likely to be far off


@pytest.mark.parametrize("middle", [0.004, 0.4, 0.99])
def test_a_band_is_the_shortest_interval_that_holds_nine_pours_in_ten(middle):
    weights, means, deviations = np.array([0.7, 0.3]), np.array([[middle], [middle]]), np.array([[0.01], [0.06]])
    rng = np.random.default_rng(0)
    chosen = (rng.random(100_000) < 0.3).astype(int)
    drawn = np.clip(middle + deviations[chosen, 0] * rng.standard_normal(100_000), 0.0, 1.0)
    low, high = highest_density_intervals(weights, means, deviations, 0.9)[0]
    assert np.mean((drawn >= low) & (drawn <= high)) == pytest.approx(0.9, abs=0.01)
    equal = np.quantile(drawn, [0.05, 0.95])
    assert high - low < (0.85 if middle != 0.4 else 1.005) * (equal[1] - equal[0])


def test_most_pours_lie_in_the_bands_that_come_with_them():
    answer = propose(asked(displaced, POURED, acquisition="least_loss", count=1))
    low, high = answer.bands[0]
    assert 0.0 <= low <= cup(answer.points[0])[0] <= high
    assert high < answer.means[0] + 2.0 * float(np.hypot(answer.deviations, answer.noises)[0])


@pytest.mark.slow
def test_intervals_hold_the_share_of_pours_that_they_state():
    """Benches displaced as the priors say; pours all over the box, predicted after three others."""
    inside, number = {0.5: 0, 0.9: 0, 0.99: 0}, 0
    for bench in range(20):
        rng = np.random.default_rng(bench)
        moved = rng.standard_normal(2) * (0.14, 0.02)
        poured, ahead = rng.random((3, 2)), rng.random((12, 2))
        model = averaged(asked(lambda x, moved=moved: cup(np.atleast_2d(x) - moved), poured))
        lost = np.clip(cup(ahead) * (1.0 + 0.03 * rng.standard_normal(12)), 0.0, 1.0)
        number += len(lost)
        for level in inside:
            low, high = model.bands(ahead, level).T
            inside[level] += int(((low <= lost) & (lost <= high)).sum())
    assert 0.45 < inside[0.5] / number < 0.6
    assert 0.84 < inside[0.9] / number < 0.97
    assert inside[0.99] / number > 0.95


def test_with_something_good_in_hand_no_unknown_corner_is_tried():
    poured = [*POURED, (0.35, 0.6)]
    careful = propose(asked(cup, poured, acquisition="least_loss"))
    daring = propose(MinimumQuery(PLANE, data_of(poured, cup(poured)), plain=True))
    assert cup(careful.points[0])[0] < 0.02 < cup(daring.points[0])[0]
    assert careful.discrepancy.gain < 0.02


def test_with_nothing_in_hand_the_pours_that_follow_make_it_worth_looking_elsewhere():
    poured = [(0.1, 0.1), (0.9, 0.1)]
    wrong = asked(lambda x: 1.0 - 0.8 * cup(x), poured, acquisition="least_loss")
    last = propose(replace(wrong, discrepancy=replace(wrong.discrepancy, pours_left=0)))
    first = propose(wrong)
    assert first.discrepancy.gain > 0.1
    assert first.means[0] > last.means[0]


def test_a_limit_is_kept_where_any_action_keeps_it_and_told_where_none_does():
    limit = Limit(0.1, 0.05)
    question = asked(displaced, [*POURED, (0.35, 0.6)], acquisition="least_loss")
    kept = propose(replace(question, discrepancy=replace(question.discrepancy, limit=limit))).discrepancy
    assert kept.least_exceedance <= kept.exceedances[0] <= limit.probability
    hopeless = asked(lambda x: 1.0 - 0.8 * cup(x), [(0.1, 0.1)], acquisition="least_loss")
    told = propose(replace(hopeless, discrepancy=replace(hopeless.discrepancy, limit=limit))).discrepancy
    assert told.least_exceedance > limit.probability


def test_simulations_beside_a_pour_are_made_around_what_is_in_doubt():
    answer = propose(asked(displaced, POURED, acquisition="least_loss", count=4))
    beside = np.array(answer.points[1:])
    assert len({tuple(p) for p in beside}) == 3
    assert np.all((beside >= 0.0) & (beside <= 1.0))


def hidden(points):
    """A narrow valley in a plateau with a slope."""
    x, y = np.atleast_2d(points).T
    return 0.6 + 0.2 * (x + y) - 0.6 * np.exp(-((np.hypot(x - 0.7, y - 0.75) / 0.13) ** 2))


def test_a_slope_of_the_plateau_leaves_no_hole_between_simulations():
    points = [(0.1, 0.1), (0.9, 0.2), (0.3, 0.9), (0.5, 0.5)]
    while len(points) < 22:
        slope = 0.6 + 0.2 * np.sum(points, axis=1)
        points += propose(MinimumQuery(PLANE, data_of(points, slope), replicates=False, seed=len(points))).points
    assert cdist(np.random.default_rng(2).random((500, 2)), points).min(axis=1).max() < 0.25


def test_beside_lost_pours_simulations_search_the_valley_that_none_has_shown():
    lost = [(0.8, 0.8), (0.7, 0.2)]
    told = asked(hidden, [], acquisition="least_loss", count=3, data=Data(tuple(lost), (1.0, 1.0)))
    corner = [i for i, point in enumerate(told.simulated.points) if max(point) > 0.5]
    points, costs = (tuple(part[i] for i in corner) for part in (told.simulated.points, told.simulated.costs))
    beside = np.array(
        propose(replace(told, simulated=Data(points, tuple(max(cost, 0.6) for cost in costs)))).points[1:]
    )
    assert np.all(beside < 0.6), "nothing was simulated there"


def test_what_was_learnt_with_one_receiver_makes_the_first_prediction_for_the_next_better():
    learnt = propose(asked(displaced, POURED, count=0)).discrepancy.drawn
    assert len(learnt) == 64
    assert isinstance(learnt[0], BenchOffset)
    fresh = asked(displaced, [], count=0, predict_at=ASK)
    told = replace(fresh, discrepancy=replace(fresh.discrepancy, drawn=learnt))
    assert error(propose(told)) < 0.9 * error(propose(fresh))


def test_the_order_of_the_simulations_changes_no_bit():
    question = asked(displaced, POURED, acquisition="least_loss", count=3)
    turned = replace(question, simulated=Data(question.simulated.points[::-1], question.simulated.costs[::-1]))
    first, second = propose(question), propose(turned)
    assert replace(first, seconds=0.0) == replace(second, seconds=0.0)


GOOD = (0.35, 0.6)


def on_a_changed_bench(costs):
    """The same good action again and again."""
    return asked(cup, [], acquisition="least_loss", data=Data((GOOD,) * len(costs), tuple(costs)))


def test_two_pours_outside_their_intervals_are_taken_for_a_change_of_the_bench():
    before = (0.0, 0.004, 0.0, 0.002, 0.0, 0.003)
    assert propose(on_a_changed_bench(before)).discrepancy.since_change is None
    assert propose(on_a_changed_bench((*before, 0.9))).discrepancy.since_change is None  # it may be a mishap
    changed = propose(on_a_changed_bench((*before, 0.9, 0.92)))
    assert changed.discrepancy.since_change == 2
    assert np.linalg.norm(np.array(changed.points[0]) - GOOD) > 0.08
    back = propose(on_a_changed_bench((0.9, 0.92, *before)))
    assert np.linalg.norm(np.array(back.points[0]) - GOOD) < 0.08


def test_a_second_change_is_noticed_like_the_first():
    costs = (0.0, 0.004, 0.0, 0.002, 0.9, 0.92, 0.91, 0.9, 0.0, 0.003, 0.002)
    assert propose(on_a_changed_bench(costs)).discrepancy.since_change == 3


def around(i):
    return 0.35 + 0.1 * np.cos(2.4 * i), 0.6 + 0.1 * np.sin(2.4 * i)


def on_a_drifting_bench(count, pace, growth=0.0, **changes):
    """Pours all around a valley that moves away, and loses more, with every one."""
    places = [around(i) for i in range(count)]
    costs = [float(cup(np.subtract(place, (pace * i, 0.0)))[0]) + growth * i for i, place in enumerate(places)]
    near = (0.35, 0.6) + 0.15 * np.random.default_rng(3).standard_normal((40, 2))
    simulated = np.concatenate([np.random.default_rng(1).random((40, 2)), near])
    return asked(cup, [], data=data_of(places, costs), simulated=data_of(simulated, cup(simulated)), **changes)


def test_the_pace_of_a_bench_that_drifts_is_inferred():
    found = propose(on_a_drifting_bench(20, 0.004)).discrepancy
    assert found.drifts is not None
    assert -0.006 < found.drifts[0] < -0.001
    assert found.since_change is None


def test_a_bench_that_stands_still_is_not_said_to_drift():
    assert propose(on_a_drifting_bench(20, 0.0)).discrepancy.drifts is None


def test_older_pours_are_forgotten_where_more_is_lost_with_every_pour():
    following = [around(i) for i in range(20, 26)]
    answer = propose(on_a_drifting_bench(20, 0.0, growth=0.015, predict_at=tuple(following)))
    assert np.abs(answer.predictions - cup(following) - 0.3).mean() < 0.04


def test_question_and_answer_survive_the_journal():
    question = asked(displaced, POURED, acquisition="least_loss", count=2)
    assert from_json(to_json(question, SuggestionQuery), SuggestionQuery) == question
    answer = propose(question)
    text = canonical(to_json(answer, type(answer)))
    assert canonical(to_json(from_json(to_json(answer, type(answer)), type(answer)), type(answer))) == text


def test_a_cost_in_another_unit_is_the_same_question():
    question = asked(displaced, POURED, acquisition="least_loss", count=1, seed=3)
    grams = replace(
        question,
        data=Data(question.data.points, tuple(200.0 * c for c in question.data.costs)),
        simulated=Data(question.simulated.points, tuple(200.0 * c for c in question.simulated.costs)),
        discrepancy=replace(question.discrepancy, worst=200.0),
    )
    assert propose(grams).means[0] == pytest.approx(200.0 * propose(question).means[0], rel=0.05, abs=0.5)


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ({"acquisition": "least_loss", "discrepancy": None}, "needs a discrepancy"),
        ({"discrepancy": ModelDiscrepancy(PRIORS[:1])}, "axes"),
    ],
)
def test_a_question_that_makes_no_sense_is_refused(changes, text):
    with pytest.raises(ValueError, match=text):
        propose(asked(displaced, POURED, **changes))


@pytest.mark.parametrize("scatter", [0.002, 0.03])
def test_pours_that_are_alike_tell_how_much_a_pour_scatters(scatter):
    place, signs = (0.6, 0.6), (1.0, -0.6, 0.3, -1.0, 0.8, -0.5, 0.2, -0.2)
    costs = tuple(0.05 + scatter * sign for sign in signs)
    question = asked(cup, [])
    data = replace(question.data, points=(place,) * len(costs), costs=costs)
    found = propose(replace(question, data=data, count=0)).best_noise
    assert found is not None
    assert 0.5 * scatter < found < 1.5 * scatter + 0.15 * 0.06
