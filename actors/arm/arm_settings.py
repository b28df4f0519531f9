"""Settings of arms.

- `ArmSettings` is the base class: frozen values that name the driver's class and the planner; `ARMS` is the registry of
  installed kinds. `UrArmSettings` is for UR arms.
- `SafetyRecord` holds safety settings that an operator has accepted.
- `ArmDiagnostics` holds what an arm reports to `decant robot check`.

Drivers and planners are named by text and imported when they are needed, because settings are also read where no arm is
started.
"""

from __future__ import annotations

import ipaddress
import json
import math
import re
from abc import abstractmethod
from collections.abc import Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from pkgutil import resolve_name
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal, Self

from pydantic import Field, Strict

from actors.arm.arm_geometry import ArmLimits, Centre, JointAngles, Mount, Pose, RobotCell, Speed
from actors.arm.ur.robot_models import MODELS, Calibration, RobotModel, same_robot
from actors.interfaces import DeviceCheck
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.settings.model import (
    NOT_IN_FINGERPRINT,
    SET_BY_PROGRAM,
    Choice,
    Example,
    FilePath,
    Problems,
    Settings,
    Text,
)
from sim_engine.settings.plugin_registry import PluginRegistry, settings_kind
from sim_engine.settings.quantity import Quantity

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFacts, ArmFigure, PlannedPour
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

    def recorded(self) -> dict[str, Any]:
        """The values that were read, JSON-ready, for `ArmSettings.diagnostics_of`; empty if they are not kept."""
        return {}

    def at_home(self) -> DeviceCheck:
        """Whether the arm stands at its home pose."""
        return DeviceCheck("position", "ok", "at home, as far as the driver tells")


class ArmSettings(Settings):
    """Base class of the section `arm`: settings of one arm, which are sent to the machine of the bench.

    The field `kind` of a subclass has the name under which it is registered in `decant.arms`.
    """

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "ur"

    doses: ClassVar[bool] = False
    """Whether the driver pours wanted amounts, see `actors.arm.arm_interface.DosingArm`."""

    emulator: ClassVar[str] = ""
    """'module:callable' that makes, from these settings, the emulator of the arm on a virtual bench. See
    `actors.bench.virtual_bench.ArmEmulator`; '' for a driver that only simulates."""

    kind: str = ""
    """Kind of the arm."""

    time_scale: Annotated[float, SET_BY_PROGRAM] = 1.0
    """Bench seconds per second of the clock; 1 for hardware, 0 to skip all waits."""

    warning_time: Annotated[float, SET_BY_PROGRAM] = 0.0
    """Time from the operator's consent to the first movement [s]."""

    upright_speed: Annotated[float, SET_BY_PROGRAM] = math.radians(10.0)
    """Angular velocity at which a stopped, tilted pourer is brought upright [rad/s]."""

    @classmethod
    def unknown_tag(cls, word: str) -> str:
        """The plug-in that provides this kind, if it could not be loaded."""
        return next((str(broken) for broken in ARMS.broken if broken.name == word), "")

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """Add a problem for each value that does not fit the rest of the laboratory.

        Args:
            problems: of the laboratory, whose keys `arm` and `cell` are.
            mode: 'virtual' or 'hardware'.
            cell: the section `cell`; None if it is missing.
        """

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """The same settings in a cell, with the time scale of a virtual bench (1 on hardware)."""
        return self.with_values(time_scale=time_scale)

    def with_stored(self, folder: Path) -> Self:
        """The settings with the contents of recordings that they name.

        Args:
            folder: of the laboratory's file, to which paths are relative.

        Raises:
            ValueError: a recording cannot be read; the text names it.
        """
        return self

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

    @property
    def upright_time(self) -> float:
        """Longest time that bringing a stopped pourer upright may take [s]."""
        return 4.0 * math.radians(140.0) / self.upright_speed

    def on_clock(self, seconds: float) -> float:
        """Bench time converted to clock time [s]; 0 if nothing is waited for."""
        return seconds / self.time_scale if self.time_scale > 0.0 else 0.0

    def fitted_to(self, facts: ArmFacts) -> Self:
        """The settings with what a connected arm reports about its own geometry, for planning."""
        return self

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

    def diagnostics(self) -> ArmDiagnostics:
        """Read everything that `decant robot check` reports; nothing moves, no setting changes."""
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

    def diagnostics_of(self, recorded: Mapping[str, Any]) -> ArmDiagnostics:
        """The diagnostics of values that were recorded before (`ArmDiagnostics.recorded`); nothing is connected.

        Raises:
            ValueError: the values cannot be read.
        """
        raise ValueError("this kind of arm has no recorded readouts")

    def readiness(self) -> DeviceCheck | None:
        """Read whether a motion could begin now, for a display while no run uses the arm.

        The reading is short, changes nothing, and does not connect the driver. None if this kind of arm offers none.
        """
        return None


ARMS: PluginRegistry[type[ArmSettings]] = PluginRegistry("decant.arms", "arm", settings_kind(ArmSettings))
"""Settings classes of all installed kinds of arms."""

ArmModel = Annotated[str, Choice(lambda: tuple(MODELS), similar=False)]

Acceleration = Annotated[float, Quantity("rad/s^2", "80 deg/s^2", 0.0, math.radians(2000.0), positive=True)]

_HOME = "{base: 0 deg, shoulder: -90 deg, elbow: 90 deg, wrist1: 0 deg, wrist2: -90 deg, wrist3: 0 deg}"
_LIMITS = "{box: {low: {x: …, y: …, z: …}, high: {x: …, y: …, z: …}}}"


class UrArmSettings(ArmSettings):
    """A UR arm that holds the pourer."""

    doses: ClassVar[bool] = True
    emulator: ClassVar[str] = "actors.emulators.ur_controller.arm_emulator:UrEmulator"

    kind: Literal["ur"] = "ur"
    """A UR robot; the default kind."""

    model: Annotated[ArmModel, Example("ur10e")]
    """Model of the robot."""

    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Network address of its controller; a virtual laboratory starts its own controller."""

    mount: Mount = Mount()
    """Mounting of the robot; on a table unless given."""

    tool: Annotated[Pose, Example("{z: 180 mm}")]
    """Tool centre point in the flange's frame, as set on the teach pendant."""

    payload: Annotated[float, Quantity("kg", "1.5 kg", 0.0, 35.0)]
    """Mass of gripper and filled pourer, as set on the teach pendant."""

    payload_centre: Centre = Centre()
    """Centre of gravity of gripper and pourer in the flange's frame."""

    grip: Annotated[Pose, Example("{x: 60 mm, rx: 1.571 rad}")]
    """Pose of the pourer in the frame of the tool centre point: origin in the middle of its underside, z out of its opening, x towards the side where liquid leaves."""  # noqa: E501

    home: Annotated[JointAngles, Example(_HOME)]
    """Waiting pose of the arm, with the pourer upright."""

    limits: Annotated[ArmLimits, Example(_LIMITS)]
    """Limits of the arm in this cell."""

    approach_speed: Speed = math.radians(40.0)
    """Speed of the fastest joint between home and pour."""

    approach_acceleration: Acceleration = math.radians(80.0)
    """Acceleration of the fastest joint between home and pour."""

    upright_speed: Speed = math.radians(10.0)
    """Speed at which a stopped, tilted pourer is brought upright."""

    warning_time: Annotated[float, Quantity("s", "3 s", 0.0, 60.0)] = 3.0
    """Time from the operator's consent to the first movement."""

    rate: Annotated[float, Quantity("1/s", "125 Hz", 100.0, 500.0)] = 125.0
    """Rate at which the joints are read back."""

    registers: Annotated[int, Strict(), Field(ge=0, le=45), NOT_IN_FINGERPRINT] = 43
    """First of the three integer inputs of the controller that are written; 0 to 23 are reserved for a fieldbus."""

    cell: Annotated[RobotCell, SET_BY_PROGRAM]
    """Objects around the arm: the laboratory's section `cell`."""

    calibration_file: Annotated[FilePath | None, NOT_IN_FINGERPRINT] = None
    """Recording of this robot by 'decant robot check --record', with whose calibrated lengths pours are checked before it is connected; nominal lengths unless given."""  # noqa: E501

    calibration: Annotated[Calibration | None, SET_BY_PROGRAM] = None
    """Calibration of this robot: as `calibration_file` records it, and once it is connected, as its controller reports it. None for nominal lengths."""  # noqa: E501

    @property
    def robot(self) -> RobotModel:
        """The robot's kinematics: nominal, or calibrated."""
        return _robot(self.model, self.calibration)

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """See `ArmSettings.check_laboratory`."""
        arm = problems.within("arm")
        self._check_address(arm, mode)
        if arm.valid("model", "rate"):
            fastest = MODELS[self.model].frequency
            if self.rate > fastest:
                arm.add(f"a {self.model} answers at most {fastest} times a second; write '{fastest} Hz'", "rate")
        if arm.valid("model", "payload") and self.payload > (most := MODELS[self.model].payload):
            arm.add(f"a {self.model} carries at most {most:g} kg", "payload")
        if cell is None:
            if problems.valid("cell"):
                problems.add(
                    "an arm needs to know what stands where; add 'cell: {receiver: …, direction: …}' beside it", "arm"
                )
        elif problems.valid("arm", "cell"):
            check_limits = resolve_name("actors.arm.planning.path_checks:check_limits")
            for problem in check_limits(self.with_values(cell=cell)):
                key, _, text = problem.partition(": ")
                owner = problems if key.startswith("cell.") else arm
                owner.add(text, *key.split("."), more=True)

    def _check_address(self, problems: Problems, mode: str) -> None:
        if mode != "hardware":
            if self.address:
                problems.add("a virtual arm has no address: remove it, or write 'mode: hardware'", "address")
        elif not self.address:
            text = "an arm of hardware needs its controller's 'address', for example 'address: 192.168.0.10'"
            problems.add(text, of="address")
        elif not _is_address(self.address):
            problems.add(
                f"{self.address!r} is neither an IPv4 address nor a host name; write for example '192.168.0.10', no "
                "port",
                "address",
            )

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """See `ArmSettings.in_laboratory`."""
        return self.with_values(cell=cell, time_scale=time_scale)

    def driver(self, accepted: str | None) -> tuple[type[Any], tuple[Any, ...]]:
        """See `ArmSettings.driver`."""
        if accepted is None:
            return resolve_name("actors.arm.ur.ur_driver:UrArm"), (self,)
        return resolve_name("actors.arm.ur.ur_driver:AcceptedArm"), (self, accepted)

    def plan(self, scene: Scene, action: Action) -> PourPath:
        """See `ArmSettings.plan`."""
        plan_path = resolve_name("actors.arm.planning.pour_planner:plan_path")
        planning = resolve_name("actors.bench.pour_feasibility")
        pourer, receiver = planning.vessel(scene.pourer), planning.vessel(scene.receiver)
        path: PourPath = plan_path(planning.plan_pour(scene, action), self, pourer, receiver)
        return path

    def with_stored(self, folder: Path) -> Self:
        """See `ArmSettings.with_stored`: the calibration of `calibration_file`."""
        if self.calibration_file is None:
            return self
        path = folder / self.calibration_file
        try:
            recorded = json.loads(path.read_text(encoding="utf-8"))["readout"]
            found = resolve_name("actors.arm.ur.controller_readout:findings_of")(recorded)
            state, model = found.state, found.model
        except OSError as error:
            raise ValueError(f"calibration_file {path}: {error.strerror}") from None
        except (ValueError, KeyError, TypeError):
            text = "is no recording of 'decant robot check --record'"
            raise ValueError(f"calibration_file {path}: {text}") from None
        if state is None or not same_robot(model, self.model):
            kind = f"a {model}" if model else "no robot"
            raise ValueError(f"calibration_file {path}: records {kind}, and the arm is a {self.model}")
        return self.with_values(calibration=state.calibration)

    def fitted_to(self, facts: ArmFacts) -> Self:
        """See `ArmSettings.fitted_to`: the robot's calibration."""
        return self.with_values(calibration=getattr(facts, "kinematics", None))

    def figure(self) -> ArmFigure:
        """See `ArmSettings.figure`."""
        figure: ArmFigure = resolve_name("actors.arm.appearance:LinkFigure")(self)
        return figure

    def missing(self) -> str | None:
        """See `ArmSettings.missing`."""
        missing: str | None = resolve_name("actors.arm.ur.rtde_client:client_missing")()
        return missing

    @property
    def title(self) -> str:
        """See `ArmSettings.title`."""
        return f"{self.model.upper()} at {self.address}"

    @property
    def payload_limit(self) -> float | None:
        """See `ArmSettings.payload_limit`."""
        return self.payload

    @property
    def tilt_speed_limit(self) -> float:
        """See `ArmSettings.tilt_speed_limit`."""
        return self.limits.tilt_speed

    @property
    def upright_time(self) -> float:
        """See `ArmSettings`."""
        return 4.0 * self.limits.tilt / self.upright_speed

    def diagnostics(self) -> ArmDiagnostics:
        """See `ArmSettings.diagnostics`."""
        found: ArmDiagnostics = resolve_name("actors.arm.ur.commissioning:UrDiagnostics").at(self)
        return found

    def diagnostics_of(self, recorded: Mapping[str, Any]) -> ArmDiagnostics:
        """See `ArmSettings.diagnostics_of`."""
        found: ArmDiagnostics = resolve_name("actors.arm.ur.commissioning:UrDiagnostics").of_record(self, recorded)
        return found

    def readiness(self) -> DeviceCheck | None:
        """See `ArmSettings.readiness`."""
        if not self.address:
            return None
        check: DeviceCheck = resolve_name("actors.arm.ur.commissioning:readiness")(self)
        return check


@lru_cache(maxsize=64)
def _robot(model: str, calibration: Calibration | None) -> RobotModel:
    return replace(MODELS[model], calibration=calibration)


_LABEL = r"[A-Za-z0-9]([A-Za-z0-9-]{0,61}[A-Za-z0-9])?"
_HOST = re.compile(rf"(?=.{{1,253}}\Z){_LABEL}(\.{_LABEL})*\.?")


def _is_address(text: str) -> bool:
    if re.fullmatch(r"[\d.]+", text):  # a text of digits and dots can only be meant as an address
        try:
            ipaddress.IPv4Address(text)
        except ValueError:
            return False
        return True
    return _HOST.fullmatch(text) is not None
