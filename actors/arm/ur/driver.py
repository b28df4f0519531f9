"""A UR arm as everything above sees it: plain, blocking, and still until an operator has said that it may move.

The client library lives in a worker process; here are consent, checks, and what came of a motion.
"""

from __future__ import annotations

import contextlib
import itertools
import os
import threading
import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from actors.arm.joint_path import ExecutedPath, FloatArray, JointPath, PourPath
from actors.arm.path.checks import recheck
from actors.arm.protocol import ArmState
from actors.arm.spec import Joints, UrArmSpec
from actors.arm.ur.dashboard import DashboardError, stop_program
from actors.arm.ur.errors import (
    ArmError,
    ArmLostError,
    ArmNotReleasedError,
    ArmRefusedError,
    ArmStoppedError,
)
from actors.arm.ur.facts import ArmFacts, facts_of
from actors.arm.ur.jogging import jog_path
from actors.arm.ur.messages import Motion, Outcome, Reading, Settings
from actors.arm.ur.process import WorkerProcess
from actors.arm.ur.script import checked, path_program
from actors.arm.ur.tracking import executed_path
from actors.arm.ur.ways import HARDLY, rejoin, upright_way, way_home
from actors.protocols import LaboratoryError

OPEN_TIME, ANSWER_TIME, RECOVERY_TIME = 30.0, 15.0, 90.0
"""Longest waits for the worker [s]: to start and connect, to answer, to make the robot ready (of controller time)."""

MOTION_MARGIN = 40.0
"""What a motion may take beyond twice its planned time before its worker counts as hung [s]."""

STOP_TIME = 1.0
"""Each means of stopping gets so long before the next is tried [s]."""

_numbers = itertools.count(os.getpid() % 4096 * 65536 + 1)
"""Of motions: unlike any that another process may have left in the controller's registers."""


@dataclass(frozen=True, eq=False)
class Leg:
    """One motion, and what to call it.

    Attributes:
        path: to be followed.
        phases: (name, start, end) [s].
        tilts: of the pourer at the path's times [rad].
    """

    path: JointPath
    phases: tuple[tuple[str, float, float], ...]
    tilts: FloatArray

    @classmethod
    def upright(cls, name: str, path: JointPath) -> Leg:
        """A way with the pourer upright."""
        return cls(path, ((name, 0.0, path.duration),), np.zeros(len(path.times)))

    def phase(self, time: float) -> str:
        """What goes on at a time [s]."""
        return next((name for name, _, end in self.phases if time < end), self.phases[-1][0])

    def tilt(self, time: float) -> float:
        """Of the pourer then [rad]."""
        return float(np.interp(time, self.path.times, self.tilts))


class UrArm:
    """The arm.

    Args:
        spec: which arm, where, and what it may do. Its address must be filled in.
    """

    def __init__(self, spec: UrArmSpec) -> None:
        self._spec = spec
        self._worker: WorkerProcess | None = None
        self._facts: ArmFacts | None = None
        self._working = threading.Lock()
        self._released_at: float | None = None
        self._stops = 0
        self._stopped = False
        self._standing = threading.Condition()
        self._stood_at: float | None = None
        self._leg: Leg | None = None
        self._announced = False
        self._last_pour: PourPath | None = None
        self._tilt = 0.0

    # ---- nothing moves

    def connect(self) -> ArmFacts:
        """Find the robot, by a new worker. Nothing moves, and nothing may until `release`.

        Raises:
            ArmLostError: it can't be reached; ArmRefusedError: it is another robot than the settings say.
        """
        if not self._spec.address:
            raise ArmRefusedError("the arm has no address; give the controller's, or have a virtual one started")
        with self._at_work("connecting"):
            self._discard()
            self._worker = WorkerProcess()
            try:
                self._ask("open", self._spec.address, self._spec.rate, deadline=OPEN_TIME)
                facts = self._facts = self._find_out()
                self._check_model(facts)
            except ArmError:
                self._discard()
                raise
            return facts

    def facts(self) -> ArmFacts:
        """The robot as it is now."""
        return self._find_out()

    def joints(self) -> Joints:
        """Measured, now [rad]."""
        reading: Reading = self._ask("read")
        a, b, c, d, e, f = reading.joints
        return a, b, c, d, e, f

    def release(self) -> None:
        """An operator consents to the next cycle: way there, pour, way back; or to one recovery, un-tilting or jog.

        Consent ends with that, with any stop, refusal or loss, and with `lock` and `hands_in`.
        """
        self._released_at = time.monotonic()
        self._stopped = False

    def lock(self) -> None:
        """Nothing may begin to move until `release`."""
        self._released_at = None

    def hands_in(self) -> None:
        """Before hands are invited into the cell: no program runs on the controller, and none will without `release`.

        Raises:
            ArmError: that can't be verified. Keep hands out.
        """
        self.lock()
        with self._at_work("being made safe"):
            self._ask("hands_in")

    def state(self) -> ArmState:
        """Where the arm is; answered at once, also during a motion."""
        leg, worker = self._leg, self._worker
        if leg is None:
            return ArmState(stopped=self._stopped, tilt=self._tilt)
        progress = None if worker is None else worker.progress
        clock = 0.0 if progress is None or self._announced else min(progress.clock, leg.path.duration)
        return ArmState(
            moving=not self._announced,
            stopped=self._stopped,
            time=clock,
            fraction=clock / leg.path.duration,
            phase="announced" if self._announced else leg.phase(clock),
            tilt=leg.tilt(clock),
        )

    # ---- motions

    def move_to_start(self, path: PourPath) -> None:
        """From home to where the pour begins, the pourer upright.

        Raises:
            ArmRefusedError: before anything moved; ArmStoppedError: on the way; ArmLostError.
        """
        with self._at_work("moving"):
            self._go(Leg.upright("approach", path.approach))

    def execute(self, path: PourPath) -> ExecutedPath:
        """Tilt, hold, return.

        Returns:
            What the arm's encoders say it did, sampled `spec.rate` times per second of the clock.

        Raises:
            ArmRefusedError: before anything moved; ArmStoppedError: on the way, tilted perhaps; ArmLostError.
        """
        with self._at_work("pouring"):
            self._last_pour = path
            executed = self._go(Leg(path.pour, path.phases, path.tilts))
            self._tilt = float(path.tilts[-1])
            return executed

    def retreat(self, path: PourPath) -> None:
        """Home from the pour's end, or from wherever an upright pourer was stopped. Ends the operator's consent.

        Raises:
            ArmRefusedError: before anything moved; ArmStoppedError: on the way; ArmLostError.
        """
        with self._at_work("retreating"):
            self._consent()
            way = way_home(path, np.array(self.joints()), self._spec)
            self._go(Leg.upright("retreat", way))
            self.lock()

    def untilt(self, path: PourPath | None = None) -> None:
        """Bring a stopped pourer upright, slowly, the way it came. Ends the operator's consent.

        Args:
            path: the pour that was stopped; the last one by default.

        Raises:
            ArmRefusedError: before anything moved; ArmStoppedError: on the way; ArmLostError.
        """
        with self._at_work("un-tilting"):
            self._consent()
            poured = path or self._last_pour
            if poured is None:
                raise ArmRefusedError("no pour is known that was stopped; bring the pourer upright at the pendant")
            self._last_pour = poured
            way, tilts = upright_way(poured, np.array(self.joints()), self._spec)
            self._go(Leg(way, (("untilt", 0.0, way.duration),), tilts))
            self._tilt = float(tilts[-1])
            self.lock()

    def jog(self, axis: str, amount: float, speed: float) -> None:
        """One small step, for setting up. Ends the operator's consent.

        Args:
            axis: 'joint 1' … 'joint 6', or of the tool in the base's axes: 'x', 'y', 'z', 'rx', 'ry', 'rz'.
            amount: [rad], at most 10°; [m], at most 50 mm.
            speed: [rad/s], [m/s].

        Raises:
            ArmRefusedError: before anything moved; ArmStoppedError: on the way; ArmLostError.
        """
        with self._at_work("jogging"):
            self._consent()
            self._go(Leg.upright("jog", jog_path(self._spec, self.joints(), axis, amount, speed)))
            self.lock()

    def recover(self) -> str:
        """After a stop that an operator has looked into: unlock, switch on, connect anew. Needs and ends consent.

        Returns:
            What was done, for people.

        Raises:
            ArmRefusedError: something has to be done by hand first; ArmLostError.
        """
        self._consent()
        self.lock()
        self.connect()
        with self._at_work("recovering"):
            done: str = self._ask(
                "recover", self._spec.time_scale, deadline=ANSWER_TIME + 2.0 * RECOVERY_TIME / self._spec.time_scale
            )
            return done

    # ---- stopping

    def stop(self) -> float:
        """Stop, now, whatever is going on, and see the arm stand. Nothing moves until `release`.

        Three means, one after the other: an order that the running program looks for in every cycle; the dashboard,
        over a connection of its own; an end of the heartbeat.

        Returns:
            Time from the call to standstill [s]; 0 if nothing was moving.

        Raises:
            ArmLostError: the arm could not be seen to stand.
        """
        asked = time.monotonic()
        self._stopped = True
        self.lock()
        with self._standing:
            self._stops += 1
            stops = self._stops
            self._stood_at = None
            self._standing.notify_all()
        worker = self._worker
        if worker is not None:
            worker.stop(stops)
        if self._leg is None:
            return 0.0
        for means in (self._stop_by_dashboard, self._stop_by_silence, None):
            with self._standing:
                if self._standing.wait_for(lambda: self._leg is None, STOP_TIME):
                    return 0.0 if self._stood_at is None else max(0.0, self._stood_at - asked)
            if means is not None:
                means()
        raise ArmLostError("the arm could not be seen to stand within 3 s of a stop: press the emergency stop")

    def _stop_by_dashboard(self) -> None:
        with contextlib.suppress(DashboardError):
            stop_program(self._spec.address, 0.5)

    def _stop_by_silence(self) -> None:
        if self._worker is not None:
            self._worker.kill()

    def close(self) -> None:
        """Stop, and let the robot go."""
        if self._leg is not None:
            with contextlib.suppress(ArmError):
                self.stop()
        self.lock()
        self._discard()

    # ---- how

    @contextlib.contextmanager
    def _at_work(self, doing: str) -> Iterator[None]:
        if not self._working.acquire(timeout=0.5):
            raise ArmRefusedError(f"the arm is busy; {doing} has to wait")
        try:
            yield
        except LaboratoryError:
            self.lock()
            raise
        finally:
            self._working.release()

    def _ask(self, method: str, *arguments: object, deadline: float = ANSWER_TIME) -> Any:
        worker = self._worker
        if worker is None or not worker.alive:
            raise ArmLostError("the arm is not connected; connect first")
        try:
            return worker.call(method, *arguments, deadline=deadline)
        except ArmLostError:
            self.lock()
            worker.kill()
            raise

    def _discard(self) -> None:
        worker, self._worker = self._worker, None
        self.lock()
        if worker is not None:
            worker.kill()

    def _find_out(self) -> ArmFacts:
        return facts_of(self._ask("facts", deadline=ANSWER_TIME))

    def _check_model(self, facts: ArmFacts) -> None:
        model = facts.model.lower().removesuffix("e") + ("e" if facts.e_series else "")
        if model != self._spec.model:
            raise ArmRefusedError(
                f"the robot at {self._spec.address} is a {model.upper()} (software {facts.version}); "
                f"the arm is set up as {self._spec.model.upper()}"
            )

    def _consent(self) -> float:
        released = self._released_at
        if released is None:
            raise ArmNotReleasedError("the arm is locked: an operator has to release it before it moves")
        return released

    def _go(self, leg: Leg) -> ExecutedPath:
        """One motion, to its end."""
        released, stops, spec = self._consent(), self._stops, self._spec
        path = checked(leg.path)
        if leg.phases[0][0] != "jog":  # which checks itself: it may be the way back in
            recheck(path, spec)
        if self._facts is None:
            raise ArmLostError("the arm is not connected; connect first")
        settings = Settings(tuple(spec.tool.as_list), spec.payload, spec.payload_centre)
        number = next(_numbers)
        program = path_program(path, settings, number, cb3=not self._facts.e_series)
        start, end = (tuple(map(float, path.joints[k])) for k in (0, -1))
        motion = Motion(program, number, start, end, path.duration, settings, stops)
        self._announced, self._leg = True, leg
        if self._worker is not None:
            self._worker.progress = None
        try:
            self._announce(released, leg, stops)
            self._announced = False
            outcome = self._run(motion, leg)
            return self._judge(outcome, leg)
        finally:
            with self._standing:
                self._announced, self._leg = False, None
                self._standing.notify_all()

    def _announce(self, released: float, leg: Leg, stops: int) -> None:
        until = released + self._spec.announcement / self._spec.time_scale
        with self._standing:
            left = until - time.monotonic()
            if self._standing.wait_for(lambda: self._stops != stops, max(left, 0.0)):
                raise ArmStoppedError("stopped before it moved", "operator", "announced", 0.0, leg.tilt(0.0))

    def _run(self, motion: Motion, leg: Leg) -> Outcome:
        deadline = MOTION_MARGIN + 2.0 * motion.duration / self._spec.time_scale
        try:
            outcome = self._ask("run", motion, deadline=deadline)
        except ArmRefusedError as error:
            raise ArmRefusedError(f"{leg.phases[0][0]} refused: {error}") from None
        except ArmLostError as error:
            progress = None if self._worker is None else self._worker.progress
            clock = 0.0 if progress is None else progress.clock
            self._tilt, self._stopped = leg.tilt(clock), True
            raise ArmLostError(f"{error}. {self._last_seen(leg, clock)}") from None
        assert isinstance(outcome, Outcome)
        return outcome

    def _judge(self, outcome: Outcome, leg: Leg) -> ExecutedPath:
        with self._standing:
            self._stood_at = outcome.standing
        executed = executed_path(
            outcome.samples, leg.path, self._spec, completed=outcome.kind == "completed", slider=outcome.slider
        )
        if outcome.kind == "completed":
            return executed
        place = outcome.clock
        if outcome.standing is not None:
            near, apart = rejoin(leg.path, np.array(outcome.joints))
            place = near if apart <= HARDLY else place
        self._tilt, self._stopped = leg.tilt(place), True
        if outcome.kind == "lost":
            if self._worker is not None:
                self._worker.kill()
            raise ArmLostError(f"{outcome.text}. {self._last_seen(leg, outcome.clock)}", executed)
        phase = leg.phase(outcome.clock)
        tilted = f", the pourer tilted by {np.degrees(self._tilt):.0f}°" if self._tilt > 0.02 else ""
        raise ArmStoppedError(
            f"{outcome.kind} during {phase}, {outcome.clock:.2f} s after its begin{tilted}: {outcome.text}. "
            "The arm holds still; look into it, then release",
            *(outcome.kind, phase, outcome.clock, self._tilt, executed),
        )

    def _last_seen(self, leg: Leg, clock: float) -> str:
        return (
            f"Last seen during {leg.phase(clock)}, {clock:.2f} s after its begin, the pourer tilted by "
            f"{np.degrees(leg.tilt(clock)):.0f}°; the program on the controller ends by its watchdog"
        )
