"""The report of a run, finished or not: `report.html`, one self-contained page.

`run_page` renders the whole report; `reduced_run_page` is used if the campaign or its results can't be read. The tables
of stages, costs, pours, receivers and questions are functions of their own.
"""

from __future__ import annotations

import json
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from orchestrator.journal.journal_check import JournalCheck
from orchestrator.journal.run_record import PourMade, Record
from orchestrator.results import figure_style as style
from orchestrator.results.html_page import HtmlTable, Picture, Row, render
from orchestrator.results.loss_units import DISCREPANCY, deployment_unit, is_calibration, loss_of_pour, unit_of_pour
from orchestrator.results.run_summary import RunSummary
from orchestrator.results.stage_views import SPLITS, receiver_names
from orchestrator.results.surrogate_figures import posterior_lines
from orchestrator.results.wording import advice, standing, unknown_of_all, what_was_asked
from orchestrator.states import State
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.outcome import normalised_spillage


def stage_table(record: Record) -> HtmlTable:
    """Progress of each stage."""
    rows = [
        Row(
            [
                stage.name,
                "closed" if stage.closed else "open",
                str(stage.pours or ""),
                str(stage.simulations or ""),
                str(stage.failed_simulations or ""),
            ]
        )
        for stage in record.stages.values()
    ]
    header = ["stage", "state", "pours", "simulations", "of them unusable"]
    return HtmlTable("Stages, in the order in which they ran", header, rows, frozenset({2, 3, 4})).filled()


def cost_table(plan: CampaignPlan, summary: RunSummary, record: Record) -> HtmlTable:
    """Costs of the run: pours, grams, minutes."""
    pours, weighed = record.pours, [p.measured for p in record.weighed if p.measured is not None]
    begun = [pour for pour in pours if pour.came != "not begun"]
    rows: list[tuple[str, str]] = []
    if begun:
        failed, unknown = (sum(p.came == came for p in begun) for came in ("failed", "unknown"))
        more = "".join(f", {n} {word}" for n, word in ((failed, "failed"), (unknown, "of unknown outcome")) if n)
        rows.append(("pours", f"{len(begun)} begun, {len(weighed)} weighed{more}"))
    if weighed:
        loaded, spilled, retained = (
            1e3 * sum(getattr(m, n) for m in weighed) for n in ("loaded", "spilled", "retained")
        )
        delivered = loaded - spilled - retained
        rows.append(
            (
                "liquid",
                f"{loaded:.0f} g: {delivered:.0f} g delivered, {spilled:.1f} g spilled, {retained:.1f} g retained",
            )
        )
    rows.append(("program at work", minutes(record.at_work_s)))
    arm = [pour.seconds for pour in begun if pour.seconds]
    if arm:
        rows.append(("of it pouring", f"{minutes(sum(arm))}, {sum(arm) / len(arm):.1f} s a pour{_pace(plan)}"))
    simulations = sum(stage.simulations for stage in record.stages.values())
    if simulations:
        each = f", {summary.cpu_s / simulations:.1f} s each" if summary.cpu_s else ""
        rows.append(("simulations", f"{simulations}, {minutes(summary.cpu_s)} of CPU time{each}"))
    for stage, use in summary.occupancy.items():
        if use.pool_busy is not None:
            rows.append((f"pool beside the arm, {stage.rpartition(':')[2]}", f"{100 * use.pool_busy:.0f} % busy"))
    return HtmlTable("Cost", ["what", "how much"], [Row(cells) for cells in rows])


def _pace(plan: CampaignPlan) -> str:
    laboratory = plan.laboratory
    if laboratory.mode != "virtual":
        return ""
    scale = laboratory.arm.time_scale if laboratory.arm is not None else None
    if scale is None and laboratory.bench is not None:
        scale = laboratory.bench.time_scale
    if scale is None or scale == 1.0:
        return ""
    return (
        " (this bench waits for nothing)"
        if scale == 0.0
        else f" (this bench runs {scale:g} times as fast as a real one)"
    )


def minutes(seconds: float) -> str:
    """A duration in a suitable unit."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"


def pour_tables(plan: CampaignPlan, record: Record, names: Mapping[str, str]) -> list[HtmlTable]:
    """Every requested pour, one table for each stage."""
    stages = dict.fromkeys(pour.stage for pour in record.pours)
    return [_pours(plan, stage, [p for p in record.pours if p.stage == stage], names) for stage in stages]


def _pours(plan: CampaignPlan, stage: str, pours: list[PourMade], names: Mapping[str, str]) -> HtmlTable:
    first = pours[0].request
    calibrating, unit = is_calibration(plan, first), unit_of_pour(plan, first)
    searched = _varied(pours)
    losses = {
        pour.id: loss
        for pour in pours
        if pour.measured is not None and (loss := loss_of_pour(plan, pour.request, pour.measured)) is not None
    }
    best = None if calibrating or not losses else min(losses, key=lambda key: losses[key])
    rows = []
    for pour in pours:
        measured, action = pour.measured, pour.request.action.values()
        r = None if measured is None else normalised_spillage(measured.fractions)
        predicted = pour.request.predicted
        cells = [
            str(pour.request.number),
            *(_bare(name, action[name]) for name in searched),
            "—" if measured is None else f"{1e3 * measured.loaded:.1f}",
            "—" if measured is None else f"{1e3 * measured.spilled:.1f}",
            "—" if measured is None else f"{1e3 * measured.retained:.1f}",
            "—" if r is None else f"{100 * r:.2f}",
            "—" if predicted is None else unit.text(predicted.mean, predicted.deviation),
            "—" if pour.id not in losses or calibrating else unit.text(losses[pour.id]),
            _remark(pour),
        ]
        rows.append(Row(cells, "best" if pour.id == best else "bad" if pour.came in ("failed", "unknown") else ""))
    header = ["pour", *(style.label(name) for name in searched), "loaded [g]", "spilled [g]", "retained [g]"]
    header += ["spilled / poured [%]", "expected", "came to", "remark"]
    into = names.get(first.scene, first.scene)
    what = (
        ""
        if calibrating
        else f"; expected and came to: {unit.label}" + ("; the best is bold" if best is not None else "")
    )
    return HtmlTable(
        f"{stage}: {len(pours)} pours into {into}{what}", header, rows, frozenset(range(len(header) - 1))
    ).filled()


def _varied(pours: list[PourMade]) -> list[str]:
    """Dimensions in which the pours differ; for a single pour the speed and the distance."""
    values = [pour.request.action.values() for pour in pours]
    varied = [name for name in values[0] if len({one[name] for one in values}) > 1]
    return varied or ["angular_velocity", "x_offset"]


def _bare(name: str, value: float | None) -> str:
    """A value without its unit, which is in the column's head."""
    return style.display_value(name, value).removesuffix(style.display_unit(name)).rstrip()


def _remark(pour: PourMade) -> str:
    said = f"; a person said: {pour.said}" if pour.said else ""
    match pour.came:
        case "unknown":
            return f"UNKNOWN: it had begun, and nobody knows what came of it{said}"
        case "not begun":
            return "asked for, not begun"
        case "failed":
            return f"failed: {pour.reason}{said}"
        case "weighed":
            return said.removeprefix("; ")


def receiver_table(plan: CampaignPlan, summary: RunSummary) -> HtmlTable:
    """Comparison of the receivers."""
    rows = []
    if plan.deployment is not None:
        unit = deployment_unit(plan.deployment)
        for row in summary.receivers.values():
            confirmed = row.confirmed.loss if row.confirmed is not None else None
            rows.append(
                Row(
                    [
                        row.receiver,
                        row.strategy,
                        str(row.pours or ""),
                        "" if row.first_loss is None else unit.text(row.first_loss),
                        "" if row.best_loss is None else f"{unit.text(row.best_loss)} (pour {row.best_pour})",
                        "" if row.best_delivered_g is None else f"{row.best_delivered_g:.1f} g",
                        "" if row.predicted_loss is None else unit.text(row.predicted_loss, row.predicted_deviation),
                        "" if confirmed is None else unit.text(confirmed.mean, confirmed.deviation),
                        str(row.simulations or ""),
                    ]
                )
            )
    label = "" if plan.deployment is None else deployment_unit(plan.deployment).label
    header = ["receiver", "strategy", "pours", "first", "best measured", "delivered by it", "expected of the"
              " recommended action", "poured again", "simulations"]  # fmt: skip
    return HtmlTable(label, header, rows, frozenset({2, 3, 4, 5, 6, 7, 8})).filled()


def question_table(record: Record) -> HtmlTable:
    """Questions to the operator and their answers."""
    rows = [
        Row(
            [
                time.strftime("%Y-%m-%d %H:%M", time.localtime(one.time)),
                one.stage,
                one.text,
                "nobody has answered" if one.answer is None else one.answer,
            ],
            "bad" if one.answer is None else "",
        )
        for one in record.questions
    ]
    return HtmlTable("What people were asked", ["when", "stage", "question", "answer"], rows)


REPORT_NAME = "report.html"

MODES = {"virtual": "VIRTUAL", "hardware": "REAL", "none": "SIMULATION ONLY"}
"""Text of the badge by the bench's mode."""

MOST_DECISIONS = 300

_THETA_FIGURES = ("discrepancy", "posterior", "test discrepancy")

_NARROW = ("test discrepancy", "spillage", "posterior")
"""Figures that can be placed next to each other."""

_FIGURES: dict[str, tuple[str, str]] = {
    "discrepancy map": (
        "Map of the discrepancy between simulated and weighed spillage over the parameters θ, with the θ that were "
        "tried as dots and θ* as a star.",
        "How far simulations are from the weighed pours, over θ. The star is θ*.",
    ),
    "discrepancy trials": (
        "Discrepancy of every tried θ against each searched parameter.",
        "Every θ that was tried, against each parameter.",
    ),
    "posterior": (
        "Histograms of each parameter and clouds of each pair of parameters, of θ that fit the weighed pours.",
        "θ that fit the pours. Where a cloud fills its panel, the pours say little.",
    ),
    "test discrepancy": (
        "Bars: mean difference of simulated and weighed spillage for θ*, for uncalibrated and random θ, and for "
        "regressions, on pours used for calibration and on others.",
        "What calibration was worth: θ* beside its rivals, on pours that it was made with and on others.",
    ),
    "spillage": (
        "Loss of every pour in the order made, with what was predicted of it and the best so far.",
        "What every pour came to (dots), what was expected of it (bars: where nine in ten such pours lie), and the "
        "best so far (line).",
    ),
    "loss map": (
        "Map of the expected loss over the searched actions with the pours as numbered dots and the recommended action "
        "as a star.",
        "What is expected of actions. Numbers are pours in their order, the star is the recommended action.",
    ),
    "safe window": (
        "Loss along each dimension of the action, with the recommended action, the tolerance and the range inside "
        "which it is kept.",
        "How far the action may be missed before too much is spilled.",
    ),
}
"""Alt text and caption of a figure, by the beginning of its name."""


def run_page(
    plan: CampaignPlan,
    summary: RunSummary,
    record: Record,
    directory: Path,
    *,
    versions: Mapping[str, Any],
    check: JournalCheck,
) -> str:
    """The page of a run.

    Args:
        plan: plan of the campaign.
        summary: summary of its closed stages.
        record: content of its journal.
        directory: folder of the run.
        versions: content of `versions.json`; empty if it is missing.
        check: check of its journal; a journal that fails is reported at the top of the page.

    Returns:
        HTML.
    """
    names = receiver_names(plan)
    said = advice(plan, summary)
    pictures = {name: _picture(name, file) for name, file in summary.figures.items() if file.is_file()}
    mode = plan.laboratory.mode if record.pours or plan.laboratory.pours else "none"
    ended = _date(record.ended)
    return render(
        "run.html.j2",
        title=f"{plan.name}: {directory.name}",
        kicker=f"Report of a pouring campaign · run {directory.name}",
        heading=plan.name,
        mode=MODES[mode],
        mode_look=mode,
        state=str(record.state),
        finished=record.state is State.FINISHED,
        lead=f"Begun {_date(record.created)}, last entry {ended}. Seed {plan.seed}.",
        standing=[*_damage(check), *standing(record, directory.name)],
        advice=said,
        no_advice=[] if said else _without_advice(plan, summary, record),
        open=unknown_of_all(plan, summary, record),
        asked=what_was_asked(plan),
        stages=stage_table(record),
        cost=cost_table(plan, summary, record),
        questions=question_table(record),
        theta=_theta_table(plan, summary),
        theta_lines=_theta_lines(plan, summary),
        scores=_score_table(summary),
        theta_figures=[one for name, one in pictures.items() if name.startswith(_THETA_FIGURES)],
        receivers=receiver_table(plan, summary),
        figures=[one for name, one in pictures.items() if not name.startswith(_THETA_FIGURES)],
        pours=pour_tables(plan, record, names),
        no_pours="No pour was asked for." if not record.pours else "",
        not_simulated=_not_simulated(summary, names),
        settings=[*_settings(plan, summary, directory, versions), ("records", check.verdict)],
        decisions=record.decisions[-MOST_DECISIONS:],
        notes=[(_date(when), text) for when, text in record.notes],
        resolved=_resolved(plan),
        footer=f"Made by Decant {dict(versions.get('packages', {})).get('decant', '')} from the run's journal.",
    )


def reduced_run_page(
    name: str,
    record: Record,
    directory: Path,
    *,
    versions: Mapping[str, Any],
    check: JournalCheck,
    reason: str,
    found: Mapping[str, Any],
) -> str:
    """The page of a run whose campaign or results can't be read, for example because a plug-in is not installed.

    Args:
        name: name of its campaign.
        record: content of its journal.
        directory: folder of the run.
        versions: content of `versions.json`.
        check: check of its journal.
        reason: why the full page can't be made.
        found: its row of the catalogue: mode, seed, θ*, recommended actions.

    Returns:
        HTML.
    """
    mode = found.get("mode") or "none"
    advice = [
        f"Recommended for {receiver} by {one['strategy']} (degrees, millimetres, seconds): "
        f"{', '.join(f'{key} {value:.4g}' for key, value in one['action'].items() if value is not None)}."
        for receiver, one in (found.get("recommended") or {}).items()
    ]
    theta = found.get("theta") or {}
    advice += [f"θ* (SI units): {', '.join(f'{key} {value:.4g}' for key, value in theta.items())}."] if theta else []
    pours = [
        Row(
            [
                str(pour.request.number),
                pour.stage,
                pour.request.scene,
                style.display_values({k: v for k, v in pour.request.action.values().items() if v is not None}),
                pour.came if pour.measured is not None else f"{pour.came}: {pour.reason}".rstrip(": "),
                "—" if pour.measured is None else f"{1e3 * pour.measured.spilled:.1f}",
                "—" if pour.measured is None else f"{1e3 * pour.measured.retained:.1f}",
            ]
        )
        for pour in record.pours
    ]
    header = ["pour", "stage", "scene", "action", "outcome", "spilled [g]", "retained [g]"]
    packages = dict(versions.get("packages", {}))
    settings = {
        "campaign": Path(versions.get("campaign", name)).name,
        "seed": str(found.get("seed", "not recorded")),
        "Python": f"{versions.get('python', 'not recorded')}",
        "packages": ", ".join(f"{k} {v}" for k, v in packages.items() if v != "not installed") or "not recorded",
        "records": check.verdict,
    }
    nothing = HtmlTable("", [], [])
    cost = [
        Row(["pours weighed", str(len(record.weighed))]),
        Row(["simulations", str(sum(stage.simulations for stage in record.stages.values()))]),
        Row(["at work", f"{record.at_work_s / 60.0:.1f} min"]),
    ]
    return render(
        "run.html.j2",
        title=f"{name}: {directory.name}",
        kicker=f"Reduced report of a pouring campaign · run {directory.name}",
        heading=name,
        mode=MODES.get(mode, mode),
        mode_look=mode,
        state=str(record.state),
        finished=record.state is State.FINISHED,
        lead=f"Begun {_date(record.created)}, last entry {_date(record.ended)}.",
        standing=[f"This report is reduced to what the journal has. {reason}", *_damage(check)],
        advice=[],
        no_advice=advice or ["This run recommends no action that can be read here."],
        open=[],
        asked=[("campaign", name)],
        stages=stage_table(record),
        cost=HtmlTable("What the run took", ["", ""], cost, frozenset({1})),
        questions=question_table(record),
        theta=None,
        theta_lines=[],
        scores=nothing,
        theta_figures=[],
        receivers=nothing,
        figures=[_picture(file.stem.replace("-", " "), file) for file in sorted((directory / "figures").glob("*.png"))],
        pours=[HtmlTable("Every pour that was asked for", header, pours, frozenset({0, 5, 6}))] if pours else [],
        no_pours="No pour was asked for.",
        not_simulated=nothing,
        settings=list(settings.items()),
        decisions=record.decisions[-MOST_DECISIONS:],
        notes=[(_date(when), text) for when, text in record.notes],
        resolved="",
        footer=f"Made by Decant {packages.get('decant', '')} from the run's journal.",
    )


def _damage(check: JournalCheck) -> list[str]:
    if not check.problems:
        return []
    made = f" The ledger of pours names: {'; '.join(check.pours)}." if check.pours else ""
    return [
        "WARNING: the records of this run are damaged or incomplete. Numbers on this page may be wrong or missing. "
        f"Problems: {'; '.join(check.problems)}.{made}"
    ]


def _resolved(plan: CampaignPlan) -> str:
    """The campaign's file with all values filled in, without the output paths of the machine."""
    kept = {key: value for key, value in plan.resolved.items() if key != "outputs"}
    return json.dumps(kept, indent=2, ensure_ascii=False) if kept else ""


def _date(seconds: float) -> str:
    return time.strftime("%Y-%m-%d %H:%M:%S %Z", time.localtime(seconds))


def _picture(name: str, file: Path) -> Picture:
    alt, caption = next((texts for start, texts in _FIGURES.items() if name.startswith(start)), (name, ""))
    return Picture.of(file, f"{name}: {alt}", caption or name, wide=not name.startswith(_NARROW))


def _without_advice(plan: CampaignPlan, summary: RunSummary, record: Record) -> list[str]:
    poured = [pour for pour in record.weighed if not is_calibration(plan, pour.request)]
    if plan.deployment is not None and any(name.startswith("deployment") for name in record.stages):
        said = ["No action is recommended yet: what deployment has learnt is written down when its stage is closed."]
        losses = {loss_of_pour(plan, p.request, m): p for p in poured if (m := p.measured) is not None}
        known = [loss for loss in losses if loss is not None]
        if known:
            action = losses[min(known)].request.action.values()
            best = style.display_values({name: action[name] for name in plan.deployment.actions.names})
            unit = deployment_unit(plan.deployment)
            said.append(f"The best of {len(known)} pours so far came to {unit.text(min(known))}, with {best}.")
        return said
    if summary.theta is not None:
        return [
            "This run calibrated the simulator; it recommends no action. The parameters to use are in theta.json, "
            "which 'decant plan CAMPAIGN --parameters' reads."
        ]
    return ["This run recommends no action."]


def _theta_table(plan: CampaignPlan, summary: RunSummary) -> HtmlTable | None:
    if summary.calibrated_theta is None:
        return None
    calibration, posterior = plan.calibration, summary.posterior
    axes = {} if calibration is None else {axis.name: axis for axis in calibration.parameters.axes}
    rows = []
    for name, value in summary.calibrated_theta.model_dump().items():
        axis = axes.get(name)
        searched = "not searched" if axis is None else f"{style.number(axis.lower)} … {style.number(axis.upper)}"
        region = "—"
        if posterior is not None and name in posterior.region:
            low, high = posterior.region[name]
            region = f"{low:.3g} … {high:.3g}"
            region += ", not determined" if name in posterior.open else ""
        words = style.PARAMETER_NAMES.get(name, name.replace("_", " "))
        rows.append(Row([words, style.display_value(name, value), region, searched]))
    level = "" if posterior is None else f"{100 * posterior.level:.0f} % of the θ that fit"
    return HtmlTable("θ* with its region", ["parameter", "θ*", level or "region", "searched"], rows).filled()


def _theta_lines(plan: CampaignPlan, summary: RunSummary) -> list[str]:
    lines = []
    if summary.predicted_discrepancy is not None:
        expected = DISCREPANCY.text(max(summary.predicted_discrepancy, 0.0), summary.predicted_deviation or 0.0)
        lines.append(f"Expected {DISCREPANCY.label.rsplit(' [', 1)[0]} of θ*: {expected}.")
    if summary.posterior is not None and plan.calibration is not None:
        found = posterior_lines(summary.posterior, plan.calibration.parameters)
        lines += [f"{line[:1].upper()}{line[1:]}." for line in found]
    if summary.calibration_gain is not None:
        text = summary.calibration_gain.text
        lines.append(f"{text[:1].upper()}{text[1:]}.")
    return lines


def _score_table(summary: RunSummary) -> HtmlTable:
    columns = {
        "calibrated": "θ*",
        "posterior": "mean over θ's posterior",
        "uncalibrated": "uncalibrated θ",
        "random_theta": "random θ (median)",
        "mean_predictor": "mean of training pours",
        "regression": "GP regression of training pours",
    }
    rows = [
        Row([SPLITS[split], *("—" if (v := row.get(name)) is None else f"{100 * v:.2f}" for name in columns)])
        for split, row in summary.discrepancy.items()
        if any(value is not None for value in row.values())
    ]
    caption = "Mean |measured − predicted| spillage [% of what was poured]: less is better"
    return HtmlTable(caption, ["pours", *columns.values()], rows, frozenset(range(1, len(columns) + 1))).filled()


def _not_simulated(summary: RunSummary, names: Mapping[str, str]) -> HtmlTable:
    rows = [
        Row([names.get(scene, scene), one.kind.replace("_", " "), f"{one.hit} of {one.tried}", one.text])
        for scene, several in summary.not_covered.items()
        for one in several
    ]
    return HtmlTable("At the middle and the corners of the ranges", ["into", "what", "actions", "meaning"], rows)


def _settings(
    plan: CampaignPlan, summary: RunSummary, directory: Path, versions: Mapping[str, Any]
) -> list[tuple[str, str]]:
    packages = dict(versions.get("packages", {}))
    found = [
        ("campaign", Path(versions.get("campaign", plan.source)).name),
        ("seed", str(plan.seed)),
        ("laboratory", f"{plan.laboratory.name} ({MODES.get(plan.laboratory.mode, plan.laboratory.mode)})"),
        ("simulations side by side", str(plan.parallel_simulations)),
        (
            "Python",
            f"{versions['python']} on {versions.get('platform', '')}" if "python" in versions else "not recorded",
        ),
        ("packages", ", ".join(f"{k} {v}" for k, v in packages.items() if v != "not installed") or "not recorded"),
        ("recording", "campaign.rrd, beside this page" if (directory / "campaign.rrd").is_file() else "none"),
        ("every number", "summary.json, resolved.json, versions.json and journal.sqlite, beside this page"),
    ]
    if plan.deployment is not None:
        found.insert(2, ("minimised", deployment_unit(plan.deployment).label))
    return found if summary.figures else [*found, ("figures", "none were drawn; 'decant report' draws them")]
