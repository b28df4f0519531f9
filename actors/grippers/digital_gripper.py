"""A gripper that is switched by digital outputs of a UR arm, with optional confirming inputs.

`DigitalSettings` are the settings, `DigitalGripper` the driver: a pneumatic gripper, or an electric one with a
controller of its own. An output is set by a secondary program, which the controller runs next to any other and which
claims no variable of the data exchange; outputs and inputs are read from the primary interface.

Sources: the manufacturer's script manual for secondary programs and `set_…_digital_out`; its page on the primary
interface for the bits of the masterboard data. Not tried on a gripper.
"""

from __future__ import annotations

import math
import re
import socket
import struct
import threading
import time
from dataclasses import dataclass
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, Strict
from pydantic_core import PydanticCustomError

from actors.arm.arm_settings import ArmSettings
from actors.arm.ur.primary_interface import MASTERBOARD, PORT, PrimaryError, read_parts
from actors.grippers.gripper_interface import REST, Force, GripperError, GripperSettings, GripperState, Width
from sim_engine.settings.model import Example, Problems
from sim_engine.settings.quantity import Quantity

REPLY_TIMEOUT = 3.0
"""Longest wait for the controller [s]."""

_GROUPS = {"standard": (0, 8), "configurable": (8, 8), "tool": (16, 2)}
"""First bit and number of signals of each group."""

_SIGNAL = re.compile(r"(not )?(standard|configurable|tool) (\d)")


def _signal(text: str) -> str:
    match = _SIGNAL.fullmatch(text)
    if match is None or int(match[3]) >= _GROUPS[match[2]][1]:
        raise PydanticCustomError(
            "digital_signal",
            "{text} is no digital signal of the arm; write for example 'standard 3', 'configurable 1' or 'tool 0', "
            "with 'not ' in front if it is low",
            {"text": repr(text)},
        )
    return text


SignalName = Annotated[str, Strict(), AfterValidator(_signal), Example("standard 3")]


@dataclass(frozen=True)
class Signal:
    """A digital signal in a state.

    Attributes:
        group: 'standard', 'configurable' or 'tool'.
        number: within the group.
        level: high, in this state.
    """

    group: str
    number: int
    level: bool

    @classmethod
    def of(cls, text: str) -> Signal:
        """The signal that a setting names: 'standard 3', or 'not tool 0'."""
        match = _SIGNAL.fullmatch(text)
        assert match is not None
        return cls(match[2], int(match[3]), not match[1])

    def given(self, bits: int) -> bool:
        """Whether the signal has its level, in the bits of the masterboard."""
        return bool(bits >> (_GROUPS[self.group][0] + self.number) & 1) == self.level


class DigitalSettings(GripperSettings):
    """A gripper that digital outputs of a UR arm switch."""

    kind: Literal["digital"] = "digital"
    """A gripper on digital outputs of a UR arm."""

    close: SignalName
    """Output that closes the gripper, and opens it when it is switched back: standard, configurable or tool."""

    open: SignalName | None = None
    """Output that opens the gripper, for a valve with two coils."""

    held: SignalName | None = None
    """Input that confirms a held object. Without it the operator is asked."""

    opened: SignalName | None = None
    """Input that confirms open fingers."""

    travel: Annotated[float, Quantity("s", "1 s", 0.05, 30.0)] = 1.0
    """Time in which the fingers open or close."""

    opening: Width
    """Width between the open fingers."""

    nominal_force: Force = 50.0
    """Force of the gripper, as set on it."""

    @property
    def widest(self) -> float:
        """See `GripperSettings.widest`."""
        return self.opening

    @property
    def forces(self) -> tuple[float, float]:
        """See `GripperSettings.forces`."""
        return self.nominal_force, self.nominal_force

    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        """See `GripperSettings.driver`."""
        return DigitalGripper, (self,)

    def check_values(self, problems: Problems) -> None:
        """See `Settings.check_values`."""
        if problems.valid("force") and self.force is not None:
            problems.add("is not set over digital outputs; remove it, and write 'nominal_force'", "force")
        if problems.valid("close", "open") and self.open is not None:
            first, second = Signal.of(self.close), Signal.of(self.open)
            if (first.group, first.number) == (second.group, second.number):
                problems.add("is the output that closes; remove it if one output does both", "open")

    def check_laboratory(self, problems: Problems, *, mode: str, arm: ArmSettings | None) -> None:
        """See `GripperSettings.check_laboratory`."""
        super().check_laboratory(problems, mode=mode, arm=arm)
        if arm is not None and not arm.digital_outputs:
            problems.add("the outputs are those of a UR arm, and this is another one", "kind")


class DigitalGripper:
    """Driver; see `Gripper`.

    Args:
        settings: the signals.
        timeout: longest wait for the controller [s].
    """

    def __init__(self, settings: DigitalSettings, timeout: float = REPLY_TIMEOUT) -> None:
        self._settings, self._timeout = settings, timeout
        self._where = f"gripper on digital outputs of {settings.address}"
        self._closing, self._until = Signal.of(settings.close), 0.0
        self._stopped = threading.Event()

    def _bits(self) -> tuple[int, int]:
        """Levels of the inputs and of the outputs."""
        try:
            data = read_parts(self._settings.address, self._timeout).get(MASTERBOARD, b"")
        except PrimaryError as error:
            raise GripperError(f"{self._where}: {error}") from None
        if len(data) < 8:
            raise GripperError(f"{self._where}: the controller sends no digital signals")
        inputs, outputs = struct.unpack_from(">ii", data)
        return inputs, outputs

    def _switch(self, *, closed: bool) -> None:
        """Set the outputs, and read them back.

        Raises:
            GripperError: the controller has not set them.
        """
        signals = [(self._closing, closed)]
        if self._settings.open is not None:
            signals.insert(0, (Signal.of(self._settings.open), not closed))
        lines = [f"  set_{signal.group}_digital_out({signal.number}, {signal.level == on})" for signal, on in signals]
        program = "\n".join(["sec gripper():", *lines, "end", ""])
        try:
            with socket.create_connection((self._settings.address, PORT), timeout=self._timeout) as connection:
                connection.recv(1)  # the controller has accepted the connection
                connection.sendall(program.encode())
                end = time.monotonic() + self._timeout
                while not all(signal.given(self._bits()[1]) == on for signal, on in signals):
                    if time.monotonic() > end:
                        raise GripperError(
                            f"{self._where}: the outputs are not set; is the controller in remote control, are the "
                            "outputs free, and does no fieldbus write them?"
                        )
                    time.sleep(REST)
        except OSError as error:
            raise GripperError(f"{self._where}: {error}") from None
        self._until = time.monotonic() + self._settings.travel

    def connect(self) -> str:
        """See `Gripper.connect`."""
        return f"a {self._where}, {self.state()}"

    def prepare(self) -> None:
        """See `Gripper.prepare`; nothing is needed."""
        self.state()

    def state(self) -> GripperState:
        """See `Gripper.state`."""
        inputs, outputs = self._bits()
        closed = self._closing.given(outputs)
        detected: bool | None = False if not closed else None
        if closed and self._settings.held is not None:
            detected = Signal.of(self._settings.held).given(inputs)
        return GripperState(math.nan, time.monotonic() < self._until, detected, self._settings.nominal_force)

    def open(self, width: float) -> GripperState:
        """See `Gripper.open`; opens fully."""
        self._switch(closed=False)
        state = self._rested()
        if self._settings.opened is not None and not Signal.of(self._settings.opened).given(self._bits()[0]):
            raise GripperError(f"{self._where}: '{self._settings.opened}' does not confirm open fingers")
        return state

    def grip(self, width: float, force: float) -> GripperState:
        """See `Gripper.grip`."""
        self._switch(closed=True)
        return self._rested()

    def _rested(self) -> GripperState:
        self._stopped.clear()
        self._stopped.wait(self._settings.travel)
        self._until = 0.0
        return self.state()

    def stop(self) -> None:
        """See `Gripper.stop`; a valve cannot stop half way, and the outputs stay as they are."""
        self._stopped.set()

    def close(self) -> None:
        """See `Gripper.close`."""
