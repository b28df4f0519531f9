"""Messages and registers shared by the driver, the worker and the controller's program.

These are plain values, and the module has no slow imports, so that the worker starts quickly. The client library can
write input registers 18 … 22 and read output registers 12 … 19.
"""

from __future__ import annotations

from dataclasses import dataclass

from actors.arm.ur.primary_interface import RobotState

STOP_ORDER, HEARTBEAT, GO = 19, 20, 21
"""Integer inputs. An order is the number of its motion, so that an old order has no effect."""

NUMBER, STATUS = 12, 13
"""Integer outputs: the number of the motion whose program runs, and its status."""

CLOCK, TOOL = 12, 13
"""Double outputs: time on the path [s]; from `TOOL` on, the six values of the controller's tool."""

READY, RUNNING, DONE, STOPPED = 1, 2, 3, 4
"""Statuses: ready and waiting for `GO`; moving; arrived; stopped by order."""

SLOWEST_HEARTBEAT = 2.0
"""If the heartbeat is written less often than this, the program ends and the arm stops [Hz of the clock]."""

SILENCE = 0.2
"""If the time of the data does not advance for so long while the arm moves, they are stale [s of the clock]."""


ROBOT_MODES = {
    -1: "no controller",
    0: "disconnected",
    1: "safety to be confirmed",
    2: "booting",
    3: "off",
    4: "on, not started",
    5: "idle, brakes closed",
    6: "being moved by hand",
    7: "running",
    8: "updating firmware",
}
SAFETY_MODES = {
    1: "normal",
    2: "reduced mode",
    3: "protective stop",
    4: "recovery mode",
    5: "safeguard stop",
    6: "emergency stop (system)",
    7: "emergency stop (robot)",
    8: "safety violation",
    9: "fault of the safety system",
}
RUNNING_MODE, NORMAL, REDUCED = 7, 1, 2
STOPPED_PROGRAM, PLAYING = 1, 2


def why_not_ready(robot_mode: int, safety_mode: int, runtime: int, slider: float) -> str:
    """Why an arm cannot move; '' if it can. Driver, worker, `decant robot check` and its display all use this decision.

    Reduced mode prevents motion: pours are planned within the normal limits, and would end in a protective stop.

    Args:
        robot_mode, safety_mode, runtime: RTDE's numbers (`robot_mode`, `safety_mode`, `runtime_state`).
        slider: `target_speed_fraction`, 0 … 1.
    """
    if safety_mode != NORMAL:
        return f"{SAFETY_MODES.get(safety_mode, f'safety mode {safety_mode}')} is in force"
    if robot_mode != RUNNING_MODE:
        return f"the robot is {ROBOT_MODES.get(robot_mode, f'in mode {robot_mode}')}, not running"
    if runtime != STOPPED_PROGRAM:
        return "a program runs on the controller, or is paused; stop it at the pendant"
    if slider < 0.999:
        return f"the speed slider is at {100.0 * slider:.0f} %; a pour needs 100 %"
    return ""


class TroubleError(Exception):
    """The worker cannot do what was requested.

    Args:
        kind: 'refused' before anything moved, or 'lost'.
        text: the message.
    """

    def __init__(self, kind: str, text: str) -> None:
        super().__init__(kind, text)
        self.kind, self.text = kind, text


@dataclass(frozen=True)
class MotionSettings:
    """Settings of every motion.

    Attributes:
        tool: TCP in the flange's frame [m], [rad].
        payload: [kg]; `centre` [m].
    """

    tool: tuple[float, ...]
    payload: float
    centre: tuple[float, ...]


@dataclass(frozen=True)
class MotionOrder:
    """A program that moves the arm, and its conditions.

    Attributes:
        program: text; it waits for `GO` before it moves anything.
        number: of the motion.
        start, end: joints [rad].
        duration: of its path [s of controller time].
        settings: read back before the start.
        stops: number of stops when the motion was requested; if there is another one, it does not start.
    """

    program: str
    number: int
    start: tuple[float, ...]
    end: tuple[float, ...]
    duration: float
    settings: MotionSettings
    stops: int


@dataclass(frozen=True)
class DataPackage:
    """One package of the controller.

    Attributes:
        time: of the controller [s]; `seen` [s of `time.monotonic`].
        joints, speeds: measured [rad], [rad/s].
        robot_mode, safety_mode, runtime: as numbers.
        slider: 0 … 1.
        payload: [kg]; `centre` [m].
        number, status, clock, tool: of the program, see the registers.
    """

    time: float
    seen: float
    joints: tuple[float, ...]
    speeds: tuple[float, ...]
    robot_mode: int
    safety_mode: int
    runtime: int
    slider: float
    payload: float
    centre: tuple[float, ...]
    number: int
    status: int
    clock: float
    tool: tuple[float, ...]

    @property
    def stands(self) -> bool:
        """Whether no joint moves."""
        return max(map(abs, self.speeds)) < STANDSTILL


STANDSTILL = 2e-3
"""Joint speed below which a joint counts as standing still [rad/s]."""

Sample = tuple[float, tuple[float, ...], float]
"""Controller time [s], joints [rad], time on the path [s]."""


@dataclass(frozen=True)
class MotionProgress:
    """Progress of a motion, which the worker sends without a request.

    Attributes:
        clock: time on the path [s].
        joints: [rad].
        moving: a joint moves.
    """

    clock: float
    joints: tuple[float, ...]
    moving: bool


@dataclass(frozen=True)
class MotionOutcome:
    """The outcome of a motion.

    Attributes:
        kind: 'completed', or why it was interrupted: see `actors.arm.arm_interface.ArmStoppedError`, or 'lost'.
        text: the reason, as a message.
        samples: readings from its start on.
        clock: time on the path where it ended [s].
        joints: where the arm stands [rad]; as last seen, if `standing` is None.
        standing: when it was first seen at rest [s of `time.monotonic`].
        answered: when the program was first seen to accept a stop order [s of `time.monotonic`].
        moved: it had been ordered to start.
        slider: lowest position seen.
    """

    kind: str
    text: str
    samples: list[Sample]
    clock: float
    joints: tuple[float, ...]
    standing: float | None
    answered: float | None = None
    moved: bool = True
    slider: float = 1.0


@dataclass(frozen=True)
class Facts:
    """The worker's facts about a controller; see `actors.arm.ur.ur_session.UrFacts`."""

    model: str
    serial: str
    version: tuple[int, ...]
    remote: bool | None
    program: str
    reading: DataPackage
    state: RobotState
