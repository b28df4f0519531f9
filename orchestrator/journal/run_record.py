"""A readable record of a run, finished or not, from its journal.

- `read_record` returns a `Record`: stages, pours, questions, notes, decisions and times.
- `answers` yields finished requests with their outcomes; `pour_row` is a pour as a table row in display units.
- `read_result` returns the `CampaignResult`: state, counts, costs, and the results of the stages.

The module only reads; it does not check the journal (`orchestrator.journal.journal_check`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from orchestrator.journal.codec import decode_outcome, decode_request
from orchestrator.journal.journal import Entry, JournalReader, Kind
from orchestrator.journal.stage_results import Results, decode_results
from orchestrator.requests import Ask, Failed, Outcome, Pour, Poured, Request
from orchestrator.states import RESTING, State
from orchestrator.strategies.stage_result import displayed_action
from sim_engine.outcome import PourMeasurement, normalised_spillage

Came = Literal["weighed", "failed", "unknown", "not begun"]


@dataclass
class PourMade:
    """A requested pour and its outcome.

    Attributes:
        came: status; 'unknown': it had begun and its outcome was not reported.
        time: when it finished, or began if it has no outcome (seconds since 1970); 0 if it has not begun.
        outcome: as recorded; None without one.
        measured: the measurement, if it was weighed.
        reason: why it failed.
        said: the operator's answer about it; '' without one.
        seconds: duration, operator and balance included; None if unknown.
    """

    stage: str
    id: int
    request: Pour
    came: Came = "not begun"
    time: float = 0.0
    outcome: Outcome | None = None
    measured: PourMeasurement | None = None
    reason: str = ""
    said: str = ""
    seconds: float | None = None


@dataclass
class StageDone:
    """Progress of a stage."""

    name: str
    closed: bool = False
    simulations: int = 0
    failed_simulations: int = 0
    pours: int = 0


@dataclass
class RecordedQuestion:
    """A question to the operator. `answer` is None while there is none."""

    time: float
    stage: str
    text: str
    answer: str | None = None


@dataclass
class Record:
    """The content of a run's journal in readable form.

    Attributes:
        created: when the run was begun, seconds since 1970.
        ended: when the last entry was written.
        state: the last recorded state.
        reason: why that state was entered.
        at_work_s: seconds during which a process had the run; without pauses.
        notes: messages for the operator: time and text.
        decisions: reasons for the strategies' requests: stage and text.
    """

    created: float
    ended: float
    state: State = State.QUEUED
    reason: str = ""
    at_work_s: float = 0.0
    stages: dict[str, StageDone] = field(default_factory=dict)
    pours: list[PourMade] = field(default_factory=list)
    questions: list[RecordedQuestion] = field(default_factory=list)
    notes: list[tuple[float, str]] = field(default_factory=list)
    decisions: list[tuple[str, str]] = field(default_factory=list)

    @property
    def unknown_pours(self) -> list[PourMade]:
        """Pours that had begun and have no outcome."""
        return [pour for pour in self.pours if pour.came == "unknown"]

    @property
    def weighed(self) -> list[PourMade]:
        """Pours that were weighed."""
        return [pour for pour in self.pours if pour.measured is not None]


def read_record(journal: JournalReader) -> Record:
    """Read a journal, finished or not.

    Raises:
        RunError: an entry can't be decoded.
    """
    reading = _Reading(journal.header.created)
    for entry in journal.entries():
        reading.read(entry)
    return reading.end()


class _Reading:
    def __init__(self, created: float) -> None:
        self.record = Record(created, created)
        self._pours: dict[tuple[str, int], PourMade] = {}
        self._asked: dict[tuple[str, int], RecordedQuestion] = {}
        self._process: tuple[int, float] | None = None

    def read(self, entry: Entry) -> None:
        record, body, key = self.record, entry.body, (entry.stage, entry.body.get("id", -1))
        match entry.kind:
            case Kind.CAMPAIGN_STATE:
                self._enter(entry)
            case Kind.STAGE_OPENED:
                record.stages[entry.stage] = StageDone(entry.stage)
            case Kind.STAGE_CLOSED:
                record.stages[entry.stage].closed = True
            case Kind.REQUESTED:
                self._requested(entry, body)
            case Kind.FINISHED if body["outcome"]["type"] in ("Simulated", "Failed"):
                stage = record.stages[entry.stage]
                stage.simulations += 1
                failed = body["outcome"]["type"] == "Failed" or body["outcome"]["outcome"].get("invalid") is not None
                stage.failed_simulations += failed
            case Kind.POUR_STARTED:
                self._pours[key].came, self._pours[key].time = "unknown", entry.t
            case Kind.POUR_WITHDRAWN:
                self._pours[key].came = "not begun"
            case Kind.POUR_FINISHED:
                self._poured(self._pours[key], entry)
                record.stages[entry.stage].pours += 1
            case Kind.OPERATOR_ASKED:
                self._asks(key, entry, body["question"])
            case Kind.OPERATOR_ANSWERED:
                if key in self._asked:
                    self._asked[key].answer = body["answer"]
                if key in self._pours:
                    self._pours[key].said = body["answer"]
            case Kind.NOTE:
                record.notes.append((entry.t, body["text"]))
            case Kind.DECISION:
                record.decisions.append((entry.stage, body["text"]))
        self.record.ended = entry.t

    def end(self) -> Record:
        """The whole record. A process that still has the run, or died with it, is counted until its last entry."""
        if self._process is not None:
            self.record.at_work_s += self.record.ended - self._process[1]
        return self.record

    def _enter(self, entry: Entry) -> None:
        record, body = self.record, entry.body
        if self._process is not None:
            pid, since = self._process
            # For a process that died, the last entry before the next process's first entry counts as its end.
            until = entry.t if body.get("pid") == pid else max(record.ended, since)
            record.at_work_s += until - since
        record.state, record.reason = State(body["after"]), body.get("reason", "")
        self._process = None if record.state in RESTING else (body.get("pid", 0), entry.t)

    def _requested(self, entry: Entry, body: dict[str, Any]) -> None:
        request = body["request"]
        if request["type"] == Pour.__name__:
            decoded = decode_request(request)
            assert isinstance(decoded, Pour)
            pour = PourMade(entry.stage, body["id"], decoded)
            self._pours[entry.stage, body["id"]] = pour
            self.record.pours.append(pour)
        elif request["type"] == Ask.__name__:
            self._asks((entry.stage, body["id"]), entry, request["question"])

    def _asks(self, key: tuple[str, int], entry: Entry, text: str) -> None:
        # a strategy's question is written when it is requested and again when it is answered
        if key not in self._asked:
            self._asked[key] = RecordedQuestion(entry.t, entry.stage, text)
            self.record.questions.append(self._asked[key])

    @staticmethod
    def _poured(pour: PourMade, entry: Entry) -> None:
        pour.time, pour.seconds = entry.t, entry.body.get("seconds")
        pour.outcome = decode_outcome(entry.body["outcome"])
        match pour.outcome:
            case Poured(measurement):
                pour.came, pour.measured = "weighed", measurement
            case Failed(_, reason):
                pour.came, pour.reason = "failed", reason


Row = dict[str, Any]


@dataclass(frozen=True)
class RequestOutcome:
    """A request and its outcome.

    Attributes:
        id: unique within the campaign.
        time: when it finished (seconds since 1970).
        seconds: duration from start to end.
    """

    stage: str
    id: int
    request: Request
    outcome: Outcome
    time: float
    seconds: float


def answers(journal: JournalReader, kind: type[Request]) -> Iterator[RequestOutcome]:
    """Finished requests of one kind, in the order in which they finished."""
    requests: dict[int, Request] = {}
    for entry in journal.entries(kinds=(Kind.REQUESTED, Kind.FINISHED, Kind.POUR_FINISHED)):
        key, body = entry.body["id"], entry.body
        if entry.kind == Kind.REQUESTED:
            if body["request"]["type"] == kind.__name__:
                requests[key] = decode_request(body["request"])
        elif key in requests:
            yield RequestOutcome(
                entry.stage, key, requests[key], decode_outcome(body["outcome"]), entry.t, body["seconds"]
            )


def pour_row(pour: Pour, outcome: Outcome | None) -> Row:
    """Number, action in display units, prediction, masses [g] and spillage r of a pour; None: it has no outcome yet."""
    row: Row = {"number": pour.number, **displayed_action(pour.action.values())}
    row["predicted"] = None if pour.predicted is None else pour.predicted.mean
    match outcome:
        case Poured(weighed):
            row |= {"loaded_g": 1e3 * weighed.loaded, "spilled_g": 1e3 * weighed.spilled}
            row |= {"retained_g": 1e3 * weighed.retained, "spillage": normalised_spillage(weighed.fractions)}
        case Failed(kind, reason):
            row["failed"] = f"{kind}: {reason}"
    return row


@dataclass(frozen=True)
class CampaignResult:
    """Result of a campaign.

    Attributes:
        results: results of the closed stages by name, in order.
        simulations: number of finished simulations, including failed ones.
        pours: number of finished pours, including failed ones.
        cpu_s: CPU seconds of all simulations and suggestions.
        seconds: wall time of this process's part of the run.
    """

    name: str
    directory: Path
    state: State
    results: Results = field(default_factory=dict)
    simulations: int = 0
    pours: int = 0
    cpu_s: float = 0.0
    seconds: float = 0.0


def read_result(journal: JournalReader, directory: Path, *, seconds: float = 0.0) -> CampaignResult:
    """Result of a run, finished or not, from its journal."""
    simulations = pours = 0
    cpu_s = 0.0
    for entry in journal.entries(kinds=[Kind.FINISHED, Kind.POUR_FINISHED]):
        outcome = entry.body["outcome"]
        match outcome["type"]:
            case "Suggested":
                cpu_s += outcome["suggestion"]["seconds"]
                continue
            case "Simulated":
                cpu_s += outcome["outcome"]["cpu_s"]
        if entry.kind == Kind.POUR_FINISHED:
            pours += 1
        else:
            simulations += 1
    return CampaignResult(
        journal.header.name,
        directory,
        journal.state(),
        decode_results(journal.stage_results()),
        simulations,
        pours,
        cpu_s,
        seconds,
    )
