"""Settings of arms.

- `ArmSpec` is the base class: plain values that name the driver's class and the planner. `UrArmSpec` is for UR arms.
- `SafetyRecord` holds safety settings that an operator has accepted.
- `ArmDiagnostics` holds what an arm reports to `decant doctor`.

Drivers and planners are named by text and imported when they are needed, because settings are also read where no arm is
started.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from actors.arm.arm_geometry import ArmLimits, Joints, Mount, Pose, RobotCell, Vector
from actors.interfaces import DeviceCheck
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.settings.model import NOT_IN_FINGERPRINT

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFigure, PlannedPour
    from actors.arm.planned_pour import PourPath


@dataclass(frozen=True)
class SafetyRecord:
    """Safety settings of an arm that an operator has accepted.

    Attributes:
        checksum: of the settings, as the arm reports it.
        serial: of the robot.
        model: of the robot.
        software: version on its controller.
        date: day and time, ISO 8601.
        accepted_by: name of the operator.
    """

    checksum: str
    serial: str
    model: str
    software: str
    date: str
    accepted_by: str


@dataclass(frozen=True)
class ArmDiagnostics:
    """Results of reading an arm, without moving it or changing a setting. Arms with more facts derive from this class.

    Attributes:
        checksum: of the safety settings; '' if the arm reports none, and then none can be accepted.
        serial, model, software: as in `SafetyRecord`.
        problem: why the arm cannot move now or cannot be reached; '' if it can move.
    """

    checksum: str = ""
    serial: str = ""
    model: str = ""
    software: str = ""
    problem: str = ""

    def checks(self, record: SafetyRecord | None, *, accept: str, virtual: bool) -> list[DeviceCheck]:
        """One line for each fact that was read.

        Args:
            record: the accepted settings; None if there are none.
            accept: the command that accepts them.
            virtual: whether the arm is virtual and needs no acceptance.
        """
        who = " ".join(filter(None, (self.model, self.serial, self.software))) or "not reached"
        checks = [DeviceCheck("arm", "fail" if self.problem else "ok", self.problem or who)]
        if self.checksum and not virtual:
            accepted = record is not None and (record.checksum, record.serial) == (self.checksum, self.serial)
            found = f"{self.checksum}, accepted by {record.accepted_by if record and accepted else 'nobody'}"
            advice = "" if accepted else f"read the arm's safety settings, then: {accept}"
            checks.append(DeviceCheck("safety checksum", "ok" if accepted else "fail", found, advice))
        return checks

    def at_home(self) -> DeviceCheck:
        """Whether the arm stands at its home pose."""
        return DeviceCheck("position", "ok", "at home, as far as the driver tells")


ArmModel = Literal["ur10", "ur10e"]


class ArmSpec(ABC):
    """Settings of one arm: frozen values that are sent to the machine of the bench.

    Attributes:
        kind: as registered in `decant.arms`, and as written in files.
        emulator: 'module:callable' that makes, from these settings, the emulator of the arm on a virtual bench. See
            `actors.bench.virtual_bench.ArmEmulator`; '' for a driver that only simulates.
        time_scale: bench seconds per second of the clock; 1 for hardware, 0 to skip all waits.
        announcement: from the operator's consent to the first movement [s].
        untilt_speed: angular velocity at which a stopped, tilted pourer is brought upright [rad/s].
    """

    kind: ClassVar[str]
    emulator: ClassVar[str] = ""
    time_scale: float
    announcement: float
    untilt_speed: float = math.radians(10.0)

    @abstractmethod
    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (an `actors.arm.arm_interface.Arm`), importable by name, and its arguments.

        Args:
            accepted: checksum of the accepted safety settings of the hardware; '' if none are accepted, None if there
                is no hardware.
        """

    @abstractmethod
    def plan(self, scene: Scene, action: Action) -> PlannedPour:
        """Check a whole pour and plan it.

        Raises:
            InvalidActionError: the pour is impossible; the text lists all problems.
        """

    def paced(self, time_scale: float) -> ArmSpec:
        """The same settings with a virtual bench's time scale."""
        return replace(self, time_scale=time_scale)  # type: ignore[type-var]

    def announced(self, announcement: float) -> ArmSpec:
        """The same settings with another time between consent and movement [s]."""
        return replace(self, announcement=announcement)  # type: ignore[type-var]

    @property
    def untilt_time(self) -> float:
        """Longest time that bringing a stopped pourer upright may take [s]."""
        return 4.0 * math.radians(140.0) / self.untilt_speed

    def on_clock(self, seconds: float) -> float:
        """Bench time converted to clock time [s]; 0 if nothing is waited for."""
        return seconds / self.time_scale if self.time_scale > 0.0 else 0.0

    def figure(self) -> ArmFigure | None:
        """The arm's figure for the live view. None if there is none; then only the pourer is shown."""
        return None

    def missing(self) -> str | None:
        """The missing software that the driver needs, as a message; None if nothing is missing."""
        return None

    @property
    def title(self) -> str:
        """Name of the arm in messages."""
        return self.kind

    @property
    def payload_limit(self) -> float | None:
        """The payload that is set up [kg]; None if unknown."""
        return None

    @property
    def tilt_speed_limit(self) -> float | None:
        """Largest angular velocity of the pourer [rad/s]; None if unknown."""
        return None

    def look(self) -> ArmDiagnostics:
        """Read everything that `decant doctor` reports; nothing moves, no setting changes."""
        from actors.interfaces import LaboratoryError

        cls, arguments = self.driver(None)
        arm = cls(*arguments)
        try:
            facts = arm.connect()
        except LaboratoryError as error:
            return ArmDiagnostics(problem=str(error))
        finally:
            arm.close()
        return ArmDiagnostics(facts.checksum, facts.serial, facts.model, facts.version, facts.problem)

    def readiness(self) -> DeviceCheck | None:
        """Read whether a motion could begin now, for a display while no run uses the arm.

        The reading is short, changes nothing, and does not connect the driver. None if this kind of arm offers none.
        """
        return None


@dataclass(frozen=True)
class UrArmSpec(ArmSpec):
    """A UR arm that holds the pourer.

    Attributes:
        model: of the robot.
        limits: of its motion in this cell.
        cell: positions of the objects around it.
        home: joints of the home pose, out of the operator's way, with the pourer upright [rad].
        address: of the controller; '' for a virtual one, whose address is filled in when it starts.
        mount: mounting of the robot.
        tool: TCP in the flange's frame.
        payload: of gripper and filled pourer [kg].
        payload_centre: in the flange's frame [m].
        grip: pourer in the TCP's frame.
        approach_speed: of the fastest joint on the way between home and pour [rad/s].
        approach_acceleration: of the fastest joint, likewise [rad/s²].
        untilt_speed: angular velocity at which a stopped, tilted pourer is brought upright [rad/s].
        announcement: from an operator's consent to the first movement [s].
        rate: of readings [Hz], at least 100.
        time_scale: controller seconds per second of the clock; 1 for a real one.
    """

    model: ArmModel
    limits: ArmLimits
    cell: RobotCell
    home: Joints
    address: Annotated[str, NOT_IN_FINGERPRINT] = ""
    mount: Mount = field(default_factory=Mount)
    tool: Pose = field(default_factory=Pose)
    payload: float = 0.0
    payload_centre: Vector = (0.0, 0.0, 0.0)
    grip: Pose = field(default_factory=Pose)
    approach_speed: float = math.radians(40.0)
    approach_acceleration: float = math.radians(80.0)
    untilt_speed: float = math.radians(10.0)
    announcement: float = 3.0
    rate: float = 125.0
    time_scale: float = 1.0

    kind: ClassVar[str] = "ur"
    emulator: ClassVar[str] = "actors.emulators.ur_controller.arm_emulator:UrEmulator"

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmSpec.driver`."""
        if accepted is None:
            return resolve_name("actors.arm.ur.ur_driver:UrArm"), (self,)
        return resolve_name("actors.arm.ur.ur_driver:AcceptedArm"), (self, accepted)

    def plan(self, scene: Scene, action: Action) -> PourPath:
        """See `ArmSpec.plan`."""
        plan_path = resolve_name("actors.arm.planning.pour_planner:plan_path")
        planning = resolve_name("actors.bench.pour_feasibility")
        pourer, receiver = planning.vessel(scene.pourer), planning.vessel(scene.receiver)
        path: PourPath = plan_path(planning.plan_pour(scene, action), self, pourer, receiver)
        return path

    def figure(self) -> ArmFigure:
        """See `ArmSpec.figure`."""
        figure: ArmFigure = resolve_name("actors.arm.appearance:LinkFigure")(self)
        return figure

    def missing(self) -> str | None:
        """See `ArmSpec.missing`."""
        missing: str | None = resolve_name("actors.arm.ur.rtde_client:client_missing")()
        return missing

    @property
    def title(self) -> str:
        """See `ArmSpec.title`."""
        return f"{self.model.upper()} at {self.address}"

    @property
    def payload_limit(self) -> float | None:
        """See `ArmSpec.payload_limit`."""
        return self.payload

    @property
    def tilt_speed_limit(self) -> float:
        """See `ArmSpec.tilt_speed_limit`."""
        return self.limits.tilt_speed

    @property
    def untilt_time(self) -> float:
        """See `ArmSpec`."""
        return 4.0 * self.limits.tilt / self.untilt_speed

    def look(self) -> ArmDiagnostics:
        """See `ArmSpec.look`."""
        look: ArmDiagnostics = resolve_name("actors.arm.ur.commissioning:UrDiagnostics").at(self)
        return look

    def readiness(self) -> DeviceCheck | None:
        """See `ArmSpec.readiness`."""
        if not self.address:
            return None
        check: DeviceCheck = resolve_name("actors.arm.ur.commissioning:readiness")(self)
        return check
