"""Arms that are no UR: one with an emulator, a simulated robot that takes joint speeds; and the keys of the example.

Its kinematics are in closed form, so that no package of an extra is needed.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import threading
import time
from collections.abc import Iterator
from typing import Annotated, Any, Literal

import numpy as np
import pytest
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmFacts
from actors.arm.arm_settings import ARMS, History
from actors.arm.joint_arm import ArmModel, JointArmSettings
from actors.arm.joint_arm_kind import JointArmKind
from actors.arm.joint_driver import JointReading, VelocityArm
from actors.arm.ur.robot_models import MODELS
from actors.arm.ur.ur_kinematics import kinematics_of
from actors.arm_geometry import JointAngles
from actors.laboratory_settings import LaboratorySettings
from sim_engine.settings.model import NOT_IN_FINGERPRINT, Text
from tests.support.planning_cell import SPEC

FloatArray = NDArray[np.float64]

SEVEN_JOINTS = {
    "tool": {"z": "100 mm"},
    "payload": "1.5 kg",
    "grip": {"x": "50 mm", "rx": "-1.2092 rad", "ry": "-1.2092 rad", "rz": "1.2092 rad"},
    "home": ["-25 deg", "35 deg", "0 deg", "-107 deg", "0 deg", "-52 deg", "0 deg"],
    "limits": {
        "box": {
            "low": {"x": "200 mm", "y": "-700 mm", "z": "0 mm"},
            "high": {"x": "1100 mm", "y": "700 mm", "z": "1 m"},
        }
    },
    "warning_time": "0.5 s",
}
"""Section `arm` of the example with seven joints, without its kind."""


class OtherArmSettings(JointArmSettings):
    """An arm with six joints."""

    kind: Literal["other"] = "other"
    home: JointAngles
    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""

    @property
    def kinematics(self) -> ArmModel:
        return kinematics_of(MODELS["ur10e"])

    @property
    def home_joints(self) -> tuple[float, ...]:
        return self.home.angles


class SpeedRobot:
    """Joints that turn at the speeds of the last command, for the time that it names. It keeps what it measures.

    Attributes:
        plugged: the robot can be reached.
        tripped: a protective stop is in force.
        drift: speeds that are added to those of a command (n,) [rad/s].
        stretch: longest time that passes between two measurements [s]: on a busy machine its clock slows down. The
            default is the interval at which a driver reads it on an idle one, 0.02 at most.
    """

    ACCELERATION = math.radians(2000.0)

    def __init__(self, joints: tuple[float, ...], time_scale: float) -> None:
        self._scale, self._lock = time_scale, threading.Lock()
        self._joints, self._speeds, self._wanted = np.array(joints), np.zeros(len(joints)), np.zeros(len(joints))
        self._now = self._until = 0.0
        self._seen, self.stretch = time.monotonic(), min(0.01 * time_scale, 0.02)
        self.plugged, self.tripped = True, False
        self.drift = np.zeros(len(joints))
        self.readings: list[tuple[float, FloatArray]] = []

    def measure(self) -> tuple[float, FloatArray]:
        with self._lock:
            seen = time.monotonic()
            now = self._now + min((seen - self._seen) * self._scale, self.stretch)
            self._seen = seen
            while self._now < now:
                step = min(0.002, now - self._now)
                stands = self.tripped or not self.plugged or self._now >= self._until
                change = (np.zeros(6) if stands else self._wanted) - self._speeds
                self._speeds = self._speeds + np.clip(change, -self.ACCELERATION * step, self.ACCELERATION * step)
                moved = self._speeds if stands else self._speeds + self.drift
                self._joints, self._now = self._joints + moved * step, self._now + step
            self.readings.append((now, self._joints))
            return self.readings[-1]

    def turn(self, speeds: FloatArray, seconds: float) -> None:
        with self._lock:  # from the latest measurement on, however late a busy driver sends it
            self._wanted, self._until = speeds, self._now + seconds


_robots: dict[str, SpeedRobot] = {}
_numbers = itertools.count()


class OtherRobot:
    """See `actors.arm.joint_driver.VelocityRobot`; without an address it has a robot of its own."""

    def __init__(self, spec: OtherArmSettings) -> None:
        self.cable = _robots.get(spec.address) or SpeedRobot(spec.home_joints, spec.time_scale)

    def connect(self) -> ArmFacts:
        return ArmFacts(model="other", problem=self.read().problem)

    def read(self) -> JointReading:
        moment, joints = self.cable.measure()
        if not self.cable.plugged:
            raise ConnectionError("the robot does not answer")
        return JointReading(moment, joints, "a protective stop: reset it at the robot" if self.cable.tripped else "")

    def turn(self, speeds: FloatArray, seconds: float) -> None:
        self.cable.turn(speeds, seconds)

    def halt(self) -> None:
        self.read()
        self.cable.turn(np.zeros(6), 0.0)

    def close(self) -> None:
        pass


class OtherEmulator:
    """See `actors.arm.arm_settings.ArmEmulator`."""

    def __init__(self, spec: OtherArmSettings) -> None:
        self.arm = self.true_arm = spec.with_values(address=f"robot-{next(_numbers)}")
        self.robot = _robots[self.arm.address] = SpeedRobot(spec.home_joints, spec.time_scale)

    def install(self) -> None:
        pass

    def history(self, since: float) -> History:
        now, _ = self.robot.measure()
        newest = itertools.takewhile(lambda reading: reading[0] > since, reversed(self.robot.readings))
        later = [(t, tuple(q.tolist())) for t, q in newest][::-1]
        return History(tuple(t for t, _ in later), tuple(q for _, q in later), now)

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        _, joints = self.robot.measure()
        return {"runtime_state": "STOPPED", "speeds": [0.0], "time": self.robot.readings[-1][0], "joints": joints}

    def close(self) -> None:
        pass


class OtherArmKind(JointArmKind[OtherArmSettings]):
    settings = OtherArmSettings
    doses = emulated = True

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        return VelocityArm, (self.spec, OtherRobot)

    def start_emulator(self) -> OtherEmulator:
        return OtherEmulator(self.spec)


def other_arm(**changes: Any) -> OtherArmSettings:
    """In the cell of `planning_cell`."""
    shared = {name: getattr(SPEC, name) for name in JointArmSettings.model_fields if name != "kind"}
    return OtherArmSettings.model_construct(
        **{**shared, "kind": "other", "home": SPEC.home, "address": ""}
    ).with_values(**changes)


@contextlib.contextmanager
def registered() -> Iterator[None]:
    """The kind is registered as an installed package does it, for as long as the context lasts."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(ARMS, "_content", ({**ARMS.all, "other": OtherArmKind}, (), {"other": "a test"}))
        # Kinds are read when the first settings are validated, which an earlier test has done.
        LaboratorySettings.model_rebuild(force=True)
        yield
    LaboratorySettings.model_rebuild(force=True)
