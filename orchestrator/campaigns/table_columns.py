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
            is a problem in both cases.
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
        if unread is not None and (not unknown.guess or unknown.guess in names):
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
    name = renamed.get(text) or renamed.get(stem, stem)
    names = {entry.name: entry for entry in columns} | {entry.standard: entry for entry in columns}
    word = re.sub(r"[\s-]+", "_", name.strip()).lower()
    column = names.get(name) or names.get(word) or next((entry for entry in columns if word in entry.aliases), None)
    alias = column is not None and word in column.aliases
    standard = column is not None and word == column.standard.lower()
    if text in renamed and not is_unit(unit):
        unit = ""  # a part of the name: 'weight (net)'
    if column is not None and not unit:
        if column.unit and not standard:
            text = f"write '{column.standard}' or '{column.name} [{column.display}]'"
            raise QuantityError(f"has no unit; {text} if that is what is meant")
        return FoundColumn(column.standard)
    if column is None and not unit:
        column = next((c for c in columns if c.unit and re.fullmatch(rf"{c.name}_[a-zµ°%_0-9]+", word)), None)
        if column is not None:
            suffix = name.strip()[len(column.name) + 1 :]
            unit = re.sub(r"(?<=[a-z])(?=[0-9])", "^", suffix.replace("_", "/"))
    if column is None:
        if text in renamed:
            raise QuantityError(f"'columns' gives it the name '{renamed[text]}', which is not known")
        guess = did_you_mean(word, names) or did_you_mean(word, [entry.standard for entry in columns])
        shown = names[guess].standard if guess else ""
        if not guess:
            raise _UnknownColumnError(
                f"unknown column; known columns: {', '.join(entry.standard for entry in columns)}"
            )
        raise _UnknownColumnError(f"unknown column; did you mean '{shown}'?", shown)
    if not column.unit:
        raise QuantityError(f"'{column.name}' has no unit; remove '{unit}'")
    if unit == column.display:
        return FoundColumn(column.standard, alias=alias)
    example = f"1 {column.display}"
    factor = parse_unit(unit, column.unit, example) / parse_unit(column.display, column.unit, example)
    if math.isclose(factor, 1.0, rel_tol=1e-12):
        return FoundColumn(column.standard, alias=alias)
    if standard and text not in renamed:
        raise QuantityError(f"has two units; write '{column.name} [{unit}]' or '{column.standard}'")
    return FoundColumn(column.standard, factor, alias)
