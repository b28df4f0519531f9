"""What a driver knows of its robot, for people and for records."""

from __future__ import annotations

from dataclasses import dataclass, field

from actors.arm.geometry import Joints, Pose, Vector
from actors.arm.protocol import ArmFacts
from actors.arm.ur.messages import ROBOT_MODES, SAFETY_MODES, Facts, why_not_ready


@dataclass(frozen=True)
class UrFacts(ArmFacts):
    """A robot as its controller tells of it.

    Attributes:
        checksum: of the safety configuration, eight hexadecimal digits; '' if it isn't told.
        robot_mode, safety_mode: in words; 'running' and 'normal' if it could move.
        remote: remote control is on; None where the controller knows no such thing.
        tool: TCP in the flange's frame, as set at present.
        payload: as set at present [kg]; `payload_centre` [m].
        joints: measured [rad].
        slider: 0 … 1.
        program: state and name of the controller's program.
        joint_ranges: lowest and highest of each joint [rad], as configured; empty if they aren't told.
        joint_speeds: likewise [rad/s].
    """

    robot_mode: str = ""
    safety_mode: str = ""
    remote: bool | None = None
    tool: Pose = field(default_factory=Pose)
    payload: float = 0.0
    payload_centre: Vector = (0.0, 0.0, 0.0)
    joints: Joints = (0.0,) * 6
    slider: float = 1.0
    program: str = ""
    joint_ranges: tuple[tuple[float, float], ...] = ()
    joint_speeds: tuple[float, ...] = ()

    @property
    def e_series(self) -> bool:
        """Whether the robot is of the generation after CB3."""
        return int(self.version.split(".")[0]) >= 5


def facts_of(told: Facts) -> UrFacts:
    """As a worker has found out."""
    r = told.reading
    a, b, c, d, e, f = r.joints
    x, y, z = r.centre
    return UrFacts(
        model=told.model,
        serial=told.serial,
        version=".".join(map(str, told.version)),
        problem=why_not_ready(r.robot_mode, r.safety_mode, r.runtime, r.slider),
        robot_mode=ROBOT_MODES.get(r.robot_mode, str(r.robot_mode)),
        safety_mode=SAFETY_MODES.get(r.safety_mode, str(r.safety_mode)),
        remote=told.remote,
        checksum=told.checksum,
        tool=Pose(*told.tool),
        payload=r.payload,
        payload_centre=(x, y, z),
        joints=(a, b, c, d, e, f),
        slider=r.slider,
        program=told.program,
        joint_ranges=told.ranges,
        joint_speeds=told.speeds,
    )
