"""Sentences and tables about a run, each made once.

Sentences are written when the result document is made (`orchestrator.reports.summarise`): `advice`, `standing`,
`open_questions`, `what_was_asked`, `cost`, `theta_sentences`, and one line each for a prediction
interval and the use of the pool. The tables arrange the document's values; the console and the page render them.
"""

from __future__ import annotations

import time
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass

from actors.dosing.dose_series import LOST
from orchestrator.learning.calibration.calibration_scores import Scores
from orchestrator.learning.calibration.campaign_memory import CampaignMemory, MemoryFound
from orchestrator.learning.calibration.posterior_summary import PosteriorSummary
from orchestrator.learning.calibration.pour_residuals import SpillageResidual
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan
from orchestrator.learning.deployment.deployment_ledger import EQUAL_LOSS
from orchestrator.learning.deployment.deployment_result import Recommended
from orchestrator.learning.deployment.model_monitoring import DOUBT, Believed
from orchestrator.learning.deployment.real_pours import PredictionCheck
from orchestrator.learning.dispense import Dispensed
from orchestrator.learning.stage_result import entered_by_hand, weighed_masses
from orchestrator.learning.strategy import plural
from orchestrator.records.run_record import RunState
from orchestrator.records.states import State
from orchestrator.reports import figure_style as style
from orchestrator.reports.loss_units import (
    DISCREPANCY,
    LossUnit,
    deployment_unit,
    minimised_loss,
)
from orchestrator.reports.run_summary import (
    NOT_SEARCHED,
    Advice,
    PoolUse,
    PourSummary,
    ReceiverSummary,
    RunLearning,
    RunOutcome,
    RunSummary,
)
from orchestrator.reports.stage_views import SPLITS
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.liquids import Liquid
from sim_engine.outcome import PourMeasurement
from sim_engine.prediction_band import PredictionInterval
from sim_engine.scene import Scene
from sim_engine.search_space import Axis, Space


def trust_line(trust: PredictionCheck | Believed) -> str | None:
    """The judgement of the pours about the simulator; None if there is none.

    Args:
        trust: of a deployment's result.
    """
    if isinstance(trust, Believed):
        return trust.text or None
    return (
        "the first pours were far from their predictions; the simulator may not fit this vessel"
        if trust.alarm
        else None
    )


FEW = 5
"""Number of pours of an action below which their mean is not reliable."""


def advice(plan: CampaignPlan, receivers: Mapping[str, ReceiverSummary]) -> tuple[Advice, ...]:
    """Advice for each receiver with a deployment result, by scene."""
    if plan.deployment is None:
        return ()
    scenes = {scene.name: scene for scene in plan.deployment.scenes}
    unit = deployment_unit(plan.deployment)
    return tuple(_advice(scenes.get(name), row, unit) for name, row in receivers.items())


def _advice(scene: Scene | None, row: ReceiverSummary, unit: LossUnit) -> Advice:
    open_points = tuple(_open(row))
    if row.recommended is None:
        why = row.gave_up or "there is no result from which to choose an action"
        lines = (f"No action is recommended: {why}.",)
        return Advice(receiver=row.receiver, action={}, fixed={}, sentences=lines, open=open_points)
    return Advice(
        receiver=row.receiver,
        action=_shown(row.recommended.action_si),
        fixed={} if scene is None else _shown(scene.fixed),
        sentences=tuple(_sentences(scene, row, unit)),
        open=open_points,
    )


def _shown(values: Mapping[str, float | None]) -> dict[str, str]:
    return {name.replace("_", " "): style.display_value(name, v).replace("_", " ") for name, v in values.items()}


def _sentences(scene: Scene | None, row: ReceiverSummary, unit: LossUnit) -> list[str]:
    load = "" if scene is None else f" {1e3 * scene.liquid.mass:.0f} g of {scene.liquid.name}"
    cup = "" if scene is None else f" from {scene.pourer.name}"
    lines = [f"To pour{load}{cup} into {row.receiver}, use the recommended action."]
    if (expected := row.recommended) is not None:
        mean = unit.text(expected.predicted_loss, expected.predicted_deviation)
        scatter = unit.scatter(expected.predicted_scatter).removeprefix(", a pour ")
        lines.append(f"Expect {unit.meaning} of {mean}{scatter and f'; single pours differ from that by {scatter}'}.")
        lines += _equally_good(expected)
    if row.prediction is not None:
        lines.append(_prediction(row))
    if row.prediction_interval is not None:
        lines.append(_sentence(band_line(row.prediction_interval)))
    if row.confirmed is not None and row.confirmed.loss is not None:
        loss = row.confirmed.loss
        times = "once more" if loss.count == 1 else f"{loss.count} more times"
        lines.append(f"Poured {times} after the choice, its measured loss was {unit.text(loss.mean, loss.deviation)}.")
    if row.texts["best measured"]:
        best = row.texts["best measured"]
        lines.append(
            f"The smallest loss of {row.pours} weighed pours was {best}; the smallest of several is partly luck, so "
            "expect more of the next pour."
            if row.pours != 1
            else f"The loss of the only weighed pour was {best}."
        )
    if row.ended:
        lines.append(f"The search stopped: {row.ended.rstrip('.')}.")
    if _is_confirmed(row) and (trust := trust_line(row.model_check)) is not None:
        lines.append(_sentence(trust))
    return lines


def _equally_good(recommended: Recommended) -> list[str]:
    """'Equally good … x offset 90 … 110 mm', the ranges that are wider than a value."""
    ranges = recommended.equal_ranges or {}
    wide = {name: style.display_interval(name, *ends) for name, ends in ranges.items() if ends[0] < ends[1]}
    if not wide:
        return []
    listed = ", ".join(f"{name.replace('_', ' ')} {text}" for name, text in wide.items())
    within = f"to {100 * EQUAL_LOSS:.1f} % of the load"
    return [f"Equally good {within}, one changed at a time: {listed}. Of these, a slow one near the middle was taken."]


def _prediction(row: ReceiverSummary) -> str:
    """'Simulated again with 5 new seeds: spilled / poured 1.20 ± 0.40 %, retained …; delivered 193.2 g, 193.6 mL.'"""
    assert row.prediction is not None
    words = {"spillage": "spilled / poured", "spilled": "spilled", "retained": "retained"}
    shown = {text: row.prediction[name] for name, text in words.items() if name in row.prediction}
    if not shown:
        return "No simulation of it with new seeds could be used."
    count = max(spread.count for spread in shown.values())
    shares = ", ".join(f"{text} {spread.percent(2)}" for text, spread in shown.items())
    amount = amount_text(row.predicted_delivered_g, row.predicted_delivered_ml)
    delivered = f"; delivered {amount} in the mean" if amount else ""
    return f"Simulated again with {count} new seeds: {shares} (mean ± standard deviation){delivered}."


def amount_text(grams: float | None, millilitres: float | None) -> str:
    """'193.2 g, 193.6 mL'; '' if unknown."""
    return "" if grams is None or millilitres is None else f"{grams:.1f} g, {millilitres:.1f} mL"


def band_line(band: PredictionInterval) -> str:
    """'nine single pours in ten spill 0.8 … 5.7 % of what is poured (simulations ± 0.3, …)'; 'uncalibrated: …'."""
    causes = {"simulations": band.simulations, "residual of calibration": band.discrepancy}
    causes["resolution"] = band.resolution or None
    listed = ", ".join(f"{name} ± {100 * value:.2f}" for name, value in causes.items() if value is not None)
    if band.discrepancy is not None:
        return f"nine single pours in ten spill {band.percent(2)} of what is poured ({listed})"
    return (
        f"uncalibrated: nine single pours in ten spill {band.percent(0)} of what is poured, if this bench deviates "
        f"from the simulator as ten benches that were drawn at random ({listed})"
    )


def pool_line(busy: float | None, longest_wait: float | None) -> str:
    """'97 % busy; between two pours the arm waited 0.06 s at most'."""
    if busy is None:
        return ""
    text = f"{100 * busy:.0f} % busy"
    return text + ("" if longest_wait is None else f"; between two pours the arm waited {longest_wait:.2g} s at most")


def _is_confirmed(row: ReceiverSummary) -> bool:
    """Whether the pours confirm the judgement about the simulator without doubt."""
    trust = row.model_check
    return isinstance(trust, Believed) and bool(trust.after) and trust.after[-1].ignorance < DOUBT


def _open(row: ReceiverSummary) -> list[str]:
    lines = []
    if row.at_bounds:
        lines.append(f"Better actions may lie outside the searched range: {', '.join(row.at_bounds)}.")
    if not _is_confirmed(row) and (alarm := trust_line(row.model_check)) is not None:
        lines.append(_sentence(alarm))
    if row.gave_up and row.recommended is not None:
        lines.append(_sentence(row.gave_up))
    if row.recommended is not None:
        lines += _poured_again(row)
    if row.failed_pours:
        failures = "1 pour failed" if row.failed_pours == 1 else f"{row.failed_pours} pours failed"
        why = f": {'; '.join(row.failures)}" if row.failures else ""
        lines.append(f"{failures}{why}. They were not weighed.")
    confirming = () if row.confirmed is None else row.confirmed.pours
    if lost := [f"pour {pour.number}: {pour.failed}" for pour in confirming if pour.failed]:
        lines.append(f"Confirming pours that failed: {'; '.join(lost)}.")
    if row.recommended is not None:
        lines.append("Errors of grip, placement and speed are included only as they occurred in these pours.")
    return lines + [f"Not simulated at this action, {gap.kind}: {gap.text}." for gap in row.not_covered]


def _poured_again(row: ReceiverSummary) -> list[str]:
    """How well the recommended action is known from pours of it."""
    count = 0 if row.confirmed is None or row.confirmed.loss is None else row.confirmed.loss.count
    if not row.pours and not count:
        return ["Nothing was poured into this receiver: the expected loss is simulated, not weighed."]
    if not count:
        return [
            "The recommended action was not poured again after the choice ('confirm' in the campaign does that): its "
            "expected loss is a prediction."
        ]
    if count >= FEW:
        return []
    pours = "one pour" if count == 1 else f"{count} pours"
    return [f"Its loss is known from {pours}; this is too few to estimate how much pours differ."]


def open_questions(plan: CampaignPlan, record: RunState, learning: RunLearning, dropped_events: int) -> list[str]:
    """Open questions after a run that do not depend on the receiver.

    Args:
        dropped_events: number of events missing in the recording.
    """
    lines = []
    if plan.laboratory.mode == "virtual" and (record.pours or plan.laboratory.pours):
        lines.append(
            "The bench was VIRTUAL: no robot moved and no liquid was weighed. Its true liquid "
            "is simulated, too; a real cup may behave differently."
        )
    if learning.calibrated_theta is not None:
        lines += _about_theta(learning)
        if plan.deployment is not None and (error := unfitted_error(learning)):
            lines.append(error)
    elif plan.calibration is None:
        lines.append("The simulator was not calibrated in this run: its parameters are those of the campaign.")
    liquids = {scene.liquid.name for scene in plan.deployment.scenes} if plan.deployment is not None else set()
    if liquids:
        lines.append(
            f"These results hold for {', '.join(sorted(liquids))}, this load, these vessels and the fixed values of "
            "the motion. For other ones, plan again."
        )
    if dropped_events:
        lines.append(f"The recording lacks {dropped_events} events, because writing was too slow.")
    return lines


def _about_theta(learning: RunLearning) -> list[str]:
    """Open questions about θ*."""
    gain, posterior = learning.calibration_gain, learning.posterior
    lines, used = [], "calibrated"
    if gain is not None and gain.recommended != used:
        lines, used = [_sentence(gain.text)], gain.recommended
    if posterior is None:
        lines.append("Other θ may fit the weighed pours as well as θ*; their region was not computed.")
    elif posterior.open:
        names = ", ".join(name.replace("_", " ") for name in posterior.open)
        lines.append(f"The pours do not determine {names}: nearly the whole searched range fits them as well as θ*.")
    if learning.discrepancy and not unfitted_error(learning):
        lines.append("The simulator was not scored on pours that calibration did not see.")
    return lines


def unfitted_error(learning: RunLearning) -> str:
    """The error on pours that were not fitted, with that of a regression without a simulator; '' if none was scored."""
    gain = learning.calibration_gain
    used = "calibrated" if gain is None else gain.recommended
    parts = []
    for split, row in learning.discrepancy.items():
        if split == "train" or (mean := row.get(used)) is None:
            continue
        regression = row.get("regression")
        rival = "a regression can't predict it" if split == "transfer" else ""
        if regression is not None:
            rival = f"a regression of the training pours, without a simulator: {DISCREPANCY.text(regression)}"
        parts.append(f"{DISCREPANCY.text(mean)} on {SPLITS[split]}{rival and f' ({rival})'}")
    if not parts:
        return ""
    return f"On pours that were not fitted, the simulated spillage is off by {' and '.join(parts)} in the mean."


def memory_sentences(memory: CampaignMemory | None, verdict: MemoryFound | None) -> list[str]:
    """The runs that the prior comes from, and whether the pours agree with it; nothing without a prior."""
    if memory is None:
        return []
    return [_sentence(line) for line in (memory.lines if verdict is None else [verdict.text, *memory.lines[1:]])]


def theta_sentences(learning: RunLearning, calibration: CalibrationPlan | None, ended: str | None) -> list[str]:
    """The knowledge of θ*: its expected discrepancy, its posterior over the searched space, whether it is justified.

    Args:
        calibration: its plan, for the searched space and the liquid.
        ended: reason of the end of an automatic calibration.
    """
    lines, gain, posterior = [], learning.calibration_gain, learning.posterior
    if learning.predicted_discrepancy is not None:
        expected = DISCREPANCY.text(learning.predicted_discrepancy, learning.predicted_deviation or 0.0)
        lines.append(f"Expected {DISCREPANCY.meaning} of θ*: {expected}.")
    if posterior is not None and calibration is not None:
        lines += map(_sentence, posterior_lines(posterior, calibration.parameters))
        lines += identified_viscosity(posterior, calibration.scene.liquid)
    if ended is not None:
        lines.append(f"The calibration ended because {ended}.")
    if gain is not None:
        lines.append(_sentence(gain.text))
        if posterior is not None and gain.recommended == "calibrated":
            lines.append(POSTERIOR_ADVICE)
    return lines


POSTERIOR_ADVICE = (
    "Plan and predict with theta.json, as the run itself does: it averages over the θ that fit, and transfers better "
    "to other vessels than θ* alone."
)


def identified_viscosity(posterior: PosteriorSummary, liquid: Liquid) -> list[str]:
    """The posterior of a thick liquid's viscosity; nothing if it was not searched or the pours do not determine it."""
    if not liquid.is_thick or "viscosity_factor" not in posterior.region or "viscosity_factor" in posterior.open:
        return []
    declared = 1e3 * liquid.dynamic_viscosity
    low, high = (f"{declared * factor:.3g}" for factor in posterior.region["viscosity_factor"])
    interval = f"{low} … {high} mPa*s ({100 * posterior.level:.0f} %; declared {declared:.3g} mPa*s)"
    return [f"Viscosity of {liquid.name}, by these pours: {interval}."]


def posterior_lines(posterior: PosteriorSummary, space: Space) -> list[str]:
    """Which parameters the pours determine and which they do not, one sentence per line.

    Args:
        posterior: posterior of a calibration's result.
        space: searched θ.
    """
    identified, unknown = [], []
    for axis in space.axes:
        words, searched = axis.name.replace("_", " "), style.display_interval(axis.name, axis.lower, axis.upper)
        if axis.name in posterior.open:
            unknown.append(f"{words} ({searched})")
        else:
            interval = style.display_interval(axis.name, *posterior.region[axis.name])
            identified.append(f"{words} {interval} (searched {searched})")
    lines = []
    if identified:
        lines.append(f"{100 * posterior.level:.0f} % of the θ that fit the pours have {', '.join(identified)}")
    if unknown:
        lines.append(
            f"the pours do not determine {', '.join(unknown)}: nearly the whole searched range fits them as well as θ*"
        )
    return [*lines, *posterior.directions]


def without_advice(plan: CampaignPlan, record: RunState, learning: RunLearning) -> list[str]:
    """The outcome of a run that recommends no action."""
    if plan.deployment is not None and any(name.startswith("deployment") for name in record.stages):
        lines = ["No action is recommended yet: the result of a deployment is written when its stage ends."]
        losses = {loss: pour for pour in record.weighed if (loss := minimised_loss(plan, pour)) is not None}
        weighed = list(losses)
        if weighed:
            action = losses[min(weighed)].request.action.values()
            best = style.display_values({name: action[name] for name in plan.deployment.actions.names})
            unit = deployment_unit(plan.deployment)
            of = (
                f"The smallest loss of {len(weighed)} pours so far"
                if len(weighed) > 1
                else "The loss of the only pour so far"
            )
            lines.append(f"{of} is {unit.text(min(weighed))}, with {best}.")
        return lines
    if learning.calibrated_theta is not None:
        error = unfitted_error(learning)
        return [
            *([error] if error else []),
            "This run calibrated the simulator; it recommends no action. The parameters to use are in theta.json, "
            "which 'decant plan CAMPAIGN --parameters' reads.",
        ]
    return ["This run recommends no action."]


def cost(record: RunState, occupancy: Mapping[str, PoolUse], time_scale: float | None = None) -> dict[str, str]:
    """Costs of a run: pours, grams, minutes.

    Args:
        time_scale: how many times as fast as a real one a virtual bench runs; 0: it waits for nothing.
    """
    weighed = [p.measured for p in record.weighed if p.measured is not None]
    begun = [pour for pour in record.pours if pour.state != "asked"]
    costs: dict[str, str] = {}
    if begun:
        failed, unknown = sum(p.state == "failed" for p in begun), len(record.unknown_pours)
        lost = "".join(f", {n} {word}" for n, word in ((failed, "failed"), (unknown, "of unknown outcome")) if n)
        again = f" ({n} more than once)" if (n := sum(p.attempts > 1 for p in begun)) else ""
        costs["pours"] = f"{len(begun)} begun{again}, {len(weighed)} weighed{lost}"
    if liquid := _liquid(record, weighed):
        costs["liquid"] = liquid
    costs["program at work"] = minutes(record.at_work_s)
    arm = [pour.seconds for pour in begun if pour.seconds]
    if arm:
        pace = f" (this bench runs {time_scale:g} times as fast as a real one)" if time_scale not in (None, 1.0) else ""
        pace = " (this bench waits for nothing)" if time_scale == 0.0 else pace
        costs["of it pouring"] = f"{minutes(sum(arm))}, {sum(arm) / len(arm):.1f} s a pour{pace}"
    if record.simulations:
        each = f", {style.two_digits(record.cpu_s / record.simulations)} s each" if record.cpu_s else ""
        costs["simulations"] = f"{record.simulations}, {minutes(record.cpu_s)} of CPU time{each}"
    pools = {f"pool during pours, {stage.rpartition(':')[2]}": use.text for stage, use in occupancy.items()}
    return costs | {name: text for name, text in pools.items() if text}


def _liquid(record: RunState, weighed: Sequence[PourMeasurement]) -> str:
    """The masses that the pours of a run have moved.

    Of doses, the liquid in the source is no sum of a run: the next dose is poured from the same liquid. What they spill
    is not weighed, and estimated as in the account of vessels.
    """
    if not weighed:
        return ""
    masses = [weighed_masses(measured) for measured in weighed]
    delivered = sum(each.delivered_g or 0.0 for each in masses)
    if all(pour.request.dose is None for pour in record.pours):
        loaded, spilled, retained = (
            sum(getattr(each, name) or 0.0 for each in masses) for name in ("loaded_g", "spilled_g", "retained_g")
        )
        return f"{loaded:.0f} g: {delivered:.0f} g delivered, {spilled:.1f} g spilled, {retained:.1f} g retained"
    text = f"{delivered:.0f} g delivered"
    if spilled := sum(each.spilled_g or 0.0 for each in masses):
        text += f", {spilled:.1f} g spilled"
    unweighed = [
        LOST[0] + measured.notes.get("dose", {}).get("missing_mass", 0.0)
        for each, measured in zip(masses, weighed, strict=True)
        if each.spilled_g is None and not entered_by_hand(measured)
    ]
    estimate = 1e3 * sum(unweighed)
    count = f"{len(unweighed)} dose{'' if len(unweighed) == 1 else 's'}"
    return f"{text}; spilled by {count}: not weighed, {estimate:.0f} g by estimate" if unweighed else text


def minutes(seconds: float) -> str:
    """A duration in a suitable unit."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"


def standing(record: RunState, run: str) -> list[str]:
    """State of an unfinished run and the next steps; empty for a finished one.

    Args:
        run: its folder's name.
    """
    state = record.state
    if state is State.FINISHED:
        return []
    again = f"the command that began it, with '--resume --run {run}' added"
    lines = [f"This run is not finished. Its state is '{state}'{f': {record.reason}' if record.reason else ''}."]
    for pour in record.unknown_pours:
        dose = pour.request.dose
        weigh = "the spilled liquid and the liquid in the pourer"
        if dose is not None:
            weigh = "the content of " + (f"'{dose.position}'" if dose.position else "the receiver")
        lines.append(
            f"{'Pour' if dose is None else 'Dose'} {pour.request.number} of {pour.stage} had begun, and its outcome is "
            f"not known. The software does not repeat it. Weigh {weigh}, and give the answer on resuming."
        )
    lines += [f"A question is open: {q.text}" for q in record.questions if q.answer is None]
    match state:
        case State.FAILED:
            lines.append(f"Finished work is kept. Fix the problem above, then continue with {again}.")
        case State.PAUSED | State.UNKNOWN:
            lines.append(f"Finished work is kept. Continue with {again}.")
        case State.QUEUED:
            lines.append("Nothing was started yet.")
        case _:
            lines.append(
                "When this page was made, the run was in progress or its process had died; the page shows the "
                f"journal at that moment. If it no longer runs, continue with {again}."
            )
    return lines


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def what_was_asked(plan: CampaignPlan, record: RunState) -> dict[str, str]:
    """Names and values: the liquid, and the calibration of the simulator and the search for pours, or the doses."""
    rows: list[tuple[str, str]] = []
    mixtures = None if plan.dispense is None else plan.dispense.mixtures
    scenes = (list(plan.calibration.poured) if plan.calibration is not None else []) + (
        list(plan.deployment.scenes) if plan.deployment is not None else []
    )
    scenes += [*([] if plan.dispense is None else plan.dispense.scenes), *filter(None, [plan.pour])]
    if scenes:
        liquids = [scene.liquid for scene in (scenes if mixtures is not None else scenes[:1])]
        texts = (f"{1e3 * liq.mass:g} g of {liq.name} ({liq.millilitres(liq.mass):.0f} mL)" for liq in liquids)
        rows.append(("liquid", _listed(texts)))
        rows.append(("poured from", _listed(scene.pourer.name for scene in scenes)))
    if doses := [pour.request.dose for pour in record.pours if pour.request.dose is not None]:
        amounts = ", ".join(f"{1e3 * dose.amount:g} g" for dose in doses)
        counts = f"{plural(len({dose.position for dose in doses}), 'mixture')}, {plural(len(doses), 'dose')}"
        rows.append(("wanted", amounts if mixtures is None else counts))
        return dict(rows)
    if plan.calibration is not None:
        calibration = plan.calibration
        pours = f"{calibration.pour_count} pours, {calibration.holdout} of them kept for testing"
        if calibration.records is not None:
            pours = f"{plural(len(calibration.records.pours), 'weighed pour')} of {calibration.records.path.name}"
        simulations = plural(calibration.simulations, "simulation")
        if getattr(calibration.settings, "simulations", None) == "auto":
            simulations = f"at most {simulations}"
        rows += [
            ("calibration", f"{calibration.strategy} on {pours}; {simulations}"),
            ("calibration: into", calibration.scene.receiver.name),
            ("calibration: actions", _ranges(calibration.actions.axes)),
            ("calibration: searched θ", _ranges(calibration.parameters.axes)),
            ("calibration: fixed", _fixed(calibration.scene)),
        ]
    if plan.deployment is not None:
        two = plan.deployment
        rows += [
            ("pouring", f"{two.strategy}, into each receiver: {two.settings.spending}"),
            ("pouring: into", _listed(scene.receiver.name for scene in two.scenes)),
            ("pouring: minimised", deployment_unit(two).label),
            ("pouring: actions", _ranges(two.actions.axes)),
            ("pouring: fixed", _fixed(two.scenes[0]) if two.scenes else ""),
        ]
        if two.confirm:
            rows.append(("pouring: afterwards", f"the recommended action is poured {two.confirm} more times"))
        if two.data is not None:
            count = sum(len(pours) for pours in two.data.pours.values())
            rows.append(("pouring: known before", f"{plural(count, 'pour')} of {two.data.path.name}"))
    return {name: value for name, value in rows if value}


def _ranges(axes: Iterable[Axis]) -> str:
    return ", ".join(_range(axis) for axis in axes)


def _range(axis: Axis) -> str:
    factor, unit = style.display_factor(axis.name), style.display_unit(axis.name)
    words = style.PARAMETER_NAMES.get(axis.name, axis.name.replace("_", " "))
    return f"{words} {style.number(axis.lower / factor)} … {style.number(axis.upper / factor)} {unit}".rstrip()


def _fixed(scene: Scene) -> str:
    values = {name.replace("_", " "): style.display_value(name, value) for name, value in scene.fixed.items()}
    return ", ".join(f"{name} {value}" for name, value in values.items()).replace("_", " ")


def _listed(names: Iterable[str]) -> str:
    return ", ".join(dict.fromkeys(names))


# ---- tables


@dataclass(frozen=True)
class ResultRow:
    """A row of a table; its first cell is the row's name.

    Attributes:
        look: 'best', 'bad' or ''.
    """

    cells: Sequence[str]
    look: str = ""


@dataclass(frozen=True)
class ResultTable:
    """A table of results.

    Attributes:
        caption: text above the table, read first by screen readers.
        numbers: columns that are right-aligned.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[ResultRow]
    numbers: frozenset[int] = frozenset()

    def filled(self) -> ResultTable:
        """A copy without empty columns."""
        columns = [i for i in range(len(self.header)) if i == 0 or any(row.cells[i].strip("—") for row in self.rows)]
        rows = [ResultRow([row.cells[i] for i in columns], row.look) for row in self.rows]
        numbers = frozenset(place for place, i in enumerate(columns) if i in self.numbers)
        return ResultTable(self.caption, [self.header[i] for i in columns], rows, numbers)


def stage_table(outcome: RunOutcome) -> ResultTable:
    """Progress of each stage."""
    rows = [
        ResultRow([s.stage, s.state, *(str(n or "") for n in (s.pours, s.simulations, s.unusable_simulations))])
        for s in outcome.stages
    ]
    header = ["stage", "state", "pours", "simulations", "of them unusable"]
    return ResultTable("Stages, in the order in which they ran", header, rows, frozenset({2, 3, 4})).filled()


def cost_table(summary: RunSummary) -> ResultTable:
    """Costs of the run."""
    return ResultTable("Cost", ["what", "how much"], [ResultRow(pair) for pair in summary.cost.items()])


def question_table(outcome: RunOutcome) -> ResultTable:
    """Questions to the operator and their answers."""
    rows = [
        ResultRow(
            [
                time.strftime("%Y-%m-%d %H:%M", time.localtime(question.time)),
                question.stage,
                question.question,
                "not answered" if question.answer is None else question.answer,
            ],
            "bad" if question.answer is None else "",
        )
        for question in outcome.questions
    ]
    return ResultTable("Questions to the operator", ["when", "stage", "question", "answer"], rows)


def theta_table(learning: RunLearning) -> ResultTable:
    """θ* with its region: the searched parameters."""
    level = "region" if learning.posterior is None else f"{100 * learning.posterior.level:.0f} % of the θ that fit"
    searched = [p for p in learning.parameters if p.searched != NOT_SEARCHED]
    rows = [ResultRow([p.name, p.value, p.region, p.searched]) for p in searched]
    return ResultTable("θ* with its region", ["parameter", "θ*", level, "searched"], rows).filled()


def fixed_parameters(learning: RunLearning) -> str:
    """The parameters that were not searched, with their values; empty if all were."""
    return ", ".join(f"{p.name} {p.value}" for p in learning.parameters if p.searched == NOT_SEARCHED)


def score_table(learning: RunLearning) -> ResultTable:
    """Mean |Δ| of θ* and its rivals by set of pours."""
    columns = {
        "calibrated": "θ*",
        "posterior": "mean over θ's posterior",
        "uncalibrated": "uncalibrated θ",
        "random_theta": "random θ (median)",
        "mean_predictor": "mean of training pours",
        "regression": "GP regression of training pours",
    }
    rows = [
        ResultRow([SPLITS[split], *("—" if (v := row.get(name)) is None else f"{100 * v:.2f}" for name in columns)])
        for split, row in learning.discrepancy.items()
        if any(value is not None for value in row.values())
    ]
    caption = "Mean |measured − predicted| spillage [% of the poured liquid]; smaller is better"
    return ResultTable(caption, ["pours", *columns.values()], rows, frozenset(range(1, len(columns) + 1))).filled()


def receiver_table(outcome: RunOutcome) -> ResultTable:
    """Comparison of the receivers; those without a result are left out."""
    shown = [
        row
        for row in outcome.receivers.values()
        if row.recommended is not None or any(p is not None and p.loss is not None for p in (row.first, row.best))
    ]
    heads = list(dict.fromkeys(head for row in shown for head in row.texts))
    rows = [
        ResultRow([row.receiver, row.strategy, *(row.texts.get(head, "") or "—" for head in heads)]) for row in shown
    ]
    header = ["receiver", "strategy", *heads]
    return ResultTable(outcome.loss_label, header, rows, frozenset(range(2, len(header)))).filled()


def pour_tables(summary: RunSummary) -> list[ResultTable]:
    """Every requested pour, one table for each stage; and every pour that a calibration was scored on."""
    stages = dict.fromkeys(pour.stage for pour in summary.outcome.pours_made)
    scores = next((result for result in summary.results.values() if isinstance(result, Scores)), None)
    scored = [_residual_table(scores.pours)] if scores is not None and scores.pours else []
    return scored + [
        _dose_table(stage, doses)
        if isinstance(doses := summary.results.get(stage), Dispensed)
        else _pour_table(stage, [pour for pour in summary.outcome.pours_made if pour.stage == stage])
        for stage in stages
    ]


def _residual_table(pours: Sequence[SpillageResidual]) -> ResultTable:
    names = {name: None for pour in pours for name in pour.action}
    varied = [name for name in names if len({pour.action.get(name) for pour in pours}) > 1]
    remarks = list(dict.fromkeys(name for pour in pours for name in pour.remarks))
    rows = []
    for pour in pours:
        actions = ["—" if (value := pour.action.get(name)) is None else f"{value:.4g}" for name in varied]
        shares = [pour.measured, pour.simulated, pour.residual]
        cells = [
            str(pour.number),
            "—" if pour.line is None else str(pour.line),
            SPLITS[pour.split].removesuffix(" pours"),
            *actions,
        ]
        cells += ["—" if share is None else f"{100 * share:.2f}" for share in shares]
        bounded = pour.low is not None and pour.high is not None
        cells.append(f"{100 * (pour.low or 0.0):.2f} … {100 * (pour.high or 0.0):.2f}" if bounded else "—")
        cells += ["no" if pour.fits is False else "—", *(pour.remarks.get(name) or "—" for name in remarks)]
        rows.append(ResultRow(cells, "bad" if pour.fits is False else ""))
    labels = [style.label(next(name for name in ACTION_DIMENSIONS if column.startswith(name))) for column in varied]
    header = ["pour", "line", "used as", *labels]
    header += ["weighed", "simulated", "difference", "expected", "fits", *remarks]
    caption = f"{len(pours)} weighed pours with their simulation by θ*; spilled / poured [%]"
    numbers = frozenset({0, 1, *range(3, len(varied) + 7)})
    return ResultTable(caption, header, rows, numbers).filled()


def _dose_table(stage: str, dispensed: Dispensed) -> ResultTable:
    rows = []
    for dose in dispensed.doses:
        error = None if dose.received_g is None else dose.received_g - dose.wanted_g
        cells = [str(dose.number), dose.position or "—", f"{dose.wanted_g:g}"]
        cells += ["—" if grams is None else f"{grams:.2f}" for grams in (dose.received_g, error, dose.half_interval_g)]
        cells += ["—" if dose.spilled_g is None else f"{dose.spilled_g:.2f}"]
        cells += ["—" if dose.duration_s is None else f"{dose.duration_s:.1f}", dose.source or "—"]
        cells += ["—" if dose.left_g is None else f"{dose.left_g:.0f} ± {2.0 * (dose.left_deviation_g or 0.0):.1f}"]
        cells += [dose.outcome_text or "—", f"{dose.end_text}{', source filled before' if dose.filled else ''}"]
        rows.append(ResultRow(cells, "bad" if dose.received_g is None or dose.outcome == "missed" else ""))
    header = ["dose", "position", "wanted [g]", "received [g]", "difference [g]", "± (90 %) [g]", "spilled [g]"]
    header += ["time [s]", "source", "left [g]", "outcome", "end"]
    return ResultTable(f"{stage}: {len(rows)} wanted amounts", header, rows, frozenset({0, *range(2, 8), 9})).filled()


def _pour_table(stage: str, pours: Sequence[PourSummary]) -> ResultTable:
    varied = [name for name in pours[0].action_si if len({pour.action_si[name] for pour in pours}) > 1]
    searched = varied or ["angular_velocity", "x_offset"]
    rows = []
    for pour in pours:
        cells = [
            str(pour.number),
            *(_bare(name, pour.action_si[name]) for name in searched),
            *("—" if grams is None else f"{grams:.1f}" for grams in (pour.loaded_g, pour.spilled_g, pour.retained_g)),
            "—" if pour.spillage is None else f"{100 * pour.spillage:.2f}",
            pour.predicted or "—",
            pour.measured if pour.state == "weighed" and not pour.calibration else "—",
            pour.remark,
        ]
        look = "best" if pour.best else "bad" if pour.state in ("failed", "unknown") else ""
        rows.append(ResultRow(cells, look))
    header = ["pour", *(style.label(name) for name in searched), "loaded [g]", "spilled [g]", "retained [g]"]
    header += ["spilled / poured [%]", "expected", "measured", "remark"]
    legend = "" if pours[0].calibration else f"; expected and measured: {pours[0].loss}"
    legend += "; the best is bold" if any(pour.best for pour in pours) else ""
    caption = f"{stage}: {plural(len(pours), 'pour')} into {pours[0].receiver}{legend}"
    return ResultTable(caption, header, rows, frozenset(range(len(header) - 1))).filled()


def _bare(name: str, value: float | None) -> str:
    """A value without its unit, which is in the column's head."""
    return style.display_value(name, value).removesuffix(style.display_unit(name)).rstrip()


def validity_table(outcome: RunOutcome) -> ResultTable:
    """Effects that are not simulated in the action spaces."""
    rows = [
        ResultRow([gap.receiver, gap.kind.replace("_", " "), f"{gap.hit} of {gap.tried}", gap.text])
        for several in outcome.not_covered.values()
        for gap in several
    ]
    return ResultTable("At the middle and the corners of the ranges", ["into", "what", "actions", "meaning"], rows)
