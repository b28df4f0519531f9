"""Conical vessels: a funnel that is closed below, an Erlenmeyer's opposite."""

from __future__ import annotations

from typing import Annotated, ClassVar

from decant.plugins import ProfileShape, Quantity, Shape, VesselError

Length = Annotated[float, Quantity("m", "40 mm", 5e-3, 0.5)]


class Cone(Shape):
    """A cone that opens upwards, cut off at its floor."""

    kind: ClassVar[str] = "cone"

    top: Length
    """Inner radius at the rim."""

    bottom: Length = 0.02
    """Inner radius at the floor."""

    height: Length = 0.08
    """Inner height."""

    wall: Annotated[float, Quantity("m", "4 mm", 1e-3, 0.02)] = 0.004
    """Thickness of wall and floor."""

    def outline(self) -> ProfileShape:
        """See `Shape.outline`."""
        if self.top < self.bottom:
            raise VesselError(
                f"a cone opens upwards; its top ({1e3 * self.top:g} mm) should be wider than its bottom "
                f"({1e3 * self.bottom:g} mm)"
            )
        inner = ((0.0, 0.0), (self.bottom, 0.0), (self.top, self.height))
        return ProfileShape(unit="m", inner=inner, wall=self.wall, floor=self.wall)
