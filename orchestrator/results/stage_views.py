"""Views of stage results for figures and tables.

Stages are found by the kind of their result, not by their name, so that any composition of stages can be reported.
Scenes are displayed by the names of their receivers; a scene's own name is the key in the journal and for programs.
"""

from __future__ import annotations

from typing import Any, TypeVar

import numpy as np

from orchestrator.journal.stage_results import Results
from orchestrator.requests import Prediction
from orchestrator.results.loss_units import DISCREPANCY, LossUnit, at_least_nothing, deployment_unit, largest_loss
from orchestrator.results.spillage_figures import DiscrepancyGroup, PourSeries
from orchestrator.results.surrogate_figures import SurrogatePicture
from orchestrator.strategies.calibration.calibration_base import Calibrated, CalibratedTheta
from orchestrator.strategies.calibration.calibration_scores import (
    UNCALIBRATED,
    CalibrationGain,
    Scores,
    recommended_theta,
)
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategies.deployment.deployment_result import Deployed
from orchestrator.strategies.single_action import Confirmed, PredictedPour
from orchestrator.strategies.stage_result import DisplayedMap, StageResult
from sim_engine.liquids import SimulationParameters


def receiver_names(plan: CampaignPlan) -> dict[str, str]:
    """Scene name → the receiver's name; the scenes' own names if two deployment scenes have receivers with the same
    name."""
    names: dict[str, str] = {}
    if plan.deployment is not None:
        scenes = plan.deployment.scenes
        distinct = len({scene.receiver.name for scene in scenes}) == len(scenes)
        names = {scene.name: scene.receiver.name if distinct else scene.name for scene in scenes}
    if plan.calibration is not None:
        for known in (plan.calibration.records, plan.calibration.transfer):
            if known is not None:
                names.setdefault(known.scene.name, known.scene.receiver.name)
        for scene in plan.calibration.poured:
            names.setdefault(scene.name, scene.receiver.name)
    return names


def receiver_name(plan: CampaignPlan, scene: str) -> str:
    """Display name of a scene; its own name if the plan does not contain it."""
    return receiver_names(plan).get(scene, scene)


L = TypeVar("L", bound=StageResult)

SPLITS = {"train": "training pours", "test": "test pours", "transfer": "another receiver"}
"""Names of the sets of weighed pours, in the order of reports."""


def all_of(results: Results, kind: type[L]) -> list[L]:
    """The results of one kind, in the stages' order."""
    return [result for result in results.values() if isinstance(result, kind)]


def calibration_of(results: Results) -> Calibrated | None:
    """The calibration's result, if it found a θ*."""
    return next((found for found in all_of(results, Calibrated) if found.found is not None), None)


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
    found = theta_of(results)
    return None if found is None else recommended_theta(found.theta, evaluation_of(results))


def deployments_of(results: Results) -> dict[str, Deployed]:
    """Results of the deployments, by scene."""
    return {result.scene: result for result in all_of(results, Deployed)}


def confirmations_of(results: Results) -> dict[str, Confirmed]:
    """Results of the repeated pours of the recommended actions, by scene."""
    return {result.scene: result for result in all_of(results, Confirmed)}


def predictions_of(results: Results) -> dict[str, PredictedPour]:
    """Results of the repeated simulations of the recommended actions, by scene."""
    return {result.scene: result for result in all_of(results, PredictedPour)}


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


def discrepancy_groups(evaluation: Scores) -> list[DiscrepancyGroup]:
    """Scores by set of pours, for `draw_discrepancy`."""
    label = calibrated_label(evaluation)
    if label is None:
        return []
    groups = []
    for split, name in SPLITS.items():
        own = evaluation.discrepancy[label].get(split)
        if own is None:
            continue
        rivals = [scores.get(split) for other, scores in evaluation.discrepancy.items() if other.startswith("random ")]
        groups.append(
            DiscrepancyGroup(
                name,
                sum(pair.split == split and pair.theta == label for pair in evaluation.pairs),
                own,
                evaluation.discrepancy.get(UNCALIBRATED, {}).get(split),
                [value for value in rivals if value is not None],
                evaluation.mean_predictor.get(split),
                evaluation.regression.get(split),
                evaluation.posterior_mean.get(split),
            )
        )
    return groups


def calibration_picture(plan: CampaignPlan, result: Calibrated) -> SurrogatePicture | None:
    """The discrepancy over θ; None if the plan calibrates nothing or no trial has a discrepancy."""
    if plan.calibration is None:
        return None
    known = [(trial.theta, trial.discrepancy) for trial in result.trials if trial.discrepancy is not None]
    shown = None if result.found is None else result.found.map
    if not known and shown is None:
        return None
    return SurrogatePicture(
        title=f"Discrepancy over θ: {', '.join(scene.receiver.name for scene in plan.calibration.scenes)}",
        cost=DISCREPANCY.label,
        space=plan.calibration.parameters,
        points=[theta for theta, _ in known],
        costs=[DISCREPANCY.factor * discrepancy for _, discrepancy in known],
        best=None if result.found is None else result.found.theta.model_dump(),
        largest=DISCREPANCY.factor,
        **_surrogate(shown, DISCREPANCY),
    )


def deployment_picture(plan: CampaignPlan, result: Deployed) -> SurrogatePicture | None:
    """The loss over actions with numbered pours; None before the first data."""
    if plan.deployment is None:
        return None
    unit = deployment_unit(plan.deployment)
    known = [(pour, pour.loss) for pour in result.weighed if pour.loss is not None]
    if not known and result.map is None:
        return None
    return SurrogatePicture(
        title=f"Loss over actions: {receiver_name(plan, result.scene)} ({result.strategy})",
        cost=unit.label,
        space=plan.deployment.actions,
        points=[pour.action_si for pour, _ in known],
        costs=[unit.factor * loss for _, loss in known],
        best=None if result.recommended is None else result.recommended.action_si,
        best_name="best action",
        numbers=[pour.number for pour, _ in known],
        simulated=[one.action_si for one in result.simulated],
        largest=unit.factor * largest_loss(plan.deployment),
        **_surrogate(result.map, unit),
    )


def pour_series(plan: CampaignPlan, results: Results, unit: LossUnit) -> list[PourSeries]:
    """Pours by receiver, for `draw_spillage`; refused ones (nothing was poured) are left out."""
    series = []
    for scene, result in deployments_of(results).items():
        pours = [pour for pour in result.pours if pour.status in ("weighed", "failed")]
        if not pours:
            continue
        losses = [
            unit.factor * pour.loss if pour.status == "weighed" and pour.loss is not None else None for pour in pours
        ]
        predictions = [
            None
            if pour.predicted is None
            else _prediction_interval(
                Prediction(
                    pour.predicted, pour.predicted_deviation or 0.0, pour.predicted_scatter, pour.predicted_band
                ),
                unit,
            )
            for pour in pours
        ]
        series.append(PourSeries(f"{receiver_name(plan, scene)} ({result.strategy})", losses, predictions))
    return series


def _prediction_interval(predicted: Prediction, unit: LossUnit) -> tuple[float, float, float]:
    low, high = predicted.of_a_pour()
    return unit.factor * at_least_nothing(predicted.mean), unit.factor * low, unit.factor * high


def _surrogate(shown: DisplayedMap | None, unit: LossUnit) -> dict[str, Any]:
    """The map of a figure: its axes, and the values of the other axes."""
    if shown is None:
        return {}
    return {
        "mean": unit.factor * np.maximum(np.asarray(shown.mean, float), 0.0),  # see `at_least_nothing`
        "deviation": unit.factor * np.asarray(shown.deviation, float),
        "over": shown.over,
        "held": shown.held,
    }
