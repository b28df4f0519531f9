"""Files of weighed pours: their columns, and the checks of every line.

`read_records` reads a file. Each problem names the file, the line and the column. How the pours fit to a campaign is
checked in `orchestrator.campaigns.weighed_pours`.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from orchestrator.campaigns.saved_table import SavedTable, TableRow, read_saved_table
from orchestrator.campaigns.table_columns import FoundColumn, KnownColumn, columns_of
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from orchestrator.learning.campaign_plan import RecordedPour
from sim_engine.action import ACTION_DIMENSIONS, Action, Dimension
from sim_engine.settings.model import MOST_POURS

MASS_COLUMNS = ("poured_g", "spilled_g", "retained_g")
SPLITS = ("train", "test", "transfer")
LIP_COLUMN = "lip_to_receiver_axis_mm"

MASS_TOLERANCE = 0.01
"""Largest relative difference between poured + retained and the load; spills and drips limit the accuracy of a
weighing."""

NOISE, NOISE_OF_LOAD = 0.3, 1e-3
"""Largest negative value of a weighed mass: in grams, or as a share of the load if that is larger."""

MOST_ALIKE = 5
"""Largest number of lines with identical numbers: real pours differ in the last digit."""

UNLIKE = 0.15
"""Difference of two pours, as a share of the liquid, above which they contradict each other; repeated pours scatter by
a few hundredths."""

MOST_NAMED = 4
"""Pairs of contradicting pours that are listed."""

ALIASES = {"angular_velocity": ("speed", "tilt_speed"), "max_angle": ("angle", "tilt_angle")}
"""Other names of dimensions in the headers of tables."""


def _column_of(dimension: Dimension) -> KnownColumn:
    return KnownColumn(dimension.name, dimension.unit, dimension.display_unit, ALIASES.get(dimension.name, ()))


def column_name(dimension: Dimension) -> str:
    """Column of an action dimension: its name and unit, e.g. 'angular_velocity_deg_s'."""
    return _column_of(dimension).standard


DIMENSION_COLUMNS = {column_name(dimension): dimension for dimension in ACTION_DIMENSIONS.values()}

COLUMNS = (
    *map(_column_of, ACTION_DIMENSIONS.values()),
    KnownColumn("lip_to_receiver_axis", "m", "mm"),
    *(KnownColumn(name.removesuffix("_g"), "kg", "g") for name in MASS_COLUMNS),
    KnownColumn("split"),
)


@dataclass
class RecordTable:
    """A file of weighed pours.

    Attributes:
        path: the file.
        rows: action dimensions [SI], masses [kg] and split of every valid line.
        dimensions: action dimensions that have a column.
        problems: all problems found.
        assumed: how the file was read, and pours that should be looked at; empty if there is nothing to note.
    """

    path: Path
    rows: list[RecordRow] = field(default_factory=list)
    dimensions: tuple[str, ...] = ()
    problems: list[Problem] = field(default_factory=list)
    assumed: str = ""

    def varying(self) -> set[str]:
        """Dimensions that have more than one value."""
        return {name for name in self.dimensions if len({row.action[name] for row in self.rows}) > 1}

    def constants(self) -> dict[str, float]:
        """Dimensions that have the same value in all pours."""
        return {name: self.rows[0].action[name] for name in self.dimensions if name not in self.varying()}


@dataclass(frozen=True)
class RecordRow:
    """One line: action dimensions [SI], masses [kg]."""

    line: int
    action: dict[str, float]
    poured: float
    spilled: float
    retained: float
    split: str
    remarks: dict[str, str] = field(default_factory=dict)

    def pour(self, fixed: Mapping[str, float | None]) -> RecordedPour:
        """The record, completed with the dimensions that have no column.

        Raises:
            ValueError: the action is incomplete or out of bounds.
        """
        action = Action.compose(fixed, self.action)
        return RecordedPour(
            action, self.poured, self.spilled, self.retained, self.split, line=self.line, remarks=self.remarks
        )


def read_records(
    path: Path,
    *,
    loaded: float,
    lip_radius: float | None = None,
    columns: Mapping[str, str] | None = None,
    split: str | None = None,
    holdout: int | None = None,
) -> RecordTable:
    """Read weighed pours.

    Columns: `poured_g`, `spilled_g`, `retained_g`, `split` (train, test or transfer) if pours are split already, and
    one per action dimension that varies, named after it and its unit (`angular_velocity_deg_s`, `max_angle_deg`,
    `x_offset_mm` …) or with another unit in brackets (`max angle [rad]`). Instead of `x_offset_mm` there may be
    `lip_to_receiver_axis_mm`, the distance from the pourer's inner lip to the receiver's axis: `lip_radius` is added to
    it. Columns of other names, such as `remarks` or `pour no.`, are kept as remarks of their pours.

    Args:
        path: the file, in any dialect that `read_saved_table` reads.
        loaded: mass in the pourer before each pour [kg].
        lip_radius: the pourer's inner radius at the lip [m].
        columns: different names in the file, {name above: name in the file}.
        split: split of all pours if the file has no such column; without it, `holdout` decides.
        holdout: number of pours, evenly spread over the lines, that become 'test' in a file without splits; None: an
            eighth, at least one.

    Returns:
        The table; its `problems` describe what is wrong with the file.
    """
    table = RecordTable(path)
    try:
        saved = read_saved_table(path)
    except ConfigError as error:
        table.problems.extend(error.problems)
        return table
    reader = _RecordReader(saved, table, loaded, lip_radius, split)
    reader.read({theirs: ours for ours, theirs in (columns or {}).items()})
    notes = [saved.note, *reader.notes]
    if reader.without_split and split is None and not table.problems:
        notes.append(_keep_for_testing(table, holdout))
    elif holdout is not None and not table.problems:
        text = "has a column 'split', which says what is kept for testing; remove it, or 'holdout' from the campaign"
        table.problems.append(saved.problem(saved.header, None, "", text))
    table.assumed = "; ".join(filter(None, [*notes, *_suspicious(table)]))
    if not table.rows and not table.problems:
        table.problems.append(Problem(path, 1, 1, "", "has no pours; add a line for each below the header"))
    return table


@dataclass
class _RecordReader:
    """Fills a table of pours from a saved table; see `read_records`."""

    saved: SavedTable
    table: RecordTable
    loaded: float
    lip_radius: float | None
    split: str | None
    empty: dict[str, list[TableRow]] = field(default_factory=dict)
    notes: list[str] = field(default_factory=list)
    without_split: bool = False

    def read(self, renamed: Mapping[str, str]) -> None:
        table, saved = self.table, self.saved
        unread: list[str] = []
        columns = columns_of(saved, COLUMNS, renamed, table.problems, unread)
        names = {column.standard for column in columns if column is not None}
        self.without_split = "split" not in names
        self._check_columns([None if column is None else column.standard for column in columns], unread)
        if table.problems:
            return
        if unread:
            self.notes.append(f"{_listed('column', [repr(name) for name in unread])} read as remarks")
        table.dimensions = tuple(
            name
            for name, dimension in ACTION_DIMENSIONS.items()
            if column_name(dimension) in names or (name == "x_offset" and LIP_COLUMN in names)
        )
        table.problems.extend(saved.misfits())
        alike: dict[tuple[str | float, ...], list[TableRow]] = {}
        read = [i for i, column in enumerate(columns) if column is not None and column.standard != "split"]
        if len(saved.rows) > MOST_POURS:
            message = f"has more than {MOST_POURS} pours, which no calibration can use; keep the best of them"
            table.problems.append(saved.problem(saved.rows[MOST_POURS], None, "", message))
            return
        for line in saved.rows:
            if len(line.cells) == len(columns):
                alike.setdefault(tuple(line.cells[i] for i in read), []).append(line)
            row = self._row(line, columns)
            if row is not None:
                table.rows.append(row)
        for name, lines in self.empty.items():
            index = [column and column.standard for column in columns].index(name)
            numbers = ", ".join(str(line.line) for line in lines[:8]) + (" …" if len(lines) > 8 else "")
            several = f" in {len(lines)} lines ({numbers}); a merged cell has its value in the first line only"
            message = f"is empty{several if len(lines) > 1 else ''}; every row needs a value"
            table.problems.append(saved.problem(lines[0], index, str(saved.header.cells[index]), message))
        for lines in alike.values():
            if len(lines) > MOST_ALIKE:
                message = (
                    f"the same pour stands in {len(lines)} lines; pours that were really made differ in the last "
                    "digit. Keep the line once"
                )
                table.problems.append(saved.problem(lines[1], None, "", message))
            elif len(lines) > 1:
                self._check_doubled([row for row in table.rows if row.line in {line.line for line in lines}])

    def _check_doubled(self, rows: list[RecordRow]) -> None:
        """Note lines with the same numbers; refuse a pour that spilled, as training and as test pour."""
        splits = {row.split for row in rows}
        if not rows:
            return
        lines = _listed("line", [str(row.line) for row in rows])
        if len(splits) > 1 and rows[0].spilled > 0.0:
            message = (
                f"{lines} have the same numbers and the splits {' and '.join(sorted(splits))}: a pour that was fitted "
                "tests nothing. Keep one of them"
            )
            line = next(line for line in self.saved.rows if line.line == rows[-1].line)
            self.table.problems.append(self.saved.problem(line, None, "", message))
        else:
            self.notes.append(f"{lines} have the same numbers: is it one pour, entered twice?")

    def _check_columns(self, names: list[str | None], unread: Sequence[str]) -> None:
        """Check that the required columns are there, once each."""
        header = self.saved.header

        def add(name: str, message: str) -> None:
            index = names.index(name) if name in names else None
            where = "" if index is None else str(header.cells[index])
            self.table.problems.append(self.saved.problem(header, index, where, message))

        if names.count(None) > len(unread):
            return  # a column with a problem may be the one that is missing
        hint = f" (not recognised: {', '.join(map(repr, unread))})" if unread else ""
        for name in MASS_COLUMNS:
            if name not in names:
                add("", f"column '{name}' is missing{hint}")
        if not any(name in DIMENSION_COLUMNS or name == LIP_COLUMN for name in names):
            add("", f"no column of an action dimension, such as 'angular_velocity_deg_s'{hint}")
        if LIP_COLUMN in names:
            if "x_offset_mm" in names:
                add(LIP_COLUMN, "says the same as 'x_offset_mm'; keep one of them")
            if self.lip_radius is None:
                text = "needs 'lip_radius' beside 'from' in the campaign, the pourer's inner radius at the lip"
                add(LIP_COLUMN, text)

    def _row(self, line: TableRow, columns: Sequence[FoundColumn | None]) -> RecordRow | None:
        saved, problems = self.saved, self.table.problems
        before = len(problems)
        index = {column.standard: i for i, column in enumerate(columns) if column is not None}

        def add(name: str, message: str) -> None:
            at = index.get(name)
            where = "" if at is None else str(saved.header.cells[at])
            problems.append(saved.problem(line, at, where, message))

        if len(line.cells) != len(columns):
            return None
        values: dict[str, float] = {}
        written: dict[str, float] = {}
        gaps = [name for name, i in index.items() if line.cells[i] == ""]
        for name in gaps:
            self.empty.setdefault(name, []).append(line)
        for column, cell in zip(columns, line.cells, strict=True):
            if column is None or column.standard in ("split", *gaps):
                continue
            try:
                written[column.standard] = saved.number(cell)
                values[column.standard] = written[column.standard] * column.factor
            except ValueError as error:
                add(column.standard, str(error))
        split = str(line.cells[index["split"]]) if "split" in index else self.split or "train"
        if split not in SPLITS and "split" not in gaps:
            add("split", f"{split!r} is not known; should be one of {', '.join(SPLITS)}")
        action: dict[str, float] = {}
        for name, value in values.items():
            dimension = ACTION_DIMENSIONS["x_offset"] if name == LIP_COLUMN else DIMENSION_COLUMNS.get(name)
            if dimension is None:
                continue
            # Rounded to a picometre, so that 44 mm + 40 mm is 84 mm.
            lip = name == LIP_COLUMN
            si = round(value * 1e-3 + (self.lip_radius or 0.0), 12) if lip else value * dimension.factor
            if not dimension.lower <= si <= dimension.upper:
                k = dimension.factor
                bounds = f"{dimension.lower / k:g} … {dimension.upper / k:g} {dimension.display_unit}"
                add(name, f"{written[name]:g} makes {dimension.name} {si / k:g}, outside {bounds}")
            action[dimension.name] = si
        if all(name in values for name in MASS_COLUMNS):
            _check_masses([values[name] for name in MASS_COLUMNS], self.loaded * 1e3, add)
        if gaps or len(problems) > before:
            return None
        poured, spilled, retained = (values[name] * 1e-3 for name in MASS_COLUMNS)
        remarks = {
            str(self.saved.header.cells[i]): f"{cell:g}" if isinstance(cell, float) else cell
            for i, cell in enumerate(line.cells)
            if columns[i] is None and cell != ""
        }
        return RecordRow(line.line, action, poured, spilled, retained, split, remarks)


def _listed(noun: str, items: Sequence[str]) -> str:
    """'line 4', or 'lines 4, 7'; at most eight of them."""
    more = f" and {len(items) - 8} more" if len(items) > 8 else ""
    return f"{noun}{'s' * (len(items) > 1)} {', '.join(items[:8])}{more}"


def _keep_for_testing(table: RecordTable, holdout: int | None) -> str:
    """Choose the test pours of a file without splits; the sentence says which."""
    count = len(table.rows)
    kept = max(1, count // 8) if holdout is None else holdout
    if kept >= count:
        text = f"keeps {kept} of {count} pours for testing, so that none is left to fit; change 'holdout'"
        if not count:
            text = "has a header and no pour below it; write one line for each pour"
        table.problems.append(Problem(table.path, 1, 1, "", text))
        return ""
    chosen = sorted({(2 * k + 1) * count // (2 * kept) for k in range(kept)})
    for i in chosen:
        table.rows[i] = replace(table.rows[i], split="test")
    if not chosen:
        return "no column 'split': all pours are fitted, none is kept for testing"
    lines = _listed("line", [str(table.rows[i].line) for i in chosen])
    return f"no column 'split': {lines} kept for testing, the others are fitted"


def _suspicious(table: RecordTable) -> list[str]:
    """Pours that contradict each other, whatever the simulator says about them.

    - A pour that was tilted farther leaves no more in the pourer, apart from what a faster motion throws out.
    - Pours of the same action spill alike.
    """
    texts = []
    for i, row in enumerate(table.rows):
        for other in table.rows[:i]:
            loaded = row.poured + row.retained
            angles = [pour.action.get("max_angle") for pour in (row, other)]
            if row.action == other.action and row.poured > 0.0 and other.poured > 0.0:
                shares = [pour.spilled / pour.poured for pour in (other, row)]
                if abs(shares[0] - shares[1]) > UNLIKE:
                    both = " and ".join(f"{100 * share:.1f} %" for share in shares)
                    texts.append(f"lines {other.line} and {row.line} have the same action and spilled {both}")
            elif None not in angles:
                less, more = sorted((row, other), key=lambda pour: pour.action["max_angle"])
                if more.retained - less.retained > UNLIKE * loaded:
                    texts.append(
                        f"line {more.line} was tilted farther than line {less.line}, and more stayed in the pourer "
                        f"({1e3 * more.retained:.4g} g, {1e3 * less.retained:.4g} g)"
                    )
    more_texts = [f"and {len(texts) - MOST_NAMED} more pairs like these"] if len(texts) > MOST_NAMED else []
    return [*texts[:MOST_NAMED], *more_texts]


def _check_masses(masses: list[float], loaded: float, add: Callable[[str, str], None]) -> None:
    poured, spilled, retained = masses
    slack = MASS_TOLERANCE * loaded
    noise = max(NOISE, NOISE_OF_LOAD * loaded)
    for name, mass in zip(MASS_COLUMNS, masses, strict=True):
        if mass < -noise:
            add(name, f"{mass:g} g is less than nothing, by more than a balance's noise of {noise:g} g")
    if abs(poured + retained - loaded) > slack:
        add(
            "poured_g",
            f"poured {poured:g} g + retained {retained:g} g = {poured + retained:g} g, "
            f"but {loaded:g} g were loaded (the campaign's liquid.mass)",
        )
    if spilled > poured + slack:
        add("spilled_g", f"spilled {spilled:g} g, more than the {poured:g} g that were poured")
