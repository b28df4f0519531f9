"""Creates the summary of a run from its plan and the results of its stages."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.journal.stage_results import Results
from orchestrator.results import figure_style as style
from orchestrator.results.run_summary import NotSimulated, ReceiverSummary, RunSummary, Totals
from orchestrator.results.stage_views import (
    SPLITS,
    calibrated_label,
    confirmations_of,
    deployments_of,
    evaluation_of,
    gain_of,
    predictions_of,
    receiver_names,
    recommended_theta_of,
    rival_scores,
    theta_of,
)
from orchestrator.strategies.calibration.calibration_scores import Scores
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategies.deployment.deployment_result import Deployed, Recommended
from orchestrator.strategies.single_action import Confirmed, PredictedPour
from sim_engine.liquids import Liquid
from sim_engine.model_validity import NotCovered
from sim_engine.search_space import Axis

if TYPE_CHECKING:
    from orchestrator.results.validity_warnings import SpaceWarning


def summarise(
    plan: CampaignPlan,
    results: Results,
    *,
    figures: Mapping[str, Path] | None = None,
    recording: Path | None = None,
    dropped_events: int = 0,
    not_covered: Mapping[str, Sequence[SpaceWarning]] | None = None,
    best_not_covered: Mapping[str, Sequence[NotCovered]] | None = None,
    totals: Totals | None = None,
) -> RunSummary:
    """The summary of a run.

    Args:
        plan: plan of the campaign.
        results: results of the stages.
        figures: name → file.
        recording: path of the `.rrd`.
        dropped_events: number of events missing in the recording.
        not_covered: effects that are not simulated in the action spaces, by scene.
        best_not_covered: the same for the recommended actions.
        totals: costs of the run.
    """
    found = theta_of(results)
    names, predictions, confirmations = receiver_names(plan), predictions_of(results), confirmations_of(results)
    liquids = {} if plan.deployment is None else {scene.name: scene.liquid for scene in plan.deployment.scenes}
    return RunSummary(
        **dict(totals or Totals()),
        campaign=plan.name,
        seed=plan.seed,
        theta=recommended_theta_of(results),
        calibrated_theta=None if found is None else found.theta,
        calibration_gain=gain_of(results),
        predicted_discrepancy=None if found is None else found.predicted_discrepancy,
        predicted_deviation=None if found is None else found.predicted_deviation,
        posterior=None if found is None or found.posterior is None else found.posterior.summary(),
        discrepancy=_discrepancies(evaluation_of(results)),
        loss=None if plan.deployment is None else plan.deployment.loss_name,
        receivers={
            scene: _receiver(
                names.get(scene, scene),
                result,
                predictions.get(scene),
                (best_not_covered or {}).get(scene, ()),
                liquids.get(scene),
                confirmations.get(scene),
                () if plan.deployment is None else plan.deployment.actions.axes,
            )
            for scene, result in deployments_of(results).items()
        },
        not_covered={
            scene: tuple(NotSimulated(**one.as_json()) for one in several)
            for scene, several in (not_covered or {}).items()
        },
        figures=dict(figures or {}),
        recording=recording,
        dropped_events=dropped_events,
        results=dict(results),
    )


def _discrepancies(evaluation: Scores | None) -> dict[str, dict[str, float | None]]:
    label = None if evaluation is None else calibrated_label(evaluation)
    if evaluation is None or label is None:
        return {}
    table: dict[str, dict[str, float | None]] = {}
    for split in SPLITS:
        if split in evaluation.discrepancy[label]:
            table[split] = {"calibrated": evaluation.discrepancy[label][split]}
            table[split] |= {
                name: scores[split] for name, scores in rival_scores(evaluation).items() if split in scores
            }
    return table


_NOTHING: dict[str, None] = dict.fromkeys(Recommended.model_fields)


def _receiver(
    name: str,
    result: Deployed,
    predicted: PredictedPour | None,
    not_covered: Sequence[NotCovered],
    liquid: Liquid | None,
    confirmed: Confirmed | None,
    axes: tuple[Axis, ...],
) -> ReceiverSummary:
    pours, best = result.weighed, result.best
    prediction = None if predicted is None else predicted.over_seeds
    received = None if prediction is None else prediction.get("received")
    delivered = None if received is None or liquid is None else received.mean * liquid.mass
    recommended: Mapping[str, Any] = _NOTHING if result.recommended is None else dict(result.recommended)
    return ReceiverSummary(
        receiver=name,
        strategy=result.strategy,
        pours=len(pours),
        failed_pours=result.failed_pours,
        failures=tuple(f"pour {row.number}: {row.reason}" for row in result.pours if row.status == "failed"),
        refused_pours=result.refused_pours,
        simulations=result.simulations,
        first_loss=pours[0].loss if pours else None,
        first_spillage=pours[0].spillage if pours else None,
        best_loss=None if best is None else best.loss,
        best_spillage=None if best is None else best.spillage,
        best_pour=None if best is None else best.number,
        best_delivered_g=None if best is None else best.delivered_g,
        best_delivered_ml=None if best is None else best.delivered_ml,
        best_measured_action=None if best is None else best.action,
        best_action=recommended["action"],
        best_action_si=recommended["action_si"],
        predicted_loss=recommended["predicted_loss"],
        predicted_deviation=recommended["predicted_deviation"],
        predicted_scatter=recommended["predicted_scatter"],
        predicted_spillage=recommended["predicted_spillage"],
        predicted_spillage_deviation=recommended["predicted_spillage_deviation"],
        untrustworthy_simulation=result.trust.alarm,
        trust=result.trust,
        gave_up=result.gave_up,
        ended=result.ended,
        front=result.front,
        risk=result.risk,
        window=result.window,
        prediction=prediction,
        prediction_band=None if predicted is None else predicted.band,
        at_bounds=tuple(style.at_ends(dict(recommended["action_si"] or {}), axes)),
        predicted_delivered_g=None if delivered is None else 1e3 * delivered,
        predicted_delivered_ml=None if delivered is None or liquid is None else liquid.millilitres(delivered),
        confirmed=confirmed,
        not_covered=tuple(not_covered),
    )
