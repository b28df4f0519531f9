"""Data that programs, clients and wires share: registers, inputs and outputs, and watchdogs on inputs.

`Registers` and `Signals` hold the values. `Watchdogs` pause or stop a program if a client does not write an input often
enough.
"""

from __future__ import annotations

from dataclasses import dataclass, field

REGISTERS = 48
"""Number of integer and of double registers in each direction."""


@dataclass
class Registers:
    """General-purpose registers. Programs write outputs and read inputs; clients do the opposite."""

    input_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    input_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    input_bits: int = 0
    output_int: list[int] = field(default_factory=lambda: [0] * REGISTERS)
    output_double: list[float] = field(default_factory=lambda: [0.0] * REGISTERS)
    output_bits: int = 0


@dataclass
class Signals:
    """Digital and analogue inputs and outputs.

    Attributes:
        digital_in, digital_out: bits 0–7 standard, 8–15 configurable, 16–17 tool.
        analog_in: two values in volt or ampere.
        analog_out: two fractions 0 … 1 of the range.
        analog_voltage: whether each analogue output is in volt (0 … 10 V) instead of ampere (4 … 20 mA).
    """

    digital_in: int = 0
    digital_out: int = 0
    analog_in: list[float] = field(default_factory=lambda: [0.0, 0.0])
    analog_out: list[float] = field(default_factory=lambda: [0.0, 0.0])
    analog_voltage: list[bool] = field(default_factory=lambda: [True, True])

    def set_output(self, bit: int, level: bool) -> None:
        """Switch one digital output."""
        self.digital_out = self.digital_out | (1 << bit) if level else self.digital_out & ~(1 << bit)

    def set_outputs(self, mask: int, levels: int, offset: int) -> None:
        """Switch the digital outputs in a mask."""
        mask, levels = mask << offset, levels << offset
        self.digital_out = (self.digital_out & ~mask) | (levels & mask)

    def set_input(self, bit: int, level: bool) -> None:
        """Set the level of a digital input."""
        self.digital_in = self.digital_in | (1 << bit) if level else self.digital_in & ~(1 << bit)

    def analog_reading(self, number: int) -> float:
        """An analogue output in its unit [V] or [A]."""
        share = self.analog_out[number]
        return 10.0 * share if self.analog_voltage[number] else 0.004 + 0.016 * share


@dataclass
class _Watch:
    longest: float
    action: str
    waited: float = 0.0


class Watchdogs:
    """The watchdogs of a program. They monitor a network, so they use wall time in scaled time, too."""

    def __init__(self) -> None:
        self._watches: dict[str, _Watch] = {}

    def set(self, name: str, longest: float, action: str) -> None:
        """Monitor an input.

        Args:
            name: of the input.
            longest: between two writes [s of wall time].
            action: 'pause' or 'stop'.
        """
        self._watches[name] = _Watch(longest, action)

    def remove(self, name: str) -> None:
        """Remove the watchdog of an input."""
        self._watches.pop(name, None)

    def clear(self) -> None:
        """Remove all watchdogs."""
        self._watches.clear()

    def written(self, name: str) -> None:
        """Record that a client wrote this input."""
        watch = self._watches.get(name)
        if watch is not None:
            watch.waited = 0.0

    def step(self, wall: float) -> tuple[str, str] | None:
        """Let wall time pass [s]. Returns the action that is due and its reason; None if none is."""
        for name, watch in self._watches.items():
            watch.waited += wall
            if watch.waited > watch.longest:
                watch.waited = 0.0
                return watch.action, f"watchdog: {name} was not written for {watch.longest:g} s"
        return None
