"""The surroundings of an arm: frames, mount, cell and limits. Plain values that import nothing heavy.

- `Pose` and `Mount` describe frames, `RobotCell` what stands around the arm.
- `ArmLimits` and `Plane` restrict its motion.
- `JOINT_NAMES` names the joints in messages.

Frames:

- *Base*: the robot's, as its controller defines it.
- *Gravity-aligned base frame*: its origin is the base's, z points up. It equals the base frame if the arm stands on a
  table and is not turned (`Mount`).
- *Flange*: where tools are mounted.
- *TCP*: tool centre point, as set on the controller.
- *Pourer*: of the vessel that pours; its underside is at z = 0, its axis along z.
- *World*: of pours (`sim_engine.motion`); its origin is below the receiver's centre, z points up, and the liquid flows
  towards +x.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

JOINT_NAMES = tuple(
    f"joint {k} ({name})"
    for k, name in enumerate(("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"), start=1)
)
"""Names of the joints in messages, in their order: numbered from 1, as on the axes of `decant jog`."""

Vector = tuple[float, float, float]
Joints = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """Position and orientation of one frame in another.

    Attributes:
        x, y, z: position [m].
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
        """x y z rx ry rz, in the controller's order."""
        return [self.x, self.y, self.z, self.rx, self.ry, self.rz]


@dataclass(frozen=True)
class Mount:
    """Mounting of the robot: it is turned about its own z axis, then tilted about the room's x axis.

    Attributes:
        tilt: 0 on a table, 90° on a wall, 180° on a ceiling [rad].
        turn: about its own z axis [rad].
    """

    tilt: float = 0.0
    turn: float = 0.0

    @property
    def up(self) -> Vector:
        """Unit vector that points up, in the base's frame."""
        lean = math.sin(self.tilt)
        return (lean * math.sin(self.turn), lean * math.cos(self.turn), math.cos(self.tilt))


@dataclass(frozen=True)
class Plane:
    """A half-space in which the arm has to stay: normal · point ≥ offset, in the room's frame.

    Attributes:
        normal: unit vector towards the allowed side.
        offset: [m].
    """

    normal: Vector
    offset: float


@dataclass(frozen=True)
class ArmLimits:
    """Hard limits of the arm in its cell.

    They are checked before a pour is planned, and again by the code that moves the arm.

    Attributes:
        box_low, box_high: corners of the box in which tool and pourer stay, in the room's frame [m].
        planes: half-spaces in which tool and pourer stay.
        joint_speed: of any joint [rad/s].
        tool_speed: of the TCP, and of any point of the pourer [m/s].
        tilt: largest tilt of the pourer [rad].
        tilt_speed: largest angular velocity of the pourer [rad/s].
        singularity: smallest |sin| of the wrist and elbow angles, and smallest distance of the shoulder from its axis
            divided by its reach.
        clearance: smallest distance between the pourer and anything that it must not touch [m].
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
class RobotCell:
    """Positions of the objects around the arm.

    Attributes:
        receiver: centre of the receiver's underside, in the room's frame [m].
        direction: of pouring, seen from above: 0 along the room's x axis, positive towards y [rad].
        table: height of the surface below which nothing may move, in the room's frame [m].
    """

    receiver: Vector
    direction: float = 0.0
    table: float = 0.0
