"""The surroundings of an arm: frames, mount, cell and limits. Settings that import nothing heavy.

- `Pose` and `Mount` describe frames, `RobotCell` the objects around the arm.
- `ArmLimits`, `Box` and `Plane` restrict its motion.
- `JointAngles` is a posture; `JOINT_NAMES` names the joints in messages.

Units in files are those of the teach pendant: mm, deg; rotation vectors in rad.

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

import itertools
import math
from typing import Annotated, Self

from pydantic import field_validator

from sim_engine.settings.model import Example, Number, Problems, Settings
from sim_engine.settings.quantity import Quantity

JOINT_NAMES = tuple(
    f"joint {k} ({name})"
    for k, name in enumerate(("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"), start=1)
)
"""Names of the joints in messages, in their order: numbered from 1, as on the axes of `decant robot jog`."""

Vector = tuple[float, float, float]
Joints = tuple[float, float, float, float, float, float]

Length = Annotated[float, Quantity("m", "100 mm", -3.0, 3.0)]
Angle = Annotated[float, Quantity("rad", "90 deg", -math.radians(363.0), math.radians(363.0))]
Turn = Annotated[float, Quantity("rad", "1.571 rad", -2.0 * math.pi, 2.0 * math.pi)]
Speed = Annotated[float, Quantity("rad/s", "40 deg/s", 0.0, math.radians(360.0), positive=True)]


class Named(Settings):
    """Numbers with names."""

    @classmethod
    def of(cls, *values: float) -> Self:
        """From all numbers in the order of the keys, without the bounds that settings have."""
        return cls.model_construct(None, **dict(zip(cls.model_fields, values, strict=True)))


class Point(Named):
    """A point in the gravity-aligned base frame. For an arm on a table, this is the base frame of the teach pendant."""

    x: Annotated[Length, Example("650 mm")]
    """The x in the base frame."""

    y: Annotated[Length, Example("0 mm")]
    """The y in the base frame."""

    z: Annotated[Length, Example("80 mm")]
    """Height above the robot's mounting point."""

    @property
    def vector(self) -> Vector:
        """x, y, z [m]."""
        return (self.x, self.y, self.z)


class Centre(Named):
    """A point in the flange's frame."""

    x: Length = 0.0
    """The x in the flange's frame."""

    y: Length = 0.0
    """The y in the flange's frame."""

    z: Length = 0.0
    """Distance outwards from the flange."""

    @property
    def vector(self) -> Vector:
        """x, y, z [m]."""
        return (self.x, self.y, self.z)


class Pose(Named):
    """Pose of a frame in another, as on the teach pendant: position and rotation vector."""

    x: Length = 0.0
    """The x of its origin."""

    y: Length = 0.0
    """The y of its origin."""

    z: Length = 0.0
    """The z of its origin."""

    rx: Turn = 0.0
    """The x of the rotation vector."""

    ry: Turn = 0.0
    """The y of the rotation vector."""

    rz: Turn = 0.0
    """The z of the rotation vector."""

    @property
    def as_list(self) -> list[float]:
        """x y z rx ry rz, in the controller's order."""
        return [self.x, self.y, self.z, self.rx, self.ry, self.rz]


def rotated(pose: Pose, vector: Vector) -> Vector:
    """A vector of the posed frame in the frame that the pose refers to (Rodrigues' formula)."""
    angle = math.hypot(pose.rx, pose.ry, pose.rz)
    x, y, z = (component / (angle or 1.0) for component in (pose.rx, pose.ry, pose.rz))
    u, v, w = vector
    along = (x * u + y * v + z * w) * (1.0 - math.cos(angle))
    crossed = (y * w - z * v, z * u - x * w, x * v - y * u)
    a, b, c = (
        old * math.cos(angle) + new * math.sin(angle) + axis * along
        for old, new, axis in zip(vector, crossed, (x, y, z), strict=True)
    )
    return a, b, c


class Mount(Settings):
    """Mounting of the robot: rotation about its own z axis, then tilt about the x axis of the base frame."""

    tilt: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """0 on a table, 90 deg on a wall, 180 deg on a ceiling."""

    turn: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """Rotation about its own z axis."""

    @property
    def up(self) -> Vector:
        """Unit vector that points up, in the base's frame."""
        lean = math.sin(self.tilt)
        return (lean * math.sin(self.turn), lean * math.cos(self.turn), math.cos(self.tilt))


class JointAngles(Named):
    """The six joints, as named and displayed on the teach pendant."""

    base: Angle
    """Joint 1."""

    shoulder: Angle
    """Joint 2."""

    elbow: Angle
    """Joint 3."""

    wrist1: Angle
    """Joint 4."""

    wrist2: Angle
    """Joint 5."""

    wrist3: Angle
    """Joint 6."""

    @property
    def angles(self) -> Joints:
        """All angles [rad]."""
        return (self.base, self.shoulder, self.elbow, self.wrist1, self.wrist2, self.wrist3)


class Box(Settings):
    """A box along the axes of the gravity-aligned base frame."""

    low: Annotated[Point, Example("{x: 300 mm, y: -500 mm, z: 0 mm}")]
    """Corner with the smallest x, y and z."""

    high: Annotated[Point, Example("{x: 1000 mm, y: 500 mm, z: 800 mm}")]
    """Corner with the largest x, y and z."""

    @property
    def corners(self) -> list[tuple[float, ...]]:
        """All eight corners [m]."""
        return list(itertools.product(*zip(self.low.vector, self.high.vector, strict=True)))


class Plane(Settings):
    """A plane that must not be crossed: normal · point ≥ offset."""

    normal: Annotated[tuple[Number, Number, Number], Example("[0, 1, 0]")]
    """Direction towards the allowed side, in the gravity-aligned base frame; its length does not matter."""

    offset: Annotated[Length, Example("-400 mm")]
    """Distance of the plane from the base, along the normal."""

    @field_validator("normal", mode="after")
    @classmethod
    def _unit(cls, normal: Vector | None) -> Vector | None:
        """The normal with length 1; one that has no direction is unchanged, and reported by `check_values`."""
        length = 0.0 if normal is None else math.sqrt(sum(v * v for v in normal))
        if normal is None or length < 1e-6 or abs(length - 1.0) < 1e-12:  # the last bit is kept
            return normal
        return (normal[0] / length, normal[1] / length, normal[2] / length)

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if problems.valid("normal") and math.hypot(*self.normal) < 1e-6:
            problems.add("has no direction; write for example [0, 1, 0]", "normal")


class ArmLimits(Settings):
    """Limits of the arm in this cell. Checked before a pour is planned, and again before any motion."""

    box: Annotated[Box, Example("{low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}")]
    """Box that must contain tool and pourer."""

    planes: tuple[Plane, ...] = ()
    """Planes that tool and pourer must not cross."""

    joint_speed: Speed = math.radians(150.0)
    """Maximum speed of any joint; the robot's own limits apply as well."""

    tool_speed: Annotated[float, Quantity("m/s", "1000 mm/s", 0.0, 3.0, positive=True)] = 1.0
    """Maximum speed of the tool centre point and of any point of the pourer."""

    tilt: Annotated[float, Quantity("rad", "140 deg", 0.0, math.pi, positive=True)] = math.radians(140.0)
    """Maximum tilt of the pourer."""

    tilt_speed: Speed = math.radians(130.0)
    """Maximum angular velocity of the pourer."""

    singularity: Annotated[float, Quantity("1", "0.1", 0.02, 0.9)] = 0.1
    """Minimum distance from singular poses: sine of wrist and elbow, shoulder over reach."""

    clearance: Annotated[float, Quantity("m", "5 mm", 0.0, 0.012)] = 5e-3
    """Minimum distance between the pourer and the receiver."""


class RobotCell(Settings):
    """Objects around the arm."""

    receiver: Annotated[Point, Example("{x: 650 mm, y: 0 mm, z: 80 mm}")]
    """Position of the middle of the receiver's underside, in the gravity-aligned base frame."""

    direction: Annotated[Angle, Example("90 deg")]
    """Pouring direction seen from above: 0 along the x axis of the base frame, 90 deg along its y axis."""

    table: Length = 0.0
    """Height of the surface below which nothing may move, in the gravity-aligned base frame."""
