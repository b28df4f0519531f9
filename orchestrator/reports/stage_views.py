"""Views of stage results for figures and tables.

Stages are found by the kind of their result, not by their name, so that any composition of stages can be reported.
"""

from __future__ import annotations

from typing import TypeVar

from orchestrator.learning.calibration.calibration_base import Calibrated, CalibratedTheta
from orchestrator.learning.calibration.calibration_scores import (
    UNCALIBRATED,
    CalibrationGain,
    Scores,
    recommended_theta,
)
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.single_action import ActionPrediction, Confirmed
from orchestrator.learning.stage_result import StageResult
from orchestrator.records.codec import Results
from sim_engine.liquids import SimulationParameters

L = TypeVar("L", bound=StageResult)

SPLITS = {"train": "training pours", "test": "test pours", "transfer": "another receiver"}
"""Names of the sets of weighed pours, in the order of reports."""


def all_of(results: Results, kind: type[L]) -> list[L]:
    """The results of one kind, in the stages' order."""
    return [result for result in results.values() if isinstance(result, kind)]


def calibration_of(results: Results) -> Calibrated | None:
    """The calibration's result, if it found a θ*."""
    return next((calibration for calibration in all_of(results, Calibrated) if calibration.found is not None), None)


def theta_of(results: Results) -> CalibratedTheta | None:
    """θ*, if one was found."""
    calibration = calibration_of(results)
    return None if calibration is None else calibration.found


def evaluation_of(results: Results) -> Scores | None:
    """The scores of θ* and its rivals on weighed pours."""
    return next(iter(all_of(results, Scores)), None)


def gain_of(results: Results) -> CalibrationGain | None:
    """Whether the weighed pours justify θ*; None if that was not compared."""
    evaluation = evaluation_of(results)
    return None if evaluation is None else evaluation.gain


def recommended_theta_of(results: Results) -> SimulationParameters | None:
    """The θ to simulate with: θ*, or the uncalibrated θ if the pours do not justify θ*; None before θ* was found."""
    theta = theta_of(results)
    return None if theta is None else recommended_theta(theta.theta, evaluation_of(results))


def deployments_of(results: Results) -> dict[str, Deployed]:
    """Results of the deployments, by scene."""
    return {result.scene: result for result in all_of(results, Deployed)}


def confirmations_of(results: Results) -> dict[str, Confirmed]:
    """Results of the repeated pours of the recommended actions, by scene."""
    return {result.scene: result for result in all_of(results, Confirmed)}


def predictions_of(results: Results) -> dict[str, ActionPrediction]:
    """Results of the repeated simulations of the recommended actions, by scene."""
    return {result.scene: result for result in all_of(results, ActionPrediction)}


def calibrated_label(evaluation: Scores) -> str | None:
    """The label of θ* in an evaluation: the one that is not a rival's."""
    rivals = ("random ", "posterior ", UNCALIBRATED)
    return next((label for label in evaluation.discrepancy if not label.startswith(rivals)), None)


def rival_scores(evaluation: Scores) -> dict[str, dict[str, float | None]]:
    """Scores of the rivals of θ*, by name and split: see `CalibrationEvaluation`."""
    return {
        "posterior": evaluation.posterior_mean,
        "uncalibrated": evaluation.discrepancy.get(UNCALIBRATED, {}),
        "random_theta": evaluation.random_median,
        "mean_predictor": evaluation.mean_predictor,
        "regression": evaluation.regression,
    }
