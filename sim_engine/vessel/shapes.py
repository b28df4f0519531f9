"""Sources of a vessel's shape: a profile, a mesh file, or a plug-in.

Small, hashable values that are valid in any process.

`VesselSpec` is a vessel by name and `Shape`; `VESSELS` is the registry of shapes. `VesselError` reports an invalid
vessel to the user who described it. `sim_engine.vessel.vessel.build_vessel` computes the geometry.
"""

from __future__ import annotations

import hashlib
import random
from typing import Annotated, Any, ClassVar, Literal

from pydantic import BaseModel, ConfigDict, Field, SerializeAsAny

from sim_engine.errors import DecantError
from sim_engine.settings.model import NOT_IN_FINGERPRINT, Example, Number, Problems, Settings
from sim_engine.settings.plugin_registry import PluginRegistry
from sim_engine.settings.quantity import Quantity, parse_quantity

LengthUnit = Literal["m", "cm", "mm", "in"]

Thickness = Annotated[float, Quantity("m", "4 mm", lower=2e-4, upper=0.1)]

Point = Annotated[tuple[Number, Number], Field(description="[r, z]")]

NARROWEST = 2e-4
"""Smallest radius of drawn profiles [m], since a negative radius is impossible."""


class Shape(Settings):
    """A source of vessels: the settings that define a shape, from which a vessel is built.

    To add one, derive a class from this one and register it in `decant.vessels` under its `kind`, which is also its key
    in a vessel's file. It has an `outline` if it is a surface of revolution, else it has `build`.
    """

    kind: ClassVar[str] = ""
    """The source: its name in the registry."""

    def outline(self) -> ProfileShape | None:
        """Its profile in metres, if it is a surface of revolution; exact distances and quadrature follow from it.

        Raises:
            VesselError: the settings define no vessel; the text states valid ones.
        """
        return None

    def content(self) -> bytes:
        """Everything that determines the geometry, for the cache's keys."""
        return f"{self.kind} {self.model_dump_json()}".encode()

    def build(self, spec: VesselSpec, *, use_cache: bool) -> Any:
        """The `sim_engine.vessel.vessel.Vessel`, for a shape without an outline; see `build_vessel`."""
        # Not abstract: a shape has this or an outline. The registry refuses shapes with neither, so this is
        # unreachable.
        raise NotImplementedError


class ProfileShape(Shape):
    """A surface of revolution."""

    kind: ClassVar[str] = "profile"

    recorded_as_given: ClassVar[bool] = True

    unit: Annotated[LengthUnit, Example("mm"), NOT_IN_FINGERPRINT]
    """Unit of the numbers in `inner`."""

    inner: Annotated[tuple[Point, ...], Example("[[0, 0], [40, 0], [40, 100]]")]
    """The inner surface as [r, z] points, from the axis at the inner floor to the rim."""

    wall: Thickness
    """Thickness of the wall, outwards."""

    floor: Thickness
    """Thickness of the floor, downwards."""

    radius_deviations: tuple[tuple[Number, ...], ...] = ()
    """Uncertainty of the shape: a row for each independent deviation, with the outward displacement of each point of
    `inner` at one standard deviation. Predictions of spillage use shapes drawn from it."""

    height_deviation: Annotated[float, Quantity("m", "0.3 mm", lower=0.0, upper=0.02)] = 0.0
    """Uncertainty of the rim's height, one standard deviation; all points move in proportion."""

    def check_values(self, problems: Problems) -> None:
        """Check the order of the points, the size, and the lengths of the rows of deviations."""
        if not problems.valid("unit", "inner"):
            return
        points = self.outline().inner
        if len(points) < 2:
            problems.add("needs at least two [r, z] points: from the axis at the floor to the rim", "inner")
            return
        if points[0] != (0.0, 0.0):
            problems.add("the first point is the inner floor on the axis and should be [0, 0]", "inner", 0)
        for i, (point, before) in enumerate(zip(points[1:], points, strict=False), start=1):
            if point[0] <= 0.0:
                text = f"r = {self.inner[i][0]:g} should be above 0; only the first point is on the axis"
                problems.add(text, "inner", i)
            if point == before:
                problems.add("is the same point as the one before; remove it", "inner", i)
        if points[-1][1] <= max(z for _, z in points[:-1]):
            problems.add("the last point is the rim and should be higher than all others", "inner", len(points) - 1)
        largest = max(max(point) for point in points)
        if not 0.005 <= largest <= 1.0:
            size = f"{largest * 1e3:g} mm"
            text = f"in {self.unit} the vessel would be {size} large; vessels are 5 mm … 1 m. Is it right?"
            problems.add(text, "unit")
        for i, row in enumerate(self.radius_deviations):
            if len(row) != len(points):
                text = f"has {len(row)} number(s); should have one for each of the {len(points)} points of 'inner'"
                problems.add(text, "radius_deviations", i)

    def content(self) -> bytes:
        """See `Shape.content`."""
        return f"{self.kind} {self.outline().model_dump_json(exclude={'unit'})}".encode()

    def outline(self) -> ProfileShape:
        """See `Shape.outline`: the profile with all numbers in metres."""
        if self.unit == "m":
            return self
        inner = tuple((self._metres(r), self._metres(z)) for r, z in self.inner)
        scale = self._metres(1)
        rows = tuple(tuple(scale * x for x in row) for row in self.radius_deviations)
        return self.with_values(unit="m", inner=inner, radius_deviations=rows)

    def _metres(self, number: float) -> float:
        return parse_quantity(f"{number} {self.unit}", "m", "40 mm")

    @property
    def uncertain(self) -> bool:
        """Whether its uncertainty is known."""
        return bool(self.radius_deviations) or self.height_deviation > 0.0

    def drawn(self, rng: random.Random) -> ProfileShape:
        """A shape drawn from the uncertainty, itself certain: one normal number for each mode."""
        profile = self.outline()
        moved = [0.0] * len(profile.inner)
        for row in profile.radius_deviations:
            by = rng.gauss(0.0, 1.0)
            moved = [m + by * d for m, d in zip(moved, row, strict=True)]
        stretch = 1.0 + rng.gauss(0.0, 1.0) * self.height_deviation / profile.inner[-1][1]
        # only the floor's centre lies on the axis
        inner = (
            (max(r + m, NARROWEST) if r > 0.0 else r, z * stretch)
            for (r, z), m in zip(profile.inner, moved, strict=True)
        )
        return ProfileShape(unit="m", inner=tuple(inner), wall=self.wall, floor=self.floor)

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request: the uncertainty, if it is not given."""
        return frozenset() if self.uncertain else frozenset({"radius_deviations", "height_deviation"})


def _shape(loaded: object, name: str) -> type[Shape]:
    if not (isinstance(loaded, type) and issubclass(loaded, Shape)):
        raise TypeError("should be a class derived from Shape")
    if loaded.kind != name:
        raise ValueError(f"its 'kind' should be '{name}', the name that it is registered under")
    if loaded.outline is Shape.outline and loaded.build is Shape.build:
        raise TypeError(f"its class {loaded.__name__} lacks 'outline' or 'build'")
    return loaded


VESSELS: PluginRegistry[type[Shape]] = PluginRegistry("decant.vessels", "source of vessels", _shape)
"""All installed sources of vessels."""


class VesselGrip(Settings):
    """How wide a vessel is where a gripper holds it."""

    width: Annotated[float, Quantity("m", "88 mm", lower=1e-3, upper=0.5)] | None = None
    """Width between the fingertips; computed from the shape unless given. Give it if the vessel has a handle."""

    tolerance: Annotated[float, Quantity("m", "2 mm", lower=1e-4, upper=0.05)] = 2e-3
    """Largest difference of the fingers from it in a good grasp."""

    mass: Annotated[float, Quantity("kg", "312 g", lower=1e-3, upper=30.0)] | None = None
    """Mass of the empty, dry vessel; needed if an arm carries it between places."""


class VesselSpec(BaseModel):
    """A vessel by its name, the source of its shape, and how it is gripped."""

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str
    shape: SerializeAsAny[Shape]
    grip: Annotated[VesselGrip | None, NOT_IN_FINGERPRINT] = None

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
            unit="m", inner=((0.0, 0.0), (inner_radius, 0.0), (inner_radius, inner_height)), wall=wall, floor=floor
        ),
    )


class VesselError(DecantError, ValueError):
    """A vessel that cannot be built or used; the message gives the reason and the remedy."""
