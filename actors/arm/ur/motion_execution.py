"""Executes one motion, from the upload of its program to rest, and makes a stopped robot ready again.

- `MotionMonitor` sends the heartbeat that lets the program continue, and monitors the motion.
- `recover` unlocks a robot after a stop. The operator must have removed the cause before.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Callable
from dataclasses import replace

from actors.arm.arm_interface import FULL_SPEED
from actors.arm.ur.dashboard import REPLY_TIMEOUT, Dashboard, DashboardError, stop_program
from actors.arm.ur.primary_interface import STATE_TIMEOUT, Primary, PrimaryError
from actors.arm.ur.rtde_client import AT_REST, RtdeClient
from actors.arm.ur.worker_messages import (
    DONE,
    FREEDRIVE,
    LEAST_SPEED,
    PLAYING,
    READY,
    ROBOT_MODES,
    RUNNING_MODE,
    SLOWEST_HEARTBEAT,
    STOPPED,
    STOPPED_PROGRAM,
    DataPackage,
    ForceSample,
    MotionOrder,
    MotionOutcome,
    MotionProgress,
    Sample,
    TiltOrder,
    TroubleError,
    may_move,
    safety_mode,
    why_not_ready,
)
from actors.arm_geometry import JOINT_NAMES
from actors.runtime.bench_clock import DeviceClock

AT_START = 0.01
"""Largest distance of the joints from a path's first point [rad]; the program first removes it slowly."""

UPRIGHT = 1e-3
"""Tilt below which the cup of a dose counts as upright [rad]."""

AT_END = 0.01
"""Largest distance of the joints from a path's last point [rad] for the path to count as completed."""

SAME_TOOL, SAME_PAYLOAD = 1e-4, 1e-3
"""Differences that count as equal: tool [m], [rad] and payload [kg], [m]."""

UPLOAD_TIME, STANDING_TIME = 5.0, 3.0
"""Longest wait for a program to report that it is ready, and for the arm to stand still [s of the clock]."""

OVERTIME = 10.0
"""Longest delay of a path beyond its planned duration [s of controller time], besides that of a lowered slider."""

HELD_TIME = 2.0
"""Longest standstill within a motion because the slider is at 0 [s of controller time]. The heartbeat continues, so
that no watchdog ends the program; a tilted cup pours on."""

BEAT_INTERVAL, TELL_INTERVAL, LOOK_INTERVAL = 0.02, 0.05, 0.002
FORCE_INTERVAL = 0.1
"""Time between two recorded forces [s of the path]."""

LATEST = 0.03
"""Time from one new package to the next one [s of the clock], for which the clock of a virtual bench waits. The
commands of a dose are late by as much."""

OWNER_SILENCE = 3.0
"""Time without a sign of life after which the driver counts as dead [s of the clock]."""


class MotionMonitor:
    """One motion.

    Args:
        client: to the controller.
        address: of the controller, for its other ports.
        motion: the motion.
        tell: called about twenty times a second with the progress.
        owner_seen: time of the driver's last sign of life [s of the client's clock].
    """

    def __init__(
        self,
        client: RtdeClient,
        address: str,
        motion: MotionOrder,
        tell: Callable[[MotionProgress], None],
        owner_seen: Callable[[], float],
    ) -> None:
        self._client, self._address, self._motion = client, address, motion
        self._time = client.clock
        self._report, self._owner_seen = tell, owner_seen
        self._ordered = threading.Event()
        self._samples: list[Sample] = []
        self._forces: list[ForceSample] = []
        self._reading: DataPackage | None = None
        self._clock, self._slider = 0.0, 1.0
        self._delay = self._held = 0.0
        self._joints: tuple[float, ...] = motion.start
        self._began = 0.0
        self._went = False
        self._heartbeats, self._next_heartbeat, self._last_heartbeat, self._longest_pause = 0, 0.0, 0.0, 0.0
        self._next_report = 0.0
        self._standing: float | None = None
        self._answered: float | None = None

    def order_stop(self) -> None:
        """Order a stop; may be called from any thread.

        In a dose the first order ends the commands: the program turns the cup back upright and ends. A second order
        stops the arm where it is.
        """
        again = self._ordered.is_set()
        self._ordered.set()
        if not self._motion.tilts or again or not self._went:
            self._client.order_stop(self._motion.number)

    def tilt(self, order: TiltOrder) -> None:
        """Pass on an order of a dose; may be called from any thread."""
        if self._motion.tilts and self._went and not self._ordered.is_set():
            self._client.tilt(order)

    def run(self) -> MotionOutcome:
        """Execute the whole motion.

        Raises:
            TroubleError: refused before anything moved.
        """
        reading = self._client.fresh()
        pours = self._motion.pours
        self._refuse_if(
            why_not_ready(
                reading.robot_mode,
                reading.safety_mode,
                reading.runtime,
                reading.slider,
                reading.status_bits,
                pours=pours,
            )
        )
        self._refuse_if(_elsewhere(reading.joints, self._motion.start))
        self._refuse_if(_not_remote(self._address, self._time))
        self._joints = reading.joints
        try:
            primary = Primary(self._address, STATE_TIMEOUT * self._time.patience)
        except PrimaryError as error:
            raise TroubleError("lost", str(error)) from None
        try:
            return self._through(primary)
        finally:
            self._time.withdraw("arm")
            primary.close()

    @staticmethod
    def _refuse_if(why: str) -> None:
        if why:
            raise TroubleError("refused", why)

    def _through(self, primary: Primary) -> MotionOutcome:
        self._write_heartbeat()
        try:
            primary.upload(self._motion.program)
            refusal = self._until_ready(primary)
            if refusal:
                self._end_program()
                messages = "; ".join(primary.complaints)
                raise TroubleError("refused", refusal + (f" (the controller says: {messages})" if messages else ""))
            if self._ordered.is_set():
                return self._broken_off("operator", "stopped by the operator")
            assert self._reading is not None
            self._began = self._reading.time  # a virtual bench sends no newer package while it waits for this program
            self._went = True
            self._client.go(self._motion.number)
            return self._until_end(primary)
        except TroubleError as trouble:
            if trouble.kind == "refused":
                raise
            self._end_program()
            return self._outcome("lost", trouble.text)
        except PrimaryError as error:
            raise TroubleError("lost", str(error)) from None

    # ---- before the start

    def _until_ready(self, primary: Primary) -> str:
        """Wait for the program, and read back its settings. Returns why it must not continue, or ''."""
        motion, settings = self._motion, self._motion.settings
        end = self._time.now + UPLOAD_TIME
        while True:
            reading = self._look()
            if self._ordered.is_set():
                return ""
            payload = (reading.payload, *reading.centre)
            if reading.number == motion.number and reading.status == READY:
                tool_is_set = _near(reading.tool, settings.tool, SAME_TOOL)
                payload_is_set = _near(payload, (settings.payload, *settings.centre), SAME_PAYLOAD)
                if tool_is_set and payload_is_set:
                    return _elsewhere(reading.joints, motion.start) or (_slowed(reading) if motion.pours else "")
                if self._time.now > end - 0.5 * UPLOAD_TIME:
                    return (
                        f"tool and payload were set to {_show((*settings.tool, settings.payload, *settings.centre))}; "
                        f"the controller has {_show((*reading.tool, *payload))}"
                    )
            if self._is_stopped(reading):
                return "the robot is not ready any more"
            if primary.broken or self._time.now > end:
                return "the program did not start on the controller"
            time.sleep(LOOK_INTERVAL)

    # ---- after the start

    def _until_end(self, primary: Primary) -> MotionOutcome:
        motion, arrived = self._motion, 0.0
        while True:
            reading = self._look()
            if reading.status == STOPPED and reading.number == motion.number:
                self._answered = time.monotonic()
                upright = "; the cup was turned back upright" if motion.tilts and reading.clock < UPRIGHT else ""
                return self._broken_off("operator", "stopped by the operator" + upright)
            if motion.tilts and self._ordered.is_set() and reading.clock < UPRIGHT and reading.stands:
                self._client.order_stop(motion.number)
            if self._is_stopped(reading):
                return self._stopped_by_safety(reading, primary)
            if reading.status_bits & FREEDRIVE:
                return self._broken_off("safety", "the freedrive button was pressed")
            if reading.status == DONE and reading.number == motion.number:
                arrived = arrived or self._time.now
                if reading.runtime == STOPPED_PROGRAM and reading.stands:
                    if _near(reading.joints, motion.end, AT_END):
                        self._standing = time.monotonic()
                        if motion.tilts and self._ordered.is_set():
                            return self._outcome("operator", "stopped by the operator; the cup was turned back upright")
                        return self._outcome("completed", "")
                    return self._outcome(
                        "program ended", f"the path was run through, but {_elsewhere(reading.joints, motion.end)}"
                    )
                if self._time.now - arrived > STANDING_TIME:
                    return self._broken_off("program ended", "the arm does not come to rest at the path's end")
            elif reading.runtime != PLAYING and reading.time > self._began:
                return self._stopped_by_program(primary)
            elif self._held > HELD_TIME:
                return self._broken_off("program ended", _held(reading))
            if reading.time - self._began > motion.duration + self._delay + OVERTIME + STANDING_TIME:
                return self._broken_off("program ended", "the motion takes far longer than planned")
            if self._time.now - self._owner_seen() > OWNER_SILENCE * self._time.patience and not motion.tilts:
                self.order_stop()
            time.sleep(LOOK_INTERVAL)

    def _stopped_by_safety(self, reading: DataPackage, primary: Primary) -> MotionOutcome:
        # After a safeguard stop the program would resume when the safeguard is reset, after a protective stop at
        # 'play'.
        mode = safety_mode(reading.safety_mode)
        if may_move(reading.safety_mode, pours=self._motion.pours):
            return self._broken_off("safety", f"the robot is {ROBOT_MODES.get(reading.robot_mode, 'not running')}")
        outcome = self._broken_off(mode.kind or "safety", mode.text)
        causes = "; ".join(primary.causes)  # they may arrive after the mode, and have by now
        return replace(outcome, text=f"{outcome.text}: {causes}") if causes else outcome

    def _is_stopped(self, reading: DataPackage) -> bool:
        allowed = may_move(reading.safety_mode, pours=self._motion.pours)
        return not allowed or reading.robot_mode != RUNNING_MODE

    def _stopped_by_program(self, primary: Primary) -> MotionOutcome:
        time.sleep(0.05)  # the safety mode may be reported a little later
        reading = self._look()
        if self._is_stopped(reading):
            return self._stopped_by_safety(reading, primary)
        if self._ordered.is_set():
            return self._broken_off("operator", "stopped by the operator")
        limit = 1.0 / SLOWEST_HEARTBEAT
        if self._longest_pause > 0.8 * limit:
            return self._broken_off(
                "watchdog", f"the heartbeat paused for {self._longest_pause:.2f} s: this computer is too busy"
            )
        messages = "; ".join(primary.complaints)
        return self._broken_off(
            "program ended", "the program was ended on the controller" + (f": {messages}" if messages else "")
        )

    def _broken_off(self, kind: str, text: str) -> MotionOutcome:
        """End the program in any state, and wait until the arm stands still."""
        self._client.order_stop(self._motion.number)
        end = self._time.now + STANDING_TIME
        requested = False
        while self._time.now < end:
            reading = self._look()
            if reading.stands and reading.runtime == STOPPED_PROGRAM:
                self._standing = self._standing or time.monotonic()
                return self._outcome(kind, text)
            if reading.stands:
                self._standing = self._standing or time.monotonic()
            if not requested and (kind != "operator" or self._time.now > end - 0.6 * STANDING_TIME):
                requested = True
                self._end_program()
            time.sleep(LOOK_INTERVAL)
        return self._outcome(kind, text + "; it could not be seen to stand and its program to end")

    def _end_program(self) -> None:
        self._client.order_stop(self._motion.number)
        with contextlib.suppress(DashboardError):
            stop_program(self._address, 0.5 * self._time.patience)

    def _outcome(self, kind: str, text: str) -> MotionOutcome:
        return MotionOutcome(
            kind,
            text,
            self._samples,
            self._clock,
            self._joints,
            self._standing,
            self._answered,
            self._went,
            self._slider,
            tuple(self._forces),
        )

    # ---- each iteration

    def _look(self) -> DataPackage:
        self._write_heartbeat()
        reading = self._client.look(1.0 if self._went else AT_REST)
        if reading is not self._reading:
            self._reading = reading
            self._time.promise("arm", LATEST)
        self._joints = reading.joints
        if self._went:
            self._slider = min(self._slider, reading.speed)
            if reading.number == self._motion.number:
                self._clock = reading.clock
            if self._samples:
                passed = max(reading.time - self._samples[-1][0], 0.0)
                self._delay += passed * max(1.0 - reading.speed, 0.0)
                self._held = self._held + passed if reading.speed < LEAST_SPEED else 0.0
            if not self._samples or reading.time > self._samples[-1][0]:
                self._samples.append((reading.time, reading.joints, reading.clock))
                if not self._forces or reading.clock - self._forces[-1][0] >= FORCE_INTERVAL:
                    self._forces.append((reading.clock, reading.force, reading.wrist))
        now = time.monotonic()
        if now > self._next_report:
            self._next_report = now + TELL_INTERVAL
            self._report(MotionProgress(self._clock, reading.joints, not reading.stands))
        return reading

    def _write_heartbeat(self) -> None:
        now = time.monotonic()
        if now < self._next_heartbeat:
            return
        if self._last_heartbeat:
            self._longest_pause = max(self._longest_pause, now - self._last_heartbeat)
        self._last_heartbeat, self._next_heartbeat = now, now + BEAT_INTERVAL
        self._heartbeats += 1
        self._client.beat(self._heartbeats)


def _near(a: tuple[float, ...], b: tuple[float, ...], tolerance: float) -> bool:
    return all(abs(x - y) <= tolerance for x, y in zip(a, b, strict=True))


def _show(values: tuple[float, ...]) -> str:
    return "[" + ", ".join(f"{v:.4g}" for v in values) + "]"


def _elsewhere(joints: tuple[float, ...], wanted: tuple[float, ...]) -> str:
    """Difference of the joints from the required ones, as text; '' if they agree."""
    errors = [abs(a - b) for a, b in zip(joints, wanted, strict=True)]
    worst = max(range(6), key=errors.__getitem__)
    if errors[worst] <= AT_START:
        return ""
    return f"{JOINT_NAMES[worst]} is {errors[worst] * 57.29578:.1f}° away from where it should be; stand there first"


def _slowed(reading: DataPackage) -> str:
    """Why the program, which runs and waits, would be slower than planned; '' if it would not."""
    if reading.speed >= FULL_SPEED:
        return ""
    return f"{_speed(reading)}; a pour needs 100 %. Decant does not raise the slider, since a person lowered it"


def _held(reading: DataPackage) -> str:
    return (
        f"the arm stood still for {HELD_TIME:g} s, and a tilted cup pours on: {_speed(reading)}. The program was "
        "ended, so that nothing moves when the slider is raised; raise it before you let the arm return"
    )


def _speed(reading: DataPackage) -> str:
    return (
        f"the controller runs programs at {100.0 * reading.speed:.0f} % of their speed (slider "
        f"{100.0 * reading.slider:.0f} %, its own slowing {100.0 * reading.scaling:.0f} %)"
    )


def _not_remote(address: str, clock: DeviceClock) -> str:
    try:
        with Dashboard(address, REPLY_TIMEOUT * clock.patience) as dashboard:
            answer = dashboard.ask("is in remote control")
    except DashboardError as error:
        raise TroubleError("lost", str(error)) from None
    # The older generation does not have this command, and reports that.
    return "the robot is in local control; switch it to remote control" if answer.lower() == "false" else ""


UNLOCK_DELAY = 5.5
"""A protective stop cannot be unlocked earlier [s of controller time]."""

POWER_TIME = 60.0
"""Longest wait for power and brakes [s of controller time]."""

_IDLE = 5


def recover(client: RtdeClient, address: str, scale: float) -> str:
    """Unlock, switch on, release the brakes: as needed.

    Args:
        client: to the controller.
        address: of its dashboard.
        scale: controller seconds per second of the clock.

    Returns:
        A description of the actions taken.

    Raises:
        TroubleError: names the manual action that is needed first.
    """
    done, clock = [], client.clock
    try:
        mode = safety_mode(client.fresh().safety_mode)
        if mode.kind == "emergency stop":
            raise TroubleError("refused", "the emergency stop is still pressed; release its button first")
        if mode.kind == "safeguard":
            raise TroubleError("refused", "the safeguard stop is still in force; leave the guarded area, then reset it")
        if mode.kind == "safety":
            raise TroubleError("refused", f"{mode.text} is in force: {mode.advice}")
        with Dashboard(address, REPLY_TIMEOUT * clock.patience) as dashboard:
            # A paused program would resume, and the next uploaded program would be discarded.
            dashboard.demand("stop", "Stopped")
            dashboard.ask("close popup")
            dashboard.ask("close safety popup")
            if mode.kind == "protective stop":
                _unlock(dashboard, scale)
                done.append("protective stop unlocked")
                _until(
                    clock,
                    lambda: may_move(client.fresh().safety_mode, pours=False),
                    POWER_TIME / scale,
                    "the safety mode stays",
                )
            if client.fresh().robot_mode < _IDLE:
                dashboard.demand("power on", "Powering on")
                done.append("switched on")
                _until(
                    clock,
                    lambda: client.fresh().robot_mode >= _IDLE,
                    POWER_TIME / scale,
                    "the robot does not switch on",
                )
            if client.fresh().robot_mode != RUNNING_MODE:
                dashboard.demand("brake release", "Brake releasing")
                done.append("brakes released")
                _until(
                    clock,
                    lambda: client.fresh().robot_mode == RUNNING_MODE,
                    POWER_TIME / scale,
                    "the brakes are not released",
                )
        _until(clock, lambda: client.fresh().runtime == STOPPED_PROGRAM, 3.0, "a program still runs on the controller")
    except DashboardError as error:
        raise TroubleError("lost", str(error)) from None
    return ", ".join(done)


def _unlock(dashboard: Dashboard, scale: float) -> None:
    for last in (False, True):
        answer = dashboard.ask("unlock protective stop")
        if answer.lower().startswith("protective stop releasing"):
            return
        if last:
            raise TroubleError("refused", f"the protective stop can't be unlocked: {answer}")
        time.sleep(UNLOCK_DELAY / scale + 0.05)


def _until(clock: DeviceClock, condition: Callable[[], bool], seconds: float, otherwise: str) -> None:
    end = clock.now + max(seconds, 3.0)
    while not condition():
        if clock.now > end:
            raise TroubleError("refused", otherwise)
        time.sleep(0.02)
