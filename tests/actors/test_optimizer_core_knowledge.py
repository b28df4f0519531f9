"""What simulations are worth: in loss, never negative, and nothing where only pours can tell."""

import math
from dataclasses import replace

import numpy as np
import pytest

from actors.optimizer.gaussian_process import (
    HyperparameterSearch,
    constant_mean_process,
    joint_process,
    simulated_mean_process,
)
from actors.optimizer.questions import Data, SearchEffort, SimulationQuery, Suggestion
from actors.optimizer.suggest import propose
from orchestrator.records.codec import from_json, to_json
from sim_engine.search_space import Axis, Space

PLANE = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))
COUPLINGS = ("residual", "scaled")


def points_of(count, seed=0):
    return np.random.default_rng(seed).random((count, 2))


def data_of(points, costs) -> Data:
    return Data(tuple(tuple(map(float, p)) for p in points), tuple(map(float, costs)))


def cup(points, centre=(0.35, 0.6)):
    """Nothing spilled in a valley, all far from it."""
    radius = np.linalg.norm(np.asarray(points) - centre, axis=1)
    return 1.0 - np.exp(-((3.0 * np.maximum(radius - 0.15, 0.0)) ** 1.5))


def asked(coupling="scaled", *, simulations=12, pours=3, **changes):
    simulated, real = points_of(simulations, 1), points_of(pours, 2)
    return SimulationQuery(
        PLANE,
        data_of(real, cup(real)),
        coupling=coupling,
        simulated=data_of(simulated, cup(simulated)),
        **{"count": 3, **changes},
    )


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_what_simulations_gain_is_a_loss_that_can_be_journalled(coupling):
    answer = propose(asked(coupling))
    assert len(answer.points) == len(answer.values) == 3
    assert all(0.0 <= value <= 2.0 for value in (*answer.values, answer.pour_value))
    assert answer.values[0] > 0.0
    assert len(set(answer.points)) == 3
    assert from_json(to_json(answer, Suggestion), Suggestion) == answer


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_simulation_removes_as_much_doubt_as_was_predicted(coupling):
    """The covariance after one more simulation, hyperparameters kept, is what conditioning says of the one before."""
    simulated, real, ask = points_of(15, 1), points_of(4, 2), points_of(6, 3)
    place = np.array([[0.4, 0.55]])

    def fitted(points, costs, thetas=(None, None)):
        searches = [HyperparameterSearch() if theta is None else HyperparameterSearch(theta, 0) for theta in thetas]
        if coupling == "scaled":
            return joint_process(points, costs, real, cup(real), search=searches[0])
        prior = constant_mean_process(points, costs, search=searches[0])
        process = simulated_mean_process(prior, real, cup(real), search=searches[1])
        process.prior = prior
        return process

    before = fitted(simulated, cup(simulated))
    thetas = (before.prior.theta, before.theta) if coupling == "residual" else (before.theta, None)
    joint = before.joint_covariance(place, ask)
    predicted = joint[1:, 1:] - np.outer(joint[1:, 0], joint[0, 1:]) / (joint[0, 0] + before.simulated_noise**2)
    longer = np.concatenate([simulated, place])
    after = fitted(longer, np.append(cup(simulated), 0.3), thetas)
    found = after.covariance(ask, ask) * (before.scale / after.scale) ** 2  # hyperparameters are in units of the scale
    assert found == pytest.approx(predicted, rel=1e-4, abs=1e-7)
    assert np.trace(predicted) < 0.999 * np.trace(before.covariance(ask, ask))


def test_where_simulations_have_told_all_they_can_only_a_pour_is_worth_anything():
    def share(simulations):
        question = asked(simulations=simulations, pours=6)
        pours = data_of(points_of(6, 2), cup(points_of(6, 2), centre=(0.5, 0.45)))
        answer = propose(replace(question, data=pours))
        return answer.values[0] / answer.pour_value

    assert share(150) < 0.1 * share(10)


def test_where_a_simulation_is_under_way_none_is_asked_for_and_a_pour_has_less_to_tell_after_another():
    first = propose(asked(count=1))
    again = propose(asked(count=1, pending=first.points))
    assert math.dist(again.points[0], first.points[0]) > 0.02
    crowd = tuple((x, y) for x in np.linspace(0, 1, 9) for y in np.linspace(0, 1, 9))
    assert propose(asked(count=1, pending=crowd)).values[0] < 0.5 * first.values[0]
    assert propose(asked(count=1, pouring=crowd)).pour_value < 0.5 * first.pour_value


def test_simulations_go_where_the_best_action_may_be_and_not_onto_the_plateau():
    answer = propose(asked(simulations=40, pours=0, count=6))
    assert max(cup(np.array(answer.points))) < 0.3


@pytest.mark.parametrize("coupling", COUPLINGS)
def test_a_fit_that_goes_on_from_the_last_one_finds_the_same_model_for_less(coupling):
    question = asked(
        coupling, simulations=40, pours=5, count=0, predict_at=((0.3, 0.5), (0.9, 0.1)), effort=SearchEffort()
    )
    fresh = propose(question)
    kept = propose(replace(question, effort=SearchEffort(fresh.fitted, 0)))
    assert kept.fitted == fresh.fitted
    assert kept.predictions == pytest.approx(fresh.predictions, abs=1e-9)
    far = tuple(tuple(value + 0.3 for value in theta) for theta in fresh.fitted)
    steps = [propose(replace(question, effort=SearchEffort(far, iterations))) for iterations in (0, 4, 30)]
    errors = [np.abs(np.subtract(step.predictions, fresh.predictions)).max() for step in steps]
    assert errors[2] < 0.02
    assert errors[2] < errors[0]
    assert steps[0].fitted != steps[1].fitted != steps[2].fitted


def test_a_start_of_another_model_is_refused():
    with pytest.raises(ValueError, match="a start of 2 hyperparameters for a model of 9"):
        propose(asked(effort=SearchEffort(((0.0, 0.0),), 4)))
    with pytest.raises(ValueError, match="must be finite"):
        propose(asked(effort=SearchEffort(((math.nan,),), 4)))
