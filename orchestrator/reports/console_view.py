"""Display of results in the terminal: the result document of a run, and tables of text."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from rich import box
from rich.console import Console, Group, RenderableType
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from orchestrator.reports import figure_style as style
from orchestrator.reports.run_summary import Advice, RunSummary
from orchestrator.reports.wording import ResultTable, receiver_table, score_table

PLAIN_WIDTH, LONGEST_LINE = 110, 1_000
"""Minimum and maximum number of columns of the table if stderr is not a terminal."""


def summary_table(summary: RunSummary) -> RenderableType:
    """The document for the terminal: θ*, discrepancies, losses and best actions by receiver, files."""
    parts: list[RenderableType] = [Text(f"\n{summary.campaign}  seed {summary.seed}", style="bold")]
    learning, outcome, files = summary.learning, summary.outcome, summary.files
    if learning.calibrated_theta is not None:
        parts.append(Text(f"θ*  {style.display_values(learning.calibrated_theta.model_dump())}"))
        parts += [Text(f"  {line}", style="dim") for line in learning.theta_sentences]
    parts += [_table(table) for table in (score_table(learning), receiver_table(outcome)) if table.rows]
    for advice in outcome.advice:
        parts += _advice(advice)
    pools = {stage.rpartition(":")[2]: use.text for stage, use in summary.occupancy.items() if use.text}
    parts += [Text(f"  {stage}: pool {text}", style="dim") for stage, text in pools.items()]
    paths = [*files.figures.items(), *([("recording", files.recording)] if files.recording else [])]
    if paths:
        width = max(len(name) for name, _ in paths)
        # Each path ends its line without a line break, so that it can be clicked and copied.
        parts.append(Text("\n".join(f"  {name:<{width}}  {path}" for name, path in paths), overflow="fold"))
    if files.dropped_events:
        parts.append(Text(f"  the recording lacks {files.dropped_events} events: it could not keep up", "yellow"))
    return Group(*parts)


def _advice(row: Advice) -> list[RenderableType]:
    action = ", ".join(f"{name} {value}" for name, value in row.action.items())
    lines = [f"  into {row.receiver}: {action}" if action else f"  into {row.receiver}", *row.sentences]
    shown: list[RenderableType] = [Text(line if i == 0 else f"    {line}") for i, line in enumerate(lines) if line]
    return shown + [Text(f"    {line}", style="yellow") for line in row.open]


def print_summary(summary: RunSummary) -> None:
    """Write the document to stderr."""
    _print(summary_table(summary), to_stderr=True)


def print_table(rows: Sequence[Mapping[str, str]], *, right: Sequence[str] = (), title: str | None = None) -> None:
    """Write a table to stdout; empty columns are left out.

    Args:
        rows: head → cell, the same heads in each.
        right: heads of columns with numbers, which are right-aligned.
    """
    table = Table(title=title, title_justify="left", title_style="bold", box=box.SIMPLE_HEAD, pad_edge=False)
    shown = [head for head in rows[0] if any(row[head] for row in rows)] if rows else []
    for head in shown:
        table.add_column(Text(head), justify="right" if head in right else "left", overflow="fold")
    for row in rows:
        table.add_row(*(Text(row[head]) for head in shown))
    _print(table)


def _table(content: ResultTable) -> RenderableType:
    table = Table(title=Text(content.caption), title_justify="left", box=box.SIMPLE_HEAD)
    for place, head in enumerate(content.header):
        table.add_column(Text(head), justify="right" if place in content.numbers else "left")
    for row in content.rows:
        table.add_row(*map(Text, row.cells))
    return table


def _print(table: RenderableType, *, to_stderr: bool = False) -> None:
    """Print a table. If the output is not a terminal, lines are as long as names and paths need."""
    console = Console(stderr=to_stderr)
    if not console.is_terminal:
        wanted = Measurement.get(console, console.options.update(max_width=LONGEST_LINE), table).maximum
        console.width = max(PLAIN_WIDTH, wanted)
    console.print(table)
