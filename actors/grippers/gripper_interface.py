"""The interface of grippers: settings, driver, state, and the limits of a grasp.

- `Gripper` is the interface of every driver, `GripperState` what it reads. `actors.contract_tests.gripper_contract`
  defines its behaviour as tests.
- `GripperSettings` is the base class of a laboratory's section `gripper`; `GRIPPERS` has the installed kinds.
- `GripLimits` decides whether a state is a grasp of a vessel.

A driver is a plain, blocking class and runs in a process of its own. How a bench hands over a vessel and watches it
is in `actors.bench.held_vessel`.
"""

from __future__ import annotations

import math
import time
from abc import abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Annotated, Any, ClassVar, Protocol

from pydantic import Field, Strict

from actors.arm.arm_interface import ArmStoppedError
from actors.arm.arm_settings import ArmSettings
from actors.interfaces import LaboratoryError
from actors.runtime.bench_clock import DeviceClock
from sim_engine.settings.model import NOT_IN_FINGERPRINT, SET_BY_PROGRAM, Problems, Settings, Text
from sim_engine.settings.plugin_registry import PluginRegistry, settings_kind
from sim_engine.settings.quantity import Quantity

Width = Annotated[float, Quantity("m", "85 mm", 0.0, 0.5, positive=True)]
Force = Annotated[float, Quantity("N", "60 N", 0.0, 500.0, positive=True)]
TcpPort = Annotated[int, Strict(), Field(ge=1, le=65535)]

REST = 0.05
"""Time between two readings of moving fingers [s]."""

SMALLEST_GAP = 2e-3
"""Smallest gap between opened fingers and a vessel, both sides together [m]."""


class GripperError(LaboratoryError):
    """The gripper cannot be reached, refuses a request, or does not carry it out."""


class VesselLostError(ArmStoppedError):
    """The gripper may have lost its vessel: the arm was stopped, and what has become of the liquid is unknown."""


@dataclass(frozen=True)
class GripperState:
    """What a gripper reports.

    Attributes:
        width: between the fingertips [m]; NaN if the gripper does not measure it.
        moving: the fingers move.
        detected: an object stopped the closing fingers and is still there; None if the gripper cannot detect one.
        force: as set on the gripper, or as it measures it [N]; None if it reports none.
        problem: why it cannot grip, or cannot be relied on; '' if there is nothing.
    """

    width: float
    moving: bool
    detected: bool | None
    force: float | None = None
    problem: str = ""

    def __str__(self) -> str:
        width = "" if math.isnan(self.width) else f"fingers at {1e3 * self.width:.1f} mm"
        held = {True: "holds an object", False: "holds nothing", None: "cannot detect an object"}[self.detected]
        return ", ".join(filter(None, (width, "moving" if self.moving else held, self.problem)))


class Gripper(Protocol):
    """Driver of a gripper. All methods block. Every method raises `GripperError` if the gripper does not answer."""

    def connect(self) -> str:
        """Connect and identify the gripper. Nothing moves. Returns its description. May be called again."""
        ...

    def prepare(self) -> None:
        """Make the gripper ready if it is not. The fingers may open and close fully: nothing may be between them.

        Raises:
            GripperError: it does not become ready.
        """
        ...

    def state(self) -> GripperState:
        """Read the state. Returns at once, also from another thread during a motion."""
        ...

    def open(self, width: float) -> GripperState:
        """Open the fingers, or close them, to a width [m]; return the state when they stand still.

        Raises:
            GripperError: they did not get there, or the gripper is not ready.
        """
        ...

    def grip(self, width: float, force: float) -> GripperState:
        """Close the fingers until an object stops them, at least to a width; return the state when they stand still.

        Args:
            width: narrower than the object [m].
            force: [N].

        Raises:
            GripperError: the fingers do not move, the gripper is not ready, or another client commands it.
        """
        ...

    def stop(self) -> None:
        """Stop the fingers. A held object stays held. Callable from another thread."""
        ...

    def close(self) -> None:
        """Release the connection, and not the object: the fingers stay as they are. Never fails."""
        ...


class GripperEmulator(Protocol):
    """The emulator that a gripper's driver connects to on a virtual bench; see `GripperSettings.start_emulator`."""

    @property
    def gripper(self) -> GripperSettings:
        """The settings, with the emulator's address."""
        ...

    def put(self, width: float | None) -> None:
        """Hold an object of this width between the fingers [m], or take it away with None."""
        ...

    def fault(self, name: str, value: float = 1.0) -> None:
        """Inject a fault; see docs/reference/grippers.md."""
        ...

    def close(self) -> None:
        """End the emulator. May be called again."""
        ...


class GripperSettings(Settings):
    """Base class of a gripper's settings. `kind` of a subclass is its name in `decant.grippers`."""

    tag: ClassVar[str] = "kind"
    default_tag: ClassVar[str] = "robotiq"
    plugins: ClassVar[str] = "decant.grippers"

    accuracy: ClassVar[float] = 1e-3
    """Largest error of a measured width [m]; added to a vessel's tolerance."""

    emulated: ClassVar[bool] = False
    """Whether a virtual bench emulates the gripper, see `start_emulator`."""

    kind: str = ""
    """Kind of the gripper."""

    address: Annotated[Text, NOT_IN_FINGERPRINT] = ""
    """Network address that the gripper is reached at; that of the arm's controller unless given."""

    force: Force | None = None
    """Force on the vessel; the middle of the gripper's range unless given."""

    clearance: Annotated[float, Quantity("m", "15 mm", SMALLEST_GAP, 0.2)] = 15e-3
    """Gap between the opened fingers and the vessel, both sides together."""

    height: Width | None = None
    """Height above the vessel's underside at which the fingers grip it; from `grip` of the arm unless given."""

    time_scale: Annotated[float, SET_BY_PROGRAM] = 1.0
    """Bench seconds per second of the clock."""

    clock: Annotated[str, SET_BY_PROGRAM] = ""
    """File of the clock that the devices of a virtual bench share (`actors.runtime.bench_clock`); '' on hardware."""

    @property
    @abstractmethod
    def widest(self) -> float:
        """Largest width between the fingertips [m]."""

    @property
    @abstractmethod
    def forces(self) -> tuple[float, float]:
        """Smallest and largest force [N]."""

    @abstractmethod
    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """The class of the driver (a `Gripper`), importable by name, and its arguments; `address` is set."""

    def start_emulator(self) -> GripperEmulator | None:
        """Start the emulator of the gripper on a virtual bench, at `address`; None if there is none."""
        return None

    @property
    def applied(self) -> float:
        """Force on the vessel [N]."""
        return sum(self.forces) / 2.0 if self.force is None else self.force

    def beside(self, arm: ArmSettings | None) -> GripperSettings:
        """The settings with the address, the time scale and the clock of an arm."""
        if arm is None:
            return self
        address = self.address or getattr(arm, "address", "")
        return self.with_values(address=address, time_scale=arm.time_scale, clock=arm.clock)

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if problems.valid("force", "model") and self.force is not None:
            low, high = self.forces
            if not low <= self.force <= high:
                problems.add(f"this gripper grips with {low:g} … {high:g} N", "force")

    def check_laboratory(self, problems: Problems, *, mode: str, arm: ArmSettings | None) -> None:
        """Add a problem for each value that does not fit the laboratory.

        Args:
            problems: of these settings.
            mode: 'virtual' or 'hardware'.
            arm: of the laboratory.
        """
        if mode == "virtual":
            if not self.emulated:
                problems.add(f"a gripper of the kind '{self.kind}' is not emulated; write 'mode: hardware'", "kind")
            if self.address:
                problems.add("a virtual gripper has no address; remove it, or write 'mode: hardware'", "address")
        if self.height is None and not hasattr(arm, "grip"):
            problems.add("this arm does not state where it holds a vessel; add 'height: 60 mm'", of="height")


GRIPPERS: PluginRegistry[type[GripperSettings]] = PluginRegistry(
    "decant.grippers", "gripper", settings_kind(GripperSettings)
)
"""Settings classes of all installed kinds of grippers."""


@dataclass(frozen=True)
class GripLimits:
    """Widths of the fingers that are a grasp of a vessel.

    Attributes:
        vessel: its name.
        width: of the vessel where it is gripped [m].
        tolerance: largest difference of the fingers' width from it [m].
    """

    vessel: str
    width: float
    tolerance: float

    def problem(self, state: GripperState) -> str:
        """Why a state is no grasp of this vessel; '' if it is one, as far as the gripper can tell."""
        if state.problem:
            return state.problem
        if state.moving:
            return "the fingers move"
        at = "" if math.isnan(state.width) else f": the fingers stand at {1e3 * state.width:.1f} mm"
        if state.detected is False:
            return f"the gripper holds nothing{at}"
        if abs(state.width - self.width) > self.tolerance:  # False without a measured width
            return (
                f"the fingers stand at {1e3 * state.width:.1f} mm, and '{self.vessel}' is {1e3 * self.width:.1f} ± "
                f"{1e3 * self.tolerance:.1f} mm wide where it is gripped: it is held crooked, at another height, or it "
                "is another vessel"
            )
        return ""


CONTROLLER_PORTS = {22, 80, 502, 29999, *range(30001, 30005), *range(30011, 30014), 30020, 50001, 50002}
"""Ports of a UR controller that serve something else."""


def check_urcap(
    problems: Problems, settings: GripperSettings, port: int, usual: int, *, mode: str, arm: ArmSettings | None
) -> None:
    """Add a problem if there is no URCap of the gripper where it is asked for.

    Args:
        problems: of the settings.
        settings: of the gripper.
        port: at its address.
        usual: port of the URCap.
        mode: 'virtual' or 'hardware'.
        arm: of the laboratory.
    """
    if problems.valid("port") and port in CONTROLLER_PORTS:
        problems.add(f"{port} is a port of the controller itself; the gripper's URCap listens on {usual}", "port")
    if mode == "hardware" and not settings.address and arm is not None and not arm.digital_outputs:
        text = "only a UR's controller has the gripper's URCap; add 'address', of the gripper's own server"
        problems.add(text, of="address")


def opened(state: GripperState, width: float, accuracy: float, where: str) -> GripperState:
    """The state after opening, if the fingers stand at the requested width.

    Args:
        state: when the fingers stand.
        width: that was requested [m].
        accuracy: see `GripperSettings` [m].
        where: the gripper and its address, for the message.

    Raises:
        GripperError: they stand elsewhere.
    """
    if abs(state.width - width) > 4.0 * accuracy:
        raise GripperError(
            f"{where}: the fingers stand at {1e3 * state.width:.1f} mm instead of {1e3 * width:.1f} mm; is something "
            "in their way?"
        )
    return state


def settled(
    read: Callable[[], GripperState], begin: float, end: float, clock: DeviceClock, same: int = 3
) -> GripperState:
    """Read a gripper until its fingers stand still.

    Right after a command a gripper still reports the state from before: an RG6 answered 'not busy' and the old width
    for 0.4 s. So its fingers count as standing only after several equal readings, and not before `begin`.

    Args:
        read: reads the state.
        begin: time for which the fingers may not have begun to move [s of the clock].
        end: longest time of the motion [s of the clock].
        clock: of the gripper.
        same: number of readings that must be equal.

    Raises:
        GripperError: they move for longer.
    """
    last, count = None, 0
    for elapsed in _ticks(clock, end):
        state = read()
        count = count + 1 if state == last and not state.moving else 0
        last = state
        if count >= same - 1 and elapsed >= begin:
            return state
    raise GripperError(f"the fingers have not come to rest within {end:g} s: {last}")


def _ticks(clock: DeviceClock, end: float) -> Iterator[float]:
    started = clock.now
    while (elapsed := clock.now - started) <= end:
        yield elapsed
        time.sleep(REST)
