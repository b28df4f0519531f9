"""Where a vessel's shape comes from: a profile, a mesh file, or what a package adds.

Small, hashable values that travel to any process.
"""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, SerializeAsAny

from sim_engine.doors import Door, DoorError
from sim_engine.marks import BY_CONTENT

LengthUnit = Literal["m", "cm", "mm", "in"]


class Shape(BaseModel):
    """A source of vessels: a small value that says where a shape comes from, and makes a vessel of it.

    A further one is a class derived from this, registered at the door `decant.vessels` under its `kind`. It has an
    `outline` if it is a surface of revolution, else it has `build`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: str = ""
    """Which source; a literal in each class, and its name at the door."""

    def outline(self) -> ProfileShape | None:
        """Its profile, if it is a surface of revolution; exact distances and quadrature follow from that.

        Raises:
            VesselError: the settings make no vessel; says what would be right.
        """
        return None

    def content(self) -> bytes:
        """Everything that determines the geometry, for the cache's keys."""
        return self.model_dump_json().encode()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Any:
        """The `sim_engine.vessel.vessel.Vessel`, where there is no outline; see `build_vessel`."""
        # Not abstract: a shape has this or an outline. The door refuses one that has neither, so nobody comes here.
        raise NotImplementedError


class ProfileShape(Shape):
    """Surface of revolution. `inner` runs from the axis at the inner floor to the rim, as (r, z) points [m], z measured
    from the inner floor's lowest point; the wall is `wall` thick outwards and `floor` thick below."""

    kind: Literal["profile"] = "profile"
    inner: tuple[tuple[float, float], ...]
    wall: float
    floor: float

    def outline(self) -> ProfileShape:
        """See `Shape.outline`."""
        return self


class MeshShape(Shape):
    """A closed mesh of the vessel's solid (STL, OBJ, PLY, GLB). `unit` None: metres if the size is plausible then.

    `up` is the mesh axis that points out of the opening.
    """

    kind: Literal["mesh"] = "mesh"
    path: Annotated[Path, BY_CONTENT]
    unit: LengthUnit | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"

    def content(self) -> bytes:
        """See `Shape.content`: the file's bytes, not its path.

        Raises:
            OSError: it can't be read.
        """
        return f"mesh {self.unit} {self.up}".encode() + self.path.read_bytes()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Any:
        """See `Shape.build`."""
        from sim_engine.vessel.mesh import build_mesh_vessel

        return build_mesh_vessel(spec, use_cache=use_cache)


def _shape(loaded: object, name: str) -> type[Shape]:
    if not (isinstance(loaded, type) and issubclass(loaded, Shape)):
        raise TypeError("should be a class derived from Shape")
    if loaded.model_fields["kind"].default != name:
        raise ValueError(
            f"its field 'kind' should be Literal['{name}'] = '{name}', the name that it is registered under"
        )
    if loaded.outline is Shape.outline and loaded.build is Shape.build:
        raise TypeError(f"its class {loaded.__name__} lacks 'outline' or 'build'")
    return loaded


VESSELS: Door[type[Shape]] = Door("decant.vessels", "source of vessels", _shape)
"""All sources of vessels that are installed."""


def _of_its_kind(value: Any) -> Any:
    """A shape as it was written down, by its kind."""
    if not isinstance(value, dict):
        return value
    try:
        return VESSELS.get(str(value.get("kind"))).model_validate(value)
    except DoorError as error:
        raise ValueError(str(error)) from None


class VesselSpec(BaseModel):
    """A vessel by name and origin of its shape."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    shape: Annotated[SerializeAsAny[Shape], BeforeValidator(_of_its_kind)]

    def content_hash(self) -> str:
        """Hash of everything that determines the geometry (the mesh file's bytes, not its path): the cache key.

        Raises:
            OSError: a file of it can't be read.
        """
        return hashlib.sha256(self.shape.content()).hexdigest()[:24]


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
