"""Commands that read the arm's state, set tool, payload and messages, and access registers and signals.

`Queries` reads joints, tool and payload. `SettingCommands` sets TCP, payload and gravity, and sends messages.
`Signalling` reads and writes registers, and sets digital outputs.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from actors.emulators.ur_controller.commands.command_arguments import ControllerAccess, positive, six, whole
from actors.emulators.ur_controller.registers import REGISTERS
from actors.emulators.ur_controller.urscript.lexer import ScriptError
from actors.emulators.ur_controller.urscript.program import Command
from actors.emulators.ur_controller.urscript.script_values import UrPose, number, numbers, show


class Queries:
    """The query commands of one controller.

    Args:
        controller: source of the values.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._controller = controller

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        controller, robot = self._controller, self._controller.robot
        answers: dict[str, Callable[..., Any]] = {
            "get_actual_joint_positions": lambda: list(robot.q),
            "get_target_joint_positions": lambda: list(robot.mover.q),
            "get_actual_tcp_pose": lambda: UrPose(robot.pose),
            "is_steady": lambda: robot.steady,
            "get_steptime": lambda: controller.dt,
            "get_tcp_offset": lambda: UrPose(robot.tcp),
            "get_target_payload": lambda: robot.payload,
            "get_target_payload_cog": lambda: list(robot.cog),
            "get_target_payload_inertia": lambda: list(robot.inertia),
        }
        return {name: Command(answer) for name, answer in answers.items()}


FARTHEST = 10.0
"""Largest entry of a tool centre point [m], [rad]; a larger one is a mistake of units."""

HEAVIEST = 12.5
"""Maximum payload of the arm [kg]."""

WITHOUT_EFFECT = (
    "force_mode_set_damping",
    "force_mode_set_gain_scaling",
    "zero_ftsensor",
    "ft_rtde_input_enable",
    "enable_external_ft_sensor",
)
"""Accepted and ignored: there is no force and no sensor here."""


class SettingCommands:
    """The setting commands of one controller.

    Args:
        controller: receives the settings.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._controller = controller
        self._robot = controller.robot

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        by_name = dict.fromkeys(WITHOUT_EFFECT, Command(lambda *_, **__: None))
        by_name |= {
            "set_tcp": Command(self.set_tcp),
            "set_payload": Command(self.set_payload),
            "set_target_payload": Command(self.set_payload),
            "set_gravity": Command(self.set_gravity),
            "textmsg": Command(self.textmsg),
            "popup": Command(self.popup),
            "protective_stop": Command(lambda: self._controller.protective_stop("asked for by the program")),
            "rtde_set_watchdog": Command(self.set_watchdog),
        }
        return by_name

    def set_tcp(self, pose: Any, tcp_name: Any = "") -> None:
        """Set the tool centre point in the flange's frame."""
        tool = six(pose)
        if max(abs(x) for x in tool) > FARTHEST:
            raise ScriptError(f"a tool centre point at {show(list(tool))}: no entry may be beyond {FARTHEST:g}")
        self._robot.set_tcp(tool)

    def set_payload(self, m: Any, cog: Any = None, inertia: Any = None, transition_time: Any = 0) -> None:
        """Set mass [kg], centre of gravity [m] and inertia [kg m²] of the payload at the flange."""
        mass = number(m)
        if not 0.0 <= mass <= HEAVIEST:
            raise ScriptError(f"a payload of {show(m)} kg; the arm carries 0 … {HEAVIEST:g} kg")
        self._robot.payload = mass
        if cog is not None:
            x, y, z = numbers(cog, 3)
            self._robot.cog = (x, y, z)
        if inertia is not None:
            self._robot.inertia = six(inertia)

    def set_gravity(self, d: Any) -> None:
        """Set the acceleration of the base that corresponds to gravity [m/s²]; it points upwards for an upright arm."""
        x, y, z = numbers(d, 3)
        self._robot.gravity = (x, y, z)

    def textmsg(self, s1: Any, s2: Any = "") -> None:
        """Write a line to the log."""
        self._controller.tell("text", show(s1) + show(s2))

    def popup(
        self, s: Any, title: Any = "Popup", warning: Any = False, error: Any = False, blocking: Any = False
    ) -> None:
        """Show a message that the operator has to close."""
        self._controller.popup = show(s)
        self._controller.tell("popup", show(s))

    def set_watchdog(self, variable_name: Any, min_frequency: Any, action: Any = "pause") -> None:
        """Pause or stop the program if a client does not write an input often enough."""
        name, doing = str(variable_name), str(action).lower()
        if doing not in ("pause", "stop", "ignore"):
            raise ScriptError(f"a watchdog can 'pause', 'stop' or 'ignore', not '{doing}'")
        if number(min_frequency) == 0.0 or doing == "ignore":
            self._controller.watchdogs.remove(name)
            return
        self._controller.watchdogs.set(name, 1.0 / positive(min_frequency, "min_frequency"), doing)


_GROUPS = {"standard_digital": (0, 7), "configurable_digital": (8, 7), "tool_digital": (16, 1)}
"""First bit and highest number of each group of digital signals."""


class Signalling:
    """The commands of one controller that read registers, and set registers and digital outputs.

    Args:
        controller: owner of registers and signals.
    """

    def __init__(self, controller: ControllerAccess) -> None:
        self._registers = controller.registers
        self._signals = controller.signals

    def commands(self) -> dict[str, Command]:
        """Return the commands by name."""
        r, by_name = self._registers, {}
        for name, store in (("integer", (r.input_int, r.output_int)), ("float", (r.input_double, r.output_double))):
            by_name[f"read_input_{name}_register"] = _reader(store[0])
            by_name[f"write_output_{name}_register"] = _writer(store[1], integer=name == "integer")
        for group, (first, highest) in _GROUPS.items():
            by_name[f"set_{group}_out"] = self._digital_setter(first, highest)
        return {name: Command(function) for name, function in by_name.items()}

    def _digital_setter(self, first: int, highest: int) -> Callable[..., Any]:
        return lambda n, b: self._signals.set_output(first + whole(n, 0, highest, "output"), bool(b))


def _reader(store: list[Any]) -> Callable[..., Any]:
    return lambda at: store[whole(at, 0, REGISTERS - 1, "register")]


def _writer(store: list[Any], *, integer: bool) -> Callable[..., Any]:
    def write(at: Any, value: Any) -> None:
        written = number(value)
        if integer:
            written = (int(written) + 0x80000000) % 0x100000000 - 0x80000000
        store[whole(at, 0, REGISTERS - 1, "register")] = written

    return write
