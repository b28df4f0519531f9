"""The self-contained record of a campaign that a run stores as `resolved.json`: the file with all values filled in.

`as_file` writes any section in the format of its file; `record_of` writes a
plan derived from another campaign, for example the cell of a study, as the base record with its changes. Loading a
record gives the plan again.
"""

from __future__ import annotations

import typing
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

from pydantic import Tag

from orchestrator.campaigns.campaign_file import CalibrationSection, LearningSettings
from orchestrator.campaigns.file_references import References
from orchestrator.campaigns.search_ranges import Parameters
from orchestrator.campaigns.yaml.file_access import resolved
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, DeploymentPlan
from sim_engine.settings.model import IN_FILE, FieldMark, Settings
from sim_engine.settings.quantity import Quantity
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec


def record_of(base: Mapping[str, Any], plan: CampaignPlan) -> dict[str, Any]:
    """A plan in the format of campaign files, JSON-ready. Loading it gives the plan again.

    There are two exceptions. Pours that the cell of a study takes over from another cell are stored as shares of the
    load; loading reads the masses of that cell's journal instead, which differ by rounding. θ drawn from a posterior
    are not included.

    Args:
        base: the record of the campaign from which the plan was made.
        plan: plan of a study's cell, or for planning alone.
    """
    record = {key: value for key, value in base.items() if key not in ("calibration", "deployment")}
    record |= {
        "name": plan.name,
        "seed": plan.seed,
        "on_unknown": plan.on_unknown,
        "outputs": written(plan.outputs),
        "laboratory": _laboratory(base["laboratory"], plan),
        "simulator": {**base["simulator"], "parameters": _parameters(plan)},
    }
    if plan.memory is None:
        record.pop("prior", None)  # it belongs to a stage that is left out
    if plan.calibration is not None:
        record["calibration"] = _calibration(base["calibration"], plan.calibration)
    if plan.deployment is not None:
        record["deployment"] = _deployment(base, plan.deployment)
    return record


def _laboratory(base: Mapping[str, Any], plan: CampaignPlan) -> dict[str, Any]:
    bench = plan.laboratory.bench
    if bench is None:
        return dict(base)
    changed = {
        "liquid": written(bench.liquid),
        "pose_error": written(bench.pose_error),
        "pose_noise": written(bench.pose_noise),
        "time_scale": bench.time_scale,
    }
    return {**base, "bench": {**base["bench"], **changed}}


def _parameters(plan: CampaignPlan) -> dict[str, Any]:
    values: dict[str, Any] = plan.parameters.model_dump()
    for axis in () if plan.calibration is None else plan.calibration.parameters.axes:
        values[axis.name] = {"range": [axis.lower, axis.upper], "scale": axis.scale}
    for prior in () if plan.calibration is None else plan.calibration.parameter_prior:
        values[prior.name] |= {"measured": prior.mean, "tolerance": prior.deviation}
    return written(Parameters.model_validate(values))


def _calibration(base: Mapping[str, Any], plan: CalibrationPlan) -> dict[str, Any]:
    pours: dict[str, Any] = {"count": plan.pour_count, "holdout": plan.holdout}
    if plan.records is not None:
        pours = {"from_run": str(plan.records.path.parent)}
    pours["design"] = "stratified" if plan.records is not None else plan.design
    settings = {"pours": pours, "random_baseline": plan.random_baseline, **written(plan.settings)}
    return {**_common(base, CalibrationSection), **settings}


def _deployment(base: Mapping[str, Any], plan: DeploymentPlan) -> dict[str, Any]:
    section = base["deployment"]
    named = next(table for table in (section, base) if "receivers" in table or "receiver" in table)
    receivers = named["receivers"] if "receivers" in named else [named["receiver"]]
    records = {receiver["name"]: receiver for receiver in receivers}
    common = {key: value for key, value in _common(section, LearningSettings).items() if key != "receiver"}
    if plan.data is None:
        common.pop("data", None)
    common["confirm"] = plan.confirm
    vessels = [records.get(scene.receiver.name) or vessel_record(scene.receiver) for scene in plan.scenes]
    return {**common, "receivers": vessels, **written(plan.settings)}


def vessel_record(vessel: VesselSpec) -> dict[str, Any]:
    """A vessel in the format of its file."""
    shape = vessel.shape
    grip = {} if vessel.grip is None else {"grip": written(vessel.grip)}
    match shape:
        case MeshShape():
            unit = {} if shape.unit is None else {"unit": shape.unit}
            return {"name": vessel.name, "mesh": str(shape.path), "up": shape.up, **unit, **grip}
        case _:
            return {"name": vessel.name, shape.kind: written(shape), **grip}


def _common(base: Mapping[str, Any], section: type[Settings]) -> dict[str, Any]:
    """The keys of a section that are common to all strategies."""
    return {key: value for key, value in base.items() if key in section.written_keys()}


def written(section: Settings) -> dict[str, Any]:
    """A section without a file, in the format of a file."""
    return as_file(section, Place(Document(Path.cwd() / "written")), References(Report()))


T = TypeVar("T")


def as_file(section: Settings, place: Place, references: References, *, defaults: bool = True) -> dict[str, Any]:
    """A section in the format of a file, JSON-ready: loading it gives an equal section.

    Defaults are written (unless the section is recorded as given), numbers keep all digits, paths are absolute, and
    sections from other files are included.

    Args:
        section: the section, without problems.
        place: place of the section.
        references: the references that read its other files.
        defaults: whether defaults are included.
    """
    defaults = defaults and not section.recorded_as_given
    return _Writer(references, defaults).section(section.completed() if defaults else section, place)


@dataclass(frozen=True)
class _Writer:
    references: References
    defaults: bool

    def section(self, section: Settings, place: Place) -> dict[str, Any]:
        table: dict[str, Any] = {}
        for key, name in section.written_keys().items():
            value, info = getattr(section, name), type(section).model_fields[name]
            if value is None or not (self.defaults or name in section.model_fields_set):
                continue
            content = self._value(value, info.annotation, tuple(info.metadata), place.at(key))
            if content != {}:  # an empty mapping has no content and could conflict with other keys
                table[key] = content
        return table

    def _value(self, value: Any, annotation: Any, metadata: tuple[Any, ...], place: Place) -> Any:
        if isinstance(value, Settings):
            return as_file(value, place, self.references, defaults=self.defaults)
        if isinstance(value, str):
            return self._text(value, annotation, metadata, place)
        if isinstance(value, Mapping):
            return {key: self._value(item, Any, (), place.at(key)) for key, item in value.items()}
        if isinstance(value, list | tuple):
            hints = _items(annotation, len(value))
            return [self._value(value[i], hint, (), place.at(i)) for i, hint in enumerate(hints)]
        if isinstance(value, float) and (quantity := _find(Quantity, annotation, metadata)) is not None:
            if quantity.unit != "1":
                return f"{value!r} {quantity.unit}"
            return round(value) if quantity.whole else value
        return value

    def _text(self, value: str, annotation: Any, metadata: tuple[Any, ...], place: Place) -> Any:
        if IN_FILE in _every(FieldMark, annotation, metadata):
            return str(resolved(place.directory / value))
        model = _behind_a_path(annotation)
        section = None if model is None else self.references.section(value, place, model)
        return value if section is None else as_file(*section, self.references, defaults=self.defaults)


def _parts(annotation: Any) -> list[tuple[Any, tuple[Any, ...]]]:
    """The alternatives of an annotation, each with its metadata: the members of unions, the content of Annotated."""
    origin = typing.get_origin(annotation)
    if origin is typing.Annotated:
        inner, *metadata = typing.get_args(annotation)
        return [(part, (*inner_metadata, *metadata)) for part, inner_metadata in _parts(inner)]
    if origin in (typing.Union, type(int | str)):
        return [alternative for argument in typing.get_args(annotation) for alternative in _parts(argument)]
    return [(annotation, ())]


def _behind_a_path(annotation: Any) -> type[Settings] | None:
    """The section that may be in its own file, referenced by a path."""
    for alternative, metadata in _parts(annotation):
        if any(isinstance(m, Tag) and m.tag == "inline" for m in metadata):
            return typing.cast("type[Settings]", alternative)
    return None


def _find(kind: type[T], annotation: Any, metadata: tuple[Any, ...]) -> T | None:
    """The first metadata of one kind in an annotation."""
    return next(iter(_every(kind, annotation, metadata)), None)


def _every(kind: type[T], annotation: Any, metadata: tuple[Any, ...]) -> list[T]:
    """All metadata of one kind in an annotation."""
    every = [*metadata, *(m for _, inner in _parts(annotation) for m in inner)]
    return [m for m in every if isinstance(m, kind)]


def _items(annotation: Any, count: int) -> list[Any]:
    """Annotations of the items of a list or tuple."""
    for alternative, _ in _parts(annotation):
        if typing.get_origin(alternative) in (list, tuple):
            inner = [hint for hint in typing.get_args(alternative) if hint is not Ellipsis]
            return inner if len(inner) == count else inner[:1] * count
    return [Any] * count
