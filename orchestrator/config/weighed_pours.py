"""Pours from before the campaign, from CSV files and previous runs, checked against the campaign.

- `read_records` reads a CSV file. Each problem names the file, the line and the column.
- `resolve_records` and `records_of_run` return the pours that a calibration uses.
- `resolve_data` returns the pours that a deployment learns from.
"""

from __future__ import annotations

import csv
import io
import math
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from actors.laboratory_settings import LaboratorySettings
from orchestrator.config.campaign_file import DataSettings, PoursFromFile, PoursSettings
from orchestrator.config.scene_builder import SceneBuilder
from orchestrator.config.search_ranges import MotionBase
from orchestrator.config.yaml.file_access import UnreadableError, missing_file, out_of_bounds, read_text, resolved
from orchestrator.config.yaml.yaml_errors import Problem, dotted
from orchestrator.config.yaml.yaml_source import Place, Report
from orchestrator.journal.codec import CodecError
from orchestrator.journal.journal import JOURNAL_NAME
from orchestrator.journal.journal_file import JournalError
from orchestrator.runs.prior_data import PreviousRun, fitting, pours_in, read_former_run
from orchestrator.strategies.campaign_plan import ExistingPours, RecordedPour, RecordSet
from sim_engine.action import ACTION_DIMENSIONS, Action, Dimension
from sim_engine.errors import did_you_mean
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.settings.model import MOST_POURS
from sim_engine.vessel.shapes import ProfileShape, VesselSpec

if TYPE_CHECKING:
    import _csv

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

_NUMBER = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")


def column_name(dimension: Dimension) -> str:
    """Column of an action dimension: its name and unit, e.g. 'angular_velocity_deg_s'."""
    return f"{dimension.name}_{dimension.display_unit.replace('/', '_').replace('^', '')}"


DIMENSION_COLUMNS = {column_name(dimension): dimension for dimension in ACTION_DIMENSIONS.values()}


@dataclass
class RecordTable:
    """A CSV file of weighed pours.

    Attributes:
        path: the file.
        rows: action dimensions [SI], masses [kg] and split of every valid line.
        dimensions: action dimensions that have a column.
        problems: all problems found.
    """

    path: Path
    rows: list[PourRecordRow] = field(default_factory=list)
    dimensions: tuple[str, ...] = ()
    problems: list[Problem] = field(default_factory=list)

    def varying(self) -> set[str]:
        """Dimensions that have more than one value."""
        return {name for name in self.dimensions if len({row.action[name] for row in self.rows}) > 1}

    def constants(self) -> dict[str, float]:
        """Dimensions that have the same value in all pours."""
        return {name: self.rows[0].action[name] for name in self.dimensions if name not in self.varying()}


@dataclass(frozen=True)
class PourRecordRow:
    """One line: action dimensions [SI], masses [kg]."""

    line: int
    action: dict[str, float]
    poured: float
    spilled: float
    retained: float
    split: str

    def pour(self, fixed: Mapping[str, float | None]) -> RecordedPour:
        """The record, completed with the dimensions that have no column.

        Raises:
            ValueError: the action is incomplete or out of bounds.
        """
        action = Action.compose(fixed, self.action)
        return RecordedPour(action, self.poured, self.spilled, self.retained, self.split)


def read_records(
    path: Path,
    *,
    loaded: float,
    lip_radius: float | None = None,
    columns: Mapping[str, str] | None = None,
    split: str | None = None,
) -> RecordTable:
    """Read weighed pours.

    Columns: `poured_g`, `spilled_g`, `retained_g`, `split` (train, test or transfer), and one per action dimension that
    varies, named after it and its unit (`angular_velocity_deg_s`, `max_angle_deg`, `x_offset_mm` …). Instead of
    `x_offset_mm` there may be `lip_to_receiver_axis_mm`, the distance from the pourer's inner lip to the receiver's
    axis: `lip_radius` is added to it.

    Args:
        path: the CSV file, UTF-8, comma-separated, with a header.
        loaded: mass in the pourer before each pour [kg].
        lip_radius: the pourer's inner radius at the lip [m].
        columns: different names in the file, {name above: name in the file}.
        split: split of all pours if the file has no such column; without it the column is required.

    Returns:
        The table; its `problems` describe what is wrong with the file.
    """
    table = RecordTable(path)
    try:
        text = read_text(path, encoding="utf-8-sig")
    except UnreadableError as error:
        table.problems.append(Problem(path, 0, 0, "", str(error)))
        return table
    if not text.strip():
        table.problems.append(Problem(path, 0, 0, "", "is empty; it needs a header and a line for each pour"))
        return table
    lines = list(io.StringIO(text, newline=""))
    reader = csv.reader(lines)
    try:
        _read_table(table, path, reader, lines, loaded, lip_radius, columns or {}, split)
    except csv.Error as error:
        message = f"is not CSV: {error}; is a quote still open?"
        table.problems.append(Problem(path, reader.line_num, 1, "", message))
    if not table.rows and not table.problems:
        table.problems.append(Problem(path, 1, 1, "", "has no pours; add a line for each below the header"))
    return table


def _read_table(
    table: RecordTable,
    path: Path,
    reader: _csv.Reader,
    lines: list[str],
    loaded: float,
    lip_radius: float | None,
    columns: Mapping[str, str],
    split: str | None,
) -> None:
    header = [cell.strip() for cell in next(reader, [])]
    names = {theirs: ours for ours, theirs in columns.items()}
    header = [names.get(cell, cell) for cell in header]
    _check_header(table, path, header, lines[0], lip_radius, needs_split=split is None)
    if table.problems:
        return
    table.dimensions = tuple(
        name
        for name, dimension in ACTION_DIMENSIONS.items()
        if column_name(dimension) in header or (name == "x_offset" and LIP_COLUMN in header)
    )
    alike: dict[tuple[str, ...], list[int]] = {}
    for cells in reader:
        if not any(cell.strip() for cell in cells):
            continue
        number = reader.line_num
        if len(table.rows) == MOST_POURS:
            message = f"has more than {MOST_POURS} pours, which no calibration can use; keep the best of them"
            table.problems.append(Problem(path, number, 1, "", message))
            return
        alike.setdefault(tuple(cell.strip() for cell in cells), []).append(number)
        row = _read_row(table, path, header, cells, number, lines[number - 1], loaded, lip_radius, split)
        if row is not None:
            table.rows.append(row)
    for numbers in alike.values():
        if len(numbers) > MOST_ALIKE:
            message = (
                f"the same pour stands in {len(numbers)} lines; pours that were really made differ in the last digit. "
                "Keep the line once"
            )
            line = lines[numbers[1] - 1]
            table.problems.append(Problem(path, numbers[1], 1, "", message, line))


def _check_header(
    table: RecordTable, path: Path, header: list[str], line: str, lip_radius: float | None, *, needs_split: bool
) -> None:
    separator = next((s for s in ";\t" if s in line and "," not in line), None)
    if separator is not None:
        name = "semicolons" if separator == ";" else "tabs"
        message = f"cells are separated by {name}; save it with commas, and numbers with a decimal point"
        table.problems.append(Problem(path, 1, line.index(separator) + 1, "", message, line))
        return
    known = (*DIMENSION_COLUMNS, LIP_COLUMN, *MASS_COLUMNS, "split")

    def add(name: str, message: str) -> None:
        column = line.find(name) + 1 if name and name in line else 1
        table.problems.append(Problem(path, 1, column, name, message, line))

    for name in dict.fromkeys(header):
        if name not in known:
            guess = did_you_mean(name, known)
            hint = f"did you mean '{guess}'?" if guess else f"known columns: {', '.join(known)}"
            add(name, f"unknown column; {hint}")
        elif header.count(name) > 1:
            add(name, "stands twice in the header; keep one")
    for name in (*MASS_COLUMNS, *(["split"] if needs_split else [])):
        if name not in header:
            add("", f"column '{name}' is missing")
    if not any(name in DIMENSION_COLUMNS or name == LIP_COLUMN for name in header):
        add("", "no column of an action dimension, such as 'angular_velocity_deg_s'")
    if LIP_COLUMN in header:
        if "x_offset_mm" in header:
            add(LIP_COLUMN, "says the same as 'x_offset_mm'; keep one of them")
        if lip_radius is None:
            add(LIP_COLUMN, "needs 'lip_radius' beside 'from' in the campaign, the pourer's inner radius at the lip")


def _read_row(
    table: RecordTable,
    path: Path,
    header: list[str],
    cells: list[str],
    number: int,
    line: str,
    loaded: float,
    lip_radius: float | None,
    usual_split: str | None,
) -> PourRecordRow | None:
    before = len(table.problems)

    def add(name: str, message: str) -> None:
        # The caret is below the cell; cells are unquoted numbers in nearly all files.
        index = header.index(name) if name in header else 0
        column = sum(len(cell) + 1 for cell in cells[:index]) + 1
        table.problems.append(Problem(path, number, column, name, message, line))

    if len(cells) != len(header):
        open_quote = "; is a quote still open?" if any("\n" in cell for cell in cells) else ""
        add("", f"has {len(cells)} cell{'s' * (len(cells) > 1)}, the header {len(header)}{open_quote}")
        return None
    values: dict[str, float] = {}
    for name, cell in zip(header, cells, strict=True):
        if name == "split":
            continue
        text = cell.strip()
        if _NUMBER.fullmatch(text) and math.isfinite(float(text)):
            values[name] = float(text)
        elif not text:
            add(name, "is empty; every pour needs a value")
        else:
            add(name, f"{text!r} is not a number; write it like 12.5")
    split = cells[header.index("split")].strip() if "split" in header else str(usual_split)
    if split not in SPLITS:
        add("split", f"{split!r} is not known; should be one of {', '.join(SPLITS)}")
    action: dict[str, float] = {}
    for name, value in values.items():
        dimension = ACTION_DIMENSIONS["x_offset"] if name == LIP_COLUMN else DIMENSION_COLUMNS.get(name)
        if dimension is None:
            continue
        # Rounded to a picometre, so that 44 mm + 40 mm is 84 mm.
        si = round(value * 1e-3 + (lip_radius or 0.0), 12) if name == LIP_COLUMN else value * dimension.factor
        if not dimension.lower <= si <= dimension.upper:
            k = dimension.factor
            bounds = f"{dimension.lower / k:g} … {dimension.upper / k:g} {dimension.display_unit}"
            add(name, f"{value:g} makes {dimension.name} {si / k:g}, outside {bounds}")
        action[dimension.name] = si
    if all(name in values for name in MASS_COLUMNS):
        _check_masses([values[name] for name in MASS_COLUMNS], loaded * 1e3, add)
    if len(table.problems) > before:
        return None
    poured, spilled, retained = (values[name] * 1e-3 for name in MASS_COLUMNS)
    return PourRecordRow(number, action, poured, spilled, retained, split)


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


Motions = tuple[tuple[MotionBase | None, Place], ...]

LIP_RADIUS_TOLERANCE = 1e-3
"""Largest difference [m] between a stated lip radius and the rim of a pourer's profile; more is a typing error."""


def resolve_records(
    pours: PoursSettings,
    place: Place,
    builder: SceneBuilder,
    table: RecordTable | None,
    actions: Space | None,
    scene: Scene | None,
    pourer: VesselSpec | None,
    motions: Motions,
) -> tuple[RecordSet | None, RecordSet | None]:
    """Calibration's records and those of the transfer scene; None if not given, or after a problem."""
    report = builder.report
    _check_lip_radius(pours, place, builder, pourer)
    records = transfer = None
    if table is not None and actions is not None:
        for name in sorted(table.varying() - set(actions.names)):
            report.add(
                place.at("from"),
                f"{name} varies in the file and is not searched; add it to {dotted(place.loc[:-1])}.actions",
            )
        _check_columns(table, actions, place.at("from"), report)
        splits = {row.split for row in table.rows}
        if "train" not in splits:
            report.add(place.at("from"), "has no pour with split 'train' to calibrate on")
        if "transfer" in splits:
            report.add(place.at("from"), "has pours with split 'transfer'; they belong to 'transfer: {from: ...}'")
    if table is not None and scene is not None:
        records = _record_set(table, scene, place.at("from"), pours, builder)
    section, at = pours.transfer, place.at("transfer")
    if section is not None:
        receiver = builder.references.vessel(section.receiver, at.at("receiver"))
        other = read_table(pours, section.source, at.at("from"), builder)
        if other is not None:
            where = (*motions, (section.motion, at.at("motion")))
            if any(row.split != "transfer" for row in other.rows):
                report.add(at.at("from"), "should only have pours with split 'transfer': they are scored, never fitted")
            moved = builder.scene(
                "transfer",
                pourer,
                receiver,
                where,
                tuple(other.varying()),
                at,
                recorded=True,
                constants=other.constants(),
                constants_win=True,
            )
            if moved is not None:
                transfer = _record_set(other, moved, at.at("from"), pours, builder)
    return records, transfer


def read_table(pours: PoursFromFile, source: str | None, place: Place, builder: SceneBuilder) -> RecordTable | None:
    """A CSV file of calibration's pours; None if not given, or after a problem."""
    if source is None or builder.liquid is None:
        return None
    return _read(resolved(place.directory / source), pours, builder.liquid, place, builder.report)


def _read(
    path: Path, pours: PoursFromFile, liquid: Liquid, place: Place, report: Report, split: str | None = None
) -> RecordTable | None:
    if (missing := missing_file(path)) is not None:
        report.add(place, missing)
        return None
    table = read_records(path, loaded=liquid.mass, lip_radius=pours.lip_radius, columns=pours.columns, split=split)
    report.problems.extend(table.problems)
    return None if table.problems else table


def _check_columns(table: RecordTable, actions: Space, place: Place, report: Report) -> bool:
    """Whether the file has a column for each searched dimension; missing ones are reported."""
    missing = [name for name in actions.names if name not in table.dimensions]
    for name in missing:
        column = LIP_COLUMN if name == "x_offset" else column_name(ACTION_DIMENSIONS[name])
        report.add(place, f"{name} is searched and the file has no column '{column}'; fix it under motion")
    return not missing


def _pours(table: RecordTable, scene: Scene, place: Place, report: Report) -> tuple[RecordedPour, ...] | None:
    try:
        return tuple(row.pour(scene.fixed) for row in table.rows)
    except ValueError as error:
        report.add(place, str(error))
        return None


def _record_set(
    table: RecordTable, scene: Scene, place: Place, pours: PoursSettings, builder: SceneBuilder
) -> RecordSet | None:
    found = _pours(table, scene, place, builder.report)
    return None if found is None else RecordSet(scene, found, table.path, pours.lip_radius, dict(pours.columns))


def _check_lip_radius(pours: PoursSettings, place: Place, builder: SceneBuilder, pourer: VesselSpec | None) -> None:
    if pours.lip_radius is None or pourer is None or not isinstance(pourer.shape, ProfileShape):
        return
    rim = pourer.shape.outline().inner[-1][0]
    if abs(rim - pours.lip_radius) > LIP_RADIUS_TOLERANCE:
        builder.report.add(
            place.at("lip_radius"),
            f"is {pours.lip_radius * 1e3:g} mm, but the rim of pourer '{pourer.name}' has an inner radius of "
            f"{rim * 1e3:g} mm",
        )


def resolve_data(
    section: DataSettings,
    place: Place,
    scenes: tuple[Scene, ...],
    actions: Space,
    laboratory: LaboratorySettings | None,
    report: Report,
) -> ExistingPours | None:
    """Existing pours of the deployment by scene; None after a problem, which is added to the report."""
    found: Mapping[str, Sequence[RecordedPour]] | None = None
    if section.source is not None and section.run is None:
        at = place.at("from")
        path = resolved(place.directory / section.source)
        found = _of_file(path, section, place, scenes, actions, report)
    elif section.run is not None and section.source is None:
        at = place.at("run")
        path, found = _of_run(section.run, at, scenes, laboratory, report)
    if found is None:
        return None
    used: dict[str, tuple[RecordedPour, ...]] = {}
    left_out: list[str] = []
    for scene in scenes:
        if scene.name in found:
            fit = fitting(found[scene.name], scene, actions)
            used[scene.name] = fit.pours
            left_out += fit.left_out
    if not any(used.values()):
        report.add(at, f"has no pour that this deployment could have made: {'; '.join(left_out)}")
        return None
    return ExistingPours(used, path, section.counts, tuple(left_out), section.lip_radius, dict(section.columns))


def _of_file(
    path: Path, section: DataSettings, place: Place, scenes: tuple[Scene, ...], actions: Space, report: Report
) -> dict[str, tuple[RecordedPour, ...]] | None:
    receivers = {scene.receiver.name: scene for scene in scenes}
    if section.receiver is None and len(scenes) > 1:
        report.add(place, f"says not into which receiver; add 'receiver:' and one of {', '.join(receivers)}", key=True)
        return None
    if section.receiver is not None and section.receiver not in receivers:
        guess = did_you_mean(section.receiver, receivers)
        hint = f"did you mean '{guess}'?" if guess else f"receivers are {', '.join(receivers)}"
        report.add(place.at("receiver"), f"deployment has no receiver '{section.receiver}'; {hint}")
        return None
    scene, at = scenes[0] if section.receiver is None else receivers[section.receiver], place.at("from")
    table = _read(path, section, scene.liquid, at, report, split="train")
    if table is None or not _check_columns(table, actions, at, report):
        return None
    pours = _pours(table, scene, at, report)
    return None if pours is None else {scene.name: pours}


def _of_run(
    run: str, place: Place, scenes: tuple[Scene, ...], laboratory: LaboratorySettings | None, report: Report
) -> tuple[Path, dict[str, tuple[RecordedPour, ...]] | None]:
    previous = former_run(run, place, report)
    if previous is None:
        return Path(run), None
    if laboratory is not None and previous.mode != laboratory.mode:
        report.add(place, f"was poured in a {previous.mode} laboratory, and '{laboratory.name}' is {laboratory.mode}")
        return previous.path, None
    found = {scene.name: pours_in(previous, scene) for scene in scenes}
    if not any(pours for pours, _ in found.values()):
        reasons = dict.fromkeys(reason for _, reason in found.values())
        report.add(place, f"has nothing to learn from: it {'; it '.join(reasons)}")
        return previous.path, None
    return previous.path, {name: tuple(pours) for name, (pours, _) in found.items() if pours}


def former_run(run: str, place: Place, report: Report) -> PreviousRun | None:
    """A previous run by its folder; None if it can't be read."""
    directory = resolved(place.directory / run)
    if (outside := out_of_bounds(directory)) is not None:
        report.add(place, f"{directory} {outside}")
        return None
    if not (directory / JOURNAL_NAME).is_file():
        what = (
            "has no journal; name the folder of a run" if directory.is_dir() else "no such folder; name that of a run"
        )
        report.add(place, f"{directory}: {what}, for example '../runs/narrow-20300131-1'")
        return None
    try:
        return read_former_run(directory)
    except (JournalError, CodecError) as error:
        report.add(place, str(error))
        return None


def records_of_run(
    run: str,
    place: Place,
    scenes: tuple[Scene, ...],
    actions: Space,
    laboratory: LaboratorySettings | None,
    report: Report,
) -> RecordSet | None:
    """Calibration pours from a previous run, in any of its scenes; None after a problem."""
    previous = former_run(run, place, report)
    if previous is None:
        return None
    if laboratory is not None and laboratory.mode == "hardware" and previous.mode != "hardware":
        report.add(place, f"was poured in a virtual laboratory, and '{laboratory.name}' has a real one's liquid")
        return None
    found: list[RecordedPour] = []
    left_out: list[str] = []
    reasons: list[str] = []
    for scene in scenes:
        pours, why = pours_in(previous, scene)
        fit = fitting(pours, scene, actions)
        found += [replace(pour, scene=scene.name) for pour in fit.pours] if len(scenes) > 1 else fit.pours
        left_out += fit.left_out
        reasons += [why] if why else []
    if not found:
        report.add(place, f"has nothing to calibrate on: it {'; it '.join(reasons) or 'has ' + '; '.join(left_out)}")
        return None
    if left_out:
        text = f"has pours that this calibration could not have made ({'; '.join(left_out)})"
        report.add(place, f"{text}; change the motion, or the bounds under actions")
        return None
    if all(pour.split != "train" for pour in found):
        report.add(place, "has no pour with split 'train' to calibrate on")
        return None
    return RecordSet(scenes[0], tuple(found), previous.path)
