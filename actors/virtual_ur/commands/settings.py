"""Commands that set what is mounted, where down is, and what a program tells people."""

from __future__ import annotations

from typing import Any

from actors.virtual_ur.commands.arguments import positive, six
from actors.virtual_ur.commands.machine import Machine
from actors.virtual_ur.urscript.errors import ScriptError
from actors.virtual_ur.urscript.program import Command
from actors.virtual_ur.urscript.values import number, numbers, show

FARTHEST = 10.0
"""Entries of a tool centre point [m], [rad]: more is a mistake of units."""

HEAVIEST = 12.5
"""Payload that the arm can carry [kg]."""

WITHOUT_EFFECT = (
    "force_mode_set_damping",
    "force_mode_set_gain_scaling",
    "zero_ftsensor",
    "ft_rtde_input_enable",
    "enable_external_ft_sensor",
    "set_tool_voltage",
    "set_tool_communication",
)
"""Accepted and ignored: there is no force, no sensor and no tool connector here."""


class Settings:
    """Bound to one controller.

    Args:
        controller: what is set.
    """

    def __init__(self, controller: Machine) -> None:
        self._controller = controller
        self._robot = controller.robot

    def commands(self) -> dict[str, Command]:
        """By name."""
        found = dict.fromkeys(WITHOUT_EFFECT, Command(lambda *_, **__: None))
        found |= {
            "set_tcp": Command(self.set_tcp),
            "set_payload": Command(self.set_payload),
            "set_target_payload": Command(self.set_payload),
            "set_payload_mass": Command(self.set_payload),
            "set_payload_cog": Command(lambda cog: self.set_payload(self._robot.payload, cog)),
            "set_gravity": Command(self.set_gravity),
            "textmsg": Command(self.textmsg),
            "popup": Command(self.popup),
            "protective_stop": Command(lambda: self._controller.protective_stop("asked for by the program")),
            "rtde_set_watchdog": Command(self.set_watchdog),
        }
        return found

    def set_tcp(self, pose: Any, tcp_name: Any = "") -> None:
        """Tool centre point in the flange's frame."""
        tool = six(pose)
        if max(abs(x) for x in tool) > FARTHEST:
            raise ScriptError(f"a tool centre point at {show(list(tool))}: no entry may be beyond {FARTHEST:g}")
        self._robot.set_tcp(tool)

    def set_payload(self, m: Any, cog: Any = None, inertia: Any = None, transition_time: Any = 0) -> None:
        """Mass [kg], centre of gravity [m] and inertia [kg m²] behind the flange."""
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
        """Acceleration that the base feels [m/s²]; upwards is positive for an arm that stands."""
        x, y, z = numbers(d, 3)
        self._robot.gravity = (x, y, z)

    def textmsg(self, s1: Any, s2: Any = "") -> None:
        """A line in the log."""
        self._controller.tell("text", show(s1) + show(s2))

    def popup(
        self, s: Any, title: Any = "Popup", warning: Any = False, error: Any = False, blocking: Any = False
    ) -> None:
        """A message that somebody has to close."""
        self._controller.popup = show(s)
        self._controller.tell("popup", show(s))

    def set_watchdog(self, variable_name: Any, min_frequency: Any, action: Any = "pause") -> None:
        """Pause or stop the program when a client doesn't write an input often enough."""
        name, doing = str(variable_name), str(action).lower()
        if doing not in ("pause", "stop", "ignore"):
            raise ScriptError(f"a watchdog can 'pause', 'stop' or 'ignore', not '{doing}'")
        if number(min_frequency) == 0.0 or doing == "ignore":
            self._controller.watchdogs.remove(name)
            return
        self._controller.watchdogs.set(name, 1.0 / positive(min_frequency, "min_frequency"), doing)
