"""What stands where around an arm of any kind."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar

from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import Section

Length = Annotated[float, Quantity("m", "100 mm", -3.0, 3.0)]
Angle = Annotated[float, Quantity("rad", "90 deg", -math.radians(363.0), math.radians(363.0))]


class PointSection(Section):
    """A point in the room's frame: the base's, as the teach pendant shows it, for an arm that stands on a table."""

    required: ClassVar[dict[str, str]] = {"x": "650 mm", "y": "0 mm", "z": "80 mm"}

    x: Length | None = None
    """The x of the room's frame."""

    y: Length | None = None
    """The y of the room's frame."""

    z: Length | None = None
    """Upwards from where the robot is screwed down."""


class CellSection(Section):
    """What stands where around the arm."""

    required: ClassVar[dict[str, str]] = {
        "receiver": "{x: 650 mm, y: 0 mm, z: 80 mm}",
        "direction": "90 deg",
    }

    receiver: PointSection | None = None
    """Where the middle of the receiver's underside stands, in the room's frame."""

    direction: Angle | None = None
    """The direction that the liquid is poured in, seen from above: 0 along the room's x, 90 deg along its y."""

    table: Length = 0.0
    """Height of the surface that nothing may go below, in the room's frame."""
