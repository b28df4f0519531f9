"""Settings of arms, and the kinds of arms that are installed.

- `ArmSettings` is the base class of the section `arm`: plain, frozen values, also read where no arm is started.
- `ArmKind` joins such settings with driver, planner, diagnostics, figure and emulator; `ARMS` is the registry of the
  installed kinds, and `arm_kind` finds the one of given settings. Decant's own are in `actors.device_kinds`.
- `SafetyRecord` holds safety settings that an operator has accepted, `ArmDiagnostics` what an arm reports to
  `decant robot check`.
"""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Generic, Protocol, Self, TypeVar

from actors.arm_geometry import RobotCell
from actors.interfaces import DeviceCheck, InvalidActionError, LaboratoryError
from actors.places import PlaceSettings
from sim_engine.action import Action
from sim_engine.scene import Scene
from sim_engine.settings.model import SET_BY_PROGRAM, Problems, Settings
from sim_engine.settings.plugin_registry import PluginRegistry

if TYPE_CHECKING:
    from actors.arm.arm_interface import ArmFacts, ArmFigure, FloatArray, PlannedPour
    from actors.arm.planned_pour import PlaceWay
    from sim_engine.scene import SampledMotion
    from sim_engine.vessel.vessel import Vessel


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
            acceptance = f"{self.checksum}, accepted by {record.accepted_by if record and accepted else 'nobody'}"
            advice = "" if accepted else f"read the arm's safety settings, then: {accept}"
            checks.append(DeviceCheck("safety checksum", "ok" if accepted else "fail", acceptance, advice))
        return checks

    def recorded(self) -> dict[str, Any]:
        """The values that were read, JSON-ready; empty if they are not kept."""
        return {}

    def at_home(self) -> DeviceCheck:
        """Whether the arm stands at its home pose."""
        return DeviceCheck("position", "ok", "at home, as far as the driver tells")


class ArmSettings(Settings):
    """Base class of the section `arm`: settings of one arm, which are sent to the machine of the bench.

    The field `kind` of a subclass has the name under which its `ArmKind` is registered in `decant.arms`.
    """

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "ur"
    plugins: ClassVar[str] = "decant.arms"

    digital_outputs: ClassVar[bool] = False
    """Whether `address` is a controller with URCaps, and digital outputs that can switch a gripper: a UR's."""

    kind: str = ""
    """Kind of the arm."""

    time_scale: Annotated[float, SET_BY_PROGRAM] = 1.0
    """Bench seconds per second of the clock; 1 for hardware, 0 to skip all waits."""

    clock: Annotated[str, SET_BY_PROGRAM] = ""
    """File of the clock that the devices of a virtual bench share (`actors.runtime.bench_clock`); '' on hardware."""

    warning_time: Annotated[float, SET_BY_PROGRAM] = 0.0
    """Time from the operator's consent to the first movement [s]."""

    upright_speed: Annotated[float, SET_BY_PROGRAM] = math.radians(10.0)
    """Angular velocity at which a stopped, tilted pourer is brought upright [rad/s]."""

    def in_laboratory(self, cell: RobotCell | None, time_scale: float) -> Self:
        """The same settings in a cell, with the time scale of a virtual bench (1 on hardware)."""
        return self.with_values(time_scale=time_scale)

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

    def expected(self, *, virtual: bool) -> Self:
        """The settings with the geometry that a connected arm will have, as far as it is known before: for checks."""
        return self

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


@dataclass(frozen=True)
class History:
    """Recorded joint motion of the controller.

    Attributes:
        times: controller times [s], increasing.
        joints: joint angles at each time [rad].
        now: controller time of the request [s].
    """

    times: tuple[float, ...]
    joints: tuple[tuple[float, ...], ...]
    now: float


class ArmEmulator(Protocol):
    """The emulator that an arm's driver connects to on a virtual bench; see `ArmKind.start_emulator`."""

    @property
    def arm(self) -> ArmSettings:
        """The settings, with the emulator's address."""
        ...

    @property
    def true_arm(self) -> ArmSettings:
        """The settings with the emulator's own geometry, which a driver has to read from it."""
        ...

    def install(self) -> None:
        """Configure the emulator once, as a person would configure a real controller."""
        ...

    def history(self, since: float) -> History:
        """Joint motion since a controller time [s]."""
        ...

    def fault(self, name: str, arguments: dict[str, Any]) -> dict[str, Any]:
        """Inject a fault, or read the emulator's internal state."""
        ...

    def close(self) -> None:
        """End the emulator. May be called again."""
        ...


S = TypeVar("S", bound=ArmSettings)


class ArmKind(ABC, Generic[S]):
    """One kind of arm: joins its settings with everything that is made from them.

    A subclass is registered in `decant.arms`. It imports driver and planner within its methods, because it is loaded
    wherever a laboratory's file is read.

    Args:
        spec: settings of one arm.
    """

    settings: ClassVar[type[ArmSettings]]
    """Class of the settings."""

    doses: ClassVar[bool] = False
    """Whether the driver pours wanted amounts, see `actors.arm.arm_interface.DosingArm`."""

    carries: ClassVar[bool] = False
    """Whether the driver carries vessels between places, see `actors.arm.arm_interface.CarryingArm`."""

    emulated: ClassVar[bool] = False
    """Whether a virtual bench emulates the arm, see `start_emulator`."""

    def __init__(self, spec: S) -> None:
        self.spec = spec

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

    def check_laboratory(self, problems: Problems, *, mode: str, cell: RobotCell | None) -> None:
        """Add a problem for each value that does not fit the rest of the laboratory.

        Args:
            problems: of the laboratory, whose keys `arm` and `cell` are.
            mode: 'virtual' or 'hardware'.
            cell: the section `cell`; None if it is missing.
        """

    def place_problems(
        self, places: Sequence[PlaceSettings], vessels: Mapping[str, Vessel], opened: Mapping[str, float] = {}
    ) -> Iterable[tuple[int, str]]:
        """Problems of a laboratory's places, each with the number of its place.

        Args:
            places: all places; `holds` names the vessels that may stand there.
            vessels: by name; without them, only what does not depend on them is checked.
            opened: width of the fingers that are open for each vessel [m].
        """
        return [(0, f"an arm of the kind '{self.spec.kind}' carries no vessels between places; remove 'places'")]

    def way(
        self,
        place: PlaceSettings,
        places: Sequence[PlaceSettings],
        vessels: Mapping[str, Vessel],
        volume: float | None = None,
    ) -> PlaceWay:
        """Plan the way from home to a place; `volume` is that of a carried liquid [m³], None for empty vessels.

        Raises:
            InvalidActionError: the way is impossible; the text lists all problems.
        """
        raise InvalidActionError(f"an arm of the kind '{self.spec.kind}' carries no vessels")

    def pouring_at(self, place: PlaceSettings) -> S:
        """The settings with which pours end at a place instead of the balance.

        Raises:
            InvalidActionError: this kind of arm carries no vessels.
        """
        raise InvalidActionError(f"an arm of the kind '{self.spec.kind}' carries no vessels")

    def in_the_way(
        self, path: PlannedPour, pourer: Vessel, places: Sequence[PlaceSettings], vessels: Mapping[str, Vessel]
    ) -> list[str]:
        """Problems of a planned pour with the vessels that may stand at other places."""
        return []

    def with_stored(self, folder: Path) -> S:
        """The settings with the contents of recordings that they name.

        Args:
            folder: of the laboratory's file, to which paths are relative.

        Raises:
            ValueError: a recording cannot be read; the text names it.
        """
        return self.spec

    def start_emulator(self) -> ArmEmulator | None:
        """Start the emulator of the arm on a virtual bench; None if the driver is a simulation itself.

        The liquid of the bench follows the emulator's joints (`pourer_motion`); plans are then `PourPath`s.
        """
        return None

    def pourer_motion(self, joints: FloatArray, times: FloatArray, *, grip_tilt: float = 0.0) -> SampledMotion:
        """The motion of the pourer for joints that encoders measured.

        Args:
            joints: shape (T, n) [rad].
            times: of the readings, shape (T,), increasing from 0 [s].
            grip_tilt: error of grip: the pourer is rotated in the gripper by this angle about its own y axis, and
                therefore tilted more [rad]. An arm cannot measure it; it belongs to the ground truth of a virtual
                bench.

        Raises:
            LaboratoryError: the arm has no figure, which gives the pourer's pose.
        """
        from actors.arm.planned_pour import slipped
        from sim_engine.scene import SampledMotion

        figure = self.figure()
        if figure is None:
            raise LaboratoryError(f"an arm of the kind '{self.spec.kind}' has no figure: its joints give no pose")
        return slipped(SampledMotion(times, figure.pourer(joints)), grip_tilt)

    def workspace(self) -> FloatArray | None:
        """Corners in the world, shape (8, 3) [m], of the box that tool and pourer may not leave; None without one."""
        return None

    def figure(self) -> ArmFigure | None:
        """The arm's figure for the live view. None if there is none; then only the pourer is shown."""
        return None

    def missing(self) -> str | None:
        """The missing software that the driver needs, as a message; None if nothing is missing."""
        return None

    def diagnostics(self) -> ArmDiagnostics:
        """Read everything that `decant robot check` reports; nothing moves, no setting changes."""
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


def _arm(loaded: object, name: str) -> type[ArmKind[Any]]:
    if not (isinstance(loaded, type) and issubclass(loaded, ArmKind)):
        raise TypeError("should be a class derived from decant.plugins.ArmKind")
    if loaded.settings.model_fields["kind"].default != name:
        raise TypeError(f"the field 'kind' of its settings should be Literal['{name}'] = '{name}', as it is registered")
    return loaded


ARMS: PluginRegistry[type[ArmKind[Any]]] = PluginRegistry("decant.arms", "arm", _arm)
"""All installed kinds of arms."""


def arm_settings() -> dict[str, type[ArmSettings]]:
    """Settings classes of all installed kinds of arms, by name."""
    return {name: kind.settings for name, kind in ARMS.all.items()}


def arm_kind(spec: ArmSettings) -> ArmKind[Any]:
    """The kind of an arm, for its settings."""
    return ARMS.get(spec.kind)(spec)
