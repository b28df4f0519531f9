"""What a pouring arm can be asked, and what it tells: one small protocol for every arm, and its values. No driver.

A driver is a plain, blocking class; `actors.runtime.remote_object` puts it into a thread or a process,
`actors.arm.arm_device` awaits it.
What it must do is written down once more as tests: `actors.contract_tests.arm_contract`.

Where things stand around an arm, and what it may do there. Plain values.

Frames. *Base*: of the robot, as its controller has it. *Room*: origin where the base's is, z up; the same as the base
for an arm that stands on a table and isn't turned (`Mount`). *Flange*: where tools are screwed on. *TCP*: tool centre
point, as set on the controller. *Pourer*: of the vessel that pours, underside at z = 0, axis along z. *World*: of pours
(`sim_engine.motion`): origin below the receiver's middle, z up, the liquid goes towards +x.

What can go wrong with the arm, for the person who stands beside it.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from actors.interfaces import LaboratoryError

JOINT_NAMES = tuple(
    f"joint {k} ({name})"
    for k, name in enumerate(("base", "shoulder", "elbow", "wrist 1", "wrist 2", "wrist 3"), start=1)
)
"""What messages call the joints, in their order: numbered from 1, as on the axes of `decant jog`."""

Vector = tuple[float, float, float]
Joints = tuple[float, float, float, float, float, float]


@dataclass(frozen=True)
class Pose:
    """Where a frame stands in another.

    Attributes:
        x, y, z: [m].
        rx, ry, rz: rotation vector [rad], as the teach pendant shows it.
    """

    x: float = 0.0
    y: float = 0.0
    z: float = 0.0
    rx: float = 0.0
    ry: float = 0.0
    rz: float = 0.0

    @property
    def as_list(self) -> list[float]:
        """x y z rx ry rz, as the controller takes it."""
        return [self.x, self.y, self.z, self.rx, self.ry, self.rz]


@dataclass(frozen=True)
class Mount:
    """How the robot is screwed down: it is turned about its own z axis, then leant about the room's x axis.

    Attributes:
        tilt: 0 on a table, 90° on a wall, 180° on a ceiling [rad].
        turn: [rad].
    """

    tilt: float = 0.0
    turn: float = 0.0

    @property
    def up(self) -> Vector:
        """Where up is, in the base's frame; of length 1."""
        lean = math.sin(self.tilt)
        return (lean * math.sin(self.turn), lean * math.cos(self.turn), math.cos(self.tilt))


@dataclass(frozen=True)
class Plane:
    """A half-space that the arm has to stay in: normal · point ≥ offset, in the room's frame.

    Attributes:
        normal: towards the allowed side, of length 1.
        offset: [m].
    """

    normal: Vector
    offset: float


@dataclass(frozen=True)
class ArmLimits:
    """What the arm may do here. Hard: checked before a pour is planned, and again by what moves the arm.

    Attributes:
        box_low, box_high: corners of the box, in the room's frame, that tool and pourer stay in [m].
        planes: half-spaces for the same.
        joint_speed: of any joint [rad/s].
        tool_speed: of the TCP, and of any point of the pourer [m/s].
        tilt: largest tilt of the pourer [rad].
        tilt_speed: largest angular velocity of the pourer [rad/s].
        singularity: smallest |sin| of wrist and elbow, and shoulder's distance from its axis over its reach.
        clearance: between the pourer and whatever it must not touch [m].
    """

    box_low: Vector
    box_high: Vector
    planes: tuple[Plane, ...] = ()
    joint_speed: float = math.radians(150.0)
    tool_speed: float = 1.0
    tilt: float = math.radians(140.0)
    tilt_speed: float = math.radians(130.0)
    singularity: float = 0.1
    clearance: float = 5e-3


@dataclass(frozen=True)
class RobotCell:
    """What stands where around the arm.

    Attributes:
        receiver: where the receiver's underside stands, middle, in the room's frame [m].
        direction: that the liquid is poured in, seen from above: 0 along the room's x, turning towards y [rad].
        table: height of the surface that nothing may go below, in the room's frame [m].
    """

    receiver: Vector
    direction: float = 0.0
    table: float = 0.0


FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class ArmState:
    """Where an arm is now.

    Attributes:
        moving: a motion is under way.
        stopped: `stop` is in force; nothing moves until `release`.
        time: bench time since the motion began [s].
        fraction: of the motion, 0 … 1.
        phase: 'announced', 'approach', the pour's 'tilt', 'hold', 'return', then 'retreat'; 'untilt', 'jog'; 'idle'.
        tilt: of the pourer [rad].
        joints: as last measured [rad]; empty for an arm that doesn't tell.
        pourer: pose of the pourer in the world (x y z [m], qw qx qy qz), from an arm without joints; empty likewise.
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
    """Which arm this is, and whether it could move.

    Attributes:
        model, serial, version: for people and records; '' where there is no such thing.
        checksum: of the settings that keep people safe, as the arm tells it; '' if it has none.
        problem: why it can't move now, in words; '' if it could.
    """

    model: str
    serial: str = ""
    version: str = ""
    checksum: str = ""
    problem: str = ""


@dataclass(frozen=True)
class ArmPose:
    """Where an arm stands, for setting up.

    Attributes:
        tool: in the base's frame.
        joints: measured [rad]; empty for an arm that doesn't tell.
        home: joints where it waits [rad]; empty likewise.
    """

    tool: Pose
    joints: tuple[float, ...] = ()
    home: tuple[float, ...] = ()


@dataclass(frozen=True)
class PathReport:
    """What was found out about a whole pour before the first movement.

    Attributes:
        joint_speed: fastest joint [rad/s], and `fastest_joint` which one, 0 …; 0 where joints aren't known.
        tool_speed: fastest point of tool or pourer [m/s].
        tilt: largest [rad]; tilt_speed: largest [rad/s].
        singularity: smallest distance from one, as `ArmLimits.singularity`; 1 for an arm that has none.
        clearance: smallest distance of the pourer from the receiver [m]; 0 where it is only known not to touch.
        low, high: corners of the box that tool and pourer pass through [m].
        duration: of approach, pour and retreat together [s].
        deviation: largest difference between the tilt that was asked for and the path's at the same time [rad]; more
            than rounding only where a step in speed was asked for, which joints can't make.
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


class PlannedPour(Protocol):
    """A whole pour, planned and checked for one arm: way there, pour, way back."""

    @property
    def approach_time(self) -> float:
        """From home to the pour's first pose [s]."""
        ...

    @property
    def pour_time(self) -> float:
        """Tilt, hold, return [s]."""
        ...

    @property
    def retreat_time(self) -> float:
        """Back home [s]."""
        ...

    @property
    def phases(self) -> tuple[tuple[str, float, float], ...]:
        """The pour's parts, 'tilt', 'hold', 'return': name, start, end [s]."""
        ...

    @property
    def report(self) -> PathReport:
        """What was found out about it, for whoever lets it happen."""
        ...

    def slowed(self, factor: float) -> PlannedPour:
        """The same way, with all its times divided by a factor in (0, 1]."""
        ...


class Executed(Protocol):
    """What an arm did, as it read it from its own joints."""

    @property
    def times(self) -> FloatArray:
        """Times of the readings, shape (T,), increasing from 0 at the pour's begin [s]."""
        ...

    @property
    def poses(self) -> FloatArray:
        """Poses of the pourer in the world, shape (T, 7): x y z [m] qw qx qy qz.

        An arm knows where its flange is, not how the vessel sits in the fingers: errors of grip are not in it.
        """
        ...

    @property
    def completed(self) -> bool:
        """False if it was stopped on the way."""
        ...

    @property
    def tracking(self) -> Mapping[str, float]:
        """How well the plan was followed, as far as the arm knows."""
        ...

    def record(self) -> dict[str, Any]:
        """For the pour's record, JSON-ready and small: enough to simulate the motion again."""
        ...


class Arm(Protocol):
    """A robot arm that pours. Motions are never repeated by software: a lost one is lost.

    All methods block, and may be called from several threads: `stop` and `state` at any time, also during a motion.
    Every method raises `actors.arm.arm_interface.ArmLostError` when the arm can't be reached.
    """

    def connect(self) -> ArmFacts:
        """Find the arm, anew if it was found before. Nothing moves, and nothing may until `release`.

        Raises:
            ArmRefusedError: it is another arm than the settings say.
            NotAcceptedError: nobody has accepted the settings that keep people safe.
        """
        ...

    def facts(self) -> ArmFacts:
        """The arm as it is now; not during a motion. Raises as `connect`, and ArmLostError before it."""
        ...

    def hands_in(self) -> None:
        """Before hands are invited into the cell: see that nothing moves, and that nothing will without `release`.

        Raises:
            ArmError: that can't be verified. Keep hands out.
        """
        ...

    def release(self) -> None:
        """A person consents to the next cycle: way there, pour, way back; or to one recovery, un-tilting or jog.

        Consent ends with that, with any stop, refusal or loss, and with `hands_in`.
        """
        ...

    def move_to_start(self, path: Any) -> None:
        """From home to where the pour begins, the pourer upright.

        Args:
            path: a `PlannedPour` that this arm's settings have planned; so are all paths below.

        Raises:
            ArmNotReleasedError: nobody has consented.
            ArmRefusedError: before anything moved; ArmStoppedError: on the way.
        """
        ...

    def execute(self, path: Any) -> Executed:
        """Tilt, hold, return; raises as `move_to_start`. A motion that was broken off is an error, not an answer."""
        ...

    def retreat(self, path: Any) -> None:
        """Home from the pour's end, or from wherever an upright pourer was stopped; raises as `move_to_start`."""
        ...

    def untilt(self, path: Any = None) -> None:
        """Bring a stopped pourer upright, slowly, the way it came; raises as `move_to_start`.

        Args:
            path: of the pour that was stopped; the last one by default.
        """
        ...

    def recover(self) -> str:
        """After a stop that a person has looked into: make the arm ready, moving nothing. Needs and ends consent.

        Returns:
            What was done, for people; '' if nothing had to be.

        Raises:
            ArmRefusedError: something has to be done by hand first.
        """
        ...

    def stop(self) -> float:
        """Stop, now, whatever is going on, and see the arm stand. Nothing moves until `release`.

        Returns:
            Time from the call to standstill [s]; 0 if nothing was moving.
        """
        ...

    def state(self) -> ArmState:
        """Where the arm is now; answered at once, also during a motion."""
        ...

    def where(self) -> ArmPose:
        """Where it stands, for setting up; not during a motion."""
        ...

    def jog(self, axis: str, amount: float, speed: float) -> None:
        """One small step, for setting up; raises as `move_to_start`.

        Args:
            axis: 'joint 1' …, or of the tool in the base's axes: 'x', 'y', 'z', 'rx', 'ry', 'rz'.
            amount: [rad] or [m].
            speed: [rad/s] or [m/s].
        """
        ...

    def close(self) -> None:
        """Stop, and let the arm go. May be called again."""
        ...


@dataclass(frozen=True)
class Bar:
    """One link.

    Attributes:
        name: for people.
        radius: [m].
    """

    name: str
    radius: float


class ArmFigure(Protocol):
    """Where everything of an arm is, in the world of pours (`actors.arm.arm_interface`)."""

    @property
    def bars(self) -> tuple[Bar, ...]:
        """The links, from the base to the tool; each as long as it always is."""
        ...

    @property
    def home(self) -> tuple[float, ...]:
        """Joints where it waits [rad]."""
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
        """Places of the tool centre point, shape (T, 3) [m], for poses (T, 7) of the vessel in the hand."""
        ...

    def executed(self, record: Mapping[str, Any]) -> tuple[FloatArray, FloatArray] | None:
        """Times (T,) [s] and joints (T, n) [rad] of a pour's record (`Executed.record`); None where it has none."""
        ...


class ArmError(LaboratoryError):
    """The arm can't do what was asked."""


class ArmRefusedError(ArmError):
    """Refused before anything moved."""


class ArmNotReleasedError(ArmRefusedError):
    """Nobody has said since the last stop, start or recovery that the arm may move."""


class NotAcceptedError(LaboratoryError):
    """The arm's safety settings aren't those that people have accepted; it moves nothing."""


class ArmLostError(ArmError):
    """The controller, the line to it or the driver's worker is gone; the arm stops by its watchdog.

    Args:
        text: what happened.
        executed: what is known of the motion that was under way.
    """

    def __init__(self, text: str, executed: Executed | None = None) -> None:
        super().__init__(text)
        self.text, self.executed = text, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.executed)


class ArmStoppedError(ArmError):
    """A motion was broken off; the arm stands where it was stopped and is locked.

    Args:
        text: what happened, and what to do.
        kind: 'operator', 'protective stop', 'emergency stop', 'safeguard', 'safety', 'watchdog', 'program ended'.
        phase: of the motion: 'announced', 'approach', 'tilt', 'hold', 'return', 'retreat', 'untilt', 'jog'.
        time: since the motion's begin [s of controller time].
        tilt: that the pourer is left with [rad].
        executed: what was done until then; None if nothing was.
    """

    def __init__(
        self, text: str, kind: str, phase: str, time: float, tilt: float, executed: Executed | None = None
    ) -> None:
        super().__init__(text)
        self.text, self.kind, self.phase = text, kind, phase
        self.time, self.tilt, self.executed = time, tilt, executed

    def __reduce__(self) -> Any:
        return type(self), (self.text, self.kind, self.phase, self.time, self.tilt, self.executed)
