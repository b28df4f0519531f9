"""What those who only watch get to see: values, sent to every watcher, never waited for.

A watcher is any callable that takes an `Event`. It runs on the control loop and must return at once; one that raises
is reported once and dropped.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from actors.interfaces import PourProgress
from orchestrator.journal.stage_results import Results
from orchestrator.requests import Decision, Outcome, Request
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Progress
from sim_engine.outcome import RecordedFrames

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Event:
    """Base of all events.

    Attributes:
        time: when it happened (seconds since 1970); for replayed events, when it had happened.
        stage: name of the stage it belongs to; empty outside any.
        replayed: read from the journal of an interrupted run, not happening now.
    """

    time: float = field(default_factory=time.time)
    stage: str = ""
    replayed: bool = False


@dataclass(frozen=True, kw_only=True)
class CampaignOpened(Event):
    """A run begins, or goes on.

    Attributes:
        stages: names of all stages, in order.
        mode: 'virtual', 'hardware', or 'none' without a bench.
        simulators: members of the pool.
    """

    name: str
    run_directory: Path
    stages: tuple[str, ...]
    mode: str
    simulators: int
    resumed: bool = False


@dataclass(frozen=True, kw_only=True)
class CampaignStateChanged(Event):
    """The campaign's state, see `orchestrator.states`."""

    before: str
    after: str
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class CampaignClosed(Event):
    """The last event of a run.

    Attributes:
        state: in which the run ends.
        results: of all closed stages, by name.
    """

    state: str
    results: Results


@dataclass(frozen=True, kw_only=True)
class StageOpened(Event):
    """A strategy takes over. `index` counts from 1."""

    index: int
    count: int
    resumed: bool = False


@dataclass(frozen=True, kw_only=True)
class StageClosed(Event):
    """A strategy is done; `result` is what it learnt."""

    result: StageResult


@dataclass(frozen=True, kw_only=True)
class RequestStarted(Event):
    """A simulation, pour or suggestion begins to run. `id` is unique within the campaign."""

    id: int
    request: Request


@dataclass(frozen=True, kw_only=True)
class RequestFinished(Event):
    """What came of it.

    Attributes:
        seconds: wall time from start to end; 0 for replayed ones.
        frames: particles, for the few simulations that are recorded.
    """

    id: int
    request: Request
    outcome: Outcome
    seconds: float = 0.0
    frames: RecordedFrames | None = None


@dataclass(frozen=True, kw_only=True)
class PourProgressed(Event):
    """Where the running pour stands."""

    id: int
    number: int
    progress: PourProgress


@dataclass(frozen=True, kw_only=True)
class MadeAhead(Event):
    """Simulations that nobody has asked for yet: the pool has nothing else to do while the arm pours.

    Attributes:
        running: being made.
        waiting: made, and not yet asked for.
    """

    running: int
    waiting: int


@dataclass(frozen=True, kw_only=True)
class StrategyProgressed(Event):
    """The strategy was told something: what of its work is done, and what it has learnt so far."""

    progress: Progress
    result: StageResult


@dataclass(frozen=True, kw_only=True)
class DecisionMade(Event):
    """Why a strategy asks for what it asks for."""

    decision: Decision


@dataclass(frozen=True, kw_only=True)
class LogLine(Event):
    """Something people should read.

    Attributes:
        asked: whether the operator reads it in a question at the terminal, where it need not stand twice.
    """

    level: Literal["info", "warning", "error"]
    text: str
    asked: bool = False


Watcher = Callable[[Event], object]


class Watchers:
    """Sends events to all watchers; one that raises is reported once and dropped."""

    def __init__(self, watchers: Sequence[Watcher] = ()) -> None:
        self._watchers = list(watchers)

    def emit(self, event: Event) -> None:
        """Hand an event to every watcher that is left. Never raises."""
        broken: list[tuple[Watcher, Exception]] = []
        for watcher in self._watchers:
            try:
                watcher(event)
            except Exception as error:
                broken.append((watcher, error))
        for watcher, problem in broken:
            self._watchers.remove(watcher)
            name = getattr(watcher, "__qualname__", type(watcher).__qualname__)
            text = f"{name} can't watch any longer: {type(problem).__name__}: {problem}"
            _log.warning(text, exc_info=problem)
            self.emit(LogLine(level="warning", text=text))

    def log(self, level: Literal["info", "warning", "error"], text: str, stage: str = "") -> None:
        """A line for people."""
        self.emit(LogLine(level=level, text=text, stage=stage))
