"""Records of a campaign: weighed pours with the scene they were poured in, checked against what is searched."""

from __future__ import annotations

from pathlib import Path

from orchestrator.config.campaign.records import LIP_COLUMN, Table, column_name, read_records
from orchestrator.config.campaign.scenes import SceneBuilder
from orchestrator.config.campaign.sections import PoursSection
from orchestrator.config.motion import MotionBase
from orchestrator.config.yaml.errors import dotted
from orchestrator.config.yaml.files import missing_file, resolved
from orchestrator.config.yaml.source import Place
from orchestrator.plan import RecordSet
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.space import Space
from sim_engine.task import Scene
from sim_engine.vessel.spec import ProfileShape, VesselSpec

Motions = tuple[tuple[MotionBase | None, Place], ...]

LIP_RADIUS_TOLERANCE = 1e-3
"""Largest difference [m] between a stated lip radius and the rim of a pourer's profile: more is a slip of the pen."""


def resolve_records(
    pours: PoursSection,
    place: Place,
    builder: SceneBuilder,
    table: Table | None,
    actions: Space | None,
    scene: Scene | None,
    pourer: VesselSpec | None,
    motions: Motions,
) -> tuple[RecordSet | None, RecordSet | None]:
    """Calibration's records and those of the transfer scene; None where something is wrong or not asked for."""
    report = builder.report
    _check_lip_radius(pours, place, builder, pourer)
    records = transfer = None
    if table is not None and actions is not None:
        for name in sorted(table.varying() - set(actions.names)):
            report.add(
                place.at("from"),
                f"{name} varies in the file and is not searched; add it to {dotted(place.loc[:-1])}.actions",
            )
        for name in actions.names:
            if name not in table.dimensions:
                column = LIP_COLUMN if name == "x_offset" else column_name(ACTION_DIMENSIONS[name])
                report.add(
                    place.at("from"), f"{name} is searched and the file has no column '{column}'; fix it under motion"
                )
        splits = {row.split for row in table.rows}
        if "train" not in splits:
            report.add(place.at("from"), "has no pour with split 'train' to calibrate on")
        if "transfer" in splits:
            report.add(place.at("from"), "has pours with split 'transfer'; they belong to 'transfer: {from: ...}'")
    if table is not None and scene is not None:
        records = _record_set(table, scene, place.at("from"), pours, pours.source, builder)
    section, at = pours.transfer, place.at("transfer")
    if section is not None:
        receiver = None if section.receiver is None else builder.references.vessel(section.receiver, at.at("receiver"))
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
                transfer = _record_set(other, moved, at.at("from"), pours, section.source, builder)
    return records, transfer


def read_table(pours: PoursSection, source: str | None, place: Place, builder: SceneBuilder) -> Table | None:
    """A CSV file of weighed pours; None where there is none or something is wrong with it."""
    if source is None or builder.liquid is None:
        return None
    path = _path(source, place)
    if (missing := missing_file(path)) is not None:
        builder.report.add(place, missing)
        return None
    table = read_records(path, loaded=builder.liquid.mass, lip_radius=pours.lip_radius, columns=pours.columns)
    builder.report.problems.extend(table.problems)
    return None if table.problems else table


def _path(source: str, place: Place) -> Path:
    return resolved(place.directory / source)


def _record_set(
    table: Table, scene: Scene, place: Place, pours: PoursSection, source: str | None, builder: SceneBuilder
) -> RecordSet | None:
    try:
        records = tuple(row.pour(scene.fixed) for row in table.rows)
    except ValueError as error:
        builder.report.add(place, str(error))
        return None
    return RecordSet(scene, records, _path(str(source), place), pours.lip_radius, dict(pours.columns))


def _check_lip_radius(pours: PoursSection, place: Place, builder: SceneBuilder, pourer: VesselSpec | None) -> None:
    if pours.lip_radius is None or pourer is None or not isinstance(pourer.shape, ProfileShape):
        return
    rim = pourer.shape.inner[-1][0]
    if abs(rim - pours.lip_radius) > LIP_RADIUS_TOLERANCE:
        builder.report.add(
            place.at("lip_radius"),
            f"is {pours.lip_radius * 1e3:g} mm, but the rim of pourer '{pourer.name}' has an inner radius of "
            f"{rim * 1e3:g} mm",
        )
