"""Sources of a vessel's shape: a profile, a mesh file, or a plug-in.

Small, hashable values that are valid in any process.

`VesselSpec` is a vessel by name and `Shape`; `VESSELS` is the registry of shapes. `VesselError` reports an invalid
vessel to the user who described it. `sim_engine.vessel.vessel.build_vessel` computes the geometry.
"""

from __future__ import annotations

import hashlib
import random
from pathlib import Path
from pkgutil import resolve_name
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, SerializeAsAny

from sim_engine.errors import DecantError
from sim_engine.settings.model import BY_CONTENT
from sim_engine.settings.plugin_registry import PluginError, PluginRegistry

LengthUnit = Literal["m", "cm", "mm", "in"]

NARROWEST = 2e-4
"""Smallest radius of drawn profiles [m], since a negative radius is impossible."""


class Shape(BaseModel):
    """A source of vessels: a small value that defines a shape and builds a vessel from it.

    To add one, derive a class from this one and register it in `decant.vessels` under its `kind`. It has an `outline`
    if it is a surface of revolution, else it has `build`.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    kind: str = ""
    """The source; a literal in each class, and its name in the registry."""

    def outline(self) -> ProfileShape | None:
        """Its profile, if it is a surface of revolution; exact distances and quadrature follow from it.

        Raises:
            VesselError: the settings define no vessel; the text states valid ones.
        """
        return None

    def content(self) -> bytes:
        """Everything that determines the geometry, for the cache's keys."""
        return self.model_dump_json().encode()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Any:
        """The `sim_engine.vessel.vessel.Vessel`, for a shape without an outline; see `build_vessel`."""
        # Not abstract: a shape has this or an outline. The registry refuses shapes with neither, so this is
        # unreachable.
        raise NotImplementedError


class ProfileShape(Shape):
    """Surface of revolution.

    `inner` runs from the axis at the inner floor to the rim, as (r, z) points [m], z measured from the inner floor's
    lowest point; the wall is `wall` thick outwards and `floor` thick below.

    `radius_deviations` describes the uncertainty: each row is an independent mode, the outward displacement of each
    point for one standard deviation [m]. `height_deviation` is that of the rim's height, all points moving in
    proportion [m]."""

    kind: Literal["profile"] = "profile"
    inner: tuple[tuple[float, float], ...]
    wall: float
    floor: float
    radius_deviations: tuple[tuple[float, ...], ...] = ()
    height_deviation: float = 0.0

    def outline(self) -> ProfileShape:
        """See `Shape.outline`."""
        return self

    @property
    def uncertain(self) -> bool:
        """Whether its uncertainty is known."""
        return bool(self.radius_deviations) or self.height_deviation > 0.0

    def drawn(self, rng: random.Random) -> ProfileShape:
        """A shape drawn from the uncertainty, itself certain: one normal number for each mode."""
        moved = [0.0] * len(self.inner)
        for row in self.radius_deviations:
            by = rng.gauss(0.0, 1.0)
            moved = [m + by * d for m, d in zip(moved, row, strict=True)]
        stretch = 1.0 + rng.gauss(0.0, 1.0) * self.height_deviation / self.inner[-1][1]
        # only the floor's centre lies on the axis
        inner = (
            (max(r + m, NARROWEST) if r > 0.0 else r, z * stretch) for (r, z), m in zip(self.inner, moved, strict=True)
        )
        return ProfileShape(inner=tuple(inner), wall=self.wall, floor=self.floor)

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request: the uncertainty, if it is not given."""
        return frozenset() if self.uncertain else frozenset({"radius_deviations", "height_deviation"})


class MeshShape(Shape):
    """A closed mesh of the vessel's solid (STL, OBJ, PLY, GLB). `unit` None: metres if the size is then plausible.

    `up` is the mesh axis that points out of the opening.
    """

    kind: Literal["mesh"] = "mesh"
    path: Annotated[Path, BY_CONTENT]
    unit: LengthUnit | None = None
    up: Literal["x", "y", "z", "-x", "-y", "-z"] = "z"

    def content(self) -> bytes:
        """See `Shape.content`: the file's bytes, not its path.

        Raises:
            OSError: it cannot be read.
        """
        return f"mesh {self.unit} {self.up}".encode() + self.path.read_bytes()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Any:
        """See `Shape.build`."""
        # Named by text to avoid a circular import: the mesh module imports vessels, which import shapes.
        return resolve_name("sim_engine.vessel.mesh:build_mesh_vessel")(spec, use_cache=use_cache)


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


VESSELS: PluginRegistry[type[Shape]] = PluginRegistry("decant.vessels", "source of vessels", _shape)
"""All installed sources of vessels."""


def _of_its_kind(value: Any) -> Any:
    """Convert a written shape, by its kind."""
    if not isinstance(value, dict):
        return value
    try:
        return VESSELS.get(str(value.get("kind"))).model_validate(value)
    except PluginError as error:
        raise ValueError(str(error)) from None


class VesselSpec(BaseModel):
    """A vessel by its name and the source of its shape."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    shape: Annotated[SerializeAsAny[Shape], BeforeValidator(_of_its_kind)]

    @property
    def uncertain(self) -> bool:
        """Whether the uncertainty of its shape is known."""
        outline = self.shape.outline()
        return outline is not None and outline.uncertain

    def drawn(self, seed: int) -> VesselSpec:
        """The vessel with a shape drawn from its uncertainty; the vessel itself if that is not given.

        Args:
            seed: the same seed gives a vessel the same shape in every scene.
        """
        outline = self.shape.outline()
        if outline is None or not outline.uncertain:
            return self
        return VesselSpec(name=self.name, shape=outline.drawn(random.Random(f"{seed} {self.name}")))

    def content_hash(self) -> str:
        """Hash of everything that determines the geometry (the mesh file's bytes, not its path): the cache key.

        Raises:
            OSError: one of its files cannot be read.
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


class VesselError(DecantError, ValueError):
    """A vessel that cannot be built or used; the message gives the reason and the remedy."""
