"""The commands that a URScript program can call, by subject: motion, state, settings, signals, mathematics."""

from __future__ import annotations

from actors.emulators.ur_controller.commands.command_arguments import ControllerAccess
from actors.emulators.ur_controller.commands.motion_commands import MoveCommands
from actors.emulators.ur_controller.commands.state_commands import Queries, SettingCommands, Signalling
from actors.emulators.ur_controller.urscript.program import Command
from actors.emulators.ur_controller.urscript.script_values import FUNCTIONS


def commands_of(controller: ControllerAccess) -> dict[str, Command]:
    """Return all commands, bound to one controller, by their URScript names."""
    commands = {name: Command(function) for name, function in FUNCTIONS.items()}
    for subject in (MoveCommands, Queries, SettingCommands, Signalling):
        commands |= subject(controller).commands()
    return commands
