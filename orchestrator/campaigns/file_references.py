"""Values in files of their own: vessels, liquids, laboratories. Each file is read once.

`References` follows paths. `VesselFile` declares the file of a vessel, with one key for each source of its shape.
"""

from __future__ import annotations

import inspect
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any, TypeVar

from pydantic import Field, create_model

from actors.arm.arm_settings import arm_kind
from actors.balance.balance_settings import SerialBalanceSettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report, wrong_kind
from sim_engine.errors import shown_path
from sim_engine.liquids import Liquid, LiquidSettings
from sim_engine.settings.model import Example, FilePath, Name, Problems, Settings
from sim_engine.vessel.mesh_shape import Axis, MeshShape, usual_up
from sim_engine.vessel.shapes import VESSELS, LengthUnit, ProfileShape, Shape, VesselGrip, VesselSpec

S = TypeVar("S", bound=Settings)

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb")
YAML_SUFFIXES = (".yaml", ".yml", ".json")


class VesselBase(Settings):
    """A vessel: a profile of [r, z] points, a mesh of its solid, or a source that an installed package adds."""

    name: Annotated[Name, Example("beaker")]
    """Its name in figures and journals."""

    profile: ProfileShape | None = None
    """A surface of revolution; or give `mesh`."""

    mesh: FilePath | None = None
    """A closed mesh of the vessel's solid: path of an STL, OBJ, PLY or GLB file; or give `profile`."""

    unit: LengthUnit | None = None
    """Unit of the mesh's coordinates."""

    up: Axis | None = None
    """Axis of the mesh that points out of the opening; unless given y for GLB and z for other files."""

    grip: VesselGrip | None = None
    """How wide the vessel is where a gripper holds it; from its shape unless given."""

    def check_values(self, problems: Problems) -> None:
        """Check that the shape is given once."""
        kinds = ("profile", "mesh", *further_sources())
        written = [key for key in kinds if self.value(key) is not None]
        if len(written) > 1:
            text = f"the vessel has a {written[0]} already; keep one of '{written[0]}' and '{written[1]}'"
            problems.add(text, written[1], key=True)
        elif self.profile is not None:
            for key in ("unit", "up"):
                if self.value(key) is not None:
                    problems.add("belongs to a mesh; a profile has its own 'unit' inside", key, key=True)
        elif not written and problems.valid(*kinds):
            others = "".join(f", or '{key}:'" for key in kinds[2:])
            problems.add(f"has no shape; add 'profile:' with [r, z] points, or 'mesh:' with the path of a file{others}")


def further_sources() -> dict[str, type[Shape]]:
    """Sources of vessels that packages add, by their keys in a vessel's file."""
    return {kind: shape for kind, shape in VESSELS.all.items() if kind not in VesselBase.model_fields}


def _vessel_file() -> type[VesselBase]:
    """The settings with one key per source of vessels."""
    fields: Any = {
        kind: (shape | None, Field(default=None, description=inspect.getdoc(shape)))
        for kind, shape in further_sources().items()
    }
    model: type[VesselBase] = create_model("VesselFile", __base__=VesselBase, __doc__=VesselBase.__doc__, **fields)
    return model


VesselFile: Any = _vessel_file()


def resolve_vessel(section: VesselBase, place: Place, report: Report) -> VesselSpec | None:
    """The vessel of a file; None after a problem. A problem of a mesh's path is added to the report."""
    shape: Shape | None = next(filter(None, map(section.value, ("profile", *further_sources()))), None)
    if section.mesh is not None and shape is None:
        path = resolved(place.directory / section.mesh)
        if path.suffix.lower() not in MESH_SUFFIXES:
            suffix = path.suffix or "a file without suffix"
            report.add(place.at("mesh"), f"{suffix} is not a mesh; use STL, OBJ, PLY or GLB")
        elif (missing := missing_file(path)) is not None:
            report.add(place.at("mesh"), missing)
        shape = MeshShape(path=path, unit=section.unit, up=section.up or usual_up(path))
    if shape is None or report.is_broken_within(place):
        return None
    return VesselSpec(name=section.name, shape=shape, grip=section.grip)


KINDS: dict[type[Settings], str] = {VesselFile: "vessel", LaboratorySettings: "laboratory"}
"""Kinds of whole files that their keys identify."""


@dataclass
class References:
    """Follows paths from files to files. Problems in any of them are added to the report with their own place."""

    report: Report
    _read: dict[tuple[Path, type[Settings]], tuple[Settings, Place] | None] = field(default_factory=dict)
    _vessels: dict[tuple[Path, Any], VesselSpec | None] = field(default_factory=dict)

    def section(self, value: Any, place: Place, model: type[S]) -> tuple[S, Place] | None:
        """The section behind a path, or the inline one, with its place; None if there is none."""
        if isinstance(value, model):
            return value, place
        if not isinstance(value, str):
            return None
        path = resolved(place.directory / value)
        if path.suffix.lower() in MESH_SUFFIXES and model is VesselFile:
            self.report.add(
                place, f"is a mesh; write {{name: {path.stem}, mesh: {value}, unit: mm}} with the unit that it is in"
            )
            return None
        if (missing := missing_file(path)) is not None:
            self.report.add(place, missing)
            return None
        if path.suffix.lower() not in YAML_SUFFIXES:
            self.report.add(place, f"{path.name} is not a YAML file; its name should end in .yaml")
            return None
        return self.file(path, model, place)

    def file(self, path: Path, model: type[S], named: Place | None = None) -> tuple[S, Place] | None:
        """The section of a whole file.

        Args:
            path: the file.
            model: class of the section.
            named: place of the reference; None for a file given directly.
        """
        key = (path, model)
        if key not in self._read:
            try:
                place = Place(Document.read(path))
            except ConfigError as error:
                self.report.problems.extend(error.problems)
                self._read[key] = None
            else:
                kind = KINDS.get(model)
                other = None if kind is None else wrong_kind(place.document, kind)
                if other is not None and named is not None:
                    self.report.add(named, f"{shown_path(path)} {other.message}")
                elif other is not None:
                    self.report.problems.append(other)
                read = None if other is not None else validate(model, place, self.report)
                self._read[key] = None if read is None else (read, place)
        entry = self._read[key]
        if entry is None:
            return None
        section, place = entry
        assert isinstance(section, model)
        return section, place

    def vessel(self, value: Any, place: Place) -> VesselSpec | None:
        """A vessel; None after a problem (which is reported)."""
        loaded = self.section(value, place, VesselFile)
        if loaded is None:
            return None
        key = (loaded[1].document.path, loaded[1].loc)
        if key not in self._vessels:
            self._vessels[key] = resolve_vessel(*loaded, self.report)
        return self._vessels[key]

    def liquid(self, value: Any, place: Place) -> Liquid | None:
        """A liquid; None after a problem."""
        loaded = self.section(value, place, LiquidSettings)
        return None if loaded is None or self.report.is_broken_within(loaded[1]) else loaded[0].load()

    def laboratory(self, value: Any, place: Place) -> LaboratorySettings | None:
        """A laboratory, ready for use; None after a problem."""
        loaded = self.section(value, place, LaboratorySettings)
        if loaded is None or self.report.is_broken_within(loaded[1]):
            return None
        laboratory, at = loaded[0].ready(), loaded[1]
        balance = laboratory.balance
        if isinstance(balance, SerialBalanceSettings) and balance.raw_lines is not None:
            folder = str(resolved(at.directory / balance.raw_lines))
            laboratory = laboratory.with_values(balance=balance.with_values(raw_lines=folder))
        if laboratory.arm is None:
            return laboratory
        try:
            return laboratory.with_values(arm=arm_kind(laboratory.arm).with_stored(at.directory))
        except ValueError as error:
            self.report.add(at.at("arm"), str(error))
            return None
