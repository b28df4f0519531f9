"""Vessels from mesh files, as settings; `sim_engine.vessel.mesh` reads the file and computes the geometry."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, ClassVar, Literal

from sim_engine.settings.model import BY_CONTENT
from sim_engine.vessel.shapes import LengthUnit, Shape, VesselSpec

if TYPE_CHECKING:
    from sim_engine.vessel.vessel import Vessel


Axis = Literal["x", "y", "z", "-x", "-y", "-z"]


def usual_up(path: Path) -> Axis:
    """The axis of a file that points upwards unless it is given: y in a GLB, as glTF 2.0 defines (3.4), else z."""
    return "y" if path.suffix.lower() == ".glb" else "z"


class MeshShape(Shape):
    """A closed mesh of the vessel's solid (STL, OBJ, PLY, GLB). `unit` None: metres if the size is then plausible.

    `up` is the mesh axis that points out of the opening.
    """

    kind: ClassVar[str] = "mesh"
    path: Annotated[Path, BY_CONTENT]
    unit: LengthUnit | None = None
    up: Axis = "z"

    def content(self) -> bytes:
        """See `Shape.content`: the file's bytes, not its path.

        Raises:
            OSError: it cannot be read.
        """
        return f"mesh {self.unit} {self.up}".encode() + self.path.read_bytes()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Vessel:
        """See `Shape.build`."""
        from sim_engine.vessel.mesh import build_mesh_vessel

        return build_mesh_vessel(spec, self, use_cache=use_cache)
