"""The CSV file of a recorded pour: time, tilt and mass as they arrived, each with its own times.

A line has a time and values of one or more columns; a cell without a value is empty. Tilt and mass usually arrive at
different times, so most lines have one of them. Nothing is interpolated. Columns carry their unit in their name, such
as `time_s`, `tilt_deg`, `mass_g`; `UNITS` lists the units. `read_series` reads a file, `write_series` writes one.

Limitations: a file is read as a whole; one hour at 20 Hz has 2 MB.
"""

from __future__ import annotations

import csv
import io
import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from actors.balance.readings import KILOGRAMS
from orchestrator.campaigns.yaml.file_access import UnreadableError, read_text
from orchestrator.campaigns.yaml.yaml_errors import PROBLEMS_SHOWN, ConfigError, Problem
from sim_engine.errors import did_you_mean

Floats = NDArray[np.float64]

UNITS: Mapping[str, Mapping[str, float]] = {
    "time": {"s": 1.0, "ms": 1e-3, "us": 1e-6},
    "tilt": {"deg": math.pi / 180.0, "rad": 1.0},
    "mass": {unit: KILOGRAMS[unit] for unit in ("g", "kg", "mg", "oz", "lb")},
    "flow": {"g_s": 1e-3, "kg_s": 1.0},
    "level": {"mm": 1e-3, "cm": 1e-2, "m": 1.0},
    "stable": {"": 1.0},
}
"""Quantities of the columns and their units, each with its value in SI. `stable` is 1 if the balance reports a stable
weight, else 0."""

REQUIRED = ("time", "mass")

SIZE_LIMIT = 50_000_000
"""Largest file [bytes]."""

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

    def __getitem__(self, part: slice) -> Column:
        return Column(self.times[part], self.values[part], self.lines[part])


@dataclass(frozen=True, eq=False)
class TimeSeries:
    """The columns of a file by quantity, and its text for messages.

    Attributes:
        path: the file.
        columns: by quantity; 'mass' is present.
        text: lines of the file.
        warnings: what is unusual, with its place.
    """

    path: Path
    columns: Mapping[str, Column]
    text: tuple[str, ...]
    warnings: tuple[Problem, ...] = ()

    def problem(self, line: int, message: str, quantity: str = "") -> Problem:
        """A problem at a line, from 1."""
        source = self.text[line - 1].rstrip() if 0 < line <= len(self.text) else ""
        return Problem(self.path, line, 1, quantity, message, source)


def read_series(path: Path, names: Mapping[str, str] | None = None) -> TimeSeries:
    """Read a file.

    Args:
        path: CSV, UTF-8, comma-separated, with a header.
        names: other names in the file, {name with unit: name in the file}.

    Raises:
        ConfigError: a column is missing or has no known unit; a value is not a finite number; times are not sorted, or
            repeat within a column.
    """
    try:
        text = read_text(path, limit=SIZE_LIMIT).removeprefix("\ufeff")
    except UnreadableError as error:
        raise ConfigError([Problem(path, 0, 0, "", str(error))]) from None
    lines = tuple(text.splitlines())
    if not text.strip():
        raise ConfigError([Problem(path, 0, 0, "", "is empty; it needs a header such as time_s,tilt_deg,mass_g")])
    reader = csv.reader(io.StringIO(text, newline=""))
    header = [cell.strip() for cell in next(reader)]
    places, warnings = _places(path, header, lines[0], names or {})
    problems: list[Problem] = []
    found: dict[str, tuple[list[float], list[float], list[int]]] = {name: ([], [], []) for name in places}
    time_place, time_unit = places.pop("time")
    width = len(header)
    before, unsorted = -math.inf, 0
    series = TimeSeries(path, {}, lines)
    try:
        for cells in reader:
            number = reader.line_num
            if len(problems) >= PROBLEMS_SHOWN:
                break
            if not cells or (len(cells) == 1 and not cells[0].strip()):
                continue
            if len(cells) != width:
                problems.append(series.problem(number, f"has {len(cells)} cells, the header {width}"))
                continue
            time = _number(cells[time_place], series, number, header[time_place], problems, required=True)
            if time is None:
                continue
            time *= time_unit
            if time < before:
                if not unsorted:
                    text = f"the time goes back, from {before:g} s to {time:g} s; sort the lines by time"
                    problems.append(series.problem(number, text, header[time_place]))
                unsorted += 1
                continue
            before = time
            for name, (place, unit) in places.items():
                value = _number(cells[place], series, number, header[place], problems)
                if value is not None:
                    times, values, numbers = found[name]
                    times.append(time)
                    values.append(unit * value)
                    numbers.append(number)
    except csv.Error as error:
        problems.append(series.problem(reader.line_num, f"is not CSV: {error}; is a quote still open?"))
    columns = {
        name: Column(np.array(times), np.array(values), np.array(numbers, dtype=np.int64))
        for name, (times, values, numbers) in found.items()
        if name != "time" and times
    }
    for name, column in columns.items():
        problems += _repeated(series, name, column)
    if not problems and "mass" not in columns:
        problems.append(series.problem(1, "has no reading of the mass; every cell of its column is empty", "mass"))
    if problems:
        raise ConfigError(problems)
    first = min(column.times[0] for column in columns.values())
    if first > CLOCK:
        columns = {name: Column(one.times - first, one.values, one.lines) for name, one in columns.items()}
        text = f"times count from 1970 ({first:.3f} s); the recording starts at 0 s"
        if first > 1e3 * CLOCK:
            text = f"{first:g} s is not a time in seconds; if it is in milliseconds, name the column time_ms"
            raise ConfigError([series.problem(2, text, header[time_place])])
        warnings = (*warnings, series.problem(2, text, header[time_place]))
    return TimeSeries(path, columns, lines, warnings)


def _places(
    path: Path, header: list[str], line: str, names: Mapping[str, str]
) -> tuple[dict[str, tuple[int, float]], tuple[Problem, ...]]:
    """Column number and unit by quantity, and warnings.

    Raises:
        ConfigError: the header is invalid.
    """
    separator = next((s for s in ";\t" if s in line and "," not in line), None)
    if separator is not None:
        text = f"cells are separated by {'semicolons' if separator == ';' else 'tabs'}; save it with commas, and "
        raise ConfigError([Problem(path, 1, 1, "", text + "numbers with a decimal point", line)])
    known = {f"{name}_{unit}" if unit else name: (name, unit) for name, units in UNITS.items() for unit in units}
    ours = {theirs: own for own, theirs in names.items()}
    problems: list[Problem] = []
    found: dict[str, tuple[int, float]] = {}
    unread: list[str] = []

    def add(name: str, message: str) -> None:
        problems.append(Problem(path, 1, line.find(name) + 1 if name else 1, name, message, line))

    for own, theirs in names.items():
        if own not in known:
            add(theirs, f"'columns' maps it to '{own}', which is no column; known are {', '.join(known)}")
        if theirs not in header:
            add("", f"column '{theirs}' is missing, which 'columns' names for '{own}'")
    for place, theirs in enumerate(header):
        own = ours.get(theirs, theirs)
        quantity, _, unit = own.partition("_")
        if own in known:
            if quantity in found:
                add(theirs, f"is a second column of the {quantity}; keep one")
            found[quantity] = (place, UNITS[quantity][unit])
        elif quantity in UNITS:
            units = ", ".join(f"{quantity}_{each}" for each in UNITS[quantity] if each) or quantity
            add(theirs, f"has no known unit; name it by its unit: {units}")
        elif guess := did_you_mean(own, [name for name in known if "_" in name]):
            add(theirs, f"unknown column; did you mean '{guess}'?")
        else:
            unread.append(theirs)
    for quantity in REQUIRED:
        if quantity not in found and not any(problem.where.startswith(quantity) for problem in problems):
            units = ", ".join(f"{quantity}_{unit}" for unit in UNITS[quantity])
            hint = f"; or map one of {', '.join(map(repr, unread[:6]))} with 'columns'" if unread else ""
            add("", f"has no column of the {quantity}; name one {units}{hint}")
    if problems:
        raise ConfigError(problems)
    if not unread:
        return found, ()
    return found, (Problem(path, 1, 1, "", f"columns that are not read: {', '.join(unread)}", line),)


def _number(
    cell: str, series: TimeSeries, line: int, name: str, problems: list[Problem], *, required: bool = False
) -> float | None:
    """A cell's number; None for an empty cell and after a problem."""
    try:
        value = float(cell)
    except ValueError:
        if not cell.strip():
            if required:
                problems.append(series.problem(line, "has no time; give every line its time", name))
            return None
        hint = "write a number"
        if required:
            hint = "write seconds from the start of the recording, not a date or a clock time"
        elif cell.strip().lower() in ("true", "false"):
            hint = "write 1 or 0"
        problems.append(series.problem(line, f"{cell.strip()!r} is not a number; {hint}", name))
        return None
    if not math.isfinite(value):
        text = f"{cell.strip()!r} is not a finite number; leave the cell empty if there is no value"
        problems.append(series.problem(line, text, name))
        return None
    return value


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
    found: list[int] = (np.flatnonzero(np.diff(column.times) > longest) + 1).tolist()
    return found
