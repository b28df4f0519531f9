"""`automatic_calibration`: a calibration with `simulations: auto` ends by itself, and names a θ that the weighed
pours prefer.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from scipy.stats import norm

from actors.optimizer.questions import Posterior
from orchestrator.learning.calibration import automatic_calibration
from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.automatic_calibration import simulation_limit
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import (
    NOT_JUSTIFIED,
    CalibrationEvaluation,
    ScoredPour,
    Scores,
)
from orchestrator.learning.calibration.posterior_summary import posterior_change
from orchestrator.learning.calibration.pour_residuals import (
    ResidualPair,
    SpillageResidual,
    misfit_sentence,
    pour_residuals,
)
from orchestrator.learning.campaign_plan import MeasuredPour
from orchestrator.learning.requests import Failed, Outcome, Request, Simulate
from orchestrator.runs.stages import CALIBRATION, EVALUATION, deployed_theta, with_posterior
from orchestrator.runs.strategy_harness import CALIBRATION_ACTIONS, SCENE, StrategyHarness, replay
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import resolution_shift
from tests.support.plans import calibration_plan, deployment_plan
from tests.support.toy_spillage import TRUE_THETA, calibration_spill

POURS = 6
PLAIN = SimulationParameters(particles=1000, cohesion=0.02)


class Quiet:
    def standard_normal(self) -> float:
        return 0.0


def exact(action: Action, theta: SimulationParameters, _: np.random.Generator) -> float:
    """The same pour always spills the same."""
    return float(np.clip(calibration_spill(action, theta, Quiet()), 0.0, 1.0))  # type: ignore[arg-type]


def poured(truth: SimulationParameters, count: int = POURS) -> list[MeasuredPour]:
    rng = np.random.default_rng(5)
    actions = [SCENE.action(CALIBRATION_ACTIONS.draw(rng)) for _ in range(count)]
    return [MeasuredPour(action, exact(action, truth, rng), 0.9) for action in actions]


def automatic(truth: SimulationParameters = TRUE_THETA, seed: int = 3) -> Any:
    plan = calibration_plan(simulations="auto", fixed_parameters=PLAIN.model_dump())
    return plan.settings.build(plan, poured(truth), seed)


@cache
def played(truth: SimulationParameters = TRUE_THETA) -> tuple[Calibrated, StrategyHarness, list[str]]:
    strategy = automatic(truth)
    harness = StrategyHarness(exact).run(strategy)
    result = strategy.result()
    assert isinstance(result, Calibrated)
    return result, harness, [decision.text for decision in strategy.decisions]


def error(theta: SimulationParameters, truth: SimulationParameters) -> float:
    rng = np.random.default_rng(0)
    return float(np.mean([abs(pour.spillage - exact(pour.action, theta, rng)) for pour in poured(truth)]))  # type: ignore[operator]


def test_it_ends_by_itself_when_the_posterior_stays_and_says_so() -> None:
    result, harness, decisions = played()
    assert result.ended is not None
    assert "changed the posterior by only" in result.ended
    assert f"calibration ends: {result.ended}" in decisions
    asked = [request for request in harness.asked if isinstance(request, Simulate)]
    assert result.simulations == len(asked) < simulation_limit(POURS)


def test_theta_describes_the_training_pours_as_the_truth_does() -> None:
    result, _, _ = played()
    assert result.found is not None
    assert error(result.found.theta, TRUE_THETA) < 0.3 * error(PLAIN, TRUE_THETA)


def test_an_uncalibrated_theta_that_is_right_stays_and_no_change_is_justified() -> None:
    result, _, _ = played(PLAIN)
    assert result.found is not None
    assert result.found.theta == PLAIN
    plan = calibration_plan(simulations="auto", fixed_parameters=PLAIN.model_dump())
    scored = [ScoredPour(SCENE.name, pour) for pour in poured(PLAIN)]
    evaluation = CalibrationEvaluation(
        PLAIN, {}, scored, Contexts.of(plan), 1, uncalibrated=PLAIN, train_seeds=result.pour_seeds
    )
    harness = StrategyHarness(exact).run(evaluation)
    assert tuple(request.seed for request in harness.asked if isinstance(request, Simulate)) == result.pour_seeds
    scores = evaluation.result()
    assert scores.gain is not None
    assert scores.gain.text.startswith(NOT_JUSTIFIED)
    results = {CALIBRATION: result, EVALUATION: scores}
    assert deployed_theta(results) == PLAIN
    assert not with_posterior(deployment_plan(), results).thetas


def test_candidates_that_cannot_become_the_best_are_dropped_and_the_first_theta_is_the_uncalibrated_one() -> None:
    result, harness, _ = played()
    asked = [request for request in harness.asked if isinstance(request, Simulate)]
    assert [request.parameters for request in asked[:POURS]] == [PLAIN] * POURS
    pours = {request.action for request in asked}
    assert pours == {pour.action for pour in poured(TRUE_THETA)}
    full = [trial for trial in result.trials if trial.discrepancy is not None and trial.defined == POURS]  # type: ignore[union-attr]
    assert len(full) < len(result.trials)
    assert result.found is not None
    assert result.found.predicted_discrepancy == min(trial.discrepancy for trial in full)  # type: ignore[type-var]


def test_a_replay_makes_the_same_requests_and_lost_simulations_do_no_harm(monkeypatch: pytest.MonkeyPatch) -> None:
    _, harness, _ = played()
    assert replay(automatic(), harness) == harness.asked
    count = 0

    def lossy(request: Request) -> Outcome | None:
        nonlocal count
        count += isinstance(request, Simulate)
        return Failed("diverged", "test") if isinstance(request, Simulate) and count % 7 == 0 else None

    monkeypatch.setattr(automatic_calibration, "STARTS_PER_PARAMETER", 4)
    strategy = automatic()
    StrategyHarness(exact, answer=lossy).run(strategy)
    assert strategy.finished


@pytest.mark.slow
def test_the_limit_follows_from_the_number_of_pours_alone(monkeypatch: pytest.MonkeyPatch) -> None:
    assert [simulation_limit(train) for train in (2, 8, 100)] == [100, 400, 1500]
    monkeypatch.setattr(automatic_calibration, "UNCHANGED", 0.0)
    monkeypatch.setattr(automatic_calibration, "STARTS_PER_PARAMETER", 4)
    monkeypatch.setattr(automatic_calibration, "THETAS_AT_MOST", 18)
    strategy = automatic()
    harness = StrategyHarness(exact).run(strategy)
    assert strategy.result().ended == f"the limit of {18 * POURS} simulations is reached"
    assert sum(isinstance(request, Simulate) for request in harness.asked) <= 18 * POURS


def test_the_change_of_a_posterior_is_measured_in_standard_deviations_and_across_a_ridge() -> None:
    rng = np.random.default_rng(1)

    def ridge(shift: float, across: float) -> Posterior:
        along = rng.normal(0.5 + shift, 0.1, 2000)
        points = np.stack([along, 1.0 - along + rng.normal(across, 0.002, 2000)], axis=1)
        return Posterior(tuple(map(tuple, points.tolist())), (0.02,) * 2000, 2000.0)

    assert posterior_change(ridge(0.0, 0.0), ridge(0.0, 0.0)) < 0.15
    assert posterior_change(ridge(0.0, 0.0), ridge(0.1, 0.0)) == pytest.approx(1.0, abs=0.15)
    assert posterior_change(ridge(0.0, 0.0), ridge(0.0, 0.004)) > 1.5


def test_swapped_weights_are_named_with_their_intervals_and_theta_without_them() -> None:
    count = 12
    pours = [replace(pour, line=i + 2) for i, pour in enumerate(poured(TRUE_THETA, count))]
    spilled = [pour.spillage or 0.0 for pour in pours]
    low, high = spilled.index(min(spilled)), spilled.index(max(spilled))
    swapped = list(pours)
    swapped[low] = replace(pours[low], spillage=spilled[high])
    swapped[high] = replace(pours[high], spillage=spilled[low])

    def scores(weighed: list[MeasuredPour]) -> Scores:
        plan = calibration_plan(simulations="auto", fixed_parameters=PLAIN.model_dump())
        strategy = plan.settings.build(plan, weighed, 3)
        StrategyHarness(exact).run(strategy)
        result = strategy.result()
        assert isinstance(result, Calibrated)
        evaluation = CalibrationEvaluation(
            strategy.theta,  # type: ignore[attr-defined]
            {},
            [ScoredPour(SCENE.name, pour) for pour in weighed],
            Contexts.of(plan),
            1,
            uncalibrated=PLAIN,
            train_seeds=result.pour_seeds,
            trials=[(trial.theta, trial.differences) for trial in result.trials],  # type: ignore[union-attr]
        )
        StrategyHarness(exact).run(evaluation)
        return evaluation.result()

    good, bad = scores(pours), scores(swapped)
    assert all(pour.fits for pour in good.pours)
    assert good.without is None
    assert {pour.number for pour in bad.pours if not pour.fits} == {low + 1, high + 1}
    assert all(pour.low is not None and pour.high is not None and pour.low < pour.high for pour in bad.pours)
    assert bad.without is not None
    assert bad.without.pours == tuple(sorted((low + 1, high + 1)))
    assert bad.without.discrepancy <= bad.without.discrepancy_now < 0.05
    assert bad.gain is not None
    assert f"pour {low + 1} (line {low + 2}) weighed {100 * spilled[high]:.1f} %" in bad.gain.text
    assert "without them θ* would be" in bad.gain.text


def compared(weighed: Sequence[float], simulated: Sequence[float]) -> tuple[SpillageResidual, ...]:
    """Residuals of training pours that were simulated with 400 particles."""
    action = SCENE.action(CALIBRATION_ACTIONS.decode([0.5, 0.5]))
    pairs = zip(weighed, simulated, strict=True)
    return pour_residuals([ResidualPair(MeasuredPour(action, r, 0.9, "train"), SCENE.name, c) for r, c in pairs], 400)


def test_two_exchanged_weights_are_named_as_a_pair_though_each_lies_in_its_interval() -> None:
    """0 and 16 % of one calibration. Its θ* lies between the two, so that the residuals of the others are larger."""
    spilled = [0.23, 0.04, 0.0, 0.007, 0.01, 0.062, 0.11, 0.33, 0.04, 0.052, 0.045, 0.16]
    simulated = [0.13, 0.09, 0.01, 0.03, 0.03, 0.12, 0.05, 0.19, 0.09, 0.02, 0.09, 0.11]
    assert all(pour.fits for pour in compared(spilled, simulated))
    spilled[2], spilled[11] = spilled[11], spilled[2]
    pours = compared(spilled, simulated)
    assert {pour.number: pour.exchanged_with for pour in pours if not pour.fits} == {3: 12, 12: 3}
    assert all(pour.low <= pour.measured <= pour.high for pour in pours)  # type: ignore[operator]
    assert "the weights of pour 3 and pour 12 seem to be exchanged" in misfit_sentence(pours, None)


def test_where_no_theta_without_the_misfits_was_simulated_the_sentence_says_how_to_find_it() -> None:
    spilled = [0.02, 0.05, 0.11, 0.02, 0.09, 0.50]
    pours = compared(spilled, [0.02, 0.05, 0.11, 0.02, 0.09, 0.03])
    of_a_table = [pour.model_copy(update={"line": pour.number + 1}) for pour in pours]
    advice = "for θ* without them, enter 'test' as their 'split' and calibrate again"
    assert advice in misfit_sentence(of_a_table, None)
    assert advice not in misfit_sentence(pours, None), "pours of the bench have no table"


def test_weights_that_scatter_are_not_called_exchanged() -> None:
    rng, tables = np.random.default_rng(4), 200
    named = 0
    for _ in range(tables):
        places = rng.uniform(-2.5, 0.0, 12)
        weighed = places + rng.normal(0.0, resolution_shift(400), 12)
        named += any(pour.exchanged_with for pour in compared(norm.cdf(weighed), norm.cdf(places)))
    assert named <= 6  # 1 in 100 expected


def test_few_pours_are_not_judged_and_a_pour_does_not_hide_itself() -> None:
    def pair(r: float, c: float, split: str = "train") -> ResidualPair:
        return ResidualPair(MeasuredPour(SCENE.action(CALIBRATION_ACTIONS.decode([0.5, 0.5])), r, 0.9, split), "s", c)

    few = pour_residuals([pair(0.1, 0.1), pair(0.9, 0.1)], 2000)
    assert [pour.fits for pour in few] == [None, None]
    many = pour_residuals([*[pair(0.2, 0.21)] * 5, pair(0.6, 0.2), pair(0.7, 0.2, "test")], 2000)
    assert [pour.fits for pour in many] == [*[True] * 5, False, False]
