"""Makes the result document of a run from its plan, its record and the results of its stages."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from actors.laboratory_settings import MODE_LABELS
from orchestrator.learning.calibration.calibration_base import CalibratedTheta
from orchestrator.learning.calibration.calibration_scores import Scores
from orchestrator.learning.calibration.posterior_summary import PosteriorSummary
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan, receiver_names
from orchestrator.learning.deployment.deployment_result import Deployed
from orchestrator.learning.single_action import ActionPrediction, Confirmed
from orchestrator.learning.stage_result import weighed_masses
from orchestrator.records.codec import Results
from orchestrator.records.journal_check import JournalCheck
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import Occupancy, RunPour, RunState
from orchestrator.records.verdict import verdict_of
from orchestrator.reports import figure_style as style
from orchestrator.reports import wording
from orchestrator.reports.loss_units import (
    SPILLAGE,
    LossUnit,
    deployment_unit,
    is_calibration,
    loss_of_pour,
    minimised_loss,
    unit_of_pour,
)
from orchestrator.reports.run_summary import (
    NOT_SEARCHED,
    LogEntry,
    NotSimulated,
    ParameterSummary,
    PoolUse,
    PourSummary,
    QuestionSummary,
    ReceiverSummary,
    RunFiles,
    RunLearning,
    RunLog,
    RunOutcome,
    RunSummary,
    StageSummary,
    Totals,
)
from orchestrator.reports.stage_views import (
    SPLITS,
    calibrated_label,
    calibration_of,
    confirmations_of,
    deployments_of,
    evaluation_of,
    gain_of,
    predictions_of,
    recommended_theta_of,
    rival_scores,
    theta_of,
)
from sim_engine.model_validity import NotCovered

MOST_DECISIONS = 300
"""Largest number of decisions in a summary, the most recent ones."""


NO_ADVICE = "This run recommends no action that can be read here."


def summarise(
    plan: CampaignPlan,
    results: Results,
    *,
    record: RunState | None = None,
    run: str = "",
    versions: Mapping[str, Any] | None = None,
    check: JournalCheck | None = None,
    files: RunFiles | None = None,
    not_covered: Mapping[str, Sequence[NotSimulated]] | None = None,
    best_not_covered: Mapping[str, Sequence[NotCovered]] | None = None,
    totals: Totals | None = None,
) -> RunSummary:
    """The result document of a run.

    Args:
        plan: plan of the campaign.
        results: results of the stages.
        record: content of the run's journal.
        run: name of the run's folder.
        versions: content of `versions.json`.
        check: check of the journal.
        files: figures and recording.
        not_covered: effects that are not simulated in the action spaces, by scene.
        best_not_covered: the same for the recommended actions.
        totals: costs of the run.
    """
    record, totals, files = record or RunState(Header(plan.name, {})), totals or Totals(), files or RunFiles()
    learning = _learning(plan, results)
    receivers = _receivers(plan, results, best_not_covered or {})
    advised = wording.advice(plan, receivers)
    outcome = _outcome(
        plan,
        record,
        advice=advised,
        without_advice=() if advised else tuple(wording.without_advice(plan, record, learning)),
        open_questions=(*_of_memory(results), *wording.open_questions(plan, record, learning, files.dropped_events)),
        loss=None if plan.deployment is None else plan.deployment.loss_name,
        loss_label="" if plan.deployment is None else deployment_unit(plan.deployment).label,
        receivers=receivers,
        not_covered={scene: tuple(several) for scene, several in (not_covered or {}).items()},
    )
    return RunSummary(
        **dict(totals),
        **_of_record(record, run, check),
        campaign=plan.name,
        seed=plan.seed,
        asked=wording.what_was_asked(plan, record),
        cost=wording.cost(record, totals.occupancy, _time_scale(plan)),
        settings=_settings(plan, versions or {}, files.recording, check, figures=bool(files.figures)),
        outcome=outcome,
        learning=learning,
        files=files,
        results=dict(results),
    )


def summarise_record(
    record: RunState,
    run: str,
    *,
    reason: str,
    catalogued: Mapping[str, Any],
    versions: Mapping[str, Any],
    check: JournalCheck,
    files: RunFiles,
) -> RunSummary:
    """The result document of a run whose campaign or results can't be read, for example because a plug-in is missing.

    Args:
        record: content of the run's journal.
        run: name of the run's folder.
        reason: why the rest can't be read.
        catalogued: the run's row of the catalogue: mode, seed, θ*, recommended actions.
        versions: content of `versions.json`.
        check: check of the journal.
        files: figures.
    """
    about = [
        f"Recommended for {receiver} by {row['strategy']} (degrees, millimetres, seconds): {_plain(row['action'])}."
        for receiver, row in (catalogued.get("recommended") or {}).items()
    ]
    if theta := catalogued.get("theta"):
        about.append(f"θ* (SI units): {_plain(theta)}.")
    fields = _of_record(record, run, check)
    fields["standing"] = (f"This report is reduced to what the journal has. {reason}", *fields["standing"])
    return RunSummary(
        **fields,
        campaign=record.header.name,
        seed=catalogued.get("seed"),
        mode=catalogued.get("mode") or "none",
        outcome=_outcome(None, record, without_advice=about or [NO_ADVICE]),
        asked={"campaign": record.header.name},
        cost=wording.cost(record, {}),
        settings={
            "campaign": Path(versions.get("campaign", record.header.name)).name,
            "seed": str(catalogued.get("seed", "not recorded")),
            **_programs(versions),
            "records": check.verdict,
        },
        files=files,
    )


def _plain(values: Mapping[str, float | None]) -> str:
    return ", ".join(f"{name} {value:.4g}" for name, value in values.items() if value is not None)


def _of_record(record: RunState, run: str, check: JournalCheck | None) -> dict[str, Any]:
    """The fields of a summary that come from the journal."""
    standing = wording.standing(record, run) if run else []
    decisions = record.decisions[-MOST_DECISIONS:]
    return {
        "run": run,
        "state": str(record.state),
        "verdict": verdict_of(record),
        "began_at": record.header.created or None,
        "ended_at": record.ended or None,
        "standing": (*(() if check is None else _damage(check)), *standing),
        "log": RunLog(
            notes=tuple(LogEntry(time=when, stage="", text=text) for when, text, _ in record.notes),
            decisions=tuple(LogEntry(time=d.time, stage=d.stage, text=d.text) for d in decisions),
        ),
    }


def _outcome(plan: CampaignPlan | None, record: RunState, **others: Any) -> RunOutcome:
    """The outcome, with the fields that come from the journal."""
    stages = (
        StageSummary(
            stage=stage.name,
            state="open" if stage.closed_at is None else "closed",
            pours=stage.pours,
            simulations=stage.simulations,
            unusable_simulations=stage.failed_simulations,
        )
        for stage in record.stages.values()
    )
    questions = (
        QuestionSummary(time=question.time, stage=question.stage, question=question.text, answer=question.answer)
        for question in record.questions
    )
    pours = pour_summaries(plan, record)
    return RunOutcome(stages=tuple(stages), pours_made=tuple(pours), questions=tuple(questions), **others)


def _damage(check: JournalCheck) -> list[str]:
    if not check.problems:
        return []
    pours = f" The ledger of pours names: {'; '.join(check.pours)}." if check.pours else ""
    return [
        "WARNING: the records of this run are damaged or incomplete. Numbers on this page may be wrong or missing. "
        f"Problems: {'; '.join(check.problems)}.{pours}"
    ]


# ---- pours


def pour_summaries(plan: CampaignPlan | None, record: RunState, *, live: bool = False) -> list[PourSummary]:
    """The requested pours of a run, in order.

    Args:
        plan: plan of the campaign; None if it can't be read.
        live: whether the run is in progress, so that a pour without outcome is under way.
    """
    best: dict[str, tuple[float, int]] = {}
    for pour in record.pours:
        if plan is not None and (loss := minimised_loss(plan, pour)) is not None:
            best[pour.stage] = min(best.get(pour.stage, (loss, pour.id)), (loss, pour.id))
    chosen = {key for _, key in best.values()}
    return [pour_summary(plan, pour, live=live, best=pour.id in chosen) for pour in record.pours]


def pour_summary(plan: CampaignPlan | None, pour: RunPour, *, live: bool = False, best: bool = False) -> PourSummary:
    """A pour in numbers and words; see `pour_summaries`."""
    request, measured, values = pour.request, pour.measured, pour.request.action.values()
    calibrating, unit, names = True, SPILLAGE, tuple(name for name, value in values.items() if value is not None)
    loss = None if measured is None else measured.fractions.spillage
    if plan is not None:
        calibrating, unit = is_calibration(plan, request), unit_of_pour(plan, request)
        section: CalibrationPlan | DeploymentPlan | None = plan.calibration if calibrating else plan.deployment
        names = ("angular_velocity", "x_offset") if section is None else section.actions.names
        loss = None if measured is None else loss_of_pour(plan, request, measured)
    masses = weighed_masses(measured)
    state = "unknown" if pour.state == "under way" and not live else pour.state
    came = "" if measured is None else "too little was poured" if loss is None else unit.text(loss)
    if measured is not None and masses.spilled_g is None:
        came = f"{1e3 * measured.delivered:.2f} g received"
    action = style.display_values({name: values[name] for name in names})
    receiver = request.scene if plan is None else receiver_names(plan).get(request.scene, request.scene)
    meaning = unit.meaning
    if request.dose is not None:
        meaning = "received"
        action = f"{1e3 * request.dose.amount:g} g wanted"
        if request.dose.cup and request.dose.source is not None:
            receiver, action = request.dose.cup, f"{action} from {request.dose.source.name}"
        came = "" if measured is None else f"{1e3 * measured.delivered:.1f} g"
    return PourSummary(
        stage=pour.stage,
        number=request.number,
        receiver=receiver,
        state=state,
        calibration=calibrating,
        action=action,
        action_si=values,
        predicted="" if request.predicted is None else unit.prediction(request.predicted),
        measured=pour.reason if state == "failed" else came,
        loss=meaning,
        best=best,
        remark=_remark(state, pour),
        **masses.model_dump(),
        time=pour.time,
        seconds=pour.seconds,
    )


def _remark(state: str, pour: RunPour) -> str:
    remark = {
        "unknown": "UNKNOWN: it had begun, and its outcome is not known",
        "under way": "under way",
        "asked": "requested, not started",
        "failed": f"failed: {pour.reason}",
    }.get(state, "")
    corrected = pour.answer.startswith("corrected")
    answer = pour.answer if corrected or not pour.answer else f"the operator answered: {pour.answer}"
    return "; ".join(filter(None, (remark, answer)))


# ---- θ and receivers


def _learning(plan: CampaignPlan, results: Results) -> RunLearning:
    evaluation, calibration, theta = evaluation_of(results), calibration_of(results), theta_of(results)
    memory = wording.memory_sentences(plan.memory, None if calibration is None else calibration.memory)
    learning = RunLearning(
        calibration_gain=gain_of(results), discrepancy=_discrepancies(evaluation), theta_sentences=tuple(memory)
    )
    if calibration is None or theta is None:
        return learning
    posterior = None if theta.posterior is None else theta.posterior.summary()
    learning = learning.model_copy(
        update={
            "theta": recommended_theta_of(results),
            "calibrated_theta": theta.theta,
            "predicted_discrepancy": theta.predicted_discrepancy,
            "predicted_deviation": theta.predicted_deviation,
            "posterior": posterior,
            "parameters": tuple(_parameters(plan.calibration, theta, posterior)),
        }
    )
    sentences = wording.theta_sentences(learning, plan.calibration, calibration.ended)
    return learning.model_copy(update={"theta_sentences": (*memory, *sentences)})


def _of_memory(results: Results) -> tuple[str, ...]:
    """What a person should check about the prior from earlier campaigns."""
    calibration = calibration_of(results)
    return () if calibration is None or calibration.memory is None else calibration.memory.questions


def _discrepancies(evaluation: Scores | None) -> dict[str, dict[str, float | None]]:
    label = None if evaluation is None else calibrated_label(evaluation)
    if evaluation is None or label is None:
        return {}
    ours, rivals = evaluation.discrepancy[label], rival_scores(evaluation)
    return {
        split: {"calibrated": ours[split], **{name: of[split] for name, of in rivals.items() if split in of}}
        for split in SPLITS
        if split in ours
    }


def _parameters(
    calibration: CalibrationPlan | None, theta: CalibratedTheta, posterior: PosteriorSummary | None
) -> Iterator[ParameterSummary]:
    axes = {} if calibration is None else {axis.name: axis for axis in calibration.parameters.axes}
    for name, value in theta.theta.model_dump().items():
        axis, region = axes.get(name), "—"
        if posterior is not None and name in posterior.region:
            low, high = posterior.region[name]
            open_end = ", not determined" if name in posterior.open else ""
            region = style.display_interval(name, low, high) + open_end
        yield ParameterSummary(
            name=style.PARAMETER_NAMES.get(name, name.replace("_", " ")),
            value=style.display_value(name, value),
            region=region,
            searched=NOT_SEARCHED if axis is None else style.display_interval(name, axis.lower, axis.upper),
        )


def _receivers(
    plan: CampaignPlan, results: Results, not_covered: Mapping[str, Sequence[NotCovered]]
) -> dict[str, ReceiverSummary]:
    names, predictions, confirmations = receiver_names(plan), predictions_of(results), confirmations_of(results)
    return {
        scene: _receiver(
            plan.deployment,
            names.get(scene, scene),
            result,
            predictions.get(scene),
            not_covered.get(scene, ()),
            confirmations.get(scene),
        )
        for scene, result in deployments_of(results).items()
    }


def _receiver(
    plan: DeploymentPlan | None,
    name: str,
    result: Deployed,
    predicted: ActionPrediction | None,
    not_covered: Sequence[NotCovered],
    confirmed: Confirmed | None,
) -> ReceiverSummary:
    pours, best, advised = result.weighed, result.best, result.recommended
    liquid = None
    if plan is not None:
        liquid = next((scene.liquid for scene in plan.scenes if scene.name == result.scene), None)
    prediction = None if predicted is None else predicted.over_seeds
    received = None if prediction is None else prediction.get("received")
    delivered = None if received is None or liquid is None else received.mean * liquid.mass
    return ReceiverSummary(
        receiver=name,
        strategy=result.strategy,
        pours=len(pours),
        failed_pours=result.failed_pours,
        failures=tuple(f"pour {row.number}: {row.reason}" for row in result.pours if row.status == "failed"),
        refused_pours=result.refused_pours,
        simulations=result.simulations,
        first=pours[0] if pours else None,
        best=best,
        recommended=advised,
        model_check=result.model_check,
        gave_up=result.gave_up,
        ended=result.ended,
        prediction=prediction,
        prediction_interval=None if predicted is None else predicted.interval,
        at_bounds=() if plan is None or advised is None else tuple(style.at_ends(advised.action_si, plan.actions.axes)),
        predicted_delivered_g=None if delivered is None else 1e3 * delivered,
        predicted_delivered_ml=None if delivered is None or liquid is None else liquid.millilitres(delivered),
        confirmed=confirmed,
        not_covered=tuple(not_covered),
        texts=_receiver_texts(result, confirmed, SPILLAGE if plan is None else deployment_unit(plan)),
    )


def _receiver_texts(result: Deployed, confirmed: Confirmed | None, unit: LossUnit) -> dict[str, str]:
    pours, best, advised = result.weighed, result.best, result.recommended
    texts = {"pours": str(len(pours) or ""), "first": "", "best measured": "", "delivered": ""}
    if pours and pours[0].loss is not None:
        texts["first"] = unit.text(pours[0].loss)
    if best is not None:
        texts["best measured"] = "" if best.loss is None else f"{unit.text(best.loss)} (pour {best.number})"
        texts["delivered"] = wording.amount_text(best.delivered_g, best.delivered_ml)
    texts["expected of the best action"] = (
        ""
        if advised is None
        else unit.text(advised.predicted_loss, advised.predicted_deviation) + unit.scatter(advised.predicted_scatter)
    )
    texts["poured again"] = ""
    if confirmed is not None and confirmed.loss is not None:
        count = "1 pour" if confirmed.loss.count == 1 else f"{confirmed.loss.count} pours"
        texts["poured again"] = f"{unit.text(confirmed.loss.mean, confirmed.loss.deviation)} ({count})"
    return texts | {"simulations": str(result.simulations or "")}


# ---- costs and settings


def pool_use(occupancies: Mapping[str, Occupancy]) -> dict[str, PoolUse]:
    """Use of the pool by stage."""
    shares = {}
    for stage, occupancy in occupancies.items():
        longest = max(occupancy.waits, default=None)
        shares[stage] = PoolUse(
            pool_busy=occupancy.fraction,
            arm_longest_wait_s=longest,
            arm_mean_wait_s=sum(occupancy.waits) / len(occupancy.waits) if occupancy.waits else None,
            text=wording.pool_line(occupancy.fraction, longest),
        )
    return shares


def _time_scale(plan: CampaignPlan) -> float | None:
    """How many times as fast as a real one a virtual bench runs; None for a real one."""
    laboratory = plan.laboratory
    if laboratory.mode != "virtual":
        return None
    scales = (settings.time_scale for settings in (laboratory.arm, laboratory.bench) if settings is not None)
    return next((scale for scale in scales if scale is not None), None)


def _settings(
    plan: CampaignPlan,
    versions: Mapping[str, Any],
    recording: Path | None,
    check: JournalCheck | None,
    *,
    figures: bool,
) -> dict[str, str]:
    settings = {
        "campaign": Path(versions.get("campaign", plan.source)).name,
        "seed": str(plan.seed),
        "minimised": "" if plan.deployment is None else deployment_unit(plan.deployment).label,
        "laboratory": f"{plan.laboratory.name} ({MODE_LABELS[plan.laboratory.mode]})",
        "simulations side by side": str(plan.parallel_simulations),
        **_programs(versions),
        "recording": "none" if recording is None else f"{recording.name}, next to this page",
        "every number": "summary.json, resolved.json, versions.json and journal.sqlite, next to this page",
        "figures": "" if figures else "none were drawn; 'decant report' draws them",
        "records": "" if check is None else check.verdict,
    }
    return {name: text for name, text in settings.items() if text}


def _programs(versions: Mapping[str, Any]) -> dict[str, str]:
    packages = {name: text for name, text in dict(versions.get("packages", {})).items() if text != "not installed"}
    python = f"{versions['python']} on {versions.get('platform', '')}" if "python" in versions else "not recorded"
    return {
        "Python": python,
        "packages": ", ".join(f"{name} {text}" for name, text in packages.items()) or "not recorded",
    }
