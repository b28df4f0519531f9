"""The driver of a UR arm: plain and blocking. The arm does not move until an operator has given consent.

- `UrArm` implements `Arm`: consent, checks, and the outcomes of motions. The client library runs in a worker process
  (`actors.arm.ur.rtde_worker`).
- `AcceptedArm` is for hardware: it moves nothing under safety settings that have not been accepted.
"""

from __future__ import annotations

import contextlib
import itertools
import math
import os
import time
from dataclasses import dataclass

import numpy as np

from actors.arm.arm_interface import (
    ArmError,
    ArmLostError,
    ArmRefusedError,
    ArmState,
    ArmStoppedError,
    NotAcceptedError,
)
from actors.arm.joint_driver import JointMotions
from actors.arm.planned_pour import ExecutedPath, FloatArray, PlaceWay, PourPath
from actors.arm.planning.motion_segments import MotionSegment
from actors.arm.planning.path_checks import recheck
from actors.arm.ur.dashboard import DashboardError, stop_program
from actors.arm.ur.executed_motion import Stops, StopTimes, executed_dose, executed_path
from actors.arm.ur.robot_comparison import payload_check
from actors.arm.ur.ur_session import ANSWER_TIME, Session, UrFacts
from actors.arm.ur.urscript_writer import TiltLimits, path_program, tilt_program
from actors.arm.ur.worker_messages import (
    REDUCED,
    DataPackage,
    MotionOrder,
    MotionOutcome,
    MotionSettings,
    TiltOrder,
)
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Joints
from actors.interfaces import LaboratoryError

RECOVERY_TIME = 90.0
"""Longest wait for a robot to be made ready [s of controller time]."""

MOTION_MARGIN = 40.0
"""Time beyond twice its planned duration after which a motion's worker counts as blocked [s]."""

IN_REDUCED_MODE = 0.25
"""Fraction of the speed of a motion in reduced mode: 100 mm/s at most, and below the speeds that installations limit
it to."""

RETURNS = ("retreat", "untilt")
"""Motions that carry and pour nothing: they are allowed in reduced mode, where they are slowed."""

STOP_TIME = 1.0
"""Time for each means of stopping before the next one is tried [s]."""

UPRIGHT_TIME = 3.5
"""Longest time for a dose's program to turn the cup back and to end [s]."""

TILT_ACCELERATION = math.radians(600.0)
"""Acceleration of the tilt in a dose [rad/s²]."""

WATCHDOG = "; the program on the controller ends by its watchdog"
"""What ends a motion whose connection was lost."""


@dataclass(frozen=True, eq=False)
class _Tilts:
    """The range of a dose.

    Attributes:
        tilts: increasing, (T,) [rad].
        joints: at these tilts, (T, 6) [rad].
        limits: of the motion.
        longest: duration [s of controller time].
    """

    tilts: FloatArray
    joints: FloatArray
    limits: TiltLimits
    longest: float


_numbers = itertools.count(os.getpid() % 4096 * 65536 + 1)
"""Numbers of motions, different from any that another process may have left in the controller's registers."""


# More than 25 methods: the whole arm interface, and what each of its motions checks before and after.
class UrArm(JointMotions):
    """A UR arm.

    Args:
        spec: its model, address and limits. The address must be filled in.

    Attributes:
        last_stop: delays of the last stop of a moving arm.
    """

    def __init__(self, spec: UrArmSettings) -> None:
        super().__init__(spec)
        self._spec: UrArmSettings = spec
        self._session = Session(spec)
        self._stops = Stops()
        self._stopped = False
        self.last_stop: StopTimes | None = None
        self._segment: MotionSegment | None = None
        self._announced = False
        self._tilting: _Tilts | None = None
        self._tilt = 0.0

    # ---- nothing moves

    def connect(self) -> UrFacts:
        """See `Arm.connect`; starts a new worker."""
        if not self._spec.address:
            raise ArmRefusedError("the arm has no address; give the controller's, or have a virtual one started")
        with self._at_work("connecting"):
            self.lock()
            facts = self._session.open()
            self._spec = self._spec.fitted_to(facts)
            return facts

    def facts(self) -> UrFacts:
        """See `Arm.facts`."""
        with self._at_work("asking for facts"):
            return self._session.find_out()

    def joints(self) -> Joints:
        """See `JointMotions.joints`; during a motion as last reported, about twenty times a second."""
        progress = self._session.progress
        if self._segment is not None and progress is not None:
            a, b, c, d, e, f = progress.joints
            return a, b, c, d, e, f
        with self._at_work("asking for joints"):
            a, b, c, d, e, f = self._measured().tolist()
            return a, b, c, d, e, f

    def _measured(self) -> FloatArray:
        reading: DataPackage = self._session.ask("read")
        return np.array(reading.joints)

    def release(self, warned: bool = False) -> None:
        """See `Arm.release`."""
        super().release(warned)
        self._stopped = False

    def lock(self) -> None:
        """Lock the arm: nothing may begin to move until `release`."""
        self._released_at = None

    def hands_in(self) -> None:
        """See `Arm.hands_in`; checks that no program runs on the controller."""
        self.lock()
        with self._at_work("being made safe"):
            self._session.ask("hands_in")

    def state(self) -> ArmState:
        """See `Arm.state`."""
        segment, progress = self._segment, self._session.progress
        if segment is None:
            joints = () if progress is None else progress.joints
            return ArmState(stopped=self._stopped, tilt=self._tilt, joints=joints)
        if (tilting := self._tilting) is not None and not self._announced:
            tilt = float(tilting.tilts[0]) + (0.0 if progress is None else progress.clock)
            joints = () if progress is None else progress.joints
            return ArmState(moving=True, stopped=self._stopped, phase="dose", tilt=tilt, joints=joints)
        clock = 0.0 if progress is None or self._announced else min(progress.clock, segment.path.duration)
        return ArmState(
            moving=not self._announced,
            stopped=self._stopped,
            time=clock,
            fraction=clock / segment.path.duration,
            phase="announced" if self._announced else segment.phase(clock),
            tilt=segment.tilt(clock),
            joints=() if progress is None else progress.joints,
        )

    # ---- motions

    def dose(self, path: PourPath, longest: float) -> ExecutedPath:
        """See `DosingArm.dose`."""
        with self._at_work("dosing"):
            self._check_plan(path)
            self._last_pour = path
            tilts, joints = path.tilt_part
            limits = TiltLimits(path.report.tilt_speed, TILT_ACCELERATION)
            try:
                return self._go(MotionSegment.of_pour(path), _Tilts(tilts, joints, limits, longest))
            finally:
                self._tilting = None

    def drive(self, speed: float, highest: float, patience: float) -> ArmState:
        """See `DosingArm.drive`."""
        if (tilting := self._tilting) is not None:
            first, last = float(tilting.tilts[0]), float(tilting.tilts[-1])
            self._session.tilt(TiltOrder(speed, min(max(highest, first), last) - first, patience))
        return self.state()

    def recover(self) -> str:
        """See `Arm.recover`; unlocks, switches on and reconnects."""
        self._consent()
        self.lock()
        self.connect()
        with self._at_work("recovering"):
            done: str = self._session.ask(
                "recover", self._spec.time_scale, deadline=ANSWER_TIME + 2.0 * RECOVERY_TIME / self._spec.time_scale
            )
            self._stopped = True
            return done

    # ---- stopping

    def stop(self) -> float:
        """See `Arm.stop`. Three means are tried one after another:

        - a stop order, which the running program reads in every cycle; in a dose, the end of the commands, after which
          the program turns the cup back upright;
        - the dashboard, over a separate connection;
        - the end of the heartbeat.
        """
        requested_at = time.monotonic()
        self._stopped = True
        self.lock()
        self._session.stop(self._stops.ask())
        if not self._stops.under_way:
            return 0.0
        for means in (self._stop_by_dashboard, self._session.kill, None):
            # in a dose the cup is turned back upright first
            timeout = STOP_TIME
            if self._tilting is not None and means == self._stop_by_dashboard:
                timeout = UPRIGHT_TIME / min(self._spec.time_scale, 1.0)
            if self._stops.wait_for_end(timeout):
                if self._stops.unseen:
                    break
                times = self._stops.times(requested_at)
                self.last_stop = times or self.last_stop
                return 0.0 if times is None else times.standing
            if means is not None:
                means()
        raise ArmLostError(
            "a stop was sent to the arm in every available way, but the arm was not seen to stand still: "
            "look at it, and press the emergency stop if it moves"
        )

    def _stop_by_dashboard(self) -> None:
        with contextlib.suppress(DashboardError):
            stop_program(self._spec.address, 0.5)

    def close(self) -> None:
        """See `Arm.close`."""
        if self._stops.under_way:
            with contextlib.suppress(ArmError):
                self.stop()
        self.lock()
        self._session.discard()

    # ---- implementation

    def _fail(self) -> None:
        self.lock()
        self._stopped = True

    def _check_plan(self, path: PourPath | PlaceWay) -> None:
        checksum = self._spec.robot.parameters.checksum
        if path.calibration not in (None, checksum):
            raise ArmRefusedError(
                f"the pour was planned for a robot with {_kinematics(path.calibration)}, this one has "
                f"{_kinematics(checksum)}: millimetres and a degree apart. Plan it again with the connected robot's "
                "facts (`ArmSettings.fitted_to`)"
            )

    def _go(self, segment: MotionSegment, tilts: _Tilts | None = None) -> ExecutedPath:
        """Execute one motion to its end.

        Args:
            segment: the motion.
            tilts: of a dose, which goes to and fro on the tilt of the segment.
        """
        stops = self._stops.count  # before consent is checked, so that a stop in between counts
        released, spec = self._consent(), self._spec
        pours = segment.name not in RETURNS
        if not pours and self._session.ask("read").safety_mode == REDUCED:
            segment = segment.slowed(IN_REDUCED_MODE)
        path = segment.path
        if segment.name != "jog":  # a jog has its own checks, since it may be the way back inside the limits
            recheck(path, spec)
        facts = self._session.facts
        if facts is None:
            raise ArmLostError("the arm is not connected; connect first")
        settings = MotionSettings(tuple(spec.tool.as_list), spec.payload, spec.payload_centre.vector, spec.registers)
        number = next(_numbers)
        start, end = (tuple(map(float, path.joints[k])) for k in (0, -1))
        duration = path.duration
        if tilts is None:
            program = path_program(path, settings, number, cb3=not facts.e_series)
        else:
            program = tilt_program(tilts.tilts, tilts.joints, tilts.limits, settings, number, cb3=not facts.e_series)
            end, duration = start, tilts.longest
        motion = MotionOrder(program, number, start, end, duration, settings, stops, pours, tilts is not None)
        self._announced, self._segment = True, segment
        self._session.forget_progress()
        self._stops.begin()
        try:
            self._announce(released, segment, stops)
            self._announced, self._tilting = False, tilts
            outcome = self._run(motion, segment)
            return self._evaluate(outcome, segment)
        except LaboratoryError:
            raise
        except BaseException:  # e.g. a keyboard interrupt: the caller does not wait for the motion any more
            self._session.stop(self._stops.ask())
            self.lock()
            self._stopped = True
            raise
        finally:
            self._announced, self._segment = False, None
            self._stops.end()

    def _announce(self, released: float, segment: MotionSegment, stops: int) -> None:
        until = released + self._spec.warning_time / self._spec.time_scale
        if self._stops.wait_for_one(stops, until - time.monotonic()):
            raise ArmStoppedError("stopped before it moved", "operator", "announced", 0.0, segment.tilt(0.0))

    def _run(self, motion: MotionOrder, segment: MotionSegment) -> MotionOutcome:
        deadline = MOTION_MARGIN + 2.0 * motion.duration / self._spec.time_scale
        try:
            outcome = self._session.ask("run", motion, deadline=deadline)
        except ArmRefusedError as error:
            raise ArmRefusedError(f"{segment.name} refused: {error}") from None
        except ArmLostError as error:
            progress = self._session.progress
            clock = 0.0 if progress is None else progress.clock
            self._stops.lost()
            self._tilt, self._stopped = segment.tilt(clock), True
            raise ArmLostError(f"{error}. {segment.last_seen(clock)}{WATCHDOG}") from None
        assert isinstance(outcome, MotionOutcome)
        return outcome

    def _evaluate(self, outcome: MotionOutcome, segment: MotionSegment) -> ExecutedPath:
        self._stops.came_to(outcome)
        completed = outcome.kind == "completed"
        if self._tilting is not None:
            executed = executed_dose(outcome.samples, self._spec, completed=completed)
            tilted = float(self._tilting.tilts[0]) + outcome.clock
            self._tilt = tilted
            if not completed:
                self._stopped = True
                if outcome.kind == "lost":
                    self._session.kill()
                    raise ArmLostError(
                        f"{outcome.text}. The pourer was last seen at {math.degrees(tilted):.0f}°", executed
                    )
                text = f"dose: {outcome.text}"
                raise ArmStoppedError(
                    text,
                    outcome.kind,
                    "dose",
                    float(executed.times[-1]) if len(executed.times) else 0.0,
                    tilted,
                    executed,
                )
            return executed
        executed = executed_path(
            outcome.samples,
            segment.path,
            self._spec,
            completed=completed,
            slider=outcome.slider,
            forces=outcome.forces,
        )
        if completed:
            self._tilt = float(segment.tilts[-1])
            return executed
        self._tilt, self._stopped = segment.tilt_left(outcome), True
        if outcome.kind == "lost":
            self._session.kill()
            raise ArmLostError(f"{outcome.text}. {segment.last_seen(outcome.clock)}{WATCHDOG}", executed)
        raise segment.stopped(outcome, executed)


def _kinematics(checksum: str | None) -> str:
    return f"calibration {checksum}" if checksum else "nominal lengths"


class AcceptedArm(UrArm):
    """A `UrArm` that compares the controller's safety checksum each time it reads the controller's facts.

    Args:
        spec: as for `UrArm`.
        accepted: the accepted checksum; '' if none is accepted.
    """

    def __init__(self, spec: UrArmSettings, accepted: str) -> None:
        super().__init__(spec)
        self._accepted = accepted
        self._address = spec.address

    def connect(self) -> UrFacts:
        """See `UrArm.connect`.

        Raises:
            NotAcceptedError: the safety settings differ from the accepted ones; the arm is disconnected.
            ArmRefusedError: the payload that is set on the controller differs from the settings'; likewise.
        """
        facts = self._compared(super().connect())
        payload = payload_check(self._spec, facts.payload, facts.payload_centre)
        if payload.state == "fail":
            self.close()
            raise ArmRefusedError(f"arm at {self._address}: payload {payload.found}: {payload.advice}")
        return facts

    def facts(self) -> UrFacts:
        """See `UrArm.facts`; raises as `connect`."""
        return self._compared(super().facts())

    def _compared(self, facts: UrFacts) -> UrFacts:
        try:
            require_accepted(self._accepted or None, facts.checksum or None, self._address)
        except NotAcceptedError:
            self.close()
            raise
        return facts


def require_accepted(accepted: str | None, found: str | None, controller: str) -> None:
    """Compare the checksum of a controller's safety configuration with the accepted one.

    Called once the controller is connected, before any motion is requested.

    Args:
        accepted: eight hexadecimal digits, as `robot check --accept-safety` recorded them; None if there are none.
        found: as the controller reports it now; None if it reports none.
        controller: its address, for messages.

    Raises:
        NotAcceptedError: with the remedy.
    """
    if accepted is None:
        raise NotAcceptedError(
            f"arm at {controller}: its safety settings (checksum {found or 'unknown'}) have not been accepted for this "
            "laboratory. Run 'decant robot check' on the laboratory's file first; it says how"
        )
    if found is None:
        raise NotAcceptedError(
            f"arm at {controller}: the controller reports no safety checksum, which it leaves out while no safety "
            f"configuration is applied; {accepted} was accepted. Confirm the settings on the teach pendant"
        )
    if found.upper() != accepted.upper():
        raise NotAcceptedError(
            f"arm at {controller}: its safety settings have changed: checksum {found.upper()}, accepted was "
            f"{accepted.upper()}. Nothing moves. Find out on the teach pendant who changed what; when the settings are "
            "right, accept them with 'decant robot check --accept-safety'"
        )
