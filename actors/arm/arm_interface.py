"""The interface of pouring arms, and its values.

- `Arm` is the interface of every driver. `actors.contract_tests.arm_contract` defines its behaviour as tests.
- `PlannedPour` and `Executed` are a pour before and after its execution.
- `ArmFigure` gives the live view the positions of an arm's links.
- `ArmError` and its subclasses are errors for the operator next to the arm.

A driver is a plain, blocking class. `actors.runtime.remote_object` runs it in a thread or a process;
`actors.arm.arm_device` awaits its calls. This module contains no driver.
`actors.arm_geometry` describes the surroundings of an arm.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.arm_geometry import Pose
from actors.interfaces import LaboratoryError

FloatArray = NDArray[np.float64]

FULL_SPEED = 0.99
"""Fraction of the programmed speed below which a pour is slowed."""


@dataclass(frozen=True)
class ArmState:
    """The present state of an arm.

    Attributes:
        moving: a motion is running.
        stopped: `stop` is in force; nothing moves until `release`.
        time: bench time since the motion began [s].
        fraction: of the motion, 0 … 1.
        phase: 'announced', 'approach', the pour's 'tilt', 'hold', 'return', then 'retreat'; 'untilt', 'jog', 'carry';
            'idle'.
        tilt: of the pourer [rad].
        joints: as last measured [rad]; empty if the arm does not report them.
        pourer: pose of the pourer in the world (x y z [m], qw qx qy qz), from an arm without joints; else empty.
    """

    moving: bool = False
    stopped: bool = False
    time: float = 0.0
    fraction: float = 0.0
    phase: str = "idle"
    tilt: float = 0.0
    joints: tuple[float, ...] = ()
    pourer: tuple[float, ...] = ()


@dataclass(frozen=True)
class ArmFacts:
    """Identity of an arm, and whether it can move.

    Attributes:
        model, serial, version: for messages and records; '' if the arm has none.
        checksum: of the arm's safety settings, as it reports it; '' if it has none.
        problem: why it cannot move now; '' if it can.
        calibration: checksum of the arm's own geometry, with which its pours are planned; '' if it reports none.
    """

    model: str
    serial: str = ""
    version: str = ""
    checksum: str = ""
    problem: str = ""
    calibration: str = ""


@dataclass(frozen=True)
class ArmPose:
    """The pose of an arm, for setting up.

    Attributes:
        tool: in the base's frame.
        joints: measured [rad]; empty if the arm does not report them.
        home: joints of the home pose [rad]; empty likewise.
    """

    tool: Pose
    joints: tuple[float, ...] = ()
    home: tuple[float, ...] = ()


@dataclass(frozen=True)
class PathReport:
    """Results of the checks of a whole pour, made before the first movement.

    Attributes:
        joint_speed: of the fastest joint [rad/s]; `fastest_joint` is its index from 0. Both are 0 if joints are
            unknown. `joint_name` is its name; '' for 'joint 1' and so on.
        tool_speed: of the fastest point of tool or pourer [m/s].
        tilt: largest [rad]; tilt_speed: largest [rad/s].
        singularity: smallest distance from a singularity, as `ArmLimits.singularity`; 1 for an arm that has none.
        clearance: smallest distance of the pourer from the receiver [m]; 0 if only the absence of contact is known.
        low, high: corners of the box through which tool and pourer pass [m].
        duration: of approach, pour and retreat together [s].
        deviation: largest difference between the requested tilt and the path's tilt at the same time [rad]. It exceeds
            rounding only if a step in speed was requested, which joints cannot make.
    """

    joint_speed: float
    fastest_joint: int
    tool_speed: float
    tilt: float
    tilt_speed: float
    singularity: float
    clearance: float
    low: tuple[float, float, float]
    high: tuple[float, float, float]
    duration: float
    deviation: float = 0.0
    joint_name: str = ""

    @property
    def fastest(self) -> str:
        """Name of the fastest joint."""
        return self.joint_name or f"joint {self.fastest_joint + 1}"


class PlannedPour(Protocol):
    """A whole pour, planned and checked for one arm: approach, pour, retreat."""

    @property
    def approach_time(self) -> float:
        """Duration from home to the pour's first pose [s]."""
        ...

    @property
    def pour_time(self) -> float:
        """Duration of tilt, hold and return [s]."""
        ...

    @property
    def retreat_time(self) -> float:
        """Duration of the way back home [s]."""
        ...

    @property
    def phases(self) -> tuple[tuple[str, float, float], ...]:
        """The pour's parts, 'tilt', 'hold', 'return': name, start, end [s]."""
        ...

    @property
    def report(self) -> PathReport:
        """Results of its checks, for the operator who gives consent."""
        ...

    def slowed(self, factor: float) -> PlannedPour:
        """The same path with all its times divided by a factor in (0, 1]."""
        ...


class Executed(Protocol):
    """The motion that an arm executed, measured at its joints."""

    @property
    def times(self) -> FloatArray:
        """Times of the readings, shape (T,), increasing from 0 at the pour's start [s]."""
        ...

    @property
    def poses(self) -> FloatArray:
        """Poses of the pourer in the world, shape (T, 7): x y z [m] qw qx qy qz.

        An arm measures the pose of its flange, not of the vessel in the gripper: these poses do not contain errors of
        grip.
        """
        ...

    @property
    def completed(self) -> bool:
        """False if it was stopped before its end."""
        ...

    @property
    def tracking(self) -> Mapping[str, float]:
        """Measures of how closely the plan was followed, as far as the arm reports them.

        'slider' is the lowest fraction of the programmed speed; below `FULL_SPEED`, the user is warned.
        """
        ...

    def record(self) -> dict[str, Any]:
        """For the pour's record: JSON-ready, small, and sufficient to simulate the motion again."""
        ...


class Arm(Protocol):
    """A robot arm that pours. Software never repeats a lost motion.

    All methods block, and may be called from several threads: `stop` and `state` at any time, also during a motion.
    Every method raises `actors.arm.arm_interface.ArmLostError` if the arm cannot be reached.
    """

    def connect(self) -> ArmFacts:
        """Connect to the arm, again if it was connected before. Nothing moves, and nothing may move until `release`.

        Raises:
            ArmRefusedError: the arm is not the one that the settings describe.
            NotAcceptedError: the safety settings have not been accepted.
        """
        ...

    def facts(self) -> ArmFacts:
        """The arm's present facts; not during a motion. Raises as `connect`, and ArmLostError before `connect`."""
        ...

    def hands_in(self) -> None:
        """Make sure, before the operator reaches into the cell, that nothing moves or can move without `release`.

        Raises:
            ArmError: this cannot be verified. The operator must not reach into the cell.
        """
        ...

    def release(self) -> None:
        """Record an operator's consent to the next cycle: approach, pour, retreat; or to one recovery, un-tilting or
        jog.

        Consent ends with that motion, with any stop, refusal or loss, and with `hands_in`.
        """
        ...

    def move_to_start(self, path: Any) -> None:
        """Move from home to the pour's start, with the pourer upright.

        Args:
            path: a `PlannedPour` that this arm's settings have planned; so are all paths below.

        Raises:
            ArmNotReleasedError: the operator has not given consent.
            ArmRefusedError: refused before anything moved.
            ArmStoppedError: stopped during the motion.
        """
        ...

    def execute(self, path: Any) -> Executed:
        """Tilt, hold, return; raises as `move_to_start`. An interrupted motion raises an error instead of returning."""
        ...

    def retreat(self, path: Any) -> None:
        """Move home from the pour's end, or from any pose where an upright pourer was stopped; raises as
        `move_to_start`.
        """
        ...

    def untilt(self, path: Any = None) -> None:
        """Bring a stopped pourer slowly upright, along the path by which it came; raises as `move_to_start`.

        Args:
            path: of the pour that was stopped; the last one by default.
        """
        ...

    def recover(self) -> str:
        """Make the arm ready after a stop that the operator has looked into.

        Nothing moves. Needs consent, which then ends.

        Returns:
            A description of the actions taken; '' if none was needed.

        Raises:
            ArmRefusedError: a manual action is needed first.
        """
        ...

    def stop(self) -> float:
        """Stop any motion at once and wait until the arm stands still. Nothing moves until `release`.

        Returns:
            Time from the call to standstill [s]; 0 if nothing was moving.
        """
        ...

    def state(self) -> ArmState:
        """The arm's present state. Returns at once, also during a motion."""
        ...

    def where(self) -> ArmPose:
        """The arm's pose, for setting up; not during a motion."""
        ...

    def jog(self, axis: str, amount: float, speed: float) -> None:
        """Make one small step, for setting up; raises as `move_to_start`.

        Args:
            axis: 'joint 1' …, or an axis of the base along or about which the tool moves: 'x', 'y', 'z', 'rx', 'ry',
                'rz'.
            amount: [rad] or [m].
            speed: [rad/s] or [m/s].
        """
        ...

    def close(self) -> None:
        """Stop and disconnect. May be called again."""
        ...


NEWS_TIMEOUT = 0.2
"""Longest time without a command after which an arm turns the cup of a dose back by itself [s of bench time]."""


class DosingArm(Protocol):
    """An `Arm` that also pours wanted amounts: its tilt is driven while the liquid flows."""

    def dose(self, path: Any, longest: float) -> Executed:
        """Tilt as `drive` says, within the tilt of a checked path; ends upright, when no commands come.

        An order to stop turns the cup back upright first; a second one stops the arm where it is.

        Args:
            path: a `PlannedPour`; the arm stands at its start.
            longest: duration [s of controller time].

        Raises:
            ArmError: as `Arm.execute`.
        """
        ...

    def drive(self, speed: float, highest: float, patience: float) -> ArmState:
        """Set the motion of a running dose until the next call, ten to twenty times a second. Returns the state.

        The arm keeps both limits by itself, in its own cycle, however late the next call is.

        Args:
            speed: of the tilt [rad/s].
            highest: tilt at which the arm stops, see `ArmState.tilt`; a larger tilt does not grow [rad].
            patience: time without a further call after which the cup is turned back; `NEWS_TIMEOUT` at most [s of
                bench time].
        """
        ...


class CarryingArm(Protocol):
    """An `Arm` that also carries vessels between places."""

    def carry(self, way: Any) -> None:
        """Move from home to a place, or back; raises as `Arm.move_to_start`. The consent stays.

        Args:
            way: an `actors.arm.planned_pour.PlaceWay`; the arm stands at its begin, or at its end if it is homewards.
        """
        ...


@dataclass(frozen=True)
class Bar:
    """One link.

    Attributes:
        name: for messages.
        radius: [m].
    """

    name: str
    radius: float


class ArmFigure(Protocol):
    """Positions of all parts of an arm, in the world frame of pours (`actors.arm.arm_interface`)."""

    @property
    def bars(self) -> tuple[Bar, ...]:
        """The links, from the base to the tool; each has a constant length."""
        ...

    @property
    def home(self) -> tuple[float, ...]:
        """Joints of the home pose [rad]."""
        ...

    @property
    def table(self) -> float:
        """Height of the table [m]."""
        ...

    def ends(self, joints: FloatArray) -> FloatArray:
        """Both ends of every bar, shape (..., bars, 2, 3) [m], for joints (..., n) [rad]."""
        ...

    def tool(self, joints: FloatArray) -> FloatArray:
        """Poses of the tool centre point, shape (T, 7), for joints (T, n)."""
        ...

    def pourer(self, joints: FloatArray) -> FloatArray:
        """Poses of the vessel in the hand, shape (T, 7), for joints (T, n)."""
        ...

    def tool_of(self, poses: FloatArray) -> FloatArray:
        """Positions of the tool centre point, shape (T, 3) [m], for poses (T, 7) of the vessel in the hand."""
        ...

    def executed(self, record: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        """Times (T,) [s] and joints (T, n) [rad] of a pour's record (`Executed.record`); None if it has none."""
        ...


class ArmError(LaboratoryError):
    """The arm cannot do what was requested."""


class ArmRefusedError(ArmError):
    """Refused before anything moved."""


class ArmNotReleasedError(ArmRefusedError):
    """The operator has not released the arm since the last stop, start or recovery."""


class NotAcceptedError(LaboratoryError):
    """The arm's safety settings differ from the accepted ones; the arm does not move."""


class ArmLostError(ArmError):
    """The controller, the connection to it or the driver's worker is lost; the arm stops by its watchdog.

    Args:
        text: what happened.
        executed: the known part of the running motion.
    """

    def __init__(self, text: str, executed: Executed | None = None) -> None:
        super().__init__(text)
        self.text, self.executed = text, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.executed)


class ArmStoppedError(ArmError):
    """A motion was interrupted; the arm stands where it was stopped and is locked.

    Args:
        text: what happened, and what to do.
        kind: 'operator', 'protective stop', 'emergency stop', 'safeguard', 'safety', 'watchdog', 'program ended'.
        phase: of the motion: 'announced', 'approach', 'tilt', 'hold', 'return', 'retreat', 'untilt', 'jog',
            'carry'.
        time: since the motion's start [s of controller time].
        tilt: of the stopped pourer [rad].
        executed: the part of the motion that was executed; None if there is none.
    """

    def __init__(
        self, text: str, kind: str, phase: str, time: float, tilt: float, executed: Executed | None = None
    ) -> None:
        super().__init__(text)
        self.text, self.kind, self.phase = text, kind, phase
        self.time, self.tilt, self.executed = time, tilt, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.kind, self.phase, self.time, self.tilt, self.executed)
