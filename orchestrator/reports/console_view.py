"""Display of results in the terminal: the result document of a run, and tables of text."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence

from rich import box
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.measure import Measurement
from rich.table import Table
from rich.text import Text

from orchestrator.reports import figure_style as style
from orchestrator.reports.run_summary import Advice, RunSummary
from orchestrator.reports.wording import ResultTable, receiver_table, score_table

PLAIN_WIDTH, LONGEST_LINE = 110, 1_000
"""Minimum and maximum number of columns of the table if stderr is not a terminal."""


class TextTable:
    """A table that cuts no word: on a screen that is too narrow for its columns, each row is a list of heads and cells.

    Args:
        heads: of the columns.
        rows: cells, one for each head.
        numbers: places of columns that are right-aligned.
        title: line above the table.
    """

    def __init__(
        self, heads: Sequence[str], rows: Sequence[Sequence[str]], numbers: Collection[int] = (), title: str = ""
    ) -> None:
        self._heads, self._rows, self._numbers, self._title = heads, rows, numbers, title

    def __rich_measure__(self, console: Console, options: ConsoleOptions) -> Measurement:
        return Measurement.get(console, options, self._table(None))

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        wide = options.update(max_width=LONGEST_LINE)
        columns = [
            [Measurement.get(console, wide, Text(text)) for text in (head, *cells) if text] or [Measurement(1, 1)]
            for head, *cells in zip(self._heads, *self._rows, strict=True)
        ]
        widths = [max(text.minimum for text in column) for column in columns]
        natural = [max(text.maximum for text in column) for column in columns]
        frame = Measurement.get(console, wide, self._table(None)).maximum - sum(natural)
        free = options.max_width - frame - sum(widths)
        if free < 0:
            yield self._list(options.max_width)
            return
        places = sorted(range(len(widths)), key=lambda place: natural[place] - widths[place])
        for others, place in zip(range(len(places), 0, -1), places, strict=True):  # an equal share, if it needs one
            share = min(natural[place] - widths[place], free // others)
            widths[place] += share
            free -= share
        yield self._table(widths)

    def _table(self, widths: Sequence[int] | None) -> Table:
        title = Text(self._title, style="bold") if self._title else None
        padding = (0, 1, 0, 0)  # two columns between cells: one of padding, one of the box
        table = Table(title=title, title_justify="left", box=box.SIMPLE_HEAD, pad_edge=False, padding=padding)
        for place, head in enumerate(self._heads):
            width = None if widths is None else widths[place]
            table.add_column(Text(head), justify="right" if place in self._numbers else "left", width=width)
        for row in self._rows:
            table.add_row(*map(Text, row))
        return table

    def _list(self, width: int) -> RenderableType:
        """'  head cell · head cell' in lines of at most `width`, below the first cell of each row."""
        lines: list[Text] = [Text(self._title, style="bold")] if self._title else []
        for first, *others in self._rows:
            lines.append(Text(f"{self._heads[0]} {first}".strip(), style="bold"))
            line = ""
            for head, cell in zip(self._heads[1:], others, strict=True):
                pair = f"{head} {cell}".strip() if cell else ""
                if line and len(line) + len(pair) + 5 > width:
                    lines.append(Text(f"  {line}"))
                    line = ""
                line = " · ".join(filter(None, (line, pair)))
            lines.append(Text(f"  {line}"))
        return Group(*lines)


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
    heads = [head for head in rows[0] if any(row[head] for row in rows)] if rows else []
    cells = [[row[head] for head in heads] for row in rows]
    numbers = {place for place, head in enumerate(heads) if head in right}
    _print(TextTable(heads, cells, numbers, title or ""))


def _table(content: ResultTable) -> RenderableType:
    return TextTable(content.header, [row.cells for row in content.rows], content.numbers, content.caption)


def _print(table: RenderableType, *, to_stderr: bool = False) -> None:
    """Print a table. If the output is not a terminal, lines are as long as names and paths need."""
    console = Console(stderr=to_stderr)
    if not console.is_terminal:
        wanted = Measurement.get(console, console.options.update(max_width=LONGEST_LINE), table).maximum
        console.width = max(PLAIN_WIDTH, wanted)
    console.print(table)
