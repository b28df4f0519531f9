"""Vessel files: one key for each source of a vessel's shape, and their conversion."""

from __future__ import annotations

import inspect
from typing import Annotated, Any

from pydantic import Field, create_model

from orchestrator.campaigns.yaml.file_access import missing_file, resolved
from orchestrator.campaigns.yaml.yaml_source import Place, Report
from sim_engine.settings.model import Example, FilePath, Name, Problems, Settings
from sim_engine.vessel.mesh_shape import Axis, MeshShape, usual_up
from sim_engine.vessel.shapes import VESSELS, LengthUnit, ProfileShape, Shape, VesselGrip, VesselSpec

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb")


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
