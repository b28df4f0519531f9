"""The table of a recorded pour: time, tilt and mass as they arrived, each with its own times.

A row has a time and values of one or more columns; a cell without a value is empty. Tilt and mass usually arrive at
different times, so most rows have one of them. Nothing is interpolated. `read_series` reads every dialect that
`orchestrator.campaigns.saved_table` reads, with units in the header; `write_series` writes the plain one.

Limitations: a file is read as a whole; one hour at 20 Hz has 2 MB.
"""

from __future__ import annotations

import csv
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orchestrator.campaigns.saved_table import SavedTable, TableRow, read_saved_table
from orchestrator.campaigns.table_columns import MASS, TILT, KnownColumn, columns_of
from orchestrator.campaigns.yaml.yaml_errors import PROBLEMS_SHOWN, ConfigError, Problem
from sim_engine.settings.quantity import parse_unit

Floats = NDArray[np.float64]

COLUMNS = (KnownColumn("time", "s", "s"), TILT, MASS)
"""Columns that are read; the tilt may be missing here."""

SIZE_LIMIT, MOST_LINES = 20_000_000, 400_000
"""Largest file [bytes], and largest number of a line."""

CLOCK = 1e8
"""Times above this one [s] count from 1970; the series then starts at 0."""


@dataclass(frozen=True, eq=False)
class Column:
    """Values of one quantity.

    Attributes:
        times: increasing (N,) [s].
        values: (N,) in SI.
        lines: of the file (N,).
    """

    times: Floats
    values: Floats
    lines: NDArray[np.int64]

    def __len__(self) -> int:
        return len(self.times)

    def __getitem__(self, rows: slice) -> Column:
        return Column(self.times[rows], self.values[rows], self.lines[rows])


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """The columns of a file by quantity, and its rows for messages.

    Attributes:
        table: the file.
        places: position of each quantity in its rows.
        columns: by quantity; 'mass' is present.
        warnings: what is unusual, with its place.
    """

    table: SavedTable
    places: Mapping[str, int]
    columns: Mapping[str, Column]
    warnings: tuple[Problem, ...] = ()

    def problem(self, line: int, message: str, quantity: str = "") -> Problem:
        """A problem at a line of the file; of the header for any other number."""
        row = next((row for row in self.table.rows if row.line == line), self.table.header)
        return self.table.problem(row, self.places.get(quantity), quantity, message)


def read_series(path: Path, names: Mapping[str, str] | None = None) -> TimeSeries:
    """Read a file.

    Args:
        path: a table with a header.
        names: other names in the file, {name with unit: name in the file}.

    Raises:
        ConfigError: a column is missing or has no known unit; a value is not a finite number; times are not sorted, or
            repeat within a column.
    """
    table = read_saved_table(path, limit=SIZE_LIMIT, most_lines=MOST_LINES)
    places, factors, unread = _places(table, names or {})
    header = table.header
    series = TimeSeries(table, places, {})
    problems = table.misfits()
    columns = _columns(series, factors, problems)
    for name, column in columns.items():
        problems += _repeated(series, name, column)
    if not problems and "mass" not in columns:
        problems.append(series.problem(header.line, "has no reading of the mass; every cell is empty", "mass"))
    if problems:
        raise ConfigError(problems)
    warnings = [series.problem(header.line, f"columns that are not read: {', '.join(unread)}")] if unread else []
    if table.note:
        warnings.append(series.problem(header.line, table.note))
    first = min(column.times[0] for column in columns.values())
    if first > CLOCK:
        line = table.rows[0].line
        columns = {name: Column(column.times - first, column.values, column.lines) for name, column in columns.items()}
        if first > 1e3 * CLOCK:
            text = f"{first:g} s is not a time in seconds; if it is in milliseconds, name the column time_ms"
            raise ConfigError([series.problem(line, text, "time")])
        text = f"times count from 1970 ({first:.3f} s); the recording starts at 0 s"
        warnings.append(series.problem(line, text, "time"))
    return TimeSeries(table, places, columns, tuple(warnings))


def _columns(series: TimeSeries, factors: Mapping[str, float], problems: list[Problem]) -> dict[str, Column]:
    """The columns of a file that have a value, in SI units; lines that can't be used are added to the problems."""
    table, places = series.table, series.places
    cells: dict[str, tuple[list[float], list[float], list[int]]] = {name: ([], [], []) for name in places}
    before, sorted_so_far = -math.inf, True
    for row in table.rows:
        if len(problems) >= PROBLEMS_SHOWN:
            break
        if len(row.cells) != len(table.header.cells):
            continue
        numbers = {name: _number(table, row, place, problems, name) for name, place in places.items()}
        time = numbers.pop("time")
        if time is None:
            if row.cells[places["time"]] == "":
                problems.append(series.problem(row.line, "has no time; give every line its time", "time"))
            continue
        time *= factors["time"]
        if time < before:
            if sorted_so_far:
                text = f"the time goes back, from {before:g} s to {time:g} s; sort the lines by time"
                problems.append(series.problem(row.line, text, "time"))
            sorted_so_far = False
            continue
        before = time
        for name, number in numbers.items():
            if number is not None:
                times, values, lines = cells[name]
                times.append(time)
                values.append(factors[name] * number)
                lines.append(row.line)
    return {
        name: Column(np.array(times), np.array(values), np.array(lines, dtype=np.int64))
        for name, (times, values, lines) in cells.items()
        if times
    }


def _places(table: SavedTable, names: Mapping[str, str]) -> tuple[dict[str, int], dict[str, float], list[str]]:
    """Position and unit [SI] of each quantity, and the columns that are not read.

    Raises:
        ConfigError: the header is invalid.
    """
    problems: list[Problem] = []
    unread: list[str] = []
    columns = columns_of(table, COLUMNS, {theirs: standard for standard, theirs in names.items()}, problems, unread)
    header = [str(cell) for cell in table.header.cells]
    for standard, theirs in names.items():
        if theirs not in header:
            text = f"column '{theirs}' is missing, which 'columns' names for '{standard}'"
            problems.append(table.problem(table.header, None, "", text))
    places: dict[str, int] = {}
    factors: dict[str, float] = {}
    for entry in COLUMNS:
        for place, column in enumerate(columns):
            if column is not None and column.standard == entry.standard:
                places[entry.name] = place
                factors[entry.name] = column.factor * parse_unit(entry.display, entry.unit, f"1 {entry.display}")
        if entry is not TILT and entry.name not in places and not problems:
            hint = f"; or map one of {', '.join(map(repr, unread[:6]))} with 'columns'" if unread else ""
            text = f"has no column of the {entry.name}; name one '{entry.standard}' or '{entry.name} [unit]'{hint}"
            problems.append(table.problem(table.header, None, "", text))
    if problems:
        raise ConfigError(problems)
    return places, factors, unread


def _number(table: SavedTable, row: TableRow, place: int, problems: list[Problem], name: str) -> float | None:
    """A cell's number in the file's unit; None for an empty cell and after a problem."""
    cell = row.cells[place]
    if cell == "":
        return None
    try:
        return table.number(cell)
    except ValueError as error:
        hint = "leave the cell empty if there is no value"
        if name == "time":
            hint = "write seconds from the start of the recording, not a date or a clock time"
        problems.append(table.problem(row, place, str(table.header.cells[place]), f"{error}; {hint}"))
        return None


def _repeated(series: TimeSeries, name: str, column: Column) -> list[Problem]:
    """The problem of times that repeat within a column."""
    again = np.flatnonzero(np.diff(column.times) <= 0.0)
    if not len(again):
        return []
    first = int(again[0])
    before, line, time = int(column.lines[first]), int(column.lines[first + 1]), float(column.times[first])
    text = f"the {name} at {time:.15g} s stands in line {before} already; keep one value for each time"
    if len(again) > 1:
        text += f" ({len(again)} times repeat: does the clock have whole seconds only? Log its fractions)"
    return [series.problem(line, text, name)]


def write_series(path: Path, columns: Mapping[str, Iterable[tuple[float, float]]]) -> None:
    """Write a file: one line for each time, sorted, with empty cells where a column has no value.

    Args:
        path: of the new file.
        columns: by their names with units, pairs of time [s] and value in that unit.

    Raises:
        OSError: it can't be written, or exists.
    """
    rows: dict[float, dict[str, float]] = {}
    for name, pairs in columns.items():
        for time, value in pairs:
            rows.setdefault(round(float(time), 4), {})[name] = value
    with path.open("x", encoding="utf-8", newline="") as file:
        writer = csv.writer(file, lineterminator="\n")
        writer.writerow(["time_s", *columns])
        for time, values in sorted(rows.items()):
            writer.writerow([f"{time:.10g}", *(f"{values[n]:.10g}" if n in values else "" for n in columns)])


def gaps(column: Column, longest: float) -> list[int]:
    """Positions before which a column has no value for more than `longest` [s]."""
    places: list[int] = (np.flatnonzero(np.diff(column.times) > longest) + 1).tolist()
    return places


@dataclass(frozen=True)
class Arrivals:
    """How the readings arrived.

    Attributes:
        interval: median [s].
        longest: largest gap [s].
        step: of the display [kg].
        repeated: number of readings that repeat the one before although the mass rises by more than 1.5 steps.
        rising: number of readings while it does.
    """

    interval: float
    longest: float
    step: float
    repeated: int
    rising: int


def arrivals(times: Floats, masses: Floats, step: float) -> Arrivals:
    """Describe how readings arrived.

    Args:
        times, masses: of the readings (R,) [s], [kg].
        step: of the display [kg].

    The rise of the mass is the slope between the readings one second before and after.
    """
    gaps = np.diff(times)
    slope = (np.interp(times + 1.0, times, masses) - np.interp(times - 1.0, times, masses)) / (
        np.minimum(times + 1.0, times[-1]) - np.maximum(times - 1.0, times[0])
    )
    rising = slope[1:] * gaps > 1.5 * step
    same = np.abs(np.diff(masses)) < 0.5 * step
    return Arrivals(float(np.median(gaps)), float(gaps.max()), step, int(np.sum(rising & same)), int(np.sum(rising)))
