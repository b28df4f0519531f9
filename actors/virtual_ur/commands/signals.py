"""Commands for registers and for digital and analogue inputs and outputs."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.virtual_ur.commands.arguments import whole
from actors.virtual_ur.commands.machine import Machine
from actors.virtual_ur.exchange import REGISTERS
from actors.virtual_ur.urscript.program import Command
from actors.virtual_ur.urscript.values import number

_GROUPS = {"standard_digital": (0, 7), "configurable_digital": (8, 7), "tool_digital": (16, 1), "digital": (0, 15)}
"""First bit and highest number of each group of digital signals."""


class Signalling:
    """Bound to one controller.

    Args:
        controller: whose registers and signals.
    """

    def __init__(self, controller: Machine) -> None:
        self._registers = controller.registers
        self._signals = controller.signals

    def commands(self) -> dict[str, Command]:
        """By name."""
        r, found = self._registers, {}
        for name, store in (("integer", (r.input_int, r.output_int)), ("float", (r.input_double, r.output_double))):
            inputs, outputs = store
            found[f"read_input_{name}_register"] = _reader(inputs)
            found[f"read_output_{name}_register"] = _reader(outputs)
            found[f"write_output_{name}_register"] = _writer(outputs, integer=name == "integer")
        found["read_input_boolean_register"] = lambda at: bool(r.input_bits >> whole(at, 0, 127, "register") & 1)
        found["read_output_boolean_register"] = lambda at: bool(r.output_bits >> whole(at, 0, 127, "register") & 1)
        found["write_output_boolean_register"] = self._write_bit
        for group, (first, highest) in _GROUPS.items():
            found[f"set_{group}_out"] = self._digital_setter(first, highest)
            found[f"get_{group}_out"] = self._digital_getter(first, highest, inputs=False)
            found[f"get_{group}_in"] = self._digital_getter(first, highest, inputs=True)
        for name in ("set_analog_out", "set_standard_analog_out"):
            found[name] = self.set_analog
        for name in ("set_analog_outputdomain", "set_standard_analog_output_domain"):
            found[name] = self.set_domain
        for name in ("get_analog_out", "get_standard_analog_out"):
            found[name] = lambda n: self._signals.analog_reading(whole(n, 0, 1, "output"))
        for name in ("get_analog_in", "get_standard_analog_in"):
            found[name] = lambda n: self._signals.analog_in[whole(n, 0, 1, "input")]
        return {name: Command(function) for name, function in found.items()}

    def _write_bit(self, at: Any, value: Any) -> None:
        bit = 1 << whole(at, 0, 127, "register")
        self._registers.output_bits = self._registers.output_bits | bit if value else self._registers.output_bits & ~bit

    def _digital_setter(self, first: int, highest: int) -> Callable[..., Any]:
        return lambda n, b: self._signals.set_output(first + whole(n, 0, highest, "output"), bool(b))

    def _digital_getter(self, first: int, highest: int, *, inputs: bool) -> Callable[..., Any]:
        def get(n: Any) -> bool:
            bits = self._signals.digital_in if inputs else self._signals.digital_out
            return bool(bits >> (first + whole(n, 0, highest, "signal")) & 1)

        return get

    def set_analog(self, n: Any, f: Any) -> None:
        """An analogue output as a fraction of its range."""
        self._signals.analog_out[whole(n, 0, 1, "output")] = min(1.0, max(0.0, number(f)))

    def set_domain(self, n: Any, domain: Any) -> None:
        """An analogue output in ampere (0) or volt (1)."""
        self._signals.analog_voltage[whole(n, 0, 1, "output")] = bool(whole(domain, 0, 1, "domain"))


def _reader(store: list[Any]) -> Callable[..., Any]:
    def read(at: Any) -> Any:
        if type(at) is int and 0 <= at < REGISTERS:
            return store[at]
        return store[whole(at, 0, REGISTERS - 1, "register")]

    return read


def _writer(store: list[Any], *, integer: bool) -> Callable[..., Any]:
    def write(at: Any, value: Any) -> None:
        given = number(value)
        if integer:
            given = (int(given) + 0x80000000) % 0x100000000 - 0x80000000
        store[whole(at, 0, REGISTERS - 1, "register")] = given

    return write
