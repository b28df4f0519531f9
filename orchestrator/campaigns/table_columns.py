"""Columns of saved tables: names with units in headers, such as 'poured_g', 'poured [kg]' or 'Max angle (rad)'.

A caller lists the columns that it can use (`KnownColumn`); `columns_of` finds them in the header of a table. Which of
them are required is up to the caller.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from orchestrator.campaigns.saved_table import SavedTable, is_unit
from orchestrator.campaigns.yaml.yaml_errors import Problem
from sim_engine.errors import did_you_mean
from sim_engine.settings.quantity import QuantityError, parse_unit

_BRACKETS = re.compile(r"(.*?)\s*[\[(]\s*(.*?)\s*[\])]")


@dataclass(frozen=True)
class KnownColumn:
    """A column that a caller can use.

    Attributes:
        name: its name without the unit, for example 'poured'.
        unit: SI unit of the quantity; empty for a column of words.
        display: unit of the standard name, 'poured_g'.
        aliases: other names.
    """

    name: str
    unit: str = ""
    display: str = ""
    aliases: tuple[str, ...] = ()

    @property
    def standard(self) -> str:
        """The name with its unit: 'poured_g', 'angular_velocity_deg_s'."""
        return self.name + ("_" + self.display.replace("/", "_").replace("^", "") if self.display else "")


TILT = KnownColumn("tilt", "rad", "deg", ("angle", "tilt_angle"))
MASS = KnownColumn("mass", "kg", "g", ("weight",))
"""Columns that several tables have: a tilt from upright, and a mass on a balance."""


@dataclass(frozen=True)
class FoundColumn:
    """A column of a file.

    Attributes:
        standard: `KnownColumn.standard`.
        factor: value of the file's unit in the unit of the standard name; 1.0 if they are equal.
        alias: whether the file has one of `KnownColumn.aliases`.
    """

    standard: str
    factor: float = 1.0
    alias: bool = False


class _UnknownColumnError(QuantityError):
    """A name that is none of the known ones.

    Attributes:
        guess: standard name of the column that it resembles; empty if it resembles none.
    """

    def __init__(self, message: str, guess: str = "") -> None:
        super().__init__(message)
        self.guess = guess


def columns_of(
    table: SavedTable,
    known: Sequence[KnownColumn],
    renamed: Mapping[str, str],
    problems: list[Problem],
    unread: list[str] | None = None,
) -> list[FoundColumn | None]:
    """The meaning of each column of the header; None for one that has a problem or is not read.

    Args:
        known: the columns that there may be.
        renamed: names in the file and the names that they stand for, with or without a unit.
        problems: problems are added here.
        unread: unknown columns are added here; None: they are problems. A name that resembles a column which is missing
            is a problem in both cases, unless it has times of day ('10:15').
    """
    columns: list[FoundColumn | None] = []
    resembling: list[tuple[int, str, _UnknownColumnError]] = []
    for index, cell in enumerate(table.header.cells):
        text = str(cell)
        try:
            column = _resolved(text, known, renamed)
        except QuantityError as error:
            if unread is not None and isinstance(error, _UnknownColumnError):
                resembling.append((index, text, error))
                columns.append(None)
                continue
            problems.append(table.problem(table.header, index, text, str(error)))
            columns.append(None)
            continue
        if any(other is not None and other.standard == column.standard for other in columns):
            same = "" if text == column.standard else f" (as '{column.standard}')"
            message = f"stands twice in the header{same}; keep one"
            problems.append(table.problem(table.header, index, text, message))
        if column.factor != 1.0 or column.alias:
            table.assumed.append(f"'{text}' as {column.standard}")
        columns.append(column)
    names = {column.standard for column in columns if column is not None}
    for index, text, unknown in resembling:
        cells = [str(cell) for row in table.rows for cell in row.cells[index : index + 1] if cell != ""]
        clock = bool(cells) and all(":" in cell for cell in cells)
        if unread is not None and (not unknown.guess or unknown.guess in names or clock):
            unread.append(text)
        else:
            problems.append(table.problem(table.header, index, text, str(unknown)))
    return columns


def _resolved(text: str, columns: Sequence[KnownColumn], renamed: Mapping[str, str]) -> FoundColumn:
    """The column that a text in a header names.

    Raises:
        QuantityError: an unknown name or unit, or no unit; the message is a correction.
    """
    if not text:
        raise QuantityError("a column has no name")
    bracketed = _BRACKETS.fullmatch(text)
    stem, unit = (bracketed[1], bracketed[2]) if bracketed else (text, "")
    name = (renamed.get(text) or renamed.get(stem, stem)).strip()
    word = re.sub(r"[\s-]+", "_", name).lower()
    if text in renamed and not is_unit(unit):
        unit = ""  # a part of the name: 'weight (net)'
    column, alias = _named(name, word, columns)
    if column is None and not unit:
        column, unit = _with_unit_in_name(name, word, columns)
    elif column is not None and not unit:
        if column.unit and word != column.standard.lower():
            remedy = f"write '{column.standard}' or '{column.name} [{column.display}]'"
            raise QuantityError(f"has no unit; {remedy} if that is what is meant")
        return FoundColumn(column.standard)
    if column is None:
        if text in renamed:
            raise QuantityError(f"'columns' gives it the name '{renamed[text]}', which is not known")
        raise _unknown(word, columns)
    if not column.unit:
        raise QuantityError(f"'{column.name}' has no unit; remove '{unit}'")
    if unit == column.display:
        return FoundColumn(column.standard, alias=alias)
    example = f"1 {column.display}"
    factor = parse_unit(unit, column.unit, example) / parse_unit(column.display, column.unit, example)
    if math.isclose(factor, 1.0, rel_tol=1e-12):
        return FoundColumn(column.standard, alias=alias)
    if word == column.standard.lower() and text not in renamed:
        raise QuantityError(f"has two units; write '{column.name} [{unit}]' or '{column.standard}'")
    return FoundColumn(column.standard, factor, alias)


def _named(name: str, word: str, columns: Sequence[KnownColumn]) -> tuple[KnownColumn | None, bool]:
    """The column with a name, a standard name or an alias, in this order; and whether it is an alias.

    Args:
        name: as written, without its unit.
        word: the same in lower case, with underscores.
    """
    names = _names(columns)
    alias = next((entry for entry in columns if word in entry.aliases), None)
    column = names.get(name) or names.get(word) or alias
    return column, column is not None and word in column.aliases


def _names(columns: Sequence[KnownColumn]) -> dict[str, KnownColumn]:
    """The columns by name and by standard name."""
    return {entry.name: entry for entry in columns} | {entry.standard: entry for entry in columns}


def _with_unit_in_name(name: str, word: str, columns: Sequence[KnownColumn]) -> tuple[KnownColumn | None, str]:
    """The column whose name has a unit appended, and the unit: 'angular_velocity_rad_s' has 'rad/s'."""
    for column in columns:
        if column.unit and re.fullmatch(rf"{column.name}_[a-zµ°%_0-9]+", word):
            suffix = name[len(column.name) + 1 :].replace("_", "/")
            return column, re.sub(r"(?<=[a-z])(?=[0-9])", "^", suffix)  # 's2' is s^2
    return None, ""


def _unknown(word: str, columns: Sequence[KnownColumn]) -> _UnknownColumnError:
    """The error about a name that is none of the columns', with the most similar one."""
    names = _names(columns)
    guess = did_you_mean(word, names) or did_you_mean(word, [entry.standard for entry in columns])
    if not guess:
        listed = ", ".join(entry.standard for entry in columns)
        return _UnknownColumnError(f"unknown column; known columns: {listed}")
    standard = names[guess].standard
    return _UnknownColumnError(f"unknown column; did you mean '{standard}'?", standard)
