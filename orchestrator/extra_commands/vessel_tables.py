"""Input of `decant vessel`: pairs of lengths, and tables of two columns.

Every reader reports invalid input as a `RefusalError` with file and line.
"""

from __future__ import annotations

import math
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from orchestrator.campaigns.saved_table import read_saved_table
from orchestrator.campaigns.table_columns import MASS, TILT, KnownColumn, columns_of
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.cli.console import RefusalError, print_note
from sim_engine.settings.quantity import QuantityError, typed_quantity

Floats = NDArray[np.float64]

LARGEST_TABLE = 2_000_000
"""Largest file of a table [bytes]."""

MOST_ROWS = 10_000

FEWEST_ROWS = 3

NARROWEST_MM, WIDEST_MM = 4.0, 1000.0
"""Limits of the mean inner diameter of vessels [mm]."""

COLUMNS = {
    one.standard: one
    for one in (
        KnownColumn("level", "m", "mm", ("height", "fill_level")),
        TILT,
        MASS,
    )
}
"""Columns of tables: levels above the inner floor, tilts from upright, masses of the liquid."""


def read_diameters(text: str, height: float) -> tuple[Floats, Floats]:
    """Parse heights and diameters of '5 mm: 60 mm, 95 mm: 72 mm' [m].

    Raises:
        RefusalError: a pair is invalid, or lies outside the vessel (exit code 2).
    """
    heights, widths = [], []
    for pair in filter(None, (entry.strip() for entry in text.split(","))):
        at, colon, wide = pair.partition(":")
        try:
            if not colon:
                raise QuantityError("should be a height and a diameter, such as '95 mm: 72 mm'")
            heights.append(typed_quantity(at.strip(), "m", "95 mm"))
            widths.append(typed_quantity(wide.strip(), "m", "72 mm"))
        except QuantityError as error:
            raise RefusalError(f"--diameters: '{pair}': {error}") from None
        if not 0.0 <= heights[-1] <= height + 1e-9:
            raise RefusalError(
                f"--diameters: '{pair}': that is not between the inner floor (0 mm) and the rim ({1e3 * height:g} mm)"
            )
        if not 0.0 < widths[-1] < 1.0:
            raise RefusalError(f"--diameters: '{pair}': a diameter should be above 0 and below 1 m")
    if not heights:
        raise RefusalError("--diameters: has no pair; write for example '5 mm: 60 mm, 95 mm: 72 mm'")
    return np.array(heights), np.array(widths)


def read_fill_table(
    path: Path, *, height: float, density: float, ruler: float, balance: float, tare: float = 0.0
) -> tuple[Floats, Floats]:
    """Read a table of levels above the inner bottom [mm] and the masses below them [g], sorted by level.

    Args:
        height: height of the rim [mm].
        density: density of the weighed liquid [g/mm³].
        ruler, balance: standard deviations of a level [mm] and of a mass [g].
        tare: contained in each mass, and subtracted [g].

    Raises:
        RefusalError: with the file, the line, and a correction (exit code 2).
    """
    rows = _read_rows(path, "level_mm", upper=height, tare=tare)
    rows.sort(key=lambda row: row[1:])
    table = _monotonic(path, rows, "a higher level holds more", 1.0, ruler, balance)
    for line, level, mass in rows:
        diameter = math.sqrt(4.0 * mass / density / (math.pi * level))
        if not NARROWEST_MM <= diameter <= WIDEST_MM:
            raise RefusalError(
                f"{path}:{line}: {mass:g} g below {level:g} mm make a vessel of {diameter:.3g} mm in diameter; should "
                f"be {NARROWEST_MM:g} to {WIDEST_MM:g} mm. Are the levels in mm above the inner floor, the masses in g "
                "of the liquid alone?"
            )
    return table


def read_tilt_table(path: Path, *, angle: float, balance: float, tare: float = 0.0) -> tuple[Floats, Floats]:
    """Read a table of tilts [deg] and the masses that the vessel retains at them [g], sorted by tilt.

    Args:
        angle, balance: standard deviations of a tilt [deg] and of a mass [g].
        tare: contained in each mass, and subtracted [g].

    Raises:
        RefusalError: with the file, the line, and a correction (exit code 2).
    """
    rows = _read_rows(path, "tilt_deg", upper=90.0, tare=tare)
    rows.sort(key=lambda row: (row[1], -row[2]))
    return _monotonic(path, rows, "a vessel that is tilted further holds less", -1.0, angle, balance)


def _monotonic(
    path: Path, rows: list[tuple[int, float, float]], rule: str, sign: float, reading: float, balance: float
) -> tuple[Floats, Floats]:
    """Return the columns of sorted rows; masses must rise (sign 1) or fall (-1), within the errors of measurement."""
    table = np.array([row[1:] for row in rows])
    values, masses = table[:, 0], table[:, 1]
    if (different := len(np.unique(values))) < FEWEST_ROWS:
        raise RefusalError(
            f"{path}: has {different} different value(s); at least {FEWEST_ROWS} say something about a shape"
        )
    steepness = float(np.ptp(masses) / np.ptp(values))
    # three standard deviations of the difference of two readings
    allowed = 3.0 * math.sqrt(2.0) * math.hypot(balance, steepness * reading)
    best = 0
    for k in range(1, len(rows)):
        back = sign * (masses[best] - masses[k])
        repeated = values[k] == values[k - 1] and abs(masses[k] - masses[k - 1]) > allowed
        if back > allowed or repeated:
            other = k - 1 if repeated else best
            raise RefusalError(
                f"{path}:{rows[k][0]}: mass_g is {masses[k]:g} at {values[k]:g}, and {masses[other]:g} at "
                f"{values[other]:g} (line {rows[other][0]}); {rule}"
            )
        best = k if back <= 0.0 else best
    return values, masses


def _read_rows(path: Path, column: str, *, upper: float, tare: float) -> list[tuple[int, float, float]]:
    """Read line number, value of a column and mass [g] of each row; see `read_fill_table`."""
    wanted = (COLUMNS[column], COLUMNS["mass_g"])
    problems: list[Problem] = []
    table = read_saved_table(path, limit=LARGEST_TABLE)
    columns = columns_of(table, wanted, {}, problems)
    if problems:
        raise ConfigError(problems)
    names = [name.standard for name in columns if name is not None]
    missing = [name.standard for name in wanted if name.standard not in names]
    if missing:
        raise RefusalError(f"{path}:1: the column '{missing[0]}' is missing; write '{column},mass_g'")
    if table.note:
        print_note(f"note: {table.note}")
    rows: list[tuple[int, float, float]] = []
    for row in table.rows:
        at = f"{path}:{row.line}"
        try:
            numbers = [table.number(cell) for cell in row.cells]
        except ValueError:
            numbers = []
        if len(numbers) != len(names):
            raise RefusalError(f"{at}: should be two numbers, {column} and mass_g")
        values = {name.standard: n * name.factor for name, n in zip(columns, numbers, strict=True) if name is not None}
        value, mass = values[column], values["mass_g"] - tare
        if value == 0.0 and (column == "tilt_deg" or mass == 0.0):
            print_note(f"note: {at}: {column} 0 is left out: it says nothing about the shape")
            continue
        if not 0.0 < value <= upper * (1.0 + 1e-9):
            raise RefusalError(f"{at}: {column} is {value:g}; should be above 0 and at most {upper:g}")
        if not 0.0 <= mass < 1e5:
            least = f"the {tare:g} g of --tare" if tare else "0"
            raise RefusalError(f"{at}: mass_g is {values['mass_g']:g}; should be at least {least}")
        rows.append((row.line, value, mass))
        if len(rows) > MOST_ROWS:
            raise RefusalError(f"{at}: more than {MOST_ROWS:,} rows")
    if len(rows) < FEWEST_ROWS:
        raise RefusalError(f"{path}: has {len(rows)} row(s); at least {FEWEST_ROWS} say something about a shape")
    return rows
