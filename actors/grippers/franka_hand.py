"""The Hand of a Franka arm, by libfranka's interface of grippers at the robot's control box.

`HandSettings` are its settings, `FrankaHand` its driver: see `actors.grippers.gripper_interface`. The Hand is a server
of its own beside the robot's: this client and that of the arm are connected at the same time.

Sources: franky-control 2.0 and reports of libfranka's users. A grasp outside of its tolerance counts as failed, and the
fingers open again (libfranka, issue 13). `stop` lets go of a held object, and a command to fingers that hold one may
wait for ever (issues 93, 108, 111): so it comes before they open, and only then. Tried with franky-sim's server, never
with a Hand.
"""

from __future__ import annotations

import contextlib
from collections.abc import Callable
from typing import Any, Literal

from actors.arm.arm_settings import ArmSettings
from actors.grippers.gripper_interface import REST, GripperError, GripperSettings, GripperState, opened
from actors.runtime.bench_clock import device_clock
from sim_engine.settings.model import Problems

SPEED = 0.05
"""Speed of the fingers [m/s]; the Hand's largest is 0.1."""

TRAVEL = 20.0
"""Longest time of a motion, homing included [s of the clock]."""

_unanswered: list[Any] = []
"""Clients whose last command was never answered: the library's thread uses them until this process ends."""


class HandSettings(GripperSettings):
    """The Hand of a Franka arm."""

    kind: Literal["franka"] = "franka"
    """The Hand of a Franka arm."""

    @property
    def widest(self) -> float:
        """See `GripperSettings.widest`."""
        return 0.08

    @property
    def forces(self) -> tuple[float, float]:
        """See `GripperSettings.forces`: of its continuous force."""
        return 30.0, 70.0

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `GripperSettings.driver`."""
        return FrankaHand, (self,)

    def check_laboratory(self, problems: Problems, *, mode: str, arm: ArmSettings | None) -> None:
        """See `GripperSettings.check_laboratory`."""
        if arm is None or arm.kind != "franka":
            problems.add("the Hand is at the control box of a Franka arm, and this arm is another one", "kind")
            return
        super().check_laboratory(problems, mode=mode, arm=arm)


class FrankaHand:
    """Driver; see `Gripper`.

    Args:
        settings: with the address of the robot.
    """

    def __init__(self, settings: HandSettings) -> None:
        self._settings = settings
        self._where = f"Hand at {settings.address}"
        self._clock = device_clock(settings.clock)
        self._hand: Any = None
        self._moves = False
        self._closed = 0.0  # width that it closes to without an object

    def connect(self) -> str:
        """See `Gripper.connect`."""
        self.close()
        self._hand = self._call(self._client)
        return f"a Franka Hand, {self.state()}"

    def prepare(self) -> None:
        """See `Gripper.prepare`: homing, after which it knows its widths."""
        if self.state().problem:
            self._go("homing")

    def state(self) -> GripperState:
        """See `Gripper.state`; the Hand reports no force."""
        seen = self._call(lambda: self._connected.state, attempts=round(self._clock.patience))
        homed = seen.max_width >= 0.5 * self._settings.widest
        problem = "" if homed else "its fingers were not homed since it was switched on"
        held = seen.is_grasped and seen.width > self._closed + 2.0 * self._settings.accuracy
        return GripperState(seen.width, self._moves, held and homed, problem=problem)

    def open(self, width: float) -> GripperState:
        """See `Gripper.open`."""
        if self._call(lambda: self._connected.is_grasped):
            self._call(self._connected.stop)
        self._go("move", width, SPEED)
        return opened(self.state(), width, self._settings.accuracy, self._where)

    def grip(self, width: float, force: float) -> GripperState:
        """See `Gripper.grip`; an object that is held already stays held."""
        if (state := self.state()).detected:
            return state
        self._closed = width
        self._go("grasp", width, SPEED, force, self._settings.widest, self._settings.widest)
        return self.state()

    def stop(self) -> None:
        """See `Gripper.stop`: fingers that do not move hold on."""
        if self._moves:
            self._call(self._connected.stop)

    def close(self) -> None:
        """See `Gripper.close`."""
        self._hand = None

    def _client(self) -> Any:
        import franky

        return franky.Gripper(self._settings.address)

    @property
    def _connected(self) -> Any:
        if self._hand is None:
            raise GripperError(f"{self._where} is not connected; connect first")
        return self._hand

    def _go(self, command: str, *values: float) -> None:
        """Carry out a command, and wait until the fingers stand."""
        hand = self._connected  # it must not end before its command
        done = self._call(lambda: getattr(hand, f"{command}_async")(*values))
        end, self._moves = self._clock.now + TRAVEL, True
        try:
            while not done.wait(REST):
                if self._clock.now > end:
                    _unanswered.append(hand)
                    raise GripperError(f"{self._where}: the fingers have not come to rest within {TRAVEL:g} s")
            if not self._call(done.get) and command != "grasp":
                raise GripperError(f"{self._where}: '{command}' failed; look at Desk")
        finally:
            self._moves = False

    def _call(self, request: Callable[[], Any], attempts: int = 1) -> Any:
        """Make a request, on a virtual bench again if a busy host was late: a real Hand's silence counts at once."""
        import franky

        try:
            return request()
        except (franky.Exception, RuntimeError) as error:
            if attempts > 1:
                with contextlib.suppress(GripperError):
                    self._hand = self._call(self._client)  # one that was without a state once gets none any more
                return self._call(request, attempts - 1)
            raise GripperError(
                f"{self._where}: {error}; is the Hand mounted and chosen in Desk, and is no other client connected?"
            ) from None
