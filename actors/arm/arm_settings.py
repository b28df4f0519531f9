"""Settings of arms: plain values that know which driver they are for, and what plans pours for it.

Drivers and planners are named by text and imported when they are needed: settings are read where nothing is started.

What an arm tells when it is looked at, for `decant doctor`: lines for people, and what of it people accept.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, field, replace
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from actors.arm.arm_interface import ArmLimits, Joints, Mount, Pose, RobotCell, Vector
from actors.interfaces import DeviceCheck
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.settings.model import FREE

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFigure, PlannedPour
    from actors.arm.planned_pour import PourPath


@dataclass(frozen=True)
class SafetyRecord:
    """Safety settings of an arm that somebody has accepted.

    Attributes:
        checksum: of the settings, as the arm tells it.
        serial: of the robot.
        model: of the robot.
        software: version on its controller.
        date: day and time, ISO 8601.
        accepted_by: who.
    """

    checksum: str
    serial: str
    model: str
    software: str
    date: str
    accepted_by: str


@dataclass(frozen=True)
class ArmDiagnostics:
    """An arm that was looked at, moving and setting nothing. Arms with more to tell derive from this.

    Attributes:
        checksum: of the settings that keep people safe; '' if the arm tells none, and then none can be accepted.
        serial, model, software: as in `SafetyRecord`.
        problem: why the arm can't move now, or can't be reached; '' if it could.
    """

    checksum: str = ""
    serial: str = ""
    model: str = ""
    software: str = ""
    problem: str = ""

    def checks(self, record: SafetyRecord | None, *, accept: str, virtual: bool) -> list[DeviceCheck]:
        """One line for everything that was found.

        Args:
            record: what was accepted; None if nothing was.
            accept: the command that accepts it.
            virtual: nobody has to.
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
        """Whether the arm stands where it waits."""
        return DeviceCheck("position", "ok", "at home, as far as the driver tells")


ArmModel = Literal["ur10", "ur10e"]


class ArmSpec(ABC):
    """Settings of one arm: frozen values that travel to where the bench is.

    Attributes:
        kind: as registered in `decant.arms`, and as written in files.
        stand_in: 'module:callable' that makes of these settings what stands in for the arm on a virtual bench, see
            `actors.bench.device_emulators.ArmEmulator`; '' for a driver that moves nothing but numbers itself.
        time_scale: bench seconds per second of the clock; 1 for anything real, 0 waits for nothing.
        announcement: from a person's consent to the first movement [s].
        untilt_speed: at which a stopped, tilted pourer is brought upright [rad/s].
    """

    kind: ClassVar[str]
    stand_in: ClassVar[str] = ""
    time_scale: float
    announcement: float
    untilt_speed: float = math.radians(10.0)

    @abstractmethod
    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (an `actors.arm.arm_interface.Arm`), importable by name, and its arguments.

        Args:
            accepted: checksum of the safety settings of hardware that people have accepted, '' if nobody has; None
                where nothing is hardware.
        """

    @abstractmethod
    def plan(self, scene: Scene, action: Action) -> PlannedPour:
        """Check a whole pour and plan it.

        Raises:
            InvalidActionError: it can't be made; with everything that is wrong with it.
        """

    def paced(self, time_scale: float) -> ArmSpec:
        """The same arm in a virtual bench's time."""
        return replace(self, time_scale=time_scale)  # type: ignore[type-var]

    def announced(self, announcement: float) -> ArmSpec:
        """The same arm, which waits for so long between consent and movement [s]."""
        return replace(self, announcement=announcement)  # type: ignore[type-var]

    @property
    def untilt_time(self) -> float:
        """Longest time that bringing a stopped pourer upright may take [s]."""
        return 4.0 * math.radians(140.0) / self.untilt_speed

    def on_clock(self, seconds: float) -> float:
        """Bench time on the clock [s]; none where nothing is waited for."""
        return seconds / self.time_scale if self.time_scale > 0.0 else 0.0

    def figure(self) -> ArmFigure | None:
        """What it looks like, for those who watch; None: nobody says, and only the vessel in its hand is shown."""
        return None

    def missing(self) -> str | None:
        """What its driver needs that isn't installed, in words; None if nothing is missing."""
        return None

    @property
    def title(self) -> str:
        """Who it is, for people."""
        return self.kind

    @property
    def payload_limit(self) -> float | None:
        """What it is set up to carry [kg]; None where nobody said."""
        return None

    @property
    def tilt_speed_limit(self) -> float | None:
        """How fast it may turn the pourer [rad/s]; None where nobody said."""
        return None

    def look(self) -> ArmDiagnostics:
        """Ask the arm everything that `decant doctor` tells of; nothing moves, nothing is set."""
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


@dataclass(frozen=True)
class UrArmSpec(ArmSpec):
    """A UR arm that holds the pourer.

    Attributes:
        model: which one.
        limits: what it may do here.
        cell: what stands where.
        home: joints where it waits, out of people's way, the pourer upright [rad].
        address: of the controller; '' for a virtual one, which is started and has its address filled in.
        mount: how the robot is screwed down.
        tool: TCP in the flange's frame.
        payload: of gripper and filled pourer [kg].
        payload_centre: in the flange's frame [m].
        grip: pourer in the TCP's frame.
        approach_speed: of the fastest joint on the way between home and pour [rad/s].
        approach_acceleration: likewise [rad/s²].
        untilt_speed: at which a stopped, tilted pourer is brought upright [rad/s].
        announcement: from an operator's consent to the first movement [s].
        rate: at which it is read back [Hz], at least 100.
        time_scale: controller seconds per second of the clock; 1 for a real one.
    """

    model: ArmModel
    limits: ArmLimits
    cell: RobotCell
    home: Joints
    address: Annotated[str, FREE] = ""
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
    stand_in: ClassVar[str] = "actors.emulators.ur_controller.controller_process:UrEmulator"

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
