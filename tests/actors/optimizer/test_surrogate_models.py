"""`surrogate_models`: what the surrogates make of simulations that are right, off, scaled or wrong."""

import json
import math
from dataclasses import replace

import numpy as np
import pytest
from scipy.optimize import approx_fprime

from actors.optimizer import gaussian_process as fitting
from actors.optimizer.covariance import Covariance, HyperPrior
from actors.optimizer.questions import (
    Data,
    Linear,
    MinimumQuery,
    PourQuery,
    RegressionQuery,
)
from actors.optimizer.suggest import propose
from orchestrator.records.codec import canonical, from_json, to_json
from sim_engine.search_space import Axis, Space

PLANE = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))
ASK = tuple((x, y) for x in (0.15, 0.4, 0.65, 0.9) for y in (0.1, 0.35, 0.6, 0.85))


def points_of(count, seed=0, dimension=2):
    return np.random.default_rng(seed).random((count, dimension))


def data_of(points, costs) -> Data:
    return Data(tuple(tuple(map(float, p)) for p in points), tuple(map(float, costs)))


def cup(points):
    """Nothing spilled in a valley, all far from it."""
    radius = np.linalg.norm(np.asarray(points) - (0.35, 0.6), axis=1)
    return 1.0 - np.exp(-((3.0 * np.maximum(radius - 0.15, 0.0)) ** 1.5))


def asked(simulated_costs, *, pours=6, **changes):
    """A query after 40 simulations and a few pours; the pours are `cup`'s."""
    simulated, real = points_of(40, 1), points_of(pours, 2)
    return PourQuery(
        PLANE,
        data_of(real, cup(real)),
        simulated=data_of(simulated, simulated_costs(simulated)),
        **{"count": 0, "predict_at": ASK, **changes},
    )


def error(answer):
    return float(np.sqrt(np.mean((np.array(answer.predictions) - cup(ASK)) ** 2)))


@pytest.mark.parametrize("kind", [{}, {"shear": (0.0, 0.5)}])
def test_the_likelihoods_gradient_is_that_of_the_likelihood(kind):
    points, costs = points_of(20, 3, 3), np.random.default_rng(4).standard_normal(20)
    covariance = Covariance(points, HyperPrior(shear=kind.get("shear")))
    theta = covariance.centre + 0.3 * np.random.default_rng(6).standard_normal(len(covariance.centre))
    numeric = approx_fprime(theta, lambda t: fitting.negative_log_likelihood(covariance, costs, t)[0], 1e-6)
    exact = fitting.negative_log_likelihood(covariance, costs, theta)[1]
    assert exact == pytest.approx(numeric, rel=1e-3, abs=1e-3)


def test_a_valley_oblique_to_the_axes_is_known_between_the_simulations_in_it():
    def jet(points):
        """A faster pour reaches farther; nothing is spilled on a strip."""
        across = np.asarray(points) @ (-0.6, 1.0) - 0.2
        return 1.0 - np.exp(-(np.maximum(np.abs(across) / 0.05 - 1.0, 0.0) ** 1.5))

    points = points_of(36, 4)
    along = tuple((x, 0.2 + 0.6 * x) for x in np.linspace(0.05, 0.95, 19).tolist())
    query = MinimumQuery(PLANE, data_of(points, jet(points)), count=0, predict_at=along)
    axes, oblique = (np.mean(propose(replace(query, replicates=told)).predictions) for told in (True, False))
    assert abs(oblique) < 0.1 < 0.3 < axes


def test_a_right_simulation_makes_a_few_pours_worth_many():
    query = asked(cup)
    alone = error(propose(RegressionQuery(PLANE, query.data, predict_at=ASK)))
    assert error(propose(query)) < 0.6 * alone


def test_a_simulation_that_is_off_by_a_constant_is_corrected():
    answer = propose(asked(lambda p: cup(p) + 0.4))
    assert error(answer) < 0.15


@pytest.mark.parametrize(("simulated", "pours"), [(2, 0), (2, 1), (3, 5), (0, 2), (1, 3), (0, 0)])
def test_any_few_simulations_and_pours_are_enough_for_an_answer(simulated, pours):
    cheap, dear = points_of(simulated, 1), points_of(pours, 2)
    query = PourQuery(PLANE, data_of(dear, cup(dear)), simulated=data_of(cheap, cup(cheap)), count=2)
    answer = propose(query)
    assert len(answer.points) == 2
    assert all(map(math.isfinite, (*answer.means, *answer.deviations, *answer.noises)))


def test_the_best_point_is_one_that_was_poured():
    query = asked(cup)
    assert propose(query).best_point in query.data.points


# -- travelling ----------------------------------------------------------------------------------------------------


def test_a_question_with_everything_in_it_survives_the_journal():
    query = PourQuery(
        PLANE,
        data_of(points_of(3), (0.1, 0.2, 0.3)),
        simulated=data_of(points_of(2, 1), (0.1, 0.2)),
        infeasible=((0.5, 0.6),),
        constraints=(Linear((("x", 1.0), ("y", -2.0)), 0.5),),
    )
    assert from_json(json.loads(canonical(to_json(query, PourQuery))), PourQuery) == query
