"""An arm that is none: a stand whose motor turns the pourer about its lip. Everything that an arm needs, in one file.

`Stand` is the driver, `StandSpec` its settings as values, `StandSection` what stands in a laboratory's file:

    arm: {kind: stand, fastest: 60 deg/s}
"""

from __future__ import annotations

import math
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import Annotated, Any, ClassVar, Literal

import numpy as np

from actors.arm.errors import ArmNotReleasedError, ArmRefusedError, ArmStoppedError
from actors.arm.geometry import Pose
from actors.arm.motion_path import ExecutedMotion, MotionPath
from actors.arm.protocol import ArmFacts, ArmState, Whereabouts
from actors.arm.spec import ArmSpec
from actors.bench.planning import plan_pour
from actors.protocols import InvalidActionError
from orchestrator.config.laboratory.arms import ArmSettings
from orchestrator.config.yaml.quantities import Quantity
from sim_engine.action import Action
from sim_engine.task import Scene

READINGS = 50.0
"""Readings of the motor's encoder per bench second [Hz]."""


@dataclass(frozen=True)
class StandSpec(ArmSpec):
    """A stand with a motor.

    Attributes:
        fastest: that the motor turns [rad/s].
    """

    fastest: float = math.radians(90.0)
    time_scale: float = 1.0
    announcement: float = 0.5

    kind: ClassVar[str] = "stand"

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmSpec.driver`; a stand has no safety settings that could be accepted."""
        return Stand, (self,)

    def plan(self, scene: Scene, action: Action) -> MotionPath:
        """See `ArmSpec.plan`: the motor makes any motion that isn't too fast for it."""
        path = MotionPath(plan_pour(scene, action), approach_time=1.0)
        if path.report.tilt_speed > self.fastest * 1.001:
            asked, most = math.degrees(path.report.tilt_speed), math.degrees(self.fastest)
            raise InvalidActionError(
                f"the stand turns at most at {most:.0f} deg/s (arm.fastest), {asked:.0f} deg/s are asked for"
            )
        return path


class StandSection(ArmSettings):
    """A stand whose motor turns the pourer."""

    required: ClassVar[dict[str, str]] = {"kind": "stand"}

    kind: Literal["stand"] = "stand"
    """A stand with a motor."""

    fastest: Annotated[float, Quantity("rad/s", "90 deg/s", 0.0, 10.0, positive=True)] = StandSpec.fastest
    """That its motor turns."""

    def resolve(self, cell: Any, place: Any, report: Any, *, mode: str) -> StandSpec | None:
        """See `ArmSettings.resolve`."""
        if mode == "hardware":
            report.add(place.at("arm"), "this example has no motor; write 'mode: virtual'")
            return None
        return StandSpec(fastest=self.fastest)


class Stand:
    """The driver: see `actors.arm.protocol.Arm`. Its motor is a clock here."""

    def __init__(self, spec: StandSpec) -> None:
        self._spec = spec
        self._one = threading.Lock()
        self._halt = threading.Event()
        self._free = False
        self._state = ArmState()
        self._height = 0.0

    def connect(self) -> ArmFacts:
        self._free = False
        return self.facts()

    def facts(self) -> ArmFacts:
        return ArmFacts(model="stand", serial="1")

    def hands_in(self) -> None:
        self._free = False

    def release(self) -> None:
        self._halt.clear()
        self._free = True
        self._state = replace(self._state, stopped=False)

    def state(self) -> ArmState:
        return self._state

    def where(self) -> Whereabouts:
        return Whereabouts(Pose(z=self._height))

    def move_to_start(self, path: MotionPath) -> None:
        self._way("approach", path.approach_time, lambda t: 0.0)

    def execute(self, path: MotionPath) -> ExecutedMotion:
        def phase(t: float) -> str:
            return next((name for name, _, end in path.phases if t < end), "return")

        reached = self._turn(path.pour_time, phase, lambda t: float(path.tilt(np.array([t]))[0]))
        times = np.linspace(0.0, reached, max(2, round(reached * READINGS)))
        executed = ExecutedMotion(times, path.poses(times), completed=reached >= path.pour_time)
        if not executed.completed:
            raise ArmStoppedError(
                f"stopped {reached:.1f} s into the pour",
                "operator",
                phase(reached),
                reached,
                self._state.tilt,
                executed,
            )
        return executed

    def retreat(self, path: MotionPath) -> None:
        self._way("retreat", path.retreat_time, lambda t: 0.0)
        self._free = False

    def untilt(self, path: MotionPath | None = None) -> None:
        tilt, speed = self._state.tilt, self._spec.untilt_speed
        self._way("untilt", tilt / speed, lambda t: max(tilt - speed * t, 0.0))
        self._free = False

    def recover(self) -> str:
        self._consent()
        self._free = False
        return ""

    def stop(self) -> float:
        begun, moved = time.monotonic(), self._state.moving
        self._halt.set()
        self._free = False
        with self._one:  # whatever turned has come to rest
            self._state = replace(self._state, moving=False, stopped=True)
        return time.monotonic() - begun if moved else 0.0

    def jog(self, axis: str, amount: float, speed: float) -> None:
        if axis != "z" or abs(amount) > 0.05:
            raise ArmRefusedError("a stand goes up and down, by 50 mm at most: axis 'z'")
        self._way("jog", abs(amount) / speed, lambda t: self._state.tilt)
        self._height += amount
        self._free = False

    def close(self) -> None:
        self.stop()

    def _consent(self) -> None:
        if not self._free:
            raise ArmNotReleasedError("the stand is locked: somebody has to release it before it moves")

    def _way(self, name: str, duration: float, tilt: Callable[[float], float]) -> None:
        reached = self._turn(duration, lambda t: name, tilt)
        if reached < duration:
            raise ArmStoppedError(f"stopped during {name}", "operator", name, reached, self._state.tilt)

    def _turn(self, duration: float, phase: Callable[[float], str], tilt: Callable[[float], float]) -> float:
        """Let the motor turn; how far it came [s of bench time]."""
        if not self._one.acquire(blocking=False):
            raise ArmRefusedError("the stand turns already")
        try:
            self._consent()
            begun, now = time.monotonic(), 0.0
            while now < duration and not self._halt.wait(0.01):
                now = min((time.monotonic() - begun) * self._spec.time_scale, duration)
                self._state = ArmState(True, False, now, now / duration, phase(now), tilt(now))
            self._state = ArmState(False, self._halt.is_set(), now, 1.0, "idle", tilt(now))
            return now
        finally:
            self._one.release()
