"""Hardware moves for one part of one run, after somebody has read what it will do and typed its name."""

from __future__ import annotations

from orchestrator.commands.arming import accepted, campaign_pours, envelope, envelope_lines, pour_count
from orchestrator.commands.speaking import RefusalError
from orchestrator.config.yaml.errors import ConfigError
from orchestrator.daemon.running import job_of
from orchestrator.daemon.shapes import WhatMovesOut
from orchestrator.daemon.store import ENDED, Item
from orchestrator.daemon.supervisor import Supervisor
from orchestrator.errors import RunError


class NotArmedError(RunError):
    """It can't be armed; the text says why."""


def what_moves(daemon: Supervisor, item: Item) -> WhatMovesOut:
    """What would move, in words; planned anew. Takes seconds.

    Raises:
        NotArmedError: nothing does, or it may not.
    """
    if item.mode != "hardware":
        raise NotArmedError(f"{item.id} has nothing to arm: its rig is {item.mode}")
    if item.state in ENDED:
        raise NotArmedError(f"{item.id} is {item.state}")
    try:
        work = job_of(daemon.settings, item, daemon.settings.rig(item.rig))
        accepted(work.plan)
        arm = work.plan.laboratory.arm
        assert arm is not None
        found = envelope(arm, campaign_pours(work.plan, work.stages))
    except (ConfigError, RunError, RefusalError, KeyError) as error:
        raise NotArmedError(str(error)) from None
    if not found.reports:
        raise NotArmedError(f"none of {len(found.refused)} actions could be poured by this arm: {found.refused[0]}")
    lines = [f"pours          up to {pour_count(work.plan, work.stages)}", *envelope_lines(found)]
    return WhatMovesOut(laboratory=work.plan.laboratory.name, arm=arm.title, lines=lines)


def arm(daemon: Supervisor, item: Item, moves: WhatMovesOut, typed: str, by: str) -> Item:
    """Arm it.

    Raises:
        NotArmedError: another name was typed.
    """
    if typed != moves.laboratory:
        raise NotArmedError(f"not armed: '{typed}' was typed, and the laboratory is {moves.laboratory}; nothing moves")
    daemon.store.change(item.id, armed=True)
    daemon.note(by, "arm", item.id, moves.laboratory)
    daemon.wake()
    return daemon.item(item.id)
