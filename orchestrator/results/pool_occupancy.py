"""Use of the simulator pool during stages that pour, and the arm's waiting times for the next request.

`Occupancy` counts one stage, `occupancies` reads all stages of a journal, `occupancy_lines` formats them for the
terminal.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

from orchestrator.journal.journal import Entry, Kind
from orchestrator.requests import Pour, Simulate
from orchestrator.results.run_summary import PoolUse
from orchestrator.states import State

if TYPE_CHECKING:
    from rich.console import RenderableType

RESTS = "pool_rests"
"""Key in a decision's values with which a strategy reports that no simulation is worthwhile now."""


@dataclass
class Occupancy:
    """Counts over one stage in which the arm pours. Times are seconds of any clock.

    The time counts from the first request to the end of the last pour. It excludes periods in which the strategy has
    reported that the pool may rest and no simulation has started since.

    Attributes:
        slots: maximum number of simulations at a time.
        busy, useful, total: slot seconds: used by simulations while the pool was useful; of useful time; of all time.
        waits: waiting times of the arm, from a pour's outcome to the beginning of the next pour.
    """

    slots: int
    busy: float = 0.0
    useful: float = 0.0
    total: float = 0.0
    waits: list[float] = field(default_factory=list)

    _now: float | None = None
    _running: int = 0
    _resting: bool = False
    _poured_at: float | None = None
    _last_pour: tuple[float, float, float] | None = None

    def simulation_started(self, time: float) -> None:
        """A simulation was handed to the pool."""
        self._pass(time)
        self._running, self._resting = self._running + 1, False

    def simulation_finished(self, time: float) -> None:
        """A simulation finished."""
        self._pass(time)
        self._running = max(self._running - 1, 0)

    def rests(self, time: float) -> None:
        """No simulation is worthwhile for now."""
        self._pass(time)
        self._resting = True

    def pour_started(self, time: float) -> None:
        """A pour began."""
        self._pass(time)
        if self._poured_at is not None:
            self.waits.append(time - self._poured_at)
        self._poured_at = self._last_pour = None

    def pour_finished(self, time: float) -> None:
        """A pour was weighed."""
        self._pass(time)
        self._poured_at = time
        self._last_pour = (self.busy, self.useful, self.total)

    def interrupted(self) -> None:
        """The run was paused or killed: nothing runs, and counting restarts with the next event."""
        self._now, self._running, self._poured_at = None, 0, None

    def finish(self) -> None:
        """The stage is finished. The time after its last pour is not counted."""
        if self._last_pour is not None:
            self.busy, self.useful, self.total = self._last_pour

    @property
    def fraction(self) -> float | None:
        """Busy share of the useful time; None if nothing was simulated during pours."""
        return self.busy / self.useful if self.useful > 0.0 else None

    def _pass(self, time: float) -> None:
        seconds = 0.0 if self._now is None else time - self._now
        self.total += self.slots * seconds
        if not (self._resting and self._running < self.slots):
            self.busy += min(self._running, self.slots) * seconds
            self.useful += self.slots * seconds
        self._now = time


def occupancies(entries: Iterable[Entry], slots: int) -> dict[str, Occupancy]:
    """The occupancy in every stage of a journal with both simulations and pours, by the stage's name."""
    simulations: set[int] = set()
    stages: dict[str, Occupancy] = {}
    done: dict[str, set[str]] = {}
    for entry in entries:
        if entry.kind == Kind.CAMPAIGN_STATE and entry.body["after"] != State.RUNNING:
            for each in stages.values():
                each.interrupted()
            continue
        stage, body = stages.setdefault(entry.stage, Occupancy(slots)), entry.body
        match entry.kind:
            case Kind.REQUESTED:
                done.setdefault(entry.stage, set()).add(body["request"]["type"])
                if body["request"]["type"] == Simulate.__name__:
                    simulations.add(body["id"])
            case Kind.STARTED if body["id"] in simulations:
                stage.simulation_started(entry.t)
            case Kind.FINISHED if body["id"] in simulations:
                stage.simulation_finished(entry.t)
            case Kind.DECISION if RESTS in body["values"]:
                stage.rests(entry.t)
            case Kind.POUR_STARTED:
                stage.pour_started(entry.t)
            case Kind.POUR_FINISHED:
                stage.pour_finished(entry.t)
            case Kind.STAGE_CLOSED:
                stage.finish()
    both = {Simulate.__name__, Pour.__name__}
    return {name: one for name, one in stages.items() if both <= done.get(name, set()) and one.useful > 0.0}


def occupancy_lines(stages: Mapping[str, PoolUse]) -> list[RenderableType]:
    """'pool 97 % busy while there was work (41 % of the time); the arm waited at most 0.06 s for a decision'."""
    from rich.text import Text

    lines: list[RenderableType] = []
    for stage, one in stages.items():
        if one.pool_busy is None:
            continue
        text = f"  {stage.rpartition(':')[2]}: pool {100 * one.pool_busy:.0f} % busy"
        if one.pool_useful is not None and one.pool_useful < 0.995:
            text += f" while there was work ({100 * one.pool_useful:.0f} % of the time)"
        if one.arm_longest_wait_s is not None:
            text += f"; between two pours the arm waited {one.arm_longest_wait_s:.2g} s at most"
        lines.append(Text(text, style="dim"))
    return lines
