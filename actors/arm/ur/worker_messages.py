"""Messages and registers shared by the driver, the worker and the controller's program.

These are plain values, and the module has no slow imports, so that the worker starts quickly. The client library can
read output registers 12 … 19. Input registers are written by `InputWriter`.
"""

from __future__ import annotations

from dataclasses import dataclass

from actors.arm.arm_interface import FULL_SPEED
from actors.arm.ur.primary_interface import RobotState

STOP_ORDER, HEARTBEAT, GO = 0, 1, 2
"""Integer inputs, counted from the arm's setting `registers`. An order is the number of its motion, so that an old
order has no effect."""

TILT_SPEED, TILT_COUNTER, TILT_HIGHEST, TILT_PATIENCE = 0, 1, 2, 3
"""Double inputs of a dose, counted from the same setting: a `TiltOrder`, and a number that changes with each one."""

NUMBER, STATUS = 12, 13
"""Integer outputs: the number of the motion whose program runs, and its status."""

CLOCK, TOOL = 12, 13
"""Double outputs: time on the path [s], in a dose the tilt [rad]; from `TOOL` on, the six values of the controller's
tool."""

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


@dataclass(frozen=True)
class SafetyMode:
    """A mode of the safety system.

    Attributes:
        word: on the dashboard.
        text: for messages.
        kind: of the stop, see `actors.arm.arm_interface.ArmStoppedError`; '' if the arm may move.
        advice: the remedy.
    """

    word: str
    text: str
    kind: str
    advice: str


_CLOSE_GUARD = "a door, mat or light curtain holds it: close it"
_RELEASE = "release the emergency stop, once you know why it was pressed"
_INSPECT = "find the cause, then unlock it on the teach pendant; Decant never does so by itself"
_RECOVER = "the arm is outside its limits: bring it back by hand in the recovery mode of the teach pendant"
_ENABLE = "hold the enabling device in its middle position, or switch it off on the teach pendant"
_RESTART = "look at the teach pendant; a fault of the safety system needs a restart, or the maker's service"

SAFETY_MODES = {
    number: SafetyMode(*row)
    for number, *row in (
        (1, "NORMAL", "normal", "", ""),
        (2, "REDUCED", "reduced mode", "", "pours need the normal limits: end it, at the pendant or its input"),
        (3, "PROTECTIVE_STOP", "protective stop", "protective stop", _INSPECT),
        (4, "RECOVERY", "recovery mode", "safety", _RECOVER),
        (5, "SAFEGUARD_STOP", "safeguard stop", "safeguard", _CLOSE_GUARD),
        (6, "SYSTEM_EMERGENCY_STOP", "emergency stop (system)", "emergency stop", _RELEASE),
        (7, "ROBOT_EMERGENCY_STOP", "emergency stop (robot)", "emergency stop", _RELEASE),
        (8, "VIOLATION", "safety violation", "safety", _RESTART),
        (9, "FAULT", "fault of the safety system", "safety", _RESTART),
        (10, "VALIDATE_JOINT_ID", "validation of a joint", "safety", "confirm the joint on the teach pendant"),
        (11, "UNDEFINED_SAFETY_MODE", "undefined safety mode", "safety", _RESTART),
        (12, "AUTOMATIC_MODE_SAFEGUARD_STOP", "safeguard stop (automatic mode)", "safeguard", _CLOSE_GUARD),
        (13, "SYSTEM_THREE_POSITION_ENABLING_STOP", "stop by an enabling device", "safeguard", _ENABLE),
        (14, "TP_THREE_POSITION_ENABLING_STOP", "stop by the pendant's enabling device", "safeguard", _ENABLE),
        (15, "IMMI_EMERGENCY_STOP", "emergency stop (injection moulding machine)", "emergency stop", _RELEASE),
        (16, "IMMI_SAFEGUARD_STOP", "safeguard stop (injection moulding machine)", "safeguard", _CLOSE_GUARD),
        (17, "PROFISAFE_WAITING_FOR_PARAMETERS", "wait for PROFIsafe", "safety", "start the PROFIsafe controller"),
        (18, "PROFISAFE_AUTOMATIC_MODE_SAFEGUARD_STOP", "safeguard stop (PROFIsafe, automatic mode)", "safeguard",
         _CLOSE_GUARD),
        (19, "PROFISAFE_SAFEGUARD_STOP", "safeguard stop (PROFIsafe)", "safeguard", _CLOSE_GUARD),
        (20, "PROFISAFE_EMERGENCY_STOP", "emergency stop (PROFIsafe)", "emergency stop", _RELEASE),
        (22, "SAFETY_API_SAFEGUARD_STOP", "safeguard stop (safety API)", "safeguard", _CLOSE_GUARD),
    )
}  # fmt: skip
"""RTDE's safety modes. Words above 9 are those of the manufacturer's client library; no public document names 21."""


def safety_mode(number: int) -> SafetyMode:
    """A safety mode by its number; an unknown one is a stop that a person has to look at."""
    return SAFETY_MODES.get(number, SafetyMode("", f"safety mode {number}", "safety", _RESTART))


RUNNING_MODE, NORMAL, REDUCED = 7, 1, 2
FREEDRIVE = 1 << 2
"""Bit of `robot_status_bits`: the freedrive button on the teach pendant is pressed."""

STOPPED_PROGRAM, PLAYING = 1, 2


LEAST_SPEED = 0.01
"""Smallest fraction of the programmed speed for any motion."""


def why_not_ready(
    robot_mode: int, safety: int, runtime: int, slider: float, status: int = 0, *, pours: bool = True
) -> str:
    """Why an arm cannot move; '' if it can. Driver, worker, `decant robot check` and its display all use this decision.

    Reduced mode prevents pours: they are planned within the normal limits, and would end in a protective stop. Slow
    motions back to home are allowed.

    Args:
        robot_mode, safety, runtime: RTDE's numbers (`robot_mode`, `safety_mode`, `runtime_state`).
        slider: `target_speed_fraction`, 0 … 1.
        status: `robot_status_bits`.
        pours: whether the motion carries or pours liquid.
    """
    if not may_move(safety, pours=pours):
        return f"{safety_mode(safety).text} is in force"
    if robot_mode != RUNNING_MODE:
        return f"the robot is {ROBOT_MODES.get(robot_mode, f'in mode {robot_mode}')}, not running"
    if status & FREEDRIVE:
        return "the freedrive button is pressed: a person moves the arm by hand; let it go"
    if runtime != STOPPED_PROGRAM:
        return "a program runs on the controller, or is paused; stop it at the pendant"
    if slider < (FULL_SPEED if pours else LEAST_SPEED):
        needed = "a pour needs 100 %" if pours else "nothing would move"
        return f"the speed slider is at {100.0 * slider:.0f} %; {needed}"
    return ""


def may_move(safety: int, *, pours: bool) -> bool:
    """Whether a safety mode allows a motion: reduced mode only without liquid."""
    return safety == NORMAL or (safety == REDUCED and not pours)


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
        registers: first of the three integer inputs that are written, and of the four double inputs of a dose.
    """

    tool: tuple[float, ...]
    payload: float
    centre: tuple[float, ...]
    registers: int


@dataclass(frozen=True)
class TiltOrder:
    """What a dose's program does until the next order.

    Attributes:
        speed: of the tilt [rad/s].
        highest: tilt from upright at which it stops [rad].
        patience: time without an order after which it turns the cup back [s of controller time].
    """

    speed: float
    highest: float
    patience: float


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
        pours: it carries or pours liquid, so it needs the normal limits and the full speed.
        tilts: it is a dose, whose orders come over registers. Without news it ends by itself, upright; the first order
            to stop ends it in this way.
    """

    program: str
    number: int
    start: tuple[float, ...]
    end: tuple[float, ...]
    duration: float
    settings: MotionSettings
    stops: int
    pours: bool
    tilts: bool = False


@dataclass(frozen=True)
class DataPackage:
    """One package of the controller.

    Attributes:
        time: of the controller [s]; `seen` [s of `time.monotonic`].
        joints, speeds: measured [rad], [rad/s].
        robot_mode, safety_mode, runtime: as numbers.
        slider: position of the speed slider, 0 … 1.
        scaling: the controller's own slowing, 0 … 1.
        payload: [kg]; `centre` [m].
        number, status, clock, tool: of the program, see the registers.
        status_bits: `robot_status_bits`.
        force: external force and torque at the TCP, in the base's frame [N], [N m], as the controller estimates them.
        wrist: raw force and torque of the sensor in the wrist, in a frame that no document names; empty if the robot
            has none.
    """

    time: float
    seen: float
    joints: tuple[float, ...]
    speeds: tuple[float, ...]
    robot_mode: int
    safety_mode: int
    runtime: int
    slider: float
    scaling: float
    payload: float
    centre: tuple[float, ...]
    number: int
    status: int
    clock: float
    tool: tuple[float, ...]
    status_bits: int = 0
    force: tuple[float, ...] = ()
    wrist: tuple[float, ...] = ()

    @property
    def speed(self) -> float:
        """Fraction of the programmed speed at which the arm really moves."""
        return self.slider * self.scaling

    @property
    def stands(self) -> bool:
        """Whether no joint moves."""
        return max(map(abs, self.speeds)) < STANDSTILL


STANDSTILL = 2e-3
"""Joint speed below which a joint counts as standing still [rad/s]."""

Sample = tuple[float, tuple[float, ...], float]
"""Controller time [s], joints [rad], time on the path [s]."""

ForceSample = tuple[float, tuple[float, ...], tuple[float, ...]]
"""Time on the path [s], external force, raw wrist force; see `DataPackage`."""


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
        slider: lowest fraction of the programmed speed that was seen.
        forces: ten readings a second.
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
    forces: tuple[ForceSample, ...] = ()


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
