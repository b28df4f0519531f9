"""Tables of a run's report: stages, cost, pours, receivers, questions."""

from __future__ import annotations

import time
from collections.abc import Mapping

from orchestrator.plan import CampaignPlan
from orchestrator.report import style
from orchestrator.report.page import Row, Table
from orchestrator.report.record import PourMade, Record
from orchestrator.report.summary import RunSummary
from orchestrator.report.units import deployment_unit, is_calibration, loss_of_pour, unit_of_pour
from sim_engine.losses import normalised_spillage


def stage_table(record: Record) -> Table:
    """How far each stage has come."""
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
    return Table("Stages, in the order in which they ran", header, rows, frozenset({2, 3, 4})).filled()


def cost_table(plan: CampaignPlan, summary: RunSummary, record: Record) -> Table:
    """What the run took: pours, grams, minutes."""
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
    return Table("Cost", ["what", "how much"], [Row(cells) for cells in rows])


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
    """A time in the unit that people would take."""
    if seconds < 90.0:
        return f"{seconds:.0f} s"
    return f"{seconds / 60:.1f} min" if seconds < 5400.0 else f"{seconds / 3600:.1f} h"


def pour_tables(plan: CampaignPlan, record: Record, names: Mapping[str, str]) -> list[Table]:
    """Every pour that was asked for, one table for each stage."""
    stages = dict.fromkeys(pour.stage for pour in record.pours)
    return [_pours(plan, stage, [p for p in record.pours if p.stage == stage], names) for stage in stages]


def _pours(plan: CampaignPlan, stage: str, pours: list[PourMade], names: Mapping[str, str]) -> Table:
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
    return Table(
        f"{stage}: {len(pours)} pours into {into}{what}", header, rows, frozenset(range(len(header) - 1))
    ).filled()


def _varied(pours: list[PourMade]) -> list[str]:
    """Dimensions in which the pours differ; of a single pour the speed and the distance."""
    values = [pour.request.action.values() for pour in pours]
    varied = [name for name in values[0] if len({one[name] for one in values}) > 1]
    return varied or ["angular_velocity", "x_offset"]


def _bare(name: str, value: float | None) -> str:
    """A value without its unit, which stands in the column's head."""
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


def receiver_table(plan: CampaignPlan, summary: RunSummary) -> Table:
    """Receivers side by side."""
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
    return Table(label, header, rows, frozenset({2, 3, 4, 5, 6, 7, 8})).filled()


def question_table(record: Record) -> Table:
    """What people were asked, and said."""
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
    return Table("What people were asked", ["when", "stage", "question", "answer"], rows)
