"""Results and settings of a run as plain sentences.

- `advice`: recommended action per receiver, its expected result, its tolerance, and open questions.
- `risk_line` and `window_line`: effect of execution errors on a planned action.
- `standing`: state of an unfinished run and the next steps.
- `what_was_asked`: the campaign's settings, for readers who have not seen its file.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass

from orchestrator.journal.run_record import Record
from orchestrator.results import figure_style as style
from orchestrator.results.loss_units import DISCREPANCY, LossUnit, deployment_unit
from orchestrator.results.run_summary import ReceiverSummary, RunSummary
from orchestrator.results.stage_views import SPLITS
from orchestrator.states import State
from orchestrator.strategies.campaign_plan import CampaignPlan, DeploymentPlan
from orchestrator.strategies.deployment.deployment_result import RiskFound
from orchestrator.strategies.deployment.model_monitoring import DOUBT, Believed
from orchestrator.strategies.deployment.real_pours import PredictionCheck
from orchestrator.strategies.deployment.safe_window import WindowFound
from sim_engine.scene import Scene
from sim_engine.search_space import Axis


def trust_line(trust: PredictionCheck | Believed) -> str | None:
    """What the pours say of the simulator; None where that is nothing.

    Args:
        trust: of a deployment's result.
    """
    if isinstance(trust, Believed):
        return trust.text or None
    return (
        "the first pours were far from what was predicted; the simulator may not fit this vessel"
        if trust.alarm
        else None
    )


def risk_line(risk: RiskFound, unit: LossUnit) -> str:
    """'under pose error and θ: CVaR 90 % 4.10 %, expected 2.30 %, pours differ by ± 1.40 %'."""
    thetas = f" and {risk.thetas} θ of the posterior" if risk.thetas else ""
    worst = f"CVaR {100 * risk.level:g} % {unit.text(max(risk.value, 0.0))}, " if risk.measure == "cvar" else ""
    return (
        f"best action under errors of execution{thetas}: {worst}expected {unit.text(max(risk.expected, 0.0))}, "
        f"pours differ by ± {unit.text(risk.spread)}"
    )


def window_line(window: WindowFound, unit: LossUnit) -> str:
    """'safe window: x offset 118 … 131 mm, angular velocity 34 … 71 deg/s at ≤ 2.00 %, checked by 12 simulations'."""
    checked = f"checked by {window.simulations} simulations"
    tolerance = unit.text(window.tolerance)
    if not window.axes:
        return f"safe window: none; the action itself comes to more than {tolerance}, {checked}"
    parts = []
    for name, ends in window.axes.items():
        low, high = (end / style.display_factor(name) for end in (ends.low, ends.high))
        more = {(): "", ("low",): " or less", ("high",): " or more"}.get(ends.cut_off, " or farther")
        parts.append(f"{name.replace('_', ' ')} {low:.4g} … {high:.4g} {style.display_unit(name)}{more}")
    return f"safe window: {', '.join(parts)} at ≤ {tolerance}, one missed at a time, {checked}"


FEW = 5
"""Number of pours of an action below which their mean is not reliable."""


@dataclass(frozen=True)
class Advice:
    """Advice for one receiver.

    Attributes:
        title: the receiver.
        action: searched dimensions in display units; empty without a recommendation.
        fixed: other dimensions, as in the campaign.
        sentences: recommendation and expected result.
        window: allowed deviation from the action, or a statement that it is unknown.
        open: open questions.
    """

    title: str
    action: dict[str, str]
    fixed: dict[str, str]
    sentences: list[str]
    window: str
    open: list[str]


def advice(plan: CampaignPlan, summary: RunSummary) -> list[Advice]:
    """Advice for each receiver with a deployment result."""
    if plan.deployment is None:
        return []
    scenes = {scene.name: scene for scene in plan.deployment.scenes}
    unit = deployment_unit(plan.deployment)
    return [_of(plan.deployment, scenes.get(name), row, unit) for name, row in summary.receivers.items()]


def _of(deployment: DeploymentPlan, scene: Scene | None, row: ReceiverSummary, unit: LossUnit) -> Advice:
    if row.best_action_si is None:
        why = row.gave_up or "nothing was learnt that an action could be chosen by"
        return Advice(row.receiver, {}, {}, [f"No action is recommended: {why}."], "", _open(row, unit))
    chosen: dict[str, float | None] = dict(row.best_action_si)
    action, fixed = _shown(chosen), {} if scene is None else _shown(scene.fixed)
    window, open_points = "", _open(row, unit)
    if row.window is not None:
        window = _sentence(window_line(row.window, unit))
    else:
        window = (
            "No safe window was looked for: nobody has checked how far this action may be missed. D1 looks for one "
            "where the campaign has 'window: {tolerance: …}'."
        )
    if ends := style.at_ends(chosen, deployment.actions.axes):
        open_points.insert(0, f"Better actions may lie beyond what was searched: {', '.join(ends)}.")
    return Advice(row.receiver, action, fixed, _sentences(scene, row, unit), window, open_points)


def _shown(values: Mapping[str, float | None]) -> dict[str, str]:
    return {name.replace("_", " "): style.display_value(name, v).replace("_", " ") for name, v in values.items()}


def _sentences(scene: Scene | None, row: ReceiverSummary, unit: LossUnit) -> list[str]:
    load = "" if scene is None else f" {1e3 * scene.liquid.mass:.0f} g of {scene.liquid.name}"
    cup = "" if scene is None else f" from {scene.pourer.name}"
    said = [f"To pour{load}{cup} into {row.receiver}, use the action below."]
    measure = unit.label.rsplit(" [", 1)[0]
    if row.predicted_loss is not None:
        mean = unit.text(max(row.predicted_loss, 0.0), row.predicted_deviation)
        scatter = unit.scatter(row.predicted_scatter).removeprefix(", a pour ")
        said.append(f"Expect {measure} of {mean}{scatter and f'; single pours differ from that by {scatter}'}.")
    if row.prediction is not None and "spillage" in row.prediction:
        seeds = row.prediction["spillage"]
        said.append(
            f"Simulated again with {seeds.count} fresh seeds, {seeds.percent(2)} of what left the pourer was spilled."
        )
    if row.confirmed is not None and row.confirmed.loss is not None:
        loss = row.confirmed.loss
        times = "once more" if loss.count == 1 else f"{loss.count} more times"
        said.append(f"Poured {times} after it was chosen, it came to {unit.text(loss.mean, loss.deviation)}.")
    if row.best_loss is not None:
        best = f"The best of {row.pours} weighed pours came to {unit.text(row.best_loss)} (pour {row.best_pour})"
        said.append(f"{best}; the least of several is a lucky one, so that it is not what to expect of the next.")
    if row.risk is not None:
        said.append(_sentence(risk_line(row.risk, unit)))
    if _is_confirmed(row) and (trust := trust_line(row.trust)) is not None:
        said.append(_sentence(trust))
    return said


def _is_confirmed(row: ReceiverSummary) -> bool:
    """Whether the pours confirm the judgement about the simulator without doubt."""
    trust = row.trust
    return isinstance(trust, Believed) and bool(trust.after) and trust.after[-1].ignorance < DOUBT


def _open(row: ReceiverSummary, unit: LossUnit) -> list[str]:
    said = []
    if not _is_confirmed(row) and (alarm := trust_line(row.trust)) is not None:
        said.append(_sentence(alarm))
    poured_again = 0 if row.confirmed is None or row.confirmed.loss is None else row.confirmed.loss.count
    if not row.pours and not poured_again:
        said.append("Nothing was poured into this receiver: what is expected of the action is simulated, not weighed.")
    elif not poured_again:
        said.append(
            "The recommended action was not poured again after it was chosen ('confirm' in the campaign does that): "
            "what is expected of it is a model's word."
        )
    elif poured_again < FEW:
        pours = "one pour" if poured_again == 1 else f"{poured_again} pours"
        said.append(f"What it comes to is known from {pours} of it; that many say little about how much pours differ.")
    if row.failed_pours:
        why = "; ".join(row.failures)
        said.append(f"{row.failed_pours} of its pours failed{f' ({why})' if why else ''}: nobody weighed them.")
    if row.risk is None:
        said.append("Errors of grip, placement and speed entered only as far as they happened in these pours.")
    said += [f"Not simulated at this action, {one.kind}: {one.text}." for one in row.not_covered]
    return said


def unknown_of_all(plan: CampaignPlan, summary: RunSummary, record: Record) -> list[str]:
    """Open questions after this run that do not depend on the receiver."""
    said = []
    if plan.laboratory.mode == "virtual" and (record.pours or plan.laboratory.pours):
        said.append(
            "The bench was VIRTUAL: no robot moved and no liquid was weighed. What the hidden liquid of that bench did "
            "is another simulation's word, and a real cup may behave otherwise."
        )
    if summary.theta is not None:
        said += _about_theta(summary)
    elif plan.calibration is None:
        said.append("The simulator was not calibrated in this run: its parameters were taken as the campaign has them.")
    liquids = {scene.liquid.name for scene in plan.deployment.scenes} if plan.deployment is not None else set()
    if liquids:
        said.append(
            f"All of this holds for {', '.join(sorted(liquids))}, this load, these vessels and what the campaign "
            "fixes of the motion. For other ones, plan anew."
        )
    if summary.dropped_events:
        said.append(f"The recording lacks {summary.dropped_events} events, because it could not keep up.")
    return said


def _about_theta(summary: RunSummary) -> list[str]:
    said, used = [], "calibrated"
    if summary.calibration_gain is not None and summary.calibration_gain.recommended != used:
        said, used = [_sentence(summary.calibration_gain.text)], summary.calibration_gain.recommended
    if summary.posterior is None:
        said.append("Which other θ fit the weighed pours as well was not asked: θ* may be one of many.")
    elif summary.posterior.open:
        names = ", ".join(name.replace("_", " ") for name in summary.posterior.open)
        said.append(f"The pours don't determine {names}: nearly all of what was searched fits them as well as θ*.")
    unseen = [
        f"{DISCREPANCY.text(own)} on {SPLITS[split]}"
        for split, row in summary.discrepancy.items()
        if split != "train" and (own := row.get(used)) is not None
    ]
    if unseen:
        said.append(
            f"On pours that calibration did not see, the simulator's spillage was off by {' and '.join(unseen)} in the "
            "mean."
        )
    elif summary.discrepancy:
        said.append("The simulator was not scored on pours that calibration did not see.")
    return said


def standing(record: Record, run: str) -> list[str]:
    """State of an unfinished run and the next steps; empty for a finished one.

    Args:
        run: its folder's name.
    """
    state = record.state
    if state is State.FINISHED:
        return []
    again = f"the command that began it, with '--resume --run {run}' added"
    said = [f"This run is not finished. Its state is '{state}'{f': {record.reason}' if record.reason else ''}."]
    unknown = [f"pour {pour.request.number} of {pour.stage}" for pour in record.unknown_pours]
    if unknown:
        said.append(
            f"{' and '.join(unknown).capitalize()} had begun, and nobody has said what came of it. It is not repeated "
            "by software. Whoever can, weighs what was spilled and what is left in the pourer, and answers on resuming."
        )
    said += [f"A question is open: {q.text}" for q in record.questions if q.answer is None]
    match state:
        case State.FAILED:
            said.append(f"What is done is kept. Mend what is named above, then go on by {again}.")
        case State.PAUSED | State.UNKNOWN:
            said.append(f"What is done is kept. Go on by {again}.")
        case State.QUEUED:
            said.append("Nothing was started yet.")
        case _:
            said.append(
                "When this page was made a process had the run, or had died with it without a word: the page shows "
                f"what the journal held at that moment. If nothing runs any more, go on by {again}."
            )
    return said


def _sentence(text: str) -> str:
    return f"{text[:1].upper()}{text[1:].rstrip('.')}."


def what_was_asked(plan: CampaignPlan) -> list[tuple[str, str]]:
    """Names and values: the liquid, the calibration of the simulator, the search for pours."""
    found: list[tuple[str, str]] = []
    scenes = (list(plan.calibration.poured) if plan.calibration is not None else []) + (
        list(plan.deployment.scenes) if plan.deployment is not None else []
    )
    if scenes:
        liquid = scenes[0].liquid
        volume = liquid.millilitres(liquid.mass)
        found.append(("liquid", f"{1e3 * liquid.mass:g} g of {liquid.name} ({volume:.0f} mL)"))
        found.append(("poured from", _listed(scene.pourer.name for scene in scenes)))
    if plan.calibration is not None:
        one = plan.calibration
        pours = f"{one.pour_count} pours, {one.holdout} of them kept for testing"
        if one.records is not None:
            pours = f"{len(one.records.pours)} weighed pours of {one.records.path.name}"
        found += [
            ("calibration", f"{one.strategy} on {pours}; {one.simulations} simulations"),
            ("… into", one.scene.receiver.name),
            ("… actions", _ranges(one.actions.axes)),
            ("… searched θ", _ranges(one.parameters.axes)),
            ("… fixed", _fixed(one.scene)),
        ]
    if plan.deployment is not None:
        two = plan.deployment
        found += [
            ("pouring", f"{two.strategy}, into each receiver: {two.settings.spending}"),
            ("… into", _listed(scene.receiver.name for scene in two.scenes)),
            ("… minimised", deployment_unit(two).label),
            ("… actions", _ranges(two.actions.axes)),
            ("… fixed", _fixed(two.scenes[0]) if two.scenes else ""),
        ]
        if two.confirm:
            found.append(("… afterwards", f"the recommended action is poured {two.confirm} more times"))
        if two.data is not None:
            count = sum(len(pours) for pours in two.data.pours.values())
            found.append(("… known before", f"{count} pours of {two.data.path.name}"))
    return [(name, value) for name, value in found if value]


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
