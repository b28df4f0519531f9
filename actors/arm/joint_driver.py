"""The driver of any arm that follows joints: `JointArm`. The author of an arm writes a `JointRobot`, five short calls.

`JointArm` is an `actors.arm.arm_interface.Arm`: consent, checks, motions, stops, the way back, steps by hand. A robot
that takes joint speeds (`VelocityRobot`) is driven by `VelocityArm`, which also pours wanted amounts.

Everything is measured on the robot's own clock, so that an emulator that is slower than real time changes nothing.
"""

from __future__ import annotations

import contextlib
import math
import threading
import time
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.arm.arm_interface import (
    ArmFacts,
    ArmLostError,
    ArmNotReleasedError,
    ArmPose,
    ArmRefusedError,
    ArmState,
    ArmStoppedError,
)
from actors.arm.joint_arm import JointArmSettings
from actors.arm.planned_pour import ExecutedPath, JointPath, PlaceWay, PourPath
from actors.arm.planning.kinematics import cell_transforms, pourer_motion
from actors.arm.planning.motion_segments import (
    UPRIGHT,
    MotionSegment,
    jog_path,
    leans,
    rejoin,
    upright_way,
    way_home,
)
from actors.arm.planning.path_checks import recheck
from actors.arm_geometry import Pose
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import device_clock

FloatArray = NDArray[np.float64]

PERIOD = 0.01
"""Time between two readings during a motion [s of the clock]."""

AT_START = 0.03
"""Largest distance of a joint from the first point of a path that begins [rad]."""

AT_END = 0.01
"""Largest distance of a joint from the last point of a path that has ended [rad]."""

SETTLING = 2.0
"""Longest time from the end of a path to rest [s of the robot's clock]."""

STANDING = 4e-3
"""Joints that change by less than this per second stand still [rad/s]."""

SILENCE = 0.5
"""Time without a newer reading after which a robot counts as lost [s of the clock]."""

LATEST = 0.02
"""Time within which a driver reads again during a motion; the clock of a virtual bench waits for it [s]."""

GAIN = 8.0
"""Speed that corrects a joint per distance from its path [1/s]."""

LARGEST_DRIFT = 0.05
"""Largest speed of a joint that is added in a dose because the robot drifts at rest [rad/s]."""

HOLD = 0.15
"""Time for which a robot keeps a commanded speed without a newer command [s]."""

SHORTEST = 5e-3
"""Least time for which a commanded speed is meant [s]."""

TILT_ACCELERATION = 10.0
"""Acceleration of the tilt in a dose [rad/s²]."""


@dataclass(frozen=True)
class JointReading:
    """A robot's measured state.

    Attributes:
        time: on the robot's clock [s].
        joints: shape (n,) [rad].
        problem: why it does not move, and what to do; '' if it can move.
        kind: of that problem, see `ArmStoppedError`.
    """

    time: float
    joints: FloatArray
    problem: str = ""
    kind: str = "protective stop"


class _Robot(Protocol):
    """What `JointRobot` and `VelocityRobot` share. Every call raises ConnectionError if it cannot be reached."""

    def connect(self) -> ArmFacts:
        """Connect, again if it was connected before. Nothing moves."""
        ...

    def read(self) -> JointReading:
        """The measured state; also during a motion."""
        ...

    def halt(self) -> None:
        """Stop at once and stand; also from another thread, and if nothing moves."""
        ...

    def close(self) -> None:
        """Disconnect. May be called again."""
        ...


class JointRobot(_Robot, Protocol):
    """What a robot does for `JointArm`. Every call raises ConnectionError if the robot cannot be reached."""

    def begin(self, path: JointPath) -> None:
        """Begin to follow joints over time, linear in between, from where the robot stands; returns at once."""
        ...


class VelocityRobot(_Robot, Protocol):
    """A robot that takes joint speeds; see `VelocityArm`.

    If it has a method `pours`, that is called before each motion: with the pour on whose path the cup is tilted, or
    with None. Such a robot brings the cup upright by itself once its driver is gone.
    """

    def turn(self, speeds: FloatArray, seconds: float) -> None:
        """Turn the joints at speeds (n,) [rad/s] until the next call, for so long at most [s], and then stand."""
        ...


@dataclass(frozen=True)
class _Ended:
    """See `actors.arm.planning.motion_segments.Ending`."""

    kind: str
    text: str
    clock: float
    joints: tuple[float, ...]
    standing: float | None = 0.0


_Move = Callable[[list[float], list[FloatArray]], _Ended | None]


# The members of the whole arm interface that are the same for a UR's motion programs and for joint trajectories.
class JointMotions(ABC):
    """Which motions an arm with joints makes, with whose consent: what all drivers share.

    Args:
        spec: settings of the arm.
    """

    def __init__(self, spec: JointArmSettings) -> None:
        self._spec = spec
        self._working = threading.Lock()
        self._released_at: float | None = None
        self._last_pour: PourPath | None = None

    # ---- what a driver adds

    @abstractmethod
    def joints(self) -> tuple[float, ...]:
        """Measured joints [rad]."""

    @abstractmethod
    def _measured(self) -> FloatArray:
        """The same, of an arm that this thread is at work with, shape (n,)."""

    @abstractmethod
    def _go(self, segment: MotionSegment) -> ExecutedPath:
        """Execute one motion to its end, with consent."""

    @abstractmethod
    def _fail(self) -> None:
        """Lock the arm after an error, and show it as stopped."""

    def _check_plan(self, path: PourPath | PlaceWay) -> None:  # noqa: B027
        """Refuse a path that was planned for another robot."""

    # ---- motions

    def where(self) -> ArmPose:
        """See `Arm.where`."""
        from scipy.spatial.transform import Rotation

        joints = self.joints()
        rotation, position = self._spec.kinematics.forward(np.array(joints))
        tool = cell_transforms(self._spec).tool
        x, y, z = map(float, position + rotation @ tool.position)
        rx, ry, rz = map(float, Rotation.from_matrix(rotation @ tool.rotation).as_rotvec())
        return ArmPose(Pose.of(x, y, z, rx, ry, rz), joints, self._spec.home_joints)

    def pace(self, time_scale: float) -> None:
        """Set the bench seconds per second of the clock, of a virtual bench."""
        self._spec = self._spec.with_values(time_scale=time_scale)

    def release(self, warned: bool = False) -> None:
        """See `Arm.release`; `warned`: the next motion begins at once."""
        self._released_at = time.monotonic() - (self._spec.warning_time if warned else 0.0)

    def move_to_start(self, path: PourPath) -> None:
        """See `Arm.move_to_start`."""
        with self._at_work("moving"):
            self._check_plan(path)
            self._go(MotionSegment.of("approach", path.approach, self._spec))

    def execute(self, path: PourPath) -> ExecutedPath:
        """See `Arm.execute`."""
        with self._at_work("pouring"):
            self._check_plan(path)
            self._last_pour = path
            return self._go(MotionSegment.of_pour(path))

    def retreat(self, path: PourPath | PlaceWay) -> None:
        """See `Arm.retreat`."""
        with self._at_work("retreating"):
            self._consent()
            self._go(MotionSegment.of("retreat", way_home(path, self._measured(), self._spec), self._spec))
            self._released_at = None

    def carry(self, way: PlaceWay) -> None:
        """See `CarryingArm.carry`."""
        with self._at_work("carrying"):
            self._check_plan(way)
            self._go(MotionSegment.of("carry", way.retreat if way.homewards else way.approach, self._spec))

    def untilt(self, path: PourPath | None = None) -> None:
        """See `Arm.untilt`."""
        with self._at_work("un-tilting"):
            self._consent()
            poured = path or self._last_pour
            if poured is None:
                raise ArmRefusedError("no pour is known that was stopped; bring the pourer upright at the robot")
            self._last_pour = poured
            way, tilts = upright_way(poured, self._measured(), self._spec)
            self._go(MotionSegment(way, (("untilt", 0.0, way.duration),), tilts))
            self._released_at = None

    def jog(self, axis: str, amount: float, speed: float) -> None:
        """See `Arm.jog`; at most 10° or 50 mm."""
        with self._at_work("jogging"):
            self._consent()
            way = jog_path(self._spec, self._measured().tolist(), axis, amount, speed)
            self._go(MotionSegment.of("jog", way, self._spec))
            self._released_at = None

    # ---- implementation

    @contextlib.contextmanager
    def _at_work(self, doing: str) -> Iterator[None]:
        if not self._working.acquire(timeout=0.5):
            raise ArmRefusedError(f"the arm is busy; {doing} has to wait")
        try:
            yield
        except ArmNotReleasedError:
            raise
        except LaboratoryError:
            self._fail()
            raise
        finally:
            self._working.release()

    def _consent(self) -> float:
        if self._released_at is None:
            raise ArmNotReleasedError("the arm is locked: an operator has to release it before it moves")
        return self._released_at


class JointArm(JointMotions):
    """The driver of an arm with joints; see `actors.arm.arm_interface.Arm`.

    Args:
        spec: its settings.
        robot: makes the robot from the settings.
    """

    def __init__(self, spec: JointArmSettings, robot: Callable[[Any], JointRobot | VelocityRobot]) -> None:
        super().__init__(spec)
        self.robot = robot(spec)
        self._stops = self._stops_before = 0
        self._asked = threading.Condition()
        self._facts: ArmFacts | None = None
        self._clock = device_clock(spec.clock)
        self._state = ArmState()

    # ---- nothing moves

    def connect(self) -> ArmFacts:
        """See `Arm.connect`."""
        self._released_at = None
        with self._at_work("connecting"):
            self._facts = self.robot.connect()
            self._read()
            return self._facts

    def facts(self) -> ArmFacts:
        """See `Arm.facts`."""
        with self._at_work("asking for facts"):
            if self._facts is None:
                raise ArmLostError("the arm is not connected; connect first")
            return replace(self._facts, problem=self._read().problem)

    def hands_in(self) -> None:
        """See `Arm.hands_in`."""
        self._released_at = None
        with self._at_work("being made safe"):
            self.robot.halt()
            self._read()

    def release(self, warned: bool = False) -> None:
        """See `Arm.release`."""
        super().release(warned)
        self._state = replace(self._state, stopped=False)

    def recover(self) -> str:
        """See `Arm.recover`; a robot with the method `recover` is asked to."""
        self._consent()
        self._released_at = None
        with self._at_work("recovering"):
            self.robot.connect()
            done: str = getattr(self.robot, "recover", str)()
            if problem := self._read().problem:
                raise ArmRefusedError(problem)
            self._state = replace(self._state, stopped=True)
            return done

    def state(self) -> ArmState:
        """See `Arm.state`."""
        return self._state

    def joints(self) -> tuple[float, ...]:
        """See `JointMotions.joints`."""
        with self._at_work("asking where it is"):
            return tuple(self._measured().tolist())

    # ---- the end

    def stop(self) -> float:
        """See `Arm.stop`."""
        asked, moved = time.monotonic(), self._state.moving
        self._released_at = None
        self._state = replace(self._state, stopped=True)
        with self._asked:
            self._stops += 1
            self._asked.notify_all()
        if moved and not self._turns_back:
            with contextlib.suppress(ConnectionError):
                self.robot.halt()
        with self._working:  # the motion has ended, and the arm stands
            self._state = replace(self._state, moving=False, stopped=True)
        return time.monotonic() - asked if moved else 0.0

    def close(self) -> None:
        """See `Arm.close`."""
        if self._state.moving:
            self.stop()
        self._released_at = None
        self.robot.close()

    # ---- implementation

    _last_time = 0.0

    _longest_gap = math.inf
    """Longest time between two readings of a motion that does not end it [s of the robot's clock]."""

    _after_loss = "The robot may go on to the end of its motion"
    """What a robot does whose driver can't reach it."""

    @property
    def _ordered(self) -> int:
        """Number of stops that were ordered since the motion began."""
        return self._stops - self._stops_before

    @property
    def _turns_back(self) -> bool:
        """Whether the motion ends by itself after a stop, with an upright cup."""
        return False

    @contextlib.contextmanager
    def _at_work(self, doing: str) -> Iterator[None]:
        with super()._at_work(doing):
            try:
                yield
            except ConnectionError as error:
                raise ArmLostError(f"{error}. {self._after_loss}; look at it") from error

    def _fail(self) -> None:
        self._released_at = None
        self._state = replace(self._state, moving=False, stopped=True)

    def _measured(self) -> FloatArray:
        return self._read().joints

    def _read(self) -> JointReading:
        reading = self.robot.read()
        self._last_time = reading.time
        self._show(reading)
        return reading

    def _show(self, reading: JointReading, **motion: Any) -> None:
        """Report a reading, at once with how far the motion is: a tilt of another time would be a jump."""
        motion = {"tilt": float(leans(reading.joints[None], self._spec)[0]), **motion}
        self._state = replace(self._state, joints=tuple(reading.joints.tolist()), **motion)

    def _go(self, segment: MotionSegment, move: _Move | None = None) -> ExecutedPath:
        """Execute one motion to its end.

        Args:
            segment: the motion.
            move: moves the arm and collects times and joints, for another motion than following the segment's path: a
                dose.
        """
        self._stops_before = self._stops  # before consent is checked, so that a stop in between counts
        released, path = self._consent(), segment.path
        if segment.name != "jog":  # a jog has its own checks, since it may be the way back inside the limits
            recheck(path, self._spec)
        self._check_start(segment)
        until = released + self._spec.on_clock(self._spec.warning_time)
        with self._asked:
            if self._asked.wait_for(lambda: self._ordered > 0, max(until - time.monotonic(), 0.0)):
                raise ArmStoppedError("stopped before it moved", "operator", "announced", 0.0, segment.tilt(0.0))
        start = self._check_start(segment)  # the arm may have been moved meanwhile; and its motion counts from here
        times, joints = [0.0], [start.joints]
        self._state = replace(
            self._state, moving=True, phase="dose" if move else segment.phase(0.0), time=0.0, fraction=0.0
        )
        try:
            ended = self._follow(segment, times, joints) if move is None else move(times, joints)
        except BaseException as error:
            with contextlib.suppress(ConnectionError):
                self.robot.halt()
            if isinstance(error, ConnectionError):
                raise ArmLostError(
                    f"{error}. {segment.last_seen(times[-1])}", self._executed(times, joints, False)
                ) from error
            raise
        finally:
            self._clock.withdraw("arm")
            self._state = replace(self._state, moving=False, phase="idle")
        executed = self._executed(times, joints, ended is None)
        if ended is None:
            return executed
        self._fail()
        if move is None:
            raise segment.stopped(ended, executed)
        raise ArmStoppedError(f"dose: {ended.text}", ended.kind, "dose", ended.clock, self._state.tilt, executed)

    def _check_start(self, segment: MotionSegment) -> JointReading:
        reading = self._read()
        if reading.problem:
            raise ArmRefusedError(reading.problem)
        if (apart := float(np.abs(reading.joints - segment.path.joints[0]).max())) > AT_START:
            raise ArmRefusedError(
                f"a joint is {np.degrees(apart):.1f}° away from where the {segment.name} begins; bring the arm there "
                "with 'decant robot home'"
            )
        return reading

    def _readings(self, times: list[float], joints: list[FloatArray]) -> Iterator[JointReading]:
        """Readings of a motion, each newer than the one before; their times count from its begin."""
        begun, arrived = self._last_time, self._clock.now
        while True:
            reading = self.robot.read()
            self._last_time, now = reading.time, reading.time - begun
            if now > times[-1]:
                times.append(now)
                joints.append(reading.joints)
                arrived = self._clock.now
                self._clock.promise("arm", self._spec.on_clock(LATEST))
                yield replace(reading, time=now)
            elif self._clock.now - arrived > SILENCE:
                raise ConnectionError("the robot reports nothing new")
            time.sleep(PERIOD)

    def _begin(self, path: JointPath) -> None:
        self.robot.begin(path)  # type: ignore[union-attr]  # `VelocityArm` overrides this

    def _steer(self, path: JointPath, reading: JointReading) -> None:
        """Called for each reading of a path."""

    def _follow(self, segment: MotionSegment, times: list[float], joints: list[FloatArray]) -> _Ended | None:
        path, reason, before = segment.path, ("", ""), 0.0
        self._begin(path)
        for reading in self._readings(times, joints):
            now, clock = reading.time, min(reading.time, path.duration)
            self._show(reading, time=now, fraction=clock / path.duration, phase=segment.phase(clock))
            held_up = now - before
            before = now
            if not reason[0] and (self._ordered or reading.problem or held_up > self._longest_gap):
                if self._ordered:
                    reason = "operator", "stopped by the operator"
                elif reading.problem:
                    reason = reading.kind, reading.problem
                else:
                    reason = "watchdog", f"this computer was held up for {held_up:.2f} s, and the arm stood meanwhile"
                ended_at = clock
                self.robot.halt()
            standing = _stand(times, joints)
            if reason[0]:
                if standing or now > ended_at + SETTLING:
                    return _Ended(*reason, ended_at, tuple(joints[-1].tolist()))
                continue
            apart = path.at(np.array([clock]))[0] - reading.joints
            if now >= path.duration and standing and np.abs(apart).max() < AT_END:
                self.robot.halt()
                return None
            if now > path.duration + SETTLING:
                self.robot.halt()
                away = f"the arm ended {np.degrees(np.abs(apart).max()):.1f}° away from the end of its path"
                return _Ended("program ended", away, path.duration, tuple(joints[-1].tolist()))
            self._steer(path, reading)
        raise AssertionError("readings do not end")

    def _executed(self, times: list[float], joints: list[FloatArray], completed: bool) -> ExecutedPath:
        if len(times) < 2:
            return ExecutedPath(np.zeros(0), np.zeros((0, len(self._spec.home_joints))), False)
        moments, measured = np.array(times), np.array(joints)
        poses = pourer_motion(measured, moments, self._spec).poses
        tracking = {"longest_gap": float(np.diff(moments).max())}
        return ExecutedPath(moments, measured, completed, tracking, poses)


@dataclass
class _Dose:
    """The motion of a dose: tilts (T,) [rad] with joints (T, n) [rad], and what `drive` asked for last."""

    tilts: FloatArray
    joints: FloatArray
    fastest: float
    speed: float = 0.0
    highest: float = 0.0
    until: float = 0.0

    def at(self, tilt: float) -> tuple[FloatArray, FloatArray]:
        """Joints at a tilt, and their change per tilt."""
        near = np.clip([tilt - 1e-3, tilt + 1e-3], self.tilts[0], self.tilts[-1])
        joints = [np.array([np.interp(t, self.tilts, column) for column in self.joints.T]) for t in (*near, tilt)]
        return joints[2], (joints[1] - joints[0]) / (near[1] - near[0])


def speeds_along(path: JointPath, time: float, span: float, joints: FloatArray) -> FloatArray:
    """Speeds that keep joints on a path until about the next command, shape (n,) [rad/s].

    Args:
        path: to be followed.
        time: on the path [s].
        span: time since the last command [s].
        joints: measured, shape (n,) [rad].
    """
    span = min(max(span, SHORTEST), LATEST)
    here, ahead = path.at(np.array([time, time + span]))
    speeds: FloatArray = (ahead - here) / span + GAIN * (here - joints)
    return speeds


class VelocityArm(JointArm):
    """The driver of an arm that takes joint speeds: it follows paths, and pours wanted amounts (`DosingArm`).

    Args:
        spec: its settings.
        robot: makes the robot from the settings.
    """

    def __init__(self, spec: JointArmSettings, robot: Callable[[Any], VelocityRobot]) -> None:
        super().__init__(spec, robot)
        self._robot: VelocityRobot = self.robot  # type: ignore[assignment]
        self._fastest = np.array(spec.kinematics.joint_speed)
        self._dose: _Dose | None = None

    _longest_gap = 0.2
    _after_loss = "The robot stops by itself"

    @property
    def _turns_back(self) -> bool:
        return self._dose is not None and self._ordered == 1

    def _begin(self, path: JointPath) -> None:
        self._steered_at = 0.0

    def _steer(self, path: JointPath, reading: JointReading) -> None:
        speeds = speeds_along(path, reading.time, reading.time - self._steered_at, reading.joints)
        self._steered_at = reading.time
        self._robot.turn(np.clip(speeds, -self._fastest, self._fastest), HOLD)

    def _go(self, segment: MotionSegment, move: _Move | None = None) -> ExecutedPath:
        self._consent()
        if (pours := getattr(self._robot, "pours", None)) is not None:
            pours(self._last_pour if segment.tilts.max() > UPRIGHT else None)
        return super()._go(segment, move)

    def dose(self, path: PourPath, longest: float) -> ExecutedPath:
        """See `DosingArm.dose`."""
        with self._at_work("dosing"):
            self._last_pour = path
            tilts, joints = path.tilt_part
            self._dose = _Dose(tilts, joints, path.report.tilt_speed)
            try:
                return self._go(MotionSegment.of_pour(path), partial(self._pour_dose, self._dose, longest))
            finally:
                self._dose = None

    def drive(self, speed: float, highest: float, patience: float) -> ArmState:
        """See `DosingArm.drive`."""
        if (dose := self._dose) is not None:
            dose.speed, dose.highest = speed, min(max(highest, float(dose.tilts[0])), float(dose.tilts[-1]))
            dose.until = self._last_time + patience
        return self._state

    def _pour_dose(self, dose: _Dose, longest: float, times: list[float], joints: list[FloatArray]) -> _Ended | None:
        first, last = float(dose.tilts[0]), float(dose.tilts[-1])
        track = JointPath(dose.tilts - first, dose.joints)
        tilt, speed, before, late = first, 0.0, 0.0, False
        drift = np.zeros(len(self._fastest))  # a dose creeps from the measured tilt on: a lasting error would stop it
        dose.until = self._last_time + 1.0  # the first command may take a while
        for reading in self._readings(times, joints):
            span, before = reading.time - before, reading.time
            late = late or span > self._longest_gap
            if reading.problem or self._ordered > 1:
                self.robot.halt()
                if reading.problem:
                    return _Ended(reading.kind, reading.problem, before, tuple(joints[-1].tolist()))
                if _stand(times, joints):
                    return _Ended("operator", "stopped by the operator", before, tuple(joints[-1].tolist()))
                continue
            back = late or self._ordered > 0 or self._last_time > dose.until or before > longest
            wanted = -dose.fastest if back else min(max(dose.speed, -dose.fastest), dose.fastest)
            room, way = max((last if back else dose.highest) - tilt, 0.0), max(tilt - first, 0.0)
            wanted = min(wanted, (2.0 * 0.8 * TILT_ACCELERATION * room) ** 0.5)
            wanted = max(wanted, -((2.0 * 0.8 * TILT_ACCELERATION * way) ** 0.5))
            step = TILT_ACCELERATION * min(span, LATEST)
            speed = min(max(wanted, speed - step), speed + step)
            tilt = min(max(tilt + speed * min(span, LATEST), first), last)
            here, per_tilt = dose.at(tilt)
            error = here - reading.joints
            drift = np.clip(drift + (0.5 * GAIN) ** 2 * min(span, LATEST) * error, -LARGEST_DRIFT, LARGEST_DRIFT)
            speeds = np.clip(per_tilt * speed + GAIN * error + drift, -self._fastest, self._fastest)
            # the robot itself stops at the largest tilt, however late the next command is
            left = max((last if back else dose.highest) - tilt, 0.0)
            self._robot.turn(speeds, min(HOLD, left / speed) if speed > 0.0 else HOLD)
            measured = first + rejoin(track, reading.joints)[0]
            self._show(reading, time=before, tilt=measured)
            if back and measured < first + AT_END and _stand(times, joints):
                self.robot.halt()
                if self._ordered:
                    return _Ended("operator", "stopped by the operator", before, tuple(joints[-1].tolist()))
                return None
        raise AssertionError("readings do not end")


def _stand(times: list[float], joints: list[FloatArray]) -> bool:
    """Whether the readings of the last 60 ms show an arm at rest."""
    first = next((k for k in range(len(times) - 1, -1, -1) if times[-1] - times[k] >= 0.06), None)
    if first is None:
        return False
    moved = max(float(np.abs(q - joints[-1]).max()) for q in joints[first:])
    return moved < STANDING * (times[-1] - times[first]) + 1e-6
