"""What a program may call, by subject: motion, questions, signals, mathematics."""

from __future__ import annotations

from typing import TYPE_CHECKING

from actors.virtual_ur.urscript.program import Command

if TYPE_CHECKING:
    from actors.virtual_ur.controller import Controller


def commands_of(controller: Controller) -> dict[str, Command]:
    """All commands, bound to one controller, by the names that programs use."""
    from actors.virtual_ur.commands import maths, motion, queries, settings, signals

    found: dict[str, Command] = {}
    for part in (maths.COMMANDS, motion.Motion(controller).commands(), queries.Queries(controller).commands()):
        found.update(part)
    found.update(settings.Settings(controller).commands())
    found.update(signals.Signalling(controller).commands())
    return found
