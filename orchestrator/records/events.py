"""The events of a run: what its journal records and its subscribers receive, as the same immutable values.

`Journal.append` writes an `Event` and then passes it to the subscribers. An event without a `kind` is only passed on:
progress for displays, and messages. `event_of` reads an event back from its entry, `replayed`.

A subscriber (`Subscriber`) is any callable that takes an `Event`. It runs on the control loop and must return at once.
If it raises an exception, the error is reported once and the subscriber is removed. The run never waits for a
subscriber and never depends on one.
"""

from __future__ import annotations

from collections.abc import Callable, Hashable, Mapping
from dataclasses import dataclass, field
from enum import StrEnum
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, Literal, cast

from actors.interfaces import PourProgress
from actors.optimizer.questions import WRITTEN_IF_SET
from orchestrator.learning.requests import NOT_WRITTEN, Decision, Outcome, Pour, Request
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Progress
from orchestrator.records.codec import (
    CodecError,
    Results,
    decode_outcome,
    decode_request,
    decode_result,
    encode_result,
    from_json,
    to_json,
    written_fields,
)
from orchestrator.records.run_clock import run_time
from orchestrator.records.states import State
from sim_engine.outcome import RecordedFrames


class Kind(StrEnum):
    """Kind of an entry in the journal; its body has the written fields of its event."""

    CAMPAIGN_STATE = "campaign.state"
    STAGE_OPENED = "stage.opened"
    STAGE_CLOSED = "stage.closed"
    ASKED = "asked"
    REQUESTED = "requested"
    STARTED = "started"
    FINISHED = "finished"
    POUR_STARTED = "pour.started"
    POUR_READ = "pour.read"
    POUR_WITHDRAWN = "pour.withdrawn"
    POUR_FINISHED = "pour.finished"
    TOLD = "told"
    DECISION = "decision"
    OPERATOR_ASKED = "operator.asked"
    OPERATOR_ANSWERED = "operator.answered"
    POUR_CORRECTED = "pour.corrected"
    NOTE = "note"


NOT_SENT = {"sent": False}
"""Metadata of a field that only the journal has; the daemon's stream leaves it out."""


@dataclass(frozen=True, kw_only=True)
class Event:
    """Base of all events.

    Attributes:
        time: when it happened, by `orchestrator.records.run_clock` [s since 1970]; a replayed event has that of the
            original.
        stage: name of the stage that it belongs to; empty outside stages.
        replayed: it belongs to an interrupted process of the run, and does not happen now.
    """

    KIND: ClassVar[Kind | None] = None

    time: float = field(default_factory=run_time, metadata=NOT_WRITTEN)
    stage: str = field(default="", metadata=NOT_WRITTEN)
    replayed: bool = field(default=False, metadata=NOT_WRITTEN)

    @property
    def kind(self) -> Kind | None:
        """Kind of its entry in the journal; None for an event that is not written."""
        return self.KIND

    @property
    def internal(self) -> bool:
        """Whether displays and the daemon's stream leave it out: resuming needs it, or only the journal has it."""
        return False

    def body(self) -> dict[str, Any]:
        """The body of its entry. Raises CodecError."""
        return cast("dict[str, Any]", to_json(self, type(self)))

    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Decode a large field of a read event when it is needed."""
            late = self.__dict__.get("_late", {})
            if name not in late:
                raise AttributeError(f"{type(self).__name__} has no attribute '{name}'")
            value = self.__dict__[name] = late.pop(name)()
            return value


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
    """The campaign's state changed, see `orchestrator.records.states`.

    Attributes:
        pid: number of the process that runs it.
    """

    KIND = Kind.CAMPAIGN_STATE

    before: State
    after: State
    reason: str = ""
    pid: int = field(default=0, metadata=NOT_SENT)


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

    KIND = Kind.STAGE_OPENED

    index: int = field(default=0, metadata=NOT_WRITTEN)
    count: int = field(default=0, metadata=NOT_WRITTEN)
    resumed: bool = field(default=False, metadata=NOT_WRITTEN)
    seed: int = field(default=0, metadata=NOT_SENT)


@dataclass(frozen=True, kw_only=True)
class StageClosed(Event):
    """A stage is finished; `result` is its final result."""

    KIND = Kind.STAGE_CLOSED

    result: StageResult

    @property
    def encoded(self) -> dict[str, Any]:
        """The result as JSON. Of a read event, it can be used without the package that declares its kind."""
        late: partial[StageResult] | None = self.__dict__.get("_late", {}).get("result")
        return encode_result(self.result) if late is None else cast("dict[str, Any]", late.args[0])


@dataclass(frozen=True, kw_only=True)
class JournalEvent(Event):
    """Base of the events that only the journal and a resumed run need."""

    @property
    def internal(self) -> bool:
        """See `Event.internal`."""
        return True


@dataclass(frozen=True, kw_only=True)
class Asked(JournalEvent):
    """The strategy was asked for requests.

    Attributes:
        simulations, pours: the free slots.
        ids: of the new requests.
    """

    KIND = Kind.ASKED

    simulations: int
    pours: int
    ids: tuple[int, ...]


@dataclass(frozen=True, kw_only=True)
class Requested(JournalEvent):
    """The strategy requests something. `id` is unique within the campaign."""

    KIND = Kind.REQUESTED

    id: int
    request: Request


@dataclass(frozen=True, kw_only=True)
class RequestStarted(Event):
    """A simulation, pour or suggestion begins to run. `id` is unique within the campaign.

    Attributes:
        attempt: how often a pour was begun, including this attempt.
    """

    id: int
    request: Request = field(metadata=NOT_WRITTEN)
    attempt: int = field(default=1, metadata=NOT_SENT)

    @property
    def kind(self) -> Kind:
        """See `Event.kind`."""
        return Kind.POUR_STARTED if isinstance(self.request, Pour) else Kind.STARTED

    def body(self) -> dict[str, Any]:
        """See `Event.body`."""
        if not isinstance(self.request, Pour):
            return {"id": self.id}
        return {"id": self.id, "attempt": self.attempt, "number": self.request.number}


@dataclass(frozen=True, kw_only=True)
class PourRead(JournalEvent):
    """What the balance showed in the receiver at the begin of a phase of a dose, for a person who has to settle it.

    Attributes:
        phase: see `actors.interfaces.DoseProgress`.
        mass: reading without the receiver [kg].
    """

    KIND = Kind.POUR_READ

    id: int
    phase: str
    mass: float


@dataclass(frozen=True, kw_only=True)
class PourWithdrawn(JournalEvent):
    """A pour that had begun poured nothing, for a reason; it may be made later."""

    KIND = Kind.POUR_WITHDRAWN

    id: int
    reason: str


@dataclass(frozen=True, kw_only=True)
class RequestFinished(Event):
    """A request has an outcome.

    Attributes:
        seconds: wall time from start to end.
        frames: particles, for the few simulations that are recorded.
    """

    id: int
    request: Request = field(metadata=NOT_WRITTEN)
    outcome: Outcome
    seconds: float = 0.0
    frames: RecordedFrames | None = field(default=None, metadata=NOT_WRITTEN | NOT_SENT)

    @property
    def kind(self) -> Kind:
        """See `Event.kind`."""
        return Kind.POUR_FINISHED if isinstance(self.request, Pour) else Kind.FINISHED


@dataclass(frozen=True, kw_only=True)
class Told(JournalEvent):
    """The strategy was told the outcome of a request, or of a pour that was added by hand."""

    KIND = Kind.TOLD

    id: int


@dataclass(frozen=True, kw_only=True)
class OperatorAsked(JournalEvent):
    """A question to the operator about a request, with the allowed answers."""

    KIND = Kind.OPERATOR_ASKED

    id: int
    question: str
    options: tuple[str, ...]


@dataclass(frozen=True, kw_only=True)
class OperatorAnswered(JournalEvent):
    """The operator's answer."""

    KIND = Kind.OPERATOR_ANSWERED

    id: int
    answer: str


@dataclass(frozen=True, kw_only=True)
class PourCorrected(JournalEvent):
    """A person corrected the outcome of a pour, which was told wrongly. The first outcome stays in the journal.

    Attributes:
        by: who corrected it.
    """

    KIND = Kind.POUR_CORRECTED

    id: int
    outcome: Outcome
    by: str = ""


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
    result: StageResult = field(metadata=NOT_SENT)


@dataclass(frozen=True, kw_only=True)
class DecisionMade(Event):
    """The reason for a strategy's requests."""

    KIND = Kind.DECISION

    decision: Decision

    def body(self) -> dict[str, Any]:
        """See `Event.body`."""
        return cast("dict[str, Any]", to_json(self.decision, Decision))


Level = Literal["note", "info", "warning", "error"]


@dataclass(frozen=True, kw_only=True)
class LogLine(Event):
    """A message for the operator.

    Attributes:
        level: a 'note' is only for the journal.
        asked: whether the operator already sees the text in a question at the terminal; a display can then omit it.
        kept: whether the journal has it.
        about: what it records of a night: 'consent', its planned 'end', the 'fault' that ended it, 'accounted' masses,
            or the subject of an answered question.
    """

    level: Level = field(default="note", metadata=NOT_WRITTEN)
    text: str
    asked: bool = field(default=False, metadata=NOT_WRITTEN)
    kept: bool = field(default=False, metadata=NOT_WRITTEN | NOT_SENT)
    about: str | None = field(default=None, metadata=WRITTEN_IF_SET)

    @property
    def kind(self) -> Kind | None:
        """See `Event.kind`."""
        return Kind.NOTE if self.kept else None

    @property
    def internal(self) -> bool:
        """See `Event.internal`."""
        return self.level == "note"


_CLASSES: dict[str, type[Event]] = {
    **{kind.KIND: kind for kind in (*Event.__subclasses__(), *JournalEvent.__subclasses__()) if kind.KIND is not None},
    Kind.STARTED: RequestStarted,
    Kind.POUR_STARTED: RequestStarted,
    Kind.NOTE: LogLine,
    Kind.FINISHED: RequestFinished,
    Kind.POUR_FINISHED: RequestFinished,
}

_LATE: dict[str, Callable[[Any], Any]] = {
    "request": decode_request,
    "outcome": decode_outcome,
    "result": decode_result,
}
"""Fields that are large, or whose package may be missing; they are decoded when they are needed."""


def event_of(kind: str, body: Mapping[str, Any], requests: dict[int, Requested], **about: Any) -> Event:
    """The event that an entry of the journal records.

    Args:
        kind, body: of the entry.
        requests: unfinished requests among the entries before it; updated.
        about: its time and stage.

    Raises:
        CodecError: the entry has another form.
    """
    cls = _CLASSES.get(kind)
    if cls is None:
        raise CodecError(f"the kind '{kind}' is not known")
    if cls is DecisionMade:
        body = {"decision": body}
    event, late = object.__new__(cls), dict[str, Any]()
    event.__dict__.update(about, replayed=True, kept=True, _late=late)
    for name, hint in written_fields(cast(Hashable, cls)).items():
        if name in body:
            if name in _LATE and not hasattr(cls, name):  # a default would hide it
                late[name] = partial(_LATE[name], body[name])
            else:
                event.__dict__[name] = from_json(body[name], hint)
        elif not hasattr(cls, name):  # it has no default
            raise CodecError(f"{cls.__name__} lacks {name}")
    if isinstance(event, Requested):
        requests[event.id] = event
    elif isinstance(event, RequestStarted | RequestFinished):
        if event.id not in requests:
            raise CodecError(f"request {event.id} has no entry")
        late["request"] = partial(getattr, requests[event.id], "request")
        if isinstance(event, RequestFinished):
            del requests[event.id]
    return event


Subscriber = Callable[[Event], object]
