"""`risk_measures`: CVaR is what it is called, and a surrogate over what was executed finds the action that bears
errors.
"""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.optimizer.gaussian_process import constant_mean_process
from actors.optimizer.questions import Data, Disturbance, MinimumQuery, Risk, RiskQuery
from actors.optimizer.risk_measures import RiskProcess, tail_weights
from actors.optimizer.suggest import propose
from sim_engine.search_space import Axis, Space

LOSSES = st.lists(st.floats(-1e3, 1e3), min_size=1, max_size=30)
LEVELS = st.floats(0.0, 0.99)
SPACE = Space((Axis("x_offset", 0.0, 1.0),))


def conditional_value_at_risk(losses: list[float], level: float) -> float:
    row = np.asarray(losses)[None, :]
    return float((tail_weights(row, level) * row).sum())


@given(LOSSES, LEVELS, LEVELS)
def test_cvar_rises_from_the_mean_to_the_worst(losses: list[float], one: float, other: float) -> None:
    low, high = sorted((one, other))
    slack = 1e-9 * (1.0 + max(map(abs, losses)))
    assert conditional_value_at_risk(losses, 0.0) == pytest.approx(np.mean(losses), abs=slack)
    assert conditional_value_at_risk(losses, 1e-9) == pytest.approx(np.mean(losses), abs=1e-5)
    assert conditional_value_at_risk(losses, low) <= conditional_value_at_risk(losses, high) + slack
    assert conditional_value_at_risk(losses, high) <= max(losses) + slack


@given(LOSSES, LEVELS, st.floats(-100.0, 100.0), st.floats(0.0, 100.0))
def test_cvar_moves_and_scales_with_the_losses(losses: list[float], level: float, shift: float, scale: float) -> None:
    before = conditional_value_at_risk(losses, level)
    after = conditional_value_at_risk([scale * loss + shift for loss in losses], level)
    assert after == pytest.approx(scale * before + shift, rel=1e-9, abs=1e-6)


@given(st.lists(st.tuples(st.floats(-100, 100), st.floats(-100, 100)), min_size=1, max_size=20), LEVELS)
def test_two_risks_together_are_no_worse_than_both_apart(pairs: list[tuple[float, float]], level: float) -> None:
    together = conditional_value_at_risk([a + b for a, b in pairs], level)
    apart = [conditional_value_at_risk(side, level) for side in zip(*pairs, strict=True)]
    assert together <= sum(apart) + 1e-8


@settings(deadline=None)
@given(st.lists(st.floats(-10, 10), min_size=2, max_size=25), st.floats(0.05, 0.95))
def test_cvar_is_the_minimum_of_rockafellar_and_uryasev(losses: list[float], level: float) -> None:
    """Their theorem: min over c of c + mean(max(loss − c, 0)) / (1 − β), attained at one of the losses."""
    values = [c + np.mean(np.maximum(np.array(losses) - c, 0.0)) / (1.0 - level) for c in losses]
    assert conditional_value_at_risk(losses, level) == pytest.approx(min(values), abs=1e-9)


def shifted(errors: np.ndarray) -> tuple[Disturbance, ...]:
    return tuple(Disturbance((1.0,), (float(error),)) for error in errors)


def test_the_measure_is_that_of_many_functions_drawn_from_the_surrogate() -> None:
    """Mean and deviation beside those of a thousand functions, drawn from the GP's posterior."""
    rng = np.random.default_rng(2)
    points = rng.random((9, 1))
    process = constant_mean_process(points, np.sin(6.0 * points[:, 0]) + 0.05 * rng.standard_normal(9))
    errors = np.linspace(-0.15, 0.15, 12)
    place = np.array([[0.62]])
    executed = place + errors[:, None]
    covariance = process.covariance(executed, executed) + 1e-10 * np.eye(12)
    drawn = rng.multivariate_normal(process.predict(executed)[0], covariance, size=4000)
    for level in (0.0, 0.75):
        mean, deviation = RiskProcess(process, shifted(errors), level).predict(place)
        weighed = np.array([conditional_value_at_risk(losses, level) for losses in drawn])
        if level == 0.0:
            assert mean[0] == pytest.approx(weighed.mean(), abs=5.0 * weighed.std() / 4000**0.5)
            assert deviation[0] == pytest.approx(weighed.std(), rel=0.1)
        else:  # of a mean function: a lower bound, and not far below
            assert weighed.mean() - 2.0 * deviation[0] < mean[0] <= weighed.mean() + 1e-6


def test_the_best_action_bears_the_errors() -> None:
    """A narrow valley of depth 0 at 0.2, a broad one of depth 0.1 at 0.7, and errors wider than the narrow one."""

    def cost(x: float) -> float:
        narrow, broad = np.exp(-0.5 * ((x - 0.2) / 0.04) ** 2), np.exp(-0.5 * ((x - 0.7) / 0.2) ** 2)
        return float(min(1.0 - narrow, 1.0 - 0.9 * broad))

    places = np.linspace(0.0, 1.0, 41)
    data = Data(tuple((float(x),) for x in places), tuple(cost(float(x)) for x in places))
    problem = MinimumQuery(SPACE, data, acquisition="posterior_minimum", seed=1)
    assert abs(propose(problem).points[0][0] - 0.2) < 0.03
    risk = Risk(shifted(np.linspace(-0.12, 0.12, 21)), 0.0)
    answer = propose(RiskQuery(SPACE, data, acquisition="posterior_minimum", seed=1, risk=risk, predict_at=data.points))
    assert abs(answer.points[0][0] - 0.7) < 0.1
    assert answer.best_point is not None
    assert abs(answer.best_point[0] - 0.7) < 0.1
    assert answer.risk is not None
    index = data.points.index(answer.best_point)
    assert answer.risk.expected[index] == pytest.approx(answer.best_mean)
    cvar = propose(RiskQuery(SPACE, data, count=0, risk=Risk(risk.disturbances, 0.8), predict_at=((0.7,),)))
    assert cvar.best_mean is not None
    assert cvar.best_mean > answer.risk.expected[index]


def test_a_question_about_risk_that_can_not_be_answered_says_why() -> None:
    data = Data(((0.1,), (0.5,)), (0.2, 0.3))
    good = Risk(shifted(np.array([0.0])))
    for risk, complaint in (
        (Risk(good.disturbances, 1.0), "level"),
        (Risk(()), "disturbances are outside"),
        (Risk((*good.disturbances, Disturbance((1.0,), (0.0,), (0.5,)))), "fit neither space"),
        (Risk((Disturbance((1.0,), (float("nan"),)),)), "not finite"),
    ):
        with pytest.raises(ValueError, match=complaint):
            propose(RiskQuery(SPACE, data, risk=risk, predict_at=((0.1,),)))
    with pytest.raises(ValueError, match="predict_at"):
        propose(RiskQuery(SPACE, data, risk=good))
