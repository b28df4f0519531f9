"""`posterior_summary`: rounding may decide which of many equally good θ becomes θ*. Plans and predictions use the
posterior, and agree.
"""

from __future__ import annotations

import hashlib
from functools import cache
from statistics import fmean
from typing import Any

import numpy as np
import pytest

from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import CalibrationGain, Scores
from orchestrator.learning.calibration.continuous_calibration import ContinuousBayesianCalibration
from orchestrator.learning.campaign_plan import DeploymentPlan, MeasuredPour
from orchestrator.learning.deployment.costing import Costing
from orchestrator.learning.single_action import ActionPrediction, RepeatedSimulation
from orchestrator.runs.stages import CALIBRATION, EVALUATION, posterior_draws, with_posterior
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, SCENE, StrategyHarness
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.search_space import Axis, Space
from tests.support.plans import calibration_plan, deployment_plan

TIED = Space((Axis("cohesion", 0.0, 0.1), Axis("friction", 0.0, 0.5)))
TRUTH = SimulationParameters(cohesion=0.05, friction=0.25)
PERTURBATION = 1e-7
"""Relative; any rounding is smaller."""

DRAWS = 32


def scatter(action: Action, theta: SimulationParameters) -> float:
    """Standard normal; like a real simulation's, it is another one after the least change of what is simulated."""
    digest = hashlib.sha256(repr((action, theta)).encode()).digest()
    return float(np.random.default_rng(list(digest)).standard_normal())


def tumbler(action: Action, theta: SimulationParameters, _: Any = None) -> float:
    """Of two parameters only the sum matters (each over its range): no pours into it can separate them."""
    speed = (action.angular_velocity / DEG - 15) / 105
    both = 0.5 * (theta.cohesion / 0.1 + theta.friction / 0.5)
    return 0.1 + 0.5 * speed * both + 0.01 * scatter(action, theta)


def bowl(action: Action, theta: SimulationParameters, _: Any = None) -> float:
    """Another vessel, in which friction counts more."""
    speed = (action.angular_velocity / DEG - 15) / 105
    both = 0.2 * theta.cohesion / 0.1 + 0.8 * theta.friction / 0.5
    return 0.1 + 0.5 * speed * both + 0.01 * scatter(action, theta)


@cache
def calibrated(perturbed: int) -> Calibrated:
    """A calibration on 16 pours whose weights are changed by ± 1e-7, relative; not for 0."""
    rng, signs = np.random.default_rng(1), np.random.default_rng(perturbed)
    pours = []
    for _ in range(16):
        action = SCENE.action(CALIBRATION_ACTIONS.draw(rng))
        factor = 1.0 + PERTURBATION * signs.choice([-1.0, 1.0]) * (perturbed > 0)
        pours.append(MeasuredPour(action, tumbler(action, TRUTH) * factor, 0.98, "train"))
    plan = calibration_plan(simulations=24, parameters=TIED, fixed_parameters={"particles": 2000})
    strategy = ContinuousBayesianCalibration(plan, pours, 5)
    StrategyHarness(tumbler).run(strategy)
    return strategy.result()


def predicted(found: Calibrated) -> ActionPrediction:
    """The prediction of a pour into the bowl with draws of the posterior."""
    assert found.found is not None
    action = SCENE.action({"angular_velocity": 90 * DEG, "max_angle": 100 * DEG})
    drawn = posterior_draws(found.found, DRAWS)
    strategy = RepeatedSimulation(Costing(Loss(), SCENE, found.found.theta), action, DRAWS, 3, drawn)
    StrategyHarness(bowl).run(strategy)
    return strategy.result()


@pytest.mark.slow
def test_predictions_of_calibrations_that_differ_by_rounding_lie_in_each_others_intervals() -> None:
    predictions = [predicted(calibrated(k)) for k in range(3)]
    for one in predictions:
        assert one.interval is not None
        for other in predictions:
            assert one.interval.low <= other.over_seeds["spillage"].mean <= one.interval.high
    truth = bowl(SCENE.action({"angular_velocity": 90 * DEG, "max_angle": 100 * DEG}), TRUTH)
    assert all(one.interval.low <= truth <= one.interval.high for one in predictions if one.interval)


def planned(strategy: str = "D1", **results: Any) -> DeploymentPlan:
    """A plan as it is built after a calibration."""
    budget = {"iterations": 8, "simulations_per_iteration": 2, "pours": 0} if strategy == "D1" else {}
    return with_posterior(deployment_plan(strategy=strategy, **budget), {CALIBRATION: calibrated(0), **results})


def test_a_plan_simulates_with_all_theta_that_fit_and_reports_one_of_them() -> None:
    plan, found = planned(), calibrated(0).found
    assert found is not None
    assert found.theta in set(posterior_draws(found, 10_000)), "θ* represents the posterior"
    strategy = plan.settings.build(plan, SCENE, found.theta, 7)
    used = [one.parameters for one in StrategyHarness(bowl).run(strategy).simulations]
    assert len(used) == 16
    assert set(used) <= set(plan.thetas)
    order = sorted(plan.thetas, key=lambda theta: theta.cohesion)
    places = [order.index(theta) / len(order) for theta in used]
    assert len(set(used)) > 12
    assert 0.3 < fmean(places) < 0.7, "an even sample, so that the mean over it is that of the posterior"


def test_a_plan_keeps_the_uncalibrated_theta_if_the_pours_do_not_justify_another() -> None:
    plain = SimulationParameters(particles=2000)
    scores = Scores(
        simulations=0,
        undefined={},
        discrepancy={},
        random_median={},
        thetas={"uncalibrated": plain},
        pairs=(),
        gain=CalibrationGain(
            pours=2, pairs=2, calibrated=0.1, uncalibrated=0.1, gain=0.0, gain_error=0.1,
            recommended="uncalibrated", text="",
        ),
    )  # fmt: skip
    assert planned(**{EVALUATION: scores}).thetas == ()
    assert planned().thetas


def test_d3_uses_the_draws_unless_it_learns_the_searched_offsets_itself() -> None:
    assert planned("D3").thetas
    found = calibrated(0).found
    assert found is not None
    searched = replace_model(found, searched=("cohesion", "receiver_x"))
    results = {CALIBRATION: replace_model(calibrated(0), found=searched)}
    assert with_posterior(deployment_plan(model="adaptive"), results).thetas == ()
    assert with_posterior(deployment_plan(model="residual"), results).thetas, "it learns no offsets"


def replace_model(model: Any, **changes: Any) -> Any:
    """A result with other values."""
    return model.model_copy(update=changes)
