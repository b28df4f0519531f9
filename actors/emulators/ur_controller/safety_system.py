"""The safety system: its configuration with a checksum, and the active stop.

`SafetyConfiguration` holds the limits and `Safety` the state. The module moves nothing; the controller reacts to the
state.
"""

from __future__ import annotations

import json
import zlib
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from enum import IntEnum
from math import degrees

from actors.arm.ur.robot_models import Joints, RobotModel
from actors.arm_geometry import JOINT_NAMES
from actors.emulators.ur_controller.robot_kinematics import Vector

UNLOCK_DELAY = 5.0
"""Minimum time between a protective stop and its unlocking [s of controller time]."""


class SafetyMode(IntEnum):
    """Safety mode as RTDE and the dashboard report it."""

    NORMAL = 1
    REDUCED = 2
    PROTECTIVE_STOP = 3
    RECOVERY = 4
    SAFEGUARD_STOP = 5
    SYSTEM_EMERGENCY_STOP = 6
    ROBOT_EMERGENCY_STOP = 7
    VIOLATION = 8
    FAULT = 9


@dataclass(frozen=True)
class SafetyPlane:
    """A half-space: the tool centre point must satisfy normal · point ≥ offset.

    Attributes:
        normal: unit vector in the base's frame, into the allowed side.
        offset: [m].
    """

    normal: Vector
    offset: float


@dataclass(frozen=True)
class SafetyConfiguration:
    """Limits that a program cannot change.

    Attributes:
        joint_ranges: lowest and highest position of each joint [rad].
        joint_speeds: [rad/s].
        tool_speed: of the tool centre point [m/s].
        planes: the tool centre point stays on their allowed side.
    """

    joint_ranges: tuple[tuple[float, float], ...]
    joint_speeds: Joints
    tool_speed: float = 1.5
    planes: tuple[SafetyPlane, ...] = ()

    @classmethod
    def of(cls, model: RobotModel) -> SafetyConfiguration:
        """The model's own limits."""
        return cls(tuple((-r, r) for r in model.joint_range), model.joint_speed)

    @property
    def checksum(self) -> str:
        """Eight hexadecimal digits that change with any limit."""
        return f"{zlib.crc32(json.dumps(asdict(self), sort_keys=True).encode()):08X}"

    def joints_violation(self, q: Sequence[float]) -> str | None:
        """Why these joint positions are forbidden [rad]; None if they are allowed."""
        for i, (angle, (low, high)) in enumerate(zip(q, self.joint_ranges, strict=True)):
            if not low <= angle <= high:
                allowed = f"{degrees(low):.0f} … {degrees(high):.0f} deg"
                return f"{JOINT_NAMES[i]} is at {degrees(angle):.1f} deg, outside {allowed}"
        return None

    def point_violation(self, point: Vector) -> str | None:
        """Why the tool centre point is forbidden here [m]; None if it is allowed."""
        for number, plane in enumerate(self.planes):
            inside = sum(a * b for a, b in zip(plane.normal, point, strict=True)) - plane.offset
            if inside < 0.0:
                return f"the tool is {-1000.0 * inside:.1f} mm beyond safety plane {number}"
        return None


class Safety:
    """The active stop. The controller reacts to it; this class moves nothing.

    Args:
        configuration: limits.

    Attributes:
        reported_checksum: reported instead of the configuration's, if set; for tests of programs that compare it.
    """

    def __init__(self, configuration: SafetyConfiguration) -> None:
        self.configuration = configuration
        self.reported_checksum: str | None = None
        self._protective_since: float | None = None
        self._emergency: SafetyMode | None = None
        self.safeguard = False
        self.reduced = False
        self.fault = False

    @property
    def checksum(self) -> str:
        """Checksum as displayed and as sent to programs."""
        return self.reported_checksum or self.configuration.checksum

    @property
    def mode(self) -> SafetyMode:
        """The most severe active mode."""
        if self.fault:
            return SafetyMode.FAULT
        if self._emergency is not None:
            return self._emergency
        if self._protective_since is not None:
            return SafetyMode.PROTECTIVE_STOP
        if self.safeguard:
            return SafetyMode.SAFEGUARD_STOP
        return SafetyMode.REDUCED if self.reduced else SafetyMode.NORMAL

    @property
    def status_bits(self) -> int:
        """RTDE's safety_status_bits: normal, reduced, protective, recovery, safeguard, system and robot emergency, any
        emergency, violation, fault, stopped due to safety.
        """
        mode = self.mode
        bits = {SafetyMode.NORMAL: 1 << 0, SafetyMode.FAULT: 1 << 9}.get(mode, 0)
        bits |= (1 << 1) if self.reduced else 0
        bits |= (1 << 2) if self._protective_since is not None else 0
        bits |= (1 << 4) if self.safeguard else 0
        if self._emergency is not None:
            bits |= (1 << 5) if self._emergency is SafetyMode.SYSTEM_EMERGENCY_STOP else (1 << 6)
            bits |= 1 << 7
        return bits | (0 if self.may_move else 1 << 10)

    @property
    def may_move(self) -> bool:
        """Whether no stop is active."""
        return self.mode in (SafetyMode.NORMAL, SafetyMode.REDUCED)

    def protective_stop(self, now: float) -> None:
        """Begin a protective stop, or restart its time."""
        self._protective_since = now

    def unlock(self, now: float) -> str | None:
        """Unlock a protective stop. Returns why that is not possible, or None."""
        if self._protective_since is None:
            return None
        if now - self._protective_since < UNLOCK_DELAY:
            return (
                "Cannot unlock protective stop until 5s after occurrence. "
                "Always inspect cause of protective stop before unlocking"
            )
        self._protective_since = None
        return None

    def emergency_stop(self, *, system: bool = False) -> None:
        """Press the emergency stop button."""
        self._emergency = SafetyMode.SYSTEM_EMERGENCY_STOP if system else SafetyMode.ROBOT_EMERGENCY_STOP

    def release_emergency_stop(self) -> None:
        """Release the emergency stop button. Power stays off until the operator switches it on."""
        self._emergency = None
        self._protective_since = None

    def restart(self) -> None:
        """Restart after a fault or violation, as after switching on. A pressed button stays pressed."""
        self.fault = False
        self._protective_since = None
