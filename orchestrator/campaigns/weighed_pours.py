"""Pours from before the campaign, from files and previous runs, checked against the campaign.

- `resolve_records` and `records_of_run` return the pours that a calibration uses.
- `resolve_data` returns the pours that a deployment learns from.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.campaign_file import DataSettings, PoursSettings, TableSource
from orchestrator.campaigns.pour_table import LIP_COLUMN, RecordTable, column_name, read_records
from orchestrator.campaigns.prior_data import PreviousRun, fitting, pours_in, read_former_run
from orchestrator.campaigns.scene_builder import SceneBuilder
from orchestrator.campaigns.search_ranges import MotionBase
from orchestrator.campaigns.yaml.file_access import missing_file, out_of_bounds, resolved
from orchestrator.campaigns.yaml.yaml_errors import dotted
from orchestrator.campaigns.yaml.yaml_source import Place, Report
from orchestrator.learning.campaign_plan import ExistingPours, RecordedPour, RecordSet
from orchestrator.records.codec import CodecError
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_file import JournalError
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.errors import did_you_mean
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.search_space import Space
from sim_engine.vessel.shapes import ProfileShape, VesselSpec

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
            if builder.hidden_by_problems(place, name):
                continue
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
        other = read_table(pours, section.source, at.at("from"), builder, transfer=True)
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


def read_table(
    pours: PoursSettings, source: str | None, place: Place, builder: SceneBuilder, *, transfer: bool = False
) -> RecordTable | None:
    """A file of calibration's pours; None if not given, or after a problem.

    Args:
        transfer: whether its pours are those of the transfer scene.
    """
    if source is None or builder.liquid is None:
        return None
    path, report = resolved(place.directory / source), builder.report
    split, holdout = ("transfer", None) if transfer else (None, pours.holdout)
    return _read(path, pours, builder.liquid, place, report, split, holdout)


def _read(
    path: Path,
    pours: TableSource,
    liquid: Liquid,
    place: Place,
    report: Report,
    split: str | None = None,
    holdout: int | None = None,
) -> RecordTable | None:
    if (missing := missing_file(path)) is not None:
        report.add(place, missing)
        return None
    table = read_records(
        path,
        loaded=liquid.mass,
        lip_radius=pours.lip_radius,
        columns=pours.columns,
        split=split,
        holdout=holdout,
    )
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
    weighed = _pours(table, scene, place, builder.report)
    if weighed is None:
        return None
    return RecordSet(scene, weighed, table.path, pours.lip_radius, dict(pours.columns), table.assumed)


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
    pours: Mapping[str, Sequence[RecordedPour]] | None = None
    assumed = ""
    if section.source is not None and section.run is None:
        at = place.at("from")
        path = resolved(place.directory / section.source)
        pours, assumed = _of_file(path, section, place, scenes, actions, report)
    elif section.run is not None and section.source is None:
        at = place.at("run")
        path, pours = _of_run(section.run, at, scenes, laboratory, report)
    if pours is None:
        return None
    used: dict[str, tuple[RecordedPour, ...]] = {}
    left_out: list[str] = []
    for scene in scenes:
        if scene.name in pours:
            fit = fitting(pours[scene.name], scene, actions)
            used[scene.name] = fit.pours
            left_out += fit.left_out
    if not any(used.values()):
        report.add(at, f"has no pour that this deployment could have made: {'; '.join(left_out)}")
        return None
    columns = dict(section.columns)
    return ExistingPours(used, path, section.counts, tuple(left_out), section.lip_radius, columns, assumed)


def _of_file(
    path: Path, section: DataSettings, place: Place, scenes: tuple[Scene, ...], actions: Space, report: Report
) -> tuple[dict[str, tuple[RecordedPour, ...]] | None, str]:
    """The pours by scene, None after a problem; and how the file was read."""
    receivers = {scene.receiver.name: scene for scene in scenes}
    if section.receiver is None and len(scenes) > 1:
        report.add(place, f"says not into which receiver; add 'receiver:' and one of {', '.join(receivers)}", key=True)
        return None, ""
    if section.receiver is not None and section.receiver not in receivers:
        guess = did_you_mean(section.receiver, receivers)
        hint = f"did you mean '{guess}'?" if guess else f"receivers are {', '.join(receivers)}"
        report.add(place.at("receiver"), f"deployment has no receiver '{section.receiver}'; {hint}")
        return None, ""
    scene, at = scenes[0] if section.receiver is None else receivers[section.receiver], place.at("from")
    table = _read(path, section, scene.liquid, at, report, split="train")
    if table is None or not _check_columns(table, actions, at, report):
        return None, ""
    pours = _pours(table, scene, at, report)
    return None if pours is None else {scene.name: pours}, table.assumed


def _of_run(
    run: str, place: Place, scenes: tuple[Scene, ...], laboratory: LaboratorySettings | None, report: Report
) -> tuple[Path, dict[str, tuple[RecordedPour, ...]] | None]:
    previous = former_run(run, place, report)
    if previous is None:
        return Path(run), None
    if laboratory is not None and previous.mode != laboratory.mode:
        report.add(place, f"was poured in a {previous.mode} laboratory, and '{laboratory.name}' is {laboratory.mode}")
        return previous.path, None
    by_scene = {scene.name: pours_in(previous, scene) for scene in scenes}
    if not any(pours for pours, _ in by_scene.values()):
        reasons = dict.fromkeys(reason for _, reason in by_scene.values())
        report.add(place, f"has nothing to learn from: it {'; it '.join(reasons)}")
        return previous.path, None
    return previous.path, {name: tuple(pours) for name, (pours, _) in by_scene.items() if pours}


def former_run(run: str, place: Place, report: Report) -> PreviousRun | None:
    """A previous run by its folder; None if it can't be read."""
    directory = resolved(place.directory / run)
    if (outside := out_of_bounds(directory)) is not None:
        report.add(place, f"{directory} {outside}")
        return None
    if not (directory / JOURNAL_NAME).is_file():
        described = (
            "has no journal; name the folder of a run" if directory.is_dir() else "no such folder; name that of a run"
        )
        report.add(place, f"{directory}: {described}, for example '../runs/narrow-20300131-1'")
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
    usable: list[RecordedPour] = []
    left_out: list[str] = []
    reasons: list[str] = []
    for scene in scenes:
        pours, why = pours_in(previous, scene)
        fit = fitting(pours, scene, actions)
        usable += [replace(pour, scene=scene.name) for pour in fit.pours] if len(scenes) > 1 else fit.pours
        left_out += fit.left_out
        reasons += [why] if why else []
    if not usable:
        report.add(place, f"has nothing to calibrate on: it {'; it '.join(reasons) or 'has ' + '; '.join(left_out)}")
        return None
    if left_out:
        text = f"has pours that this calibration could not have made ({'; '.join(left_out)})"
        report.add(place, f"{text}; change the motion, or the bounds under actions")
        return None
    if all(pour.split != "train" for pour in usable):
        report.add(place, "has no pour with split 'train' to calibrate on")
        return None
    return RecordSet(scenes[0], tuple(usable), previous.path)
