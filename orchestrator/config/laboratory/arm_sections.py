"""What may be written under `arm` and `cell` in a laboratory's file.

Units are those of the teach pendant: mm, deg, kg; rotation vectors in rad.
"""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal

from actors.arm.geometry import ArmLimits, Cell
from actors.arm.spec import UrArmSpec
from orchestrator.config.laboratory.arms import ArmSettings
from orchestrator.config.laboratory.cell import Angle, CellSection, Length, PointSection
from orchestrator.config.yaml.quantities import Quantity
from orchestrator.config.yaml.sections import Number, Section, Text
from orchestrator.config.yaml.source import Place, Report

_LIMITS = ArmLimits((0.0,) * 3, (0.0,) * 3)
_ARM = UrArmSpec("ur10e", _LIMITS, Cell((0.0,) * 3), (0.0,) * 6)

JOINTS = ("base", "shoulder", "elbow", "wrist1", "wrist2", "wrist3")
"""As the teach pendant names them."""

Turn = Annotated[float, Quantity("rad", "1.571 rad", -2.0 * math.pi, 2.0 * math.pi)]
Speed = Annotated[float, Quantity("rad/s", "40 deg/s", 0.0, math.radians(360.0), positive=True)]
Acceleration = Annotated[float, Quantity("rad/s^2", "80 deg/s^2", 0.0, math.radians(2000.0), positive=True)]


class CentreSection(Section):
    """A point in the flange's frame."""

    x: Length = 0.0
    """The x in the flange's frame."""

    y: Length = 0.0
    """The y in the flange's frame."""

    z: Length = 0.0
    """Out of the flange."""


class PoseSection(Section):
    """Where a frame stands in another, as the teach pendant shows it: place and rotation vector."""

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


class MountSection(Section):
    """How the robot is screwed down: turned about its own z axis, then leant about the room's x axis."""

    tilt: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """0 on a table, 90 deg on a wall, 180 deg on a ceiling."""

    turn: Annotated[float, Quantity("rad", "90 deg", -math.pi, math.pi)] = 0.0
    """About its own z axis."""


class JointsSection(Section):
    """The six joints, as the teach pendant names and shows them."""

    required: ClassVar[dict[str, str]] = dict.fromkeys(JOINTS, "90 deg")

    base: Angle | None = None
    """Joint 1."""

    shoulder: Angle | None = None
    """Joint 2."""

    elbow: Angle | None = None
    """Joint 3."""

    wrist1: Angle | None = None
    """Joint 4."""

    wrist2: Angle | None = None
    """Joint 5."""

    wrist3: Angle | None = None
    """Joint 6."""


class BoxSection(Section):
    """A box along the room's axes."""

    required: ClassVar[dict[str, str]] = {
        "low": "{x: 300 mm, y: -500 mm, z: 0 mm}",
        "high": "{x: 1000 mm, y: 500 mm, z: 800 mm}",
    }

    low: PointSection | None = None
    """Corner with the smallest x, y and z."""

    high: PointSection | None = None
    """Corner with the largest."""


class PlaneSection(Section):
    """A plane that must not be crossed."""

    required: ClassVar[dict[str, str]] = {"normal": "[0, 1, 0]", "offset": "-400 mm"}

    normal: tuple[Number, Number, Number] | None = None
    """Direction towards the allowed side, in the room's frame; its length does not matter."""

    offset: Length | None = None
    """Distance of the plane from the base, along the normal."""


class LimitsSection(Section):
    """What the arm may do here. Checked before a pour is planned, and again before anything moves."""

    required: ClassVar[dict[str, str]] = {"box": "{low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}"}

    box: BoxSection | None = None
    """The box that tool and pourer stay in."""

    planes: tuple[PlaneSection, ...] = ()
    """Planes that tool and pourer stay on one side of."""

    joint_speed: Speed = _LIMITS.joint_speed
    """Largest speed of any joint; the robot's own limits hold besides."""

    tool_speed: Annotated[float, Quantity("m/s", "1000 mm/s", 0.0, 3.0, positive=True)] = _LIMITS.tool_speed
    """Largest speed of the tool centre point and of any point of the pourer."""

    tilt: Annotated[float, Quantity("rad", "140 deg", 0.0, math.pi, positive=True)] = _LIMITS.tilt
    """Largest tilt of the pourer."""

    tilt_speed: Speed = _LIMITS.tilt_speed
    """Largest angular velocity of the pourer."""

    singularity: Annotated[float, Quantity("1", "0.1", 0.02, 0.9)] = _LIMITS.singularity
    """How far to stay from poses in which the arm loses a direction: sine of wrist and elbow, shoulder over reach."""

    clearance: Annotated[float, Quantity("m", "5 mm", 0.0, 0.012)] = _LIMITS.clearance
    """Between the pourer and the receiver."""


class UrArmSection(ArmSettings):
    """A UR arm that holds the pourer."""

    required: ClassVar[dict[str, str]] = {
        "model": "ur10e",
        "tool": "{z: 180 mm}",
        "payload": "1.5 kg",
        "grip": "{x: 60 mm, rx: 1.571 rad}",
        "home": "{base: 0 deg, shoulder: -90 deg, elbow: 90 deg, wrist1: 0 deg, wrist2: -90 deg, wrist3: 0 deg}",
        "limits": "{box: {low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}}",
    }

    kind: Literal["ur"] = "ur"
    """A UR robot; meant where there is no such key."""

    model: Literal["ur10", "ur10e"] | None = None
    """Which robot."""

    address: Text | None = None
    """Address of its controller in the network; a virtual laboratory starts its own."""

    mount: MountSection = MountSection()
    """How the robot is screwed down; unless given, it stands on a table."""

    tool: PoseSection | None = None
    """Tool centre point in the flange's frame, as set on the teach pendant."""

    payload: Annotated[float, Quantity("kg", "1.5 kg", 0.0, 12.5)] | None = None
    """Mass of gripper and filled pourer, as set on the teach pendant."""

    payload_centre: CentreSection = CentreSection()
    """Their centre of gravity in the flange's frame."""

    grip: PoseSection | None = None
    """The pourer in the frame of the tool centre point: its underside's middle, z out of its opening, liquid leaves towards x."""  # noqa: E501

    home: JointsSection | None = None
    """Where the arm waits, the pourer upright."""

    limits: LimitsSection | None = None
    """What the arm may do here."""

    approach_speed: Speed = _ARM.approach_speed
    """Speed of the fastest joint between home and pour."""

    approach_acceleration: Acceleration = _ARM.approach_acceleration
    """Acceleration of the fastest joint there."""

    untilt_speed: Speed = _ARM.untilt_speed
    """The speed at which a stopped, tilted pourer is brought upright."""

    announcement: Annotated[float, Quantity("s", "3 s", 0.0, 60.0)] = _ARM.announcement
    """From the operator's consent to the first movement."""

    rate: Annotated[float, Quantity("1/s", "125 Hz", 100.0, 500.0)] = _ARM.rate
    """The rate at which the joints are read back."""

    def resolve(self, cell: CellSection | None, place: Place, report: Report, *, mode: str) -> UrArmSpec | None:
        """See `ArmSettings.resolve`."""
        from orchestrator.config.laboratory.arm import resolve_arm

        return resolve_arm(self, cell, place, report, mode=mode)
