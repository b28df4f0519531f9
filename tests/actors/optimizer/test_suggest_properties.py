"""`suggest`: what holds for any question: bounds, constraints, order of answers, and what must not get into a fit."""

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from actors.optimizer.questions import Data, Linear, MinimumQuery, PourQuery
from actors.optimizer.suggest import propose
from sim_engine.search_space import Axis, Space
from tests.support.hypothesis_examples import examples

MEANS = ("constant", "zero", "simulated")
axes = st.sampled_from(
    [
        Axis("", 0.0, 1.0),
        Axis("", -2.0, 3.0),
        Axis("", 1e-4, 1.0, "log"),
        Axis("", 1, 6, integer=True),
        Axis("", 200, 50_000, "log", integer=True),
        Axis("", 0.4, 3.6, integer=True),
    ]
)
unit = st.sampled_from([0.0, 0.5, 0.5000001, 1.0]) | st.floats(0.0, 1.0)
cost = st.sampled_from([0.0, 1.0, 1.0]) | st.floats(-1e6, 1e6)


@st.composite
def spaces(draw):
    return Space(tuple(replace(draw(axes), name=f"x{i}") for i in range(draw(st.sampled_from([1, 2, 4, 6])))))


@st.composite
def questions(draw):
    """Any question with finite numbers whose constraint leaves room."""
    space = draw(spaces())
    point = st.tuples(*[unit] * space.dimension)

    def data(most):
        rows = draw(st.lists(st.tuples(point, cost), max_size=most))
        return Data(tuple(p for p, _ in rows), tuple(c for _, c in rows))

    constraints = ()
    if draw(st.booleans()):
        axis = space.axes[0]
        middle = axis.decode(0.7)
        constraints = (Linear(((axis.name, 1.0),), middle),)
    parts = {
        "pending": tuple(draw(st.lists(point, max_size=3))),
        "count": draw(st.integers(0, 3)),
        "seed": draw(st.integers(0, 2**31)),
        "infeasible": tuple(draw(st.lists(point, max_size=3))),
        "failed": tuple(draw(st.lists(point, max_size=3))),
        "constraints": constraints,
    }
    kind = draw(st.sampled_from([MinimumQuery, PourQuery]))
    parts["acquisition"] = draw(st.sampled_from(["lcb", "posterior_minimum"]))
    if kind is MinimumQuery:
        parts["mean"] = draw(st.sampled_from(["constant", "zero"]))
    else:
        parts["simulated"] = data(8)
    return kind(space, data(12), **parts)


def simulations_of(query):
    return getattr(query, "simulated", Data())


SQUARES_TO_ZERO = PourQuery(
    Space((Axis("x0", 0.0, 1.0), Axis("x1", 0.0, 1.0))),
    Data((), ()),
    count=0,
    seed=0,
    simulated=Data(((0.0, 0.0), (0.0, 0.0)), (0.0, 8.64e-207)),
)
"""Costs other than zero whose squares are zero as floats."""


@settings(max_examples=examples(80), deadline=None)
@given(question=questions())
@example(question=SQUARES_TO_ZERO)
@example(question=replace(SQUARES_TO_ZERO, count=2))
@example(question=replace(SQUARES_TO_ZERO, data=SQUARES_TO_ZERO.simulated, count=1))
@example(question=MinimumQuery(SQUARES_TO_ZERO.space, SQUARES_TO_ZERO.simulated, mean="zero"))
def test_proposals_are_finite_and_keep_to_bounds_whole_numbers_and_constraints(question):
    answer = propose(question)
    assert len(answer.points) == question.count
    for point in answer.points:
        values = question.space.decode(point)
        assert all(0.0 <= u <= 1.0 for u in point)
        for axis in question.space.axes:
            assert not axis.integer or values[axis.name] == round(values[axis.name])
        for constraint in question.constraints:
            total = sum(weight * values[name] for name, weight in constraint.weights)
            assert total <= constraint.upper + 1e-6 * max(abs(constraint.upper), 1.0)
    assert all(map(math.isfinite, (*answer.means, *answer.deviations, *answer.noises, *answer.feasibilities)))
    assert all(s > 0.0 for s in (*answer.deviations, *answer.noises))
    assert all(0.0 <= p <= 1.0 for p in answer.feasibilities)


@settings(max_examples=examples(40), deadline=None)
@given(question=questions(), shuffle=st.randoms(use_true_random=False))
def test_who_answers_first_changes_nothing(question, shuffle):
    def shuffled(data):
        order = list(range(len(data)))
        shuffle.shuffle(order)
        return Data(tuple(data.points[i] for i in order), tuple(data.costs[i] for i in order))

    pending, refused, failed = list(question.pending), list(question.infeasible), list(question.failed)
    for places in (pending, refused, failed):
        shuffle.shuffle(places)
    other = replace(
        question,
        data=shuffled(question.data),
        **({"simulated": shuffled(question.simulated)} if len(simulations_of(question)) else {}),
        pending=tuple(pending),
        infeasible=tuple(refused),
        failed=tuple(failed),
    )
    first, second = propose(question), propose(other)
    assert first.points == second.points
    assert first.means == second.means
    assert first.best_mean == second.best_mean


@settings(max_examples=examples(40), deadline=None)
@given(question=questions(), where=st.integers(0, 1000), bad=st.sampled_from([math.nan, math.inf, -math.inf, 1e300]))
def test_a_number_that_is_none_is_refused_and_never_fitted(question, where, bad):
    places = []
    for name in ("data", "simulated"):
        data = getattr(question, name, Data())
        for i in range(len(data)):
            costs = (*data.costs[:i], bad, *data.costs[i + 1 :])
            places.append({name: Data(data.points, costs)})
            point = (bad, *data.points[i][1:])
            places.append({name: Data((*data.points[:i], point, *data.points[i + 1 :]), data.costs)})
    for name in ("pending", "infeasible"):
        places += [{name: ((bad,) * question.space.dimension,)}]
    with pytest.raises(ValueError, match=r"cost \d+ is|point \d+"):
        propose(replace(question, **places[where % len(places)]))


def query_with(mean, space, data, simulated, **parts):
    """A query with that prior mean."""
    if mean == "simulated":
        return PourQuery(space, data, simulated=simulated, **parts)
    return MinimumQuery(space, data, mean=mean, **parts)


@pytest.mark.parametrize("mean", MEANS)
@pytest.mark.parametrize("scale", [1e-9, 1.0, 1e9])
def test_the_unit_of_the_cost_changes_no_proposal(mean, scale):
    points = tuple(map(tuple, np.random.default_rng(3).random((12, 2)).tolist()))
    costs = [(x - 0.3) ** 2 + (y - 0.6) ** 2 for x, y in points]
    space = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))

    def answered(unit):
        data = Data(points[:6], tuple(unit * c for c in costs[:6]))
        cheap = Data(points[6:], tuple(unit * c for c in costs[6:]))
        return propose(query_with(mean, space, data, cheap, acquisition="posterior_minimum"))

    assert answered(scale).points[0] == pytest.approx(answered(1.0).points[0], abs=0.02)


def test_on_a_plateau_of_noise_not_only_the_faces_of_the_cube_are_tried():
    space = Space(tuple(Axis(name, 0.0, 1.0) for name in "abcd"))
    rng = np.random.default_rng(0)
    data = Data()
    inside = 0
    for step in range(20):
        (point,) = propose(MinimumQuery(space, data, seed=step)).points
        data = data.added(point, min(1.0, 1.0 + 0.12 * rng.standard_normal()))
        inside += step >= 5 and all(0.1 < u < 0.9 for u in point)
    assert inside >= 2


@pytest.mark.parametrize("dimension", [2, 4, 6])
def test_many_duplicates_and_a_hundred_points_are_no_trouble(dimension):
    space = Space(tuple(Axis(f"x{i}", 0.0, 1.0) for i in range(dimension)))
    rng = np.random.default_rng(1)
    points = np.repeat(rng.random((10, dimension)), 10, axis=0)
    data = Data(tuple(map(tuple, points.tolist())), tuple(rng.random(100).tolist()))
    for mean in MEANS:
        answer = propose(query_with(mean, space, data, data))
        assert all(map(math.isfinite, (*answer.means, *answer.deviations)))
