"""A connection to one robot through a worker process.

- `Session` starts a new worker for each connection, and discards both together; a connection is never repaired.
- `WorkerProcess` is the driver's side of the worker: calls with deadlines, stops that overtake them, and detection of
  the worker's end.
- `UrFacts` holds the robot's identity and state for messages and records.

Linux could end the worker together with the thread that started it. This is not used, because that thread may end while
the arm moves. The worker ends when this process closes its side of the connection for any reason.
"""

from __future__ import annotations

import contextlib
import threading
import time
from concurrent.futures import Future
from concurrent.futures import TimeoutError as FutureTimeoutError
from dataclasses import dataclass, field
from typing import Any

from actors.arm.arm_interface import ArmError, ArmFacts, ArmLostError, ArmRefusedError
from actors.arm.ur.robot_comparison import robot_problems
from actors.arm.ur.robot_models import Calibration
from actors.arm.ur.worker_messages import (
    ROBOT_MODES,
    SILENCE,
    Facts,
    MotionProgress,
    TiltOrder,
    TroubleError,
    safety_mode,
    why_not_ready,
)
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Joints, Pose, Vector
from actors.runtime.bench_clock import DeviceClock, device_clock
from actors.runtime.child_process import ConnectedProcess


@dataclass(frozen=True)
class UrFacts(ArmFacts):
    """A robot's identity and state, as its controller reports them.

    Attributes:
        checksum: of the safety configuration, eight hexadecimal digits; '' if it is not reported.
        robot_mode, safety_mode: as text; 'running' and 'normal' if it could move.
        remote: remote control is on; None if the controller does not have this mode.
        tool: TCP in the flange's frame, as set at present.
        payload: as set at present [kg]; `payload_centre` [m].
        joints: measured [rad].
        slider: 0 … 1.
        program: state and name of the controller's program.
        joint_ranges: lowest and highest of each joint [rad], as configured; empty if they are not reported.
        joint_speeds: likewise [rad/s].
        kinematics: calibration of the robot; None if it is nominal, as a simulator's is.
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
    kinematics: Calibration | None = None

    @property
    def e_series(self) -> bool:
        """Whether the robot is of the generation after CB3."""
        return int(self.version.split(".")[0]) >= 5


def facts_of(worker_facts: Facts) -> UrFacts:
    """Convert the worker's facts."""
    r, state = worker_facts.reading, worker_facts.state
    a, b, c, d, e, f = r.joints
    x, y, z = r.centre
    return UrFacts(
        model=worker_facts.model,
        serial=worker_facts.serial,
        version=".".join(map(str, worker_facts.version)),
        problem=why_not_ready(r.robot_mode, r.safety_mode, r.runtime, r.slider, r.status_bits),
        robot_mode=ROBOT_MODES.get(r.robot_mode, str(r.robot_mode)),
        safety_mode=safety_mode(r.safety_mode).text,
        remote=worker_facts.remote,
        checksum=state.checksum,
        calibration="" if state.calibration is None else state.calibration.checksum,
        kinematics=state.calibration,
        tool=Pose.of(*state.tool),
        payload=r.payload,
        payload_centre=(x, y, z),
        joints=(a, b, c, d, e, f),
        slider=r.slider,
        program=worker_facts.program,
        joint_ranges=state.joint_ranges,
        joint_speeds=state.joint_speeds,
    )


SIGN_OF_LIFE = 0.1
"""Time between two signs of life to the worker while a call is awaited [s]."""


class WorkerProcess:
    """One worker, from its start to its end; never restarted.

    Args:
        clock: of the controller; its patience stretches deadlines.

    Attributes:
        progress: its latest progress report of a motion.
        pid: of the process.
    """

    def __init__(self, clock: DeviceClock) -> None:
        self._clock = clock
        self._child = ConnectedProcess("actors.arm.ur.rtde_worker", prompt=True)
        self._connection = self._child.connection
        self.pid = self._child.pid
        self._sending = threading.Lock()
        self._pending: dict[int, Future[Any]] = {}
        self._number = 0
        self._gone = threading.Event()
        self.progress: MotionProgress | None = None
        threading.Thread(target=self._receive, name="arm-worker", daemon=True).start()

    @property
    def alive(self) -> bool:
        """Whether it can receive requests."""
        return not self._gone.is_set()

    def call(self, method: str, *arguments: Any, deadline: float) -> Any:
        """Send a request and wait for its result.

        Args:
            method: of `actors.arm.ur.rtde_worker.Worker`.
            arguments: plain values.
            deadline: longest wait [s], also for the next progress report of a motion, which a slider may stretch
                without limit; a worker that misses it is ended.

        Raises:
            ArmRefusedError: refused before anything moved.
            ArmLostError: the controller cannot be reached, or the worker died or missed its deadline.
        """
        future: Future[Any] = Future()
        with self._sending:
            self._number += 1
            number = self._number
            self._pending[number] = future
        if not self.alive:
            raise ArmLostError(self._obituary(method))
        self._send(("call", number, method, arguments))
        deadline *= self._clock.patience
        end, reported = time.monotonic() + deadline, self.progress
        while time.monotonic() < end:
            try:
                return future.result(timeout=SIGN_OF_LIFE)
            except FutureTimeoutError:
                self._send(("alive",))
                if self.progress is not reported:
                    end, reported = time.monotonic() + deadline, self.progress
            except TroubleError as trouble:
                if trouble.kind == "refused":
                    raise ArmRefusedError(trouble.text) from None
                raise ArmLostError(trouble.text + self._errors()) from None
        self.kill()
        raise ArmLostError(f"the arm's worker did not answer '{method}' within {deadline:g} s{self._errors()}")

    def stop(self, stops: int) -> None:
        """Order a stop of any motion; does not wait."""
        self._send(("stop", stops))

    def tilt(self, order: TiltOrder) -> None:
        """Send an order of a dose; does not wait."""
        self._send(("tilt", order))

    def kill(self) -> None:
        """End the process; its watchdog ends a running motion."""
        self._child.kill()
        self._gone.wait(2.0)

    def _send(self, message: Any) -> None:
        # the end of the process is noticed where its responses are read
        with self._sending, contextlib.suppress(OSError):
            self._connection.send(message)

    def _receive(self) -> None:
        with contextlib.suppress(EOFError, OSError):
            while True:
                message = self._connection.recv()
                if isinstance(message, MotionProgress):
                    self.progress = message
                    continue
                number, good, value = message
                future = self._pending.pop(number, None)
                if future is not None and good:
                    future.set_result(value)
                elif future is not None:
                    future.set_exception(value)
        self._gone.set()
        self._child.wait(5.0)
        with self._sending:
            pending = list(self._pending.values())
            self._pending.clear()
            self._connection.close()
        for future in pending:
            future.set_exception(TroubleError("lost", self._obituary("a request")))

    def _obituary(self, method: str) -> str:
        return f"the arm's worker died during {method} (status {self._child.status}); connect again"

    def _errors(self) -> str:
        messages = self._child.errors_kept
        return f" (it said: {messages})" if messages else ""


OPEN_TIME, ANSWER_TIME = 30.0, 15.0
"""Longest waits for the worker [s]: to start and connect, and to respond."""


class Session:
    """The connection to a robot; closed at first.

    Args:
        spec: address and expected identity of the robot.

    Attributes:
        facts: of the robot when the connection was made; None without a connection.
    """

    def __init__(self, spec: UrArmSettings) -> None:
        self._spec = spec
        self._worker: WorkerProcess | None = None
        self.facts: UrFacts | None = None

    def open(self) -> UrFacts:
        """Connect with a new worker; nothing moves.

        Raises:
            ArmLostError: the robot cannot be reached.
            ArmRefusedError: the robot is not the one that the settings describe.
        """
        self.discard()
        spec = self._spec
        self._worker = WorkerProcess(device_clock(spec.clock))
        # Only a virtual controller has scaled time; the operating system may delay its process, unlike a real
        # controller.
        silence = SILENCE if spec.time_scale == 1.0 else 8.0 * SILENCE
        try:
            self.ask("open", spec.address, spec.rate, silence, spec.registers, spec.clock, deadline=OPEN_TIME)
            facts: Facts = self.ask("facts")
            self.facts = facts_of(facts)
            problems = robot_problems(spec, facts.model, facts.version, facts.state, rests=facts.reading.stands)
            if problems:
                raise ArmRefusedError(f"the robot at {spec.address} {'; '.join(problems)}")
        except ArmError:
            self.discard()
            raise
        return self.facts

    def ask(self, method: str, *arguments: object, deadline: float = ANSWER_TIME) -> Any:
        """Send the worker a request; see `WorkerProcess.call`."""
        worker = self._worker
        if worker is None or not worker.alive:
            raise ArmLostError("the arm is not connected; connect first")
        try:
            return worker.call(method, *arguments, deadline=deadline)
        except ArmLostError:
            worker.kill()
            raise

    def find_out(self) -> UrFacts:
        """The robot's present facts."""
        return facts_of(self.ask("facts"))

    @property
    def progress(self) -> MotionProgress | None:
        """The worker's latest progress report of a motion."""
        return None if self._worker is None else self._worker.progress

    @property
    def pid(self) -> int | None:
        """Process id of the worker."""
        return None if self._worker is None else self._worker.pid

    def forget_progress(self) -> None:
        """Forget the progress of the previous motion."""
        if self._worker is not None:
            self._worker.progress = None

    def stop(self, stops: int) -> None:
        """Order a stop; does not wait."""
        if self._worker is not None:
            self._worker.stop(stops)

    def tilt(self, order: TiltOrder) -> None:
        """Send an order of a dose; does not wait."""
        if self._worker is not None:
            self._worker.tilt(order)

    def kill(self) -> None:
        """End the worker; its watchdog ends a running motion."""
        if self._worker is not None:
            self._worker.kill()

    def discard(self) -> None:
        """End the worker and forget the robot."""
        self.kill()
        self._worker, self.facts = None, None
