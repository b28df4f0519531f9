"""Where things stand around an arm, and what it may do there. Plain values.

Frames. *Base*: of the robot, as its controller has it. *Room*: origin where the base's is, z up; the same as the base
for an arm that stands on a table and isn't turned (`Mount`). *Flange*: where tools are screwed on. *TCP*: tool centre
point, as set on the controller. *Pourer*: of the vessel that pours, underside at z = 0, axis along z. *World*: of pours
(`sim_engine.motion`): origin below the receiver's middle, z up, the liquid goes towards +x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

JOINT_NAMES = tuple(
    f"joint {k} ({name})"
    for k, name in enumerate(("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"), start=1)
)
"""What messages call the joints, in their order: numbered from 1, as on the axes of `decant jog`."""

Vector = tuple[float, float, float]
Joints = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """Where a frame stands in another.

    Attributes:
        x, y, z: [m].
        rx, ry, rz: rotation vector [rad], as the teach pendant shows it.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0

    @property
    def as_list(self) -> list[float]:
        """x y z rx ry rz, as the controller takes it."""
        return [self.x, self.y, self.z, self.rx, self.ry, self.rz]


@dataclass(frozen=True)
class Mount:
    """How the robot is screwed down: it is turned about its own z axis, then leant about the room's x axis.

    Attributes:
        tilt: 0 on a table, 90° on a wall, 180° on a ceiling [rad].
        turn: [rad].
    """

    tilt: float = 0.0
    turn: float = 0.0

    @property
    def up(self) -> Vector:
        """Where up is, in the base's frame; of length 1."""
        lean = math.sin(self.tilt)
        return (lean * math.sin(self.turn), lean * math.cos(self.turn), math.cos(self.tilt))


@dataclass(frozen=True)
class Plane:
    """A half-space that the arm has to stay in: normal · point ≥ offset, in the room's frame.

    Attributes:
        normal: towards the allowed side, of length 1.
        offset: [m].
    """

    normal: Vector
    offset: float


@dataclass(frozen=True)
class ArmLimits:
    """What the arm may do here. Hard: checked before a pour is planned, and again by what moves the arm.

    Attributes:
        box_low, box_high: corners of the box, in the room's frame, that tool and pourer stay in [m].
        planes: half-spaces for the same.
        joint_speed: of any joint [rad/s].
        tool_speed: of the TCP, and of any point of the pourer [m/s].
        tilt: largest tilt of the pourer [rad].
        tilt_speed: largest angular velocity of the pourer [rad/s].
        singularity: smallest |sin| of wrist and elbow, and shoulder's distance from its axis over its reach.
        clearance: between the pourer and whatever it must not touch [m].
    """

    box_low: Vector
    box_high: Vector
    planes: tuple[Plane, ...] = ()
    joint_speed: float = math.radians(150.0)
    tool_speed: float = 1.0
    tilt: float = math.radians(140.0)
    tilt_speed: float = math.radians(130.0)
    singularity: float = 0.1
    clearance: float = 5e-3


@dataclass(frozen=True)
class Cell:
    """What stands where around the arm.

    Attributes:
        receiver: where the receiver's underside stands, middle, in the room's frame [m].
        direction: that the liquid is poured in, seen from above: 0 along the room's x, turning towards y [rad].
        table: height of the surface that nothing may go below, in the room's frame [m].
    """

    receiver: Vector
    direction: float = 0.0
    table: float = 0.0
