"""What a program may call, by subject: motion, questions, signals, mathematics."""

from __future__ import annotations

from actors.virtual_ur.commands import maths, motion, queries, settings, signals
from actors.virtual_ur.commands.machine import Machine
from actors.virtual_ur.urscript.program import Command


def commands_of(controller: Machine) -> dict[str, Command]:
    """All commands, bound to one controller, by the names that programs use."""
    found: dict[str, Command] = {}
    for part in (maths.COMMANDS, motion.MoveCommands(controller).commands(), queries.Queries(controller).commands()):
        found.update(part)
    found.update(settings.Settings(controller).commands())
    found.update(signals.Signalling(controller).commands())
    return found
