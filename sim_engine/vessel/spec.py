"""Where a vessel's shape comes from: a profile, or a mesh file. Small, hashable values that travel to any process."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Literal

from pydantic import BaseModel, ConfigDict, Field

from sim_engine.marks import BY_CONTENT

LengthUnit = Literal["m", "cm", "mm", "in"]


class ProfileShape(BaseModel):
    """Surface of revolution. `inner` runs from the axis at the inner floor to the rim, as (r, z) points [m], z measured
    from the inner floor's lowest point; the wall is `wall` thick outwards and `floor` thick below."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["profile"] = "profile"
    inner: tuple[tuple[float, float], ...]
    wall: float
    floor: float


class MeshShape(BaseModel):
    """A closed mesh of the vessel's solid (STL, OBJ, PLY, GLB). `unit` None: metres if the size is plausible then.

    `up` is the mesh axis that points out of the opening.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: Literal["mesh"] = "mesh"
    path: Annotated[Path, BY_CONTENT]
    unit: LengthUnit | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"


Shape = Annotated[ProfileShape | MeshShape, Field(discriminator="kind")]


class VesselSpec(BaseModel):
    """A vessel by name and origin of its shape."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    shape: Shape

    def content_hash(self) -> str:
        """Hash of everything that determines the geometry (the mesh file's bytes, not its path): the cache key.

        Raises:
            OSError: the mesh file can't be read.
        """
        digest = hashlib.sha256()
        if isinstance(self.shape, MeshShape):
            digest.update(f"mesh {self.shape.unit} {self.shape.up}".encode())
            digest.update(self.shape.path.read_bytes())
        else:
            digest.update(self.shape.model_dump_json().encode())
        return digest.hexdigest()[:24]


def cylinder(
    name: str, *, inner_radius: float, inner_height: float, wall: float = 0.004, floor: float = 0.004
) -> VesselSpec:
    """A straight cup with a flat floor [m]."""
    return VesselSpec(
        name=name,
        shape=ProfileShape(
            inner=((0.0, 0.0), (inner_radius, 0.0), (inner_radius, inner_height)), wall=wall, floor=floor
        ),
    )
