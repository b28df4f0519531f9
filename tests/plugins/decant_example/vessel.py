"""Conical vessels: a funnel that is closed below, an Erlenmeyer's opposite."""

from __future__ import annotations

from typing import Annotated, ClassVar, Literal

from decant.plugins import ProfileShape, Quantity, Settings, Shape, VesselError

Length = Annotated[float, Quantity("m", "40 mm", 5e-3, 0.5)]


class Cone(Shape, Settings):
    """A cone that opens upwards, cut off at its floor."""

    required: ClassVar[dict[str, str]] = {"top": "40 mm"}

    kind: Literal["cone"] = "cone"
    """The key that it has in a vessel's file."""

    top: Length | None = None
    """Inner radius at the rim."""

    bottom: Length = 0.02
    """Inner radius at the floor."""

    height: Length = 0.08
    """Inner height."""

    wall: Annotated[float, Quantity("m", "4 mm", 1e-3, 0.02)] = 0.004
    """Thickness of wall and floor."""

    def outline(self) -> ProfileShape:
        """See `Shape.outline`."""
        assert self.top is not None, "a required key"
        if self.top < self.bottom:
            raise VesselError(
                f"a cone opens upwards; its top ({1e3 * self.top:g} mm) should be wider than its bottom "
                f"({1e3 * self.bottom:g} mm)"
            )
        inner = ((0.0, 0.0), (self.bottom, 0.0), (self.top, self.height))
        return ProfileShape(inner=inner, wall=self.wall, floor=self.wall)
