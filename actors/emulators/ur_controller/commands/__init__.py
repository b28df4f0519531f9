"""The commands that a URScript program can call, by subject: motion, state, settings, signals, mathematics."""

from __future__ import annotations

from actors.emulators.ur_controller.commands import math_commands as maths
from actors.emulators.ur_controller.commands import motion_commands as motion
from actors.emulators.ur_controller.commands import state_commands as queries
from actors.emulators.ur_controller.commands import state_commands as settings
from actors.emulators.ur_controller.commands import state_commands as signals
from actors.emulators.ur_controller.commands.command_arguments import ControllerAccess
from actors.emulators.ur_controller.urscript.program import Command


def commands_of(controller: ControllerAccess) -> dict[str, Command]:
    """Return all commands, bound to one controller, by their URScript names."""
    found: dict[str, Command] = {}
    for part in (maths.COMMANDS, motion.MoveCommands(controller).commands(), queries.Queries(controller).commands()):
        found.update(part)
    found.update(settings.SettingCommands(controller).commands())
    found.update(signals.Signalling(controller).commands())
    return found
