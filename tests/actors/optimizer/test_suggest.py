"""`suggest`: answers to questions about actions and parameters."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.optimizer.questions import (
    CalibrationQuery,
    Data,
    Equality,
    Linear,
    MinimumQuery,
    PourQuery,
    RegressionQuery,
    SpaceFillingQuery,
)
from actors.optimizer.suggest import propose
from orchestrator.learning.requests import Prediction
from sim_engine.search_space import Axis, Space
from tests.support.hypothesis_examples import examples

PLANE = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))


def data_of(points, costs) -> Data:
    return Data(tuple(tuple(map(float, p)) for p in points), tuple(map(float, costs)))


def bowl(points, centre=(0.3, 0.6)):
    return 2.0 * ((np.asarray(points) - centre) ** 2).sum(axis=1)


def cover(n, seed=0, dimension=2):
    return np.random.default_rng(seed).random((n, dimension))


coordinate = st.sampled_from([0.0, 0.25, 0.5, 0.5000001, 1.0]) | st.floats(0.0, 1.0)
cost = st.sampled_from([0.0, 1.0, 1.0]) | st.floats(-1e6, 1e6)


@settings(max_examples=examples(60), deadline=None)
@given(
    observed=st.lists(st.tuples(coordinate, coordinate, cost), max_size=12),
    simulated=st.lists(st.tuples(coordinate, coordinate, cost), max_size=8),
    pending=st.lists(st.tuples(coordinate, coordinate), max_size=3),
    mean=st.sampled_from(["constant", "zero", "simulated"]),
    acquisition=st.sampled_from(["lcb", "posterior_minimum"]),
    count=st.integers(0, 3),
    seed=st.integers(0, 2**31),
)
def test_any_finite_data_gives_finite_proposals_inside_the_cube(
    observed, simulated, pending, mean, acquisition, count, seed
):
    data = data_of([p[:2] for p in observed], [p[2] for p in observed])
    simulated = data_of([p[:2] for p in simulated], [p[2] for p in simulated])
    parts = {"pending": tuple(pending), "count": count, "seed": seed, "acquisition": acquisition}
    if mean == "simulated":
        answer = propose(PourQuery(PLANE, data, simulated=simulated, **parts))
    else:
        answer = propose(MinimumQuery(PLANE, data, mean=mean, **parts))
    assert len(answer.points) == count
    assert all(len(p) == 2 and all(0.0 <= u <= 1.0 for u in p) for p in answer.points)
    assert all(map(math.isfinite, (*answer.means, *answer.deviations)))
    assert all(s > 0.0 for s in answer.deviations)
    assert answer.best_mean is None or math.isfinite(answer.best_mean)


def test_the_same_question_gets_the_same_answer_and_another_seed_another():
    points = cover(12)
    problem = MinimumQuery(PLANE, data_of(points, bowl(points)), count=2, seed=3, acquisition="lcb")
    first, again = propose(problem), propose(problem)
    assert (first.points, first.means, first.hyperparameters) == (again.points, again.means, again.hyperparameters)
    drawn = [propose(SpaceFillingQuery(PLANE, seed=s)).points for s in (1, 2)]
    assert drawn[0] != drawn[1]


@pytest.mark.parametrize(
    ("change", "complaint"),
    [
        ({"data": Data(((0.1, 0.2), (0.3, 0.4)), (0.5, float("nan")))}, "cost 1 is nan"),
        ({"data": Data(((0.1, float("inf")),), (0.5,))}, "point 0"),
        ({"data": Data(((0.1,),), (0.5,))}, "has 1 coordinates, expected 2"),
        ({"kappa": float("nan")}, "kappa"),
        ({"count": -1}, "count"),
        ({"map_resolution": 10_000}, "map_resolution"),
    ],
)
def test_a_question_that_cannot_be_answered_is_refused_with_its_number(change, complaint):
    with pytest.raises(ValueError, match=complaint):
        propose(MinimumQuery(**{"space": PLANE, "data": Data(), **change}))


def test_the_minimum_of_a_smooth_cost_is_found_in_a_few_steps():
    data = Data()
    for step in range(15):
        point = propose(MinimumQuery(PLANE, data, seed=step)).points[0]
        data = data.added(point, float(bowl([point])[0]))
    best = propose(MinimumQuery(PLANE, data, acquisition="posterior_minimum")).points[0]
    assert np.linalg.norm(np.array(best) - (0.3, 0.6)) < 0.05


@pytest.mark.parametrize("ripple", [0.0, 1e-4])
def test_on_a_plateau_it_keeps_looking_where_nothing_is_known(ripple):
    corner = 0.3 * cover(6)  # (almost) everything spilled in one corner
    answer = propose(MinimumQuery(PLANE, data_of(corner, 1.0 - ripple * cover(6)[:, 0])))
    assert min(np.linalg.norm(np.array(answer.points[0]) - p) for p in corner) > 0.3
    assert answer.deviations[0] > 0.01


def test_duplicates_that_disagree_are_taken_for_noise():
    points = np.array([[0.5, 0.5]] * 6 + [[0.1, 0.1]] * 6)
    costs = np.array([0.4, 0.6] * 3 + [0.85, 0.95] * 3)
    answer = propose(RegressionQuery(PLANE, data_of(points, costs), predict_at=((0.5, 0.5), (0.1, 0.1))))
    assert answer.predictions == pytest.approx((0.5, 0.9), abs=0.06)
    assert 0.03 < answer.hyperparameters["noise"] < 0.3


def test_the_best_point_is_not_the_luckiest():
    good, tempting, bad = (0.2, 0.5), (0.6, 0.5), (0.9, 0.9)
    costs = [0.18, 0.22, 0.25, 0.15, 0.2, 0.05, 0.6, 0.55, 0.5, 0.62, 0.9, 0.92]  # 0.05: one lucky pour
    data = data_of([good] * 5 + [tempting] * 5 + [bad] * 2, costs)
    answer = propose(RegressionQuery(PLANE, data))
    assert answer.best_point == good
    assert answer.best_mean == pytest.approx(0.2, abs=0.1)


def test_points_that_are_still_out_are_not_asked_for_again():
    points = cover(12, 1)
    data = data_of(points, bowl(points))
    alone = propose(MinimumQuery(PLANE, data)).points[0]
    beside = propose(MinimumQuery(PLANE, data, pending=(alone,))).points[0]
    assert math.dist(alone, beside) > 0.05
    several = propose(MinimumQuery(PLANE, data, count=4)).points
    assert min(math.dist(p, q) for i, p in enumerate(several) for q in several[:i]) > 0.05


def test_without_data_points_are_spread_over_the_cube():
    points = np.array(propose(MinimumQuery(PLANE, Data(), count=8, seed=5)).points)
    quarters = {(int(2 * x), int(2 * y)) for x, y in points}
    assert len(quarters) == 4
    one = Data(((0.1, 0.1),), (0.5,))
    assert math.dist(propose(MinimumQuery(PLANE, one)).points[0], (0.1, 0.1)) > 0.5


def test_simulations_are_the_prior_mean_and_pours_correct_it():
    simulated = cover(30, 2)
    sims = data_of(simulated, bowl(simulated))
    shifted = cover(6, 3)
    places = ((0.2, 0.2), (0.3, 0.6), tuple(map(float, shifted[0])))
    prior = propose(PourQuery(PLANE, Data(), simulated=sims, count=0, predict_at=places))
    assert prior.predictions == pytest.approx(bowl(places), abs=0.05)
    real = data_of(shifted, bowl(shifted) + 0.4)  # reality spills 0.4 more everywhere
    corrected = propose(PourQuery(PLANE, real, simulated=sims, count=0, predict_at=places))
    assert corrected.predictions[2] == pytest.approx(bowl(places)[2] + 0.4, abs=0.1)
    assert corrected.predictions[1] > prior.predictions[1] + 0.15


def test_far_from_all_pours_the_simulations_are_believed():
    sims = data_of(cover(30, 2), bowl(cover(30, 2)))
    near = np.array([[0.1, 0.9], [0.2, 0.8]])
    far = ((0.95, 0.1), (0.9, 0.2))
    question = PourQuery(PLANE, data_of(near, bowl(near)), simulated=sims, count=0, predict_at=far)
    assert propose(question).predictions == pytest.approx(bowl(far), abs=0.1)


def test_first_pour_goes_to_the_minimum_of_the_simulated_surrogate():
    simulated = cover(30, 2)
    sims = data_of(simulated, bowl(simulated))
    first = propose(PourQuery(PLANE, Data(), simulated=sims, acquisition="posterior_minimum", count=3))
    assert math.dist(first.points[0], (0.3, 0.6)) < 0.08
    assert min(math.dist(first.points[0], p) for p in first.points[1:]) > 0.03


def test_a_shown_pour_has_an_interval_that_knows_how_little_the_pours_say_and_nothing_else_changes():
    places = cover(6, 3)
    asked = MinimumQuery(PLANE, data_of(places, bowl(places)), seed=4)
    hidden, shown = propose(asked), propose(replace(asked, map_resolution=2))
    assert hidden.bands == ()
    assert replace(shown, bands=(), surrogate=None, seconds=0.0) == replace(hidden, seconds=0.0)
    (low, high) = shown.bands[0]
    plug_in = Prediction(shown.means[0], shown.deviations[0], shown.noises[0]).of_a_pour()
    assert 0.0 <= low < high
    assert high - low > 1.3 * (plug_in[1] - plug_in[0]), "with six pours many hyperparameters are likely"


def test_intervals_of_many_pours_tend_to_those_of_the_fitted_surrogate():
    places = cover(60, 3)
    costs = 1.0 + bowl(places) + 0.1 * np.random.default_rng(3).standard_normal(60)
    shown = propose(MinimumQuery(PLANE, data_of(places, costs), map_resolution=2, seed=4))
    low, high = shown.bands[0]
    spread = 1.645 * math.hypot(shown.deviations[0], shown.noises[0])
    assert (low, high) == pytest.approx((shown.means[0] - spread, shown.means[0] + spread), abs=0.3 * spread)


@pytest.mark.parametrize("costs", [(1.0, 1.0), (0.0, 0.0, 0.0), (1e-9, 1e6, 3.0), (-5.0, -4.0, -5.0)])
def test_intervals_are_finite_and_not_negative_whatever_the_pours(costs):
    shown = propose(MinimumQuery(PLANE, data_of(cover(len(costs)), costs), map_resolution=2))
    low, high = shown.bands[0]
    assert 0.0 <= low <= high < math.inf


def test_a_pour_after_simulations_has_an_interval_averaged_over_the_remainder_s_hyperparameters():
    simulated, places = cover(30, 2), cover(3, 5)
    sims, pours = data_of(simulated, bowl(simulated)), data_of(places, bowl(places) + np.array([0.0, 0.4, 0.1]))
    answer = propose(PourQuery(PLANE, pours, simulated=sims, count=2))
    assert len(answer.bands) == 2
    for (low, high), mean, *spread in zip(answer.bands, answer.means, answer.deviations, answer.noises, strict=True):
        plug_in = Prediction(mean, *spread).of_a_pour()
        assert high - low > plug_in[1] - plug_in[0]


def test_a_mean_absolute_difference_is_minimised_over_its_context():
    # d(x, z) = x − z: the mean of |x − z| over z is least at the median of z, here 0.2, while the mean of z is 0.38
    line = Space((Axis("x", 0.0, 1.0),))
    joint = cover(40, 6)
    problem = CalibrationQuery(
        line, data_of(joint, joint[:, 0] - joint[:, 1]), contexts=((0.1,), (0.15,), (0.2,), (0.55,), (0.9,))
    )
    answer = propose(problem)
    assert answer.points[0][0] == pytest.approx(0.2, abs=0.04)
    assert answer.means[0] == pytest.approx(np.mean(np.abs(0.2 - np.array([0.1, 0.15, 0.2, 0.55, 0.9]))), abs=0.03)


def test_the_map_has_the_second_axis_in_its_rows():
    points = cover(30, 7)
    answer = propose(RegressionQuery(PLANE, data_of(points, points[:, 1]), map_resolution=5))
    mean = np.array(answer.surrogate.mean)
    assert mean.shape == (5, 5)
    assert mean[:, 2] == pytest.approx(np.linspace(0, 1, 5), abs=0.1)
    assert mean[2, :] == pytest.approx(np.full(5, 0.5), abs=0.1)


def test_of_many_axes_the_map_shows_the_two_that_matter_through_the_best_place():
    box = Space(tuple(Axis(name, 0.0, 1.0) for name in "vwxyz"))
    points = cover(60, 9, dimension=5)
    costs = 2.0 * ((points[:, [1, 3]] - (0.3, 0.6)) ** 2).sum(axis=1) + 0.1 * points[:, 4]
    asked = MinimumQuery(box, data_of(points, costs), acquisition="posterior_minimum", map_resolution=5, seed=1)
    answer = propose(asked)
    drawn = answer.surrogate
    assert drawn.axes == ("w", "y")
    assert drawn.at == answer.points[0]
    assert drawn.plane(box).names == ("w", "y")
    assert drawn.held(box) == {name: answer.points[0][i] for i, name in enumerate("vwxyz") if name in "vxz"}
    v, _, x, _, z = answer.points[0]
    row = propose(replace(asked, predict_at=tuple((v, w, x, 0.75, z) for w in np.linspace(0, 1, 5))))
    assert drawn.mean[3] == pytest.approx(row.predictions)
    assert drawn.deviation[3] == pytest.approx(row.prediction_deviations)


def test_without_a_minimiser_the_map_goes_through_the_best_place_that_was_observed():
    box = Space(tuple(Axis(name, 0.0, 1.0) for name in "xyz"))
    points = cover(20, 3, dimension=3)
    for acquisition, count in (("lcb", 2), ("posterior_minimum", 0)):
        asked = MinimumQuery(box, data_of(points, bowl(points[:, :2])), acquisition=acquisition, count=count)
        answer = propose(replace(asked, map_resolution=3))
        assert answer.surrogate.at == answer.best_point


def test_around_a_simulated_mean_the_simulations_say_which_axes_matter():
    box = Space(tuple(Axis(name, 0.0, 1.0) for name in "xyz"))
    cheap, dear = cover(40, 4, dimension=3), cover(3, 5, dimension=3)
    asked = PourQuery(box, data_of(dear, bowl(dear[:, 1:])), simulated=data_of(cheap, bowl(cheap[:, 1:])), count=0)
    assert propose(replace(asked, map_resolution=3)).surrogate.axes == ("y", "z")


def test_a_suggestion_at_a_hundred_points_takes_far_less_than_a_simulation():
    points = cover(100, 8)
    costs = bowl(points) + 0.1 * np.random.default_rng(8).standard_normal(100)
    problem = MinimumQuery(PLANE, data_of(points, costs))
    assert min(propose(problem).seconds for _ in range(3)) < 0.25  # 0.03 s where nothing else runs


def test_once_costs_show_structure_less_is_given_for_the_unknown():
    points = tuple(map(tuple, np.random.default_rng(4).random((10, 2)).tolist()))
    cover = tuple(map(tuple, np.random.default_rng(5).random((2000, 2)).tolist()))

    def excess(costs, kappa, **changes):
        """By how much the proposal misses the least m − κ s of a cover."""
        problem = MinimumQuery(PLANE, Data(points, tuple(costs)), kappa=2.0, seed=1, predict_at=cover)
        answer = propose(replace(problem, **changes))
        bound = np.array(answer.predictions) - kappa * np.array(answer.prediction_deviations)
        return (answer.means[0] - kappa * answer.deviations[0] - bound.min()) / np.std(costs)

    bowl = [(x - 0.3) ** 2 + (y - 0.6) ** 2 for x, y in points]
    noise = np.random.default_rng(1).random(10).tolist()
    assert excess(bowl, 1.0) < 0.01 < excess(bowl, 2.0)
    assert excess(noise, 2.0) < 0.01 < excess(noise, 1.0)
    assert excess(bowl, 2.0, plain=True) < 0.01 < excess(bowl, 1.0, plain=True), "the paper's κ is a constant"


def test_asked_plainly_it_does_not_leave_the_bound_to_fill_space_on_a_plateau():
    points = tuple(map(tuple, np.random.default_rng(4).random((11, 2)).tolist()))  # the next is a third one
    costs = tuple(np.random.default_rng(1).random(11).tolist())
    everywhere = tuple(map(tuple, np.random.default_rng(5).random((2000, 2)).tolist()))

    def excess(plain):
        """By how much the proposal misses the least m − 2 s of a cover."""
        answer = propose(MinimumQuery(PLANE, Data(points, costs), seed=1, predict_at=everywhere, plain=plain))
        bound = np.array(answer.predictions) - 2.0 * np.array(answer.prediction_deviations)
        return (answer.means[0] - 2.0 * answer.deviations[0] - bound.min()) / np.std(costs)

    assert excess(plain=True) < 0.01 < excess(plain=False)


# -- equal points ----------------------------------------------------------------------------------------------------


def plateau(points):
    """Nothing is lost for x in 0.3 … 0.9 and y in 0.2 … 0.7; a little less by chance at the fast end."""
    points = np.asarray(points)
    outside = np.maximum(np.maximum(0.3 - points[:, 0], points[:, 0] - 0.9), 0.0)
    outside += np.maximum(np.maximum(0.2 - points[:, 1], points[:, 1] - 0.7), 0.0)
    return outside - 1e-2 * points[:, 0]


def test_of_points_that_lose_equally_little_the_slower_one_near_the_middle_is_best():
    points = [(x, y) for x in np.linspace(0.0, 1.0, 11) for y in np.linspace(0.0, 1.0, 6)]
    query = RegressionQuery(PLANE, data_of(points, plateau(points)))
    least = propose(query)
    gentle = propose(replace(query, equality=Equality(0.02, "x")))
    assert least.best_point[0] > 0.7
    assert least.equal_ranges is None
    assert 0.4 <= gentle.best_point[0] <= 0.61
    assert gentle.best_point[1] == pytest.approx(0.4)
    (left, right), (low, high) = gentle.equal_ranges
    assert (left, right) == pytest.approx((0.3, 0.9), abs=0.05)
    assert (low, high) == pytest.approx((0.2, 0.7), abs=0.08)


def test_equal_points_keep_constraints_and_stay_away_from_refused_places():
    points = [(x, y) for x in np.linspace(0.0, 1.0, 11) for y in np.linspace(0.0, 1.0, 6)]
    refused = tuple((x, y) for x in (0.3, 0.4, 0.5) for y in (0.2, 0.4, 0.6))
    query = RegressionQuery(PLANE, data_of(points, plateau(points)), equality=Equality(0.02, "x"), refused=refused)
    assert propose(query).best_point[0] >= 0.6
    bound = replace(query, refused=(), constraints=(Linear((("y", 1.0),), 0.45),))
    answer = propose(bound)
    assert answer.best_point[1] <= 0.45
    assert answer.equal_ranges[1][1] <= 0.45


@pytest.mark.parametrize("speed", ["x", "y", ""])
def test_an_only_valley_is_recommended_whatever_counts_as_equal(speed):
    points = cover(30)
    query = RegressionQuery(PLANE, data_of(points, bowl(points)))
    assert propose(replace(query, equality=Equality(1e-6, speed))).best_point == propose(query).best_point
