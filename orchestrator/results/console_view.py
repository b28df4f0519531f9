"""Display of results in the terminal: the summary of a run, and tables of text."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

from orchestrator.results import figure_style as style
from orchestrator.results.loss_units import DISCREPANCY, LossUnit, at_least_nothing, deployment_unit
from orchestrator.results.pool_occupancy import occupancy_lines
from orchestrator.results.run_summary import ReceiverSummary, RunSummary
from orchestrator.results.stage_views import SPLITS
from orchestrator.results.surrogate_figures import posterior_lines
from orchestrator.results.wording import risk_line, trust_line, window_line
from orchestrator.strategies.campaign_plan import CampaignPlan
from orchestrator.strategies.deployment.deployment_result import ParetoAction
from orchestrator.strategies.single_action import Confirmed
from sim_engine.prediction_band import PredictionInterval, SampleStatistics

if TYPE_CHECKING:
    from rich.console import JustifyMethod, RenderableType

PLAIN_WIDTH, LONGEST_LINE = 110, 1_000
"""Minimum and maximum number of columns of the table if stderr is not a terminal."""


def summary_table(plan: CampaignPlan, summary: RunSummary) -> RenderableType:
    """The summary for the terminal: θ*, discrepancies, losses and best actions by receiver, files."""
    from rich.console import Group
    from rich.text import Text

    parts: list[RenderableType] = [Text(f"\n{summary.campaign}  seed {summary.seed}", style="bold")]
    parts += _theta_lines(plan, summary)
    discrepancies = {split: row for split, row in summary.discrepancy.items() if _has_numbers(row.values())}
    if discrepancies:
        parts.append(_discrepancy_table(discrepancies))
    if plan.deployment is not None:
        known = [row for row in summary.receivers.values() if _has_losses(row)]
        if known:
            parts.append(_receiver_table(known, deployment_unit(plan.deployment)))
        parts += _remarks(summary.receivers.values(), deployment_unit(plan.deployment))
        parts += occupancy_lines(summary.occupancy)
    files = [*summary.figures.items(), *([("recording", summary.recording)] if summary.recording else [])]
    if files:
        width = max(len(name) for name, _ in files)
        # Each path ends its line without a line break, so that it can be clicked and copied.
        parts.append(Text("\n".join(f"  {name:<{width}}  {path}" for name, path in files), overflow="fold"))
    if summary.dropped_events:
        parts.append(Text(f"  the recording lacks {summary.dropped_events} events: it could not keep up", "yellow"))
    return Group(*parts)


def _theta_lines(plan: CampaignPlan, summary: RunSummary) -> list[RenderableType]:
    from rich.text import Text

    if summary.calibrated_theta is None:
        return []
    text = Text(f"θ*  {style.display_values(summary.calibrated_theta.model_dump())}")
    if summary.predicted_discrepancy is not None:
        expected = DISCREPANCY.text(summary.predicted_discrepancy, summary.predicted_deviation or 0.0)
        text.append(f"   expected |Δ| {expected}", style="dim")
    lines: list[RenderableType] = [text]
    if summary.posterior is not None and plan.calibration is not None:
        found = posterior_lines(summary.posterior, plan.calibration.parameters)
        lines += [Text(f"  {line}", style="dim") for line in found]
    if (gain := summary.calibration_gain) is not None:
        lines.append(Text(f"  {gain.text}", style="" if gain.recommended == "calibrated" else "yellow"))
    return lines


def _has_losses(row: ReceiverSummary) -> bool:
    """Whether it has any of the table's main numbers."""
    return _has_numbers((row.first_loss, row.best_loss, row.predicted_loss))


def _has_numbers(values: Iterable[Any]) -> bool:
    return any(value is not None for value in values)


def _discrepancy_table(rows: Mapping[str, Mapping[str, float | None]]) -> RenderableType:
    from rich.table import Table

    columns = {
        "calibrated": "θ*",
        "posterior": "posterior (mean)",
        "uncalibrated": "uncalibrated",
        "random_theta": "random θ (median)",
        "mean_predictor": "mean of training pours",
        "regression": "GP regression",
    }
    shown = [name for name in columns if any(row.get(name) is not None for row in rows.values())]
    table = Table(title="mean |measured − predicted| spillage [%]", title_justify="left", title_style="", box=_box())
    table.add_column("")
    for name in shown:
        table.add_column(columns[name], justify="right")
    for split, row in rows.items():
        cells = [row.get(name) for name in shown]
        table.add_row(SPLITS[split], *("—" if cell is None else f"{100 * cell:.2f}" for cell in cells))
    return table


def _receiver_table(rows: Sequence[ReceiverSummary], unit: LossUnit) -> RenderableType:
    from rich.table import Table

    columns: dict[str, tuple[JustifyMethod, list[str]]] = {
        "receiver": ("left", [row.receiver for row in rows]),
        "": ("left", [row.strategy for row in rows]),
        "pours": ("right", [str(row.pours or "") for row in rows]),
        "first": ("right", ["" if row.first_loss is None else unit.text(row.first_loss) for row in rows]),
        "best measured": ("right", [_best_measured(row, unit) for row in rows]),
        "delivered": ("right", [_amount(row.best_delivered_g, row.best_delivered_ml) for row in rows]),
        "best expected": ("right", [_best_expected(row, unit) for row in rows]),
        "confirmed": ("right", [_confirmed(row.confirmed, unit) for row in rows]),
        "best action": ("left", [style.display_values(dict(row.best_action_si or {})) for row in rows]),
    }
    table = Table(title=unit.label, title_justify="left", title_style="", box=_box())
    shown = {name: column for name, column in columns.items() if any(column[1])}
    for name, (justify, _) in shown.items():
        table.add_column(name, justify=justify)
    for cells in zip(*(cells for _, cells in shown.values()), strict=True):
        table.add_row(*(cell or "—" for cell in cells))
    return table


def _best_measured(row: ReceiverSummary, unit: LossUnit) -> str:
    return "" if row.best_loss is None else f"{unit.text(row.best_loss)} (pour {row.best_pour})"


def _confirmed(found: Confirmed | None, unit: LossUnit) -> str:
    """'1.40 ± 0.30 % (3 pours)': the mean, and the deviation of a single pour."""
    if found is None or found.loss is None:
        return ""
    count = "1 pour" if found.loss.count == 1 else f"{found.loss.count} pours"
    return f"{unit.text(found.loss.mean, found.loss.deviation)} ({count})"


def _amount(grams: float | None, millilitres: float | None) -> str:
    """'193.2 g, 193.6 mL'."""
    return "" if grams is None or millilitres is None else f"{grams:.1f} g, {millilitres:.1f} mL"


def _best_expected(row: ReceiverSummary, unit: LossUnit) -> str:
    if row.predicted_loss is None:
        return ""
    return unit.text(row.predicted_loss, row.predicted_deviation) + unit.scatter(row.predicted_scatter)


def _remarks(rows: Iterable[ReceiverSummary], unit: LossUnit) -> list[RenderableType]:
    from rich.text import Text

    remarks: list[RenderableType] = []
    for row in rows:
        receiver = row.receiver
        if said := trust_line(row.trust):
            style = "yellow" if row.untrustworthy_simulation else ""
            remarks.append(Text(f"  {receiver}: {said}", style=style))
        if row.ended:
            remarks.append(Text(f"  {receiver}, the end: {row.ended}"))
        if row.failed_pours:
            what = "1 pour failed" if row.failed_pours == 1 else f"{row.failed_pours} pours failed"
            why = f": {'; '.join(row.failures)}" if row.failures else ""
            remarks.append(Text(f"  {receiver}: {what}{why}", style="yellow"))
        if row.confirmed is not None:
            lost = [f"pour {pour.number}: {pour.failed}" for pour in row.confirmed.pours if pour.failed]
            if lost:
                remarks.append(Text(f"  {receiver}, confirming pours that failed: {'; '.join(lost)}", style="yellow"))
        if row.gave_up:
            remarks.append(Text(f"  {receiver}: {row.gave_up}", style="yellow"))
        elif not _has_losses(row):
            remarks.append(Text(f"  {receiver}: nothing was learnt; see the journal for what failed", style="yellow"))
        remarks += [Text(f"  {receiver}, nothing beats: {_scalarization(one)}") for one in row.front or ()]
        if row.risk is not None:
            remarks.append(Text(f"  {receiver}, {risk_line(row.risk, unit)}"))
        if row.window is not None:
            remarks.append(Text(f"  {receiver}, {window_line(row.window, unit)}"))
        if row.prediction is not None:
            amount = _amount(row.predicted_delivered_g, row.predicted_delivered_ml)
            delivered = f"; delivered {amount} in the mean" if amount else ""
            remarks.append(Text(f"  {receiver}, best action: {_prediction(row.prediction)}{delivered}"))
        if row.prediction_band is not None:
            remarks.append(Text(f"  {receiver}, best action: {band_line(row.prediction_band)}"))
        if row.at_bounds:
            ends = ", ".join(row.at_bounds)
            text = f"  {receiver}, best action lies at the edge of what was searched: {ends}; beyond may be better"
            remarks.append(Text(text, style="yellow"))
        for one in row.not_covered:
            remarks.append(Text(f"  {receiver}, best action, {one.kind}: {one.text}", style="yellow"))
    return remarks


def _scalarization(one: ParetoAction) -> str:
    """'spillage 1.2 ± 0.3 %, time 40.0 ± 1.0 %  with angular velocity 41.2 deg/s, …'."""
    parts = [
        f"{name.replace('_', ' ')} {100 * at_least_nothing(mean):.1f} ± {100 * one.deviations[name]:.1f} %"
        for name, mean in one.objectives.items()
    ]
    return f"{', '.join(parts)}  with {style.display_values(dict(one.action_si))}"


def _prediction(over_seeds: Mapping[str, SampleStatistics]) -> str:
    """'spilled / poured 1.2 ± 0.4 % (mean ± standard deviation of 5 fresh seeds), retained …'."""
    shown = {name: over_seeds[name] for name in ("spillage", "spilled", "retained") if name in over_seeds}
    if not shown:
        return "no simulation of it could be used"
    words = {"spillage": "spilled / poured"}
    parts = [f"{words.get(name, name)} {spread.percent(2)}" for name, spread in shown.items()]
    count = max(spread.count for spread in shown.values())
    return f"{', '.join(parts)} (mean ± standard deviation, {count} fresh seeds)"


def band_line(band: PredictionInterval) -> str:
    """'nine single pours in ten spill 0.8 … 5.7 % of what is poured (simulations ± 0.3, …)'."""
    causes = {"simulations": band.simulations, "left over by calibration": band.discrepancy}
    causes["resolution"] = band.resolution
    said = ", ".join(f"{name} ± {100 * value:.2f}" for name, value in causes.items() if value is not None)
    lacking = "" if band.discrepancy is not None else "; what calibration left over is not known"
    return f"nine single pours in ten spill {band.percent(2)} of what is poured ({said}{lacking})"


def print_summary(plan: CampaignPlan, summary: RunSummary) -> None:
    """Write the summary's table to stderr."""
    _print(summary_table(plan, summary), to_stderr=True)


def print_table(rows: Sequence[Mapping[str, str]], *, right: Sequence[str] = (), title: str | None = None) -> None:
    """Write a table to stdout; empty columns are left out.

    Args:
        rows: head → cell, the same heads in each.
        right: heads of columns with numbers, which are right-aligned.
    """
    from rich.table import Table
    from rich.text import Text

    table = Table(title=title, title_justify="left", title_style="bold", box=_box(), pad_edge=False)
    shown = [head for head in rows[0] if any(row[head] for row in rows)] if rows else []
    for head in shown:
        table.add_column(Text(head), justify="right" if head in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(row[head]) for head in shown))
    _print(table)


def _print(table: RenderableType, *, to_stderr: bool = False) -> None:
    """Print a table. If the output is not a terminal, lines are as long as names and paths need."""
    from rich.console import Console
    from rich.measure import Measurement

    console = Console(stderr=to_stderr)
    if not console.is_terminal:
        wanted = Measurement.get(console, console.options.update(max_width=LONGEST_LINE), table).maximum
        console.width = max(PLAIN_WIDTH, wanted)
    console.print(table)


def _box() -> Any:
    from rich import box

    return box.SIMPLE_HEAD
