"""The whole cycle of a pour with an empty pourer, slowly, nothing weighed: what one tries before any liquid."""

from __future__ import annotations

import contextlib
import dataclasses
import json
import math
import sys
import time
from collections.abc import Callable
from typing import TYPE_CHECKING, Any

from actors.protocols import LaboratoryError
from orchestrator.commands.arming import accepted, confirm, report_lines
from orchestrator.commands.hands_on import connected, reached, stoppable, typed_line
from orchestrator.commands.speaking import BAD_INPUT, FAILED, RefusalError, print_json, say

if TYPE_CHECKING:
    from actors.arm.protocol import Arm, Executed, PlannedPour
    from orchestrator.plan import CampaignPlan
    from sim_engine.action import Action

RECORD = "pour.json"


def pour_empty(plan: CampaignPlan, action: Action, path: PlannedPour, *, slow: float, as_json: bool) -> None:
    """Approach, tilt, return, retreat.

    Args:
        plan: campaign.
        action: that the path was planned for.
        path: slowed already.
        slow: by what.
        as_json: print the record.

    Raises:
        RefusalError: refused (exit code 2), or stopped on the way (1).
    """
    from orchestrator.runs import create_run

    laboratory = plan.laboratory
    assert laboratory.arm is not None
    hardware = laboratory.mode == "hardware"
    if hardware and not sys.stdin.isatty():
        raise RefusalError("--empty asks a person before the arm moves: run it in a terminal", BAD_INPUT)
    checksum = accepted(plan) if hardware else None
    lines = [f"one cycle      with an EMPTY pourer, at {100 * slow:g} % of its speed", *report_lines(path.report)]
    if hardware:
        confirm(laboratory, lines)
    else:
        say(f"laboratory {laboratory.name}, virtual: nothing moves but numbers\n" + "\n".join(lines))
    try:
        directory = create_run(dataclasses.replace(plan, name=f"{plan.name}-empty"))
        with reached(laboratory) as ready:
            assert ready.arm is not None
            # this command announces each movement itself, by counting down before it lets the arm move
            driver = dataclasses.replace(ready, arm=ready.arm.announced(0.0))
            with connected(driver, checksum) as (arm, facts):
                cycle = _Cycle(arm, path, ready.arm.on_clock(laboratory.arm.announcement), ask=hardware)
                executed = cycle.run()
    except LaboratoryError as error:
        raise RefusalError(str(error), FAILED) from None
    except OSError as error:
        raise RefusalError(f"{plan.outputs.directory}: can't be written: {error.strerror}", BAD_INPUT) from None
    record = {
        "mode": laboratory.mode,
        "laboratory": laboratory.name,
        "date": time.strftime("%Y-%m-%dT%H:%M:%S%z"),
        "robot": {"model": facts.model, "serial": facts.serial, "version": facts.version, "checksum": facts.checksum},
        "action": action.values(),
        "slow": slow,
        "planned": dataclasses.asdict(path.report),
        "tracking": dict(executed.tracking),
        "executed_s": float(executed.times[-1]),
    }
    (directory / RECORD).write_text(json.dumps(record, indent=2) + "\n", encoding="utf-8")
    if as_json:
        print_json({"run": str(directory), **record})
    else:
        print(_told(executed))
    say(f"record: {directory / RECORD}")


class _Cycle:
    """One cycle, with a person's consent to each movement where there is hardware."""

    def __init__(self, arm: Arm, path: PlannedPour, announcement: float, *, ask: bool) -> None:
        self._arm, self._path, self._announcement, self._ask = arm, path, announcement, ask

    def run(self) -> Executed:
        """Raises LaboratoryError where it is refused, or stopped."""
        self._arm.hands_in()
        self._consent(
            "Put the EMPTY pourer into the gripper, and take hands and tools out of the cell. Emergency stop in hand?"
        )
        self._moving("approach", lambda: self._arm.move_to_start(self._path))
        try:
            executed: Executed = self._moving("pour", lambda: self._arm.execute(self._path))
        except LaboratoryError as error:
            self._upright(error)
            raise
        self._moving("retreat", lambda: self._arm.retreat(self._path))
        return executed

    def _moving(self, name: str, motion: Callable[[], Any]) -> Any:
        say(f"{name} …")
        return stoppable(self._arm, motion)

    def _upright(self, error: LaboratoryError) -> None:
        """After a stop with the pourer tilted: upright and home, if somebody says so."""
        say(str(error))
        if not self._ask:
            return
        if not _yes("Find the cause and mend it. Shall the arm bring the pourer upright, slowly, and go home?"):
            return
        with contextlib.suppress(LaboratoryError):
            self._arm.release()
            say(f"ready again: {self._arm.recover() or 'nothing had to be done'}")
        self._released()
        self._moving("upright", self._arm.untilt)
        self._released()
        self._moving("retreat", lambda: self._arm.retreat(self._path))

    def _consent(self, text: str) -> None:
        if self._ask and not _yes(text):
            raise LaboratoryError("not confirmed; nothing has moved")
        self._released()

    def _released(self) -> None:
        left = self._announcement
        while left > 0.0:
            say(f"the arm moves in {left:.0f} s; Ctrl-C stops it" if left >= 0.5 else "the arm moves")
            time.sleep(min(left, 1.0))
            left -= 1.0
        self._arm.release()


def _yes(text: str) -> bool:
    say(f"\n{text}")
    return typed_line("type 'yes' to go on > ").strip().lower() == "yes"


def _told(executed: Executed) -> str:
    tracking = executed.tracking
    parts = [f"the cycle was completed; the pour took {executed.times[-1]:.1f} s"]
    if "rms_angle" in tracking:
        parts.append(
            f"joints followed within {math.degrees(tracking['rms_angle']):.2f} deg rms, "
            f"{math.degrees(tracking['max_angle']):.2f} deg at most"
        )
    return "; ".join(parts)
