"""Events of a run: immutable values for displays, recordings and APIs that follow a run.

`Subscribers` sends each `Event` to its members. A subscriber (`Subscriber`) is any callable that takes an `Event`. It
runs on the control loop and must return at once. If it raises an exception, the error is reported once and the
subscriber is removed. The run never waits for a subscriber and never depends on one.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Literal

from actors.interfaces import PourProgress
from orchestrator.journal.codec import Results
from orchestrator.requests import Decision, Outcome, Request
from orchestrator.run_clock import run_time
from orchestrator.strategies.stage_result import StageResult
from orchestrator.strategies.strategy import Progress
from sim_engine.outcome import RecordedFrames

_log = logging.getLogger(__name__)


@dataclass(frozen=True, kw_only=True)
class Event:
    """Base of all events.

    Attributes:
        time: when it happened, by `orchestrator.run_clock` [s since 1970]; of a replayed event, when the original did.
        stage: name of the stage that it belongs to; empty outside stages.
        replayed: read from the journal of an interrupted run, not happening now.
    """

    time: float = field(default_factory=run_time)
    stage: str = ""
    replayed: bool = False


@dataclass(frozen=True, kw_only=True)
class CampaignOpened(Event):
    """A run begins or is resumed.

    Attributes:
        stages: names of all stages, in order.
        mode: 'virtual', 'hardware', or 'none' without a bench.
        simulators: number of simulators in the pool.
    """

    name: str
    run_directory: Path
    stages: tuple[str, ...]
    mode: str
    simulators: int
    resumed: bool = False


@dataclass(frozen=True, kw_only=True)
class CampaignStateChanged(Event):
    """The campaign's state changed, see `orchestrator.states`."""

    before: str
    after: str
    reason: str = ""


@dataclass(frozen=True, kw_only=True)
class CampaignClosed(Event):
    """The last event of a run.

    Attributes:
        state: the state in which the run ends.
        results: results of all closed stages, by name.
    """

    state: str
    results: Results


@dataclass(frozen=True, kw_only=True)
class StageOpened(Event):
    """A stage begins. `index` counts from 1."""

    index: int
    count: int
    resumed: bool = False


@dataclass(frozen=True, kw_only=True)
class StageClosed(Event):
    """A stage is finished; `result` is its final result."""

    result: StageResult


@dataclass(frozen=True, kw_only=True)
class RequestStarted(Event):
    """A simulation, pour or suggestion begins to run. `id` is unique within the campaign."""

    id: int
    request: Request


@dataclass(frozen=True, kw_only=True)
class RequestFinished(Event):
    """A request has an outcome.

    Attributes:
        seconds: wall time from start to end; 0 for replayed requests.
        frames: particles, for the few simulations that are recorded.
    """

    id: int
    request: Request
    outcome: Outcome
    seconds: float = 0.0
    frames: RecordedFrames | None = None


@dataclass(frozen=True, kw_only=True)
class PourProgressed(Event):
    """Progress of the running pour."""

    id: int
    number: int
    progress: PourProgress


@dataclass(frozen=True, kw_only=True)
class SpeculationProgressed(Event):
    """Number of speculative simulations, which use the idle pool while the arm pours.

    Attributes:
        running: simulations that are running.
        waiting: simulations that are finished and not yet requested.
    """

    running: int
    waiting: int


@dataclass(frozen=True, kw_only=True)
class StrategyProgressed(Event):
    """The strategy has processed an outcome: its progress and its result so far."""

    progress: Progress
    result: StageResult


@dataclass(frozen=True, kw_only=True)
class DecisionMade(Event):
    """The reason for a strategy's requests."""

    decision: Decision


@dataclass(frozen=True, kw_only=True)
class LogLine(Event):
    """A message for the operator.

    Attributes:
        asked: whether the operator already sees the text in a question at the terminal; a display can then omit it.
    """

    level: Literal["info", "warning", "error"]
    text: str
    asked: bool = False


Subscriber = Callable[[Event], object]


class Subscribers:
    """Sends events to all subscribers. A subscriber that raises is reported once and removed."""

    def __init__(self, subscribers: Sequence[Subscriber] = ()) -> None:
        self._subscribers = list(subscribers)

    def emit(self, event: Event) -> None:
        """Send an event to every remaining subscriber. Never raises."""
        failed: list[tuple[Subscriber, Exception]] = []
        for subscriber in self._subscribers:
            try:
                subscriber(event)
            except Exception as error:
                failed.append((subscriber, error))
        for subscriber, problem in failed:
            self._subscribers.remove(subscriber)
            name = getattr(subscriber, "__qualname__", type(subscriber).__qualname__)
            text = f"{name} can't watch any longer: {type(problem).__name__}: {problem}"
            _log.warning(text, exc_info=problem)
            self.emit(LogLine(level="warning", text=text))

    def log(self, level: Literal["info", "warning", "error"], text: str, stage: str = "") -> None:
        """Emit a `LogLine`."""
        self.emit(LogLine(level=level, text=text, stage=stage))
