"""Reads the stages' results (as strategies give them and the journal keeps them) into what figures and tables need.

A stage is known by what its result holds, not by its name, so that a run of any composition can be reported.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from orchestrator.plan import CampaignPlan
from orchestrator.report.figures import DiscrepancyGroup, PourSeries
from orchestrator.report.maps import SurrogatePicture
from orchestrator.report.names import receiver_name
from orchestrator.report.units import DISCREPANCY, LossUnit, at_least_nothing, deployment_unit, largest_loss

Result = Mapping[str, Any]
Results = Mapping[str, Result]
"""Stage name → what its strategy's `result()` gave."""

SPLITS = {"train": "training pours", "test": "test pours", "transfer": "another receiver"}
"""Names of the sets of weighed pours, in the order of reports."""


def calibration_of(results: Results) -> Result | None:
    """The result of the calibration stage, if it found a θ*."""
    return next((r for r in results.values() if r.get("theta") is not None and "trials" in r), None)


def evaluation_of(results: Results) -> Result | None:
    """The scores of θ* and its rivals on weighed pours: all evaluation stages taken together."""
    found = [r for r in results.values() if "discrepancy" in r and "random_median" in r]
    if not found:
        return None
    scores: dict[str, dict[str, float | None]] = {}
    medians: dict[str, float | None] = {}
    for one in found:
        for label, by_split in one["discrepancy"].items():
            scores.setdefault(label, {}).update(by_split)
        medians.update(one["random_median"])
    return {
        "discrepancy": scores,
        "random_median": medians,
        "pairs": [pair for one in found for pair in one.get("pairs", ())],
        "simulations": sum(int(one.get("simulations", 0)) for one in found),
    }


def deployments_of(results: Results) -> dict[str, Result]:
    """Results of the deployment stages by scene."""
    return {str(r["scene"]): r for r in results.values() if "strategy" in r and "scene" in r}


def predictions_of(results: Results) -> dict[str, Mapping[str, Any]]:
    """What fresh seeds of the recommended actions came to, by scene: quantity → mean, deviation, count."""
    return {str(r["prediction_of"]): r["over_seeds"] for r in results.values() if "prediction_of" in r}


def calibrated_label(evaluation: Result) -> str | None:
    """Under which label an evaluation scored θ*: the one that isn't random."""
    return next((label for label in evaluation["discrepancy"] if not label.startswith("random ")), None)


def discrepancy_groups(
    evaluation: Result, baselines: Mapping[str, Mapping[str, float | None]] | None = None
) -> list[DiscrepancyGroup]:
    """Scores by set of pours, for `draw_discrepancy`.

    Args:
        evaluation: as `evaluation_of` gives it.
        baselines: 'mean_predictor' and 'regression' by split, where they were computed.
    """
    label = calibrated_label(evaluation)
    if label is None:
        return []
    groups = []
    for split, name in SPLITS.items():
        own = evaluation["discrepancy"][label].get(split)
        if own is None:
            continue
        rivals = [
            scores[split]
            for other, scores in evaluation["discrepancy"].items()
            if other.startswith("random ") and scores.get(split) is not None
        ]
        rival = (baselines or {}).get(split, {})
        groups.append(
            DiscrepancyGroup(
                name,
                sum(pair["split"] == split and pair["theta"] == label for pair in evaluation["pairs"]),
                float(own),
                [float(value) for value in rivals if value is not None],
                rival.get("mean_predictor"),
                rival.get("regression"),
            )
        )
    return groups


def calibration_picture(plan: CampaignPlan, result: Result) -> SurrogatePicture | None:
    """The discrepancy over θ; None where the plan calibrates nothing or no trial told anything."""
    if plan.calibration is None:
        return None
    trials = [t for t in result["trials"] if t["discrepancy"] is not None]
    mean, deviation = _grids(result, DISCREPANCY)
    if not trials and mean is None:
        return None
    return SurrogatePicture(
        title=f"Discrepancy over θ: {plan.calibration.scene.receiver.name}",
        cost=DISCREPANCY.label,
        space=plan.calibration.parameters,
        points=[t["theta"] for t in trials],
        costs=[DISCREPANCY.factor * t["discrepancy"] for t in trials],
        best=result.get("theta"),
        largest=DISCREPANCY.factor,
        mean=mean,
        deviation=deviation,
        **_cut(result),
    )


def deployment_picture(plan: CampaignPlan, result: Result) -> SurrogatePicture | None:
    """The loss over actions with the pours numbered; None before anything was learnt."""
    if plan.deployment is None:
        return None
    unit = deployment_unit(plan.deployment)
    pours = weighed(result)
    mean, deviation = _grids(result, unit)
    if not pours and mean is None:
        return None
    return SurrogatePicture(
        title=f"Loss over actions: {receiver_name(plan, result['scene'])} ({result['strategy']})",
        cost=unit.label,
        space=plan.deployment.actions,
        points=[p["action_si"] for p in pours],
        costs=[unit.factor * p["loss"] for p in pours],
        best=result.get("action_si"),
        best_name="best action",
        mean=mean,
        deviation=deviation,
        numbers=[int(p["number"]) for p in pours],
        simulated=[one["action_si"] for one in result.get("simulated", ())],
        largest=unit.factor * largest_loss(plan.deployment),
        **_cut(result),
    )


def pour_series(plan: CampaignPlan, results: Results, unit: LossUnit) -> list[PourSeries]:
    """Pours by receiver, for `draw_spillage`; refused ones (nothing was poured) are left out."""
    series = []
    for scene, result in deployments_of(results).items():
        pours = [p for p in result["pours"] if p["status"] in ("weighed", "failed")]
        if not pours:
            continue
        series.append(
            PourSeries(
                f"{receiver_name(plan, scene)} ({result['strategy']})",
                [
                    unit.factor * p["loss"] if p["status"] == "weighed" and p["loss"] is not None else None
                    for p in pours
                ],
                [
                    None
                    if p["predicted"] is None
                    else (
                        unit.factor * at_least_nothing(p["predicted"]),
                        unit.factor * (p["predicted_deviation"] or 0.0),
                    )
                    for p in pours
                ],
            )
        )
    return series


def weighed(result: Result) -> Sequence[Result]:
    """The pours of a deployment that gave a loss."""
    return [p for p in result["pours"] if p["status"] == "weighed" and p["loss"] is not None]


def _grids(result: Result, unit: LossUnit) -> tuple[Any, Any]:
    grids = result.get("map")
    if grids is None:
        return None, None
    mean = np.maximum(np.asarray(grids["mean"], float), 0.0)  # see `at_least_nothing`
    return unit.factor * mean, unit.factor * np.asarray(grids["deviation"], float)


def _cut(result: Result) -> dict[str, Any]:
    """Which axes a result's map is over, and where the others were held."""
    grids = result.get("map")
    if grids is None or "over" not in grids:  # a map of all axes, as the first versions wrote it
        return {}
    return {"over": tuple(grids["over"]), "held": dict(grids["held"])}
