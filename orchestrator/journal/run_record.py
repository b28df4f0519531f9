"""The only reader of journals outside the engine: the history of a run, finished or not, in readable form.

- `read_record` returns a `RunRecord`: stages, pours, questions, notes, decisions and times. `RecordReader` goes on
  where it stopped, for pages that ask again at every event.
- `answers` yields finished requests with their outcomes; `pour_row` is a pour as a table row in display units.
- `read_result` returns the `CampaignResult`: state, counts, costs, and the results of the stages.

Nothing here checks the journal (`orchestrator.journal.journal_check`).
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from orchestrator.journal.codec import Results, decode_outcome, decode_request, decode_results
from orchestrator.journal.journal import JOURNAL_NAME, Entry, JournalReader, Kind
from orchestrator.journal.journal_file import Header
from orchestrator.requests import Ask, Failed, Outcome, Pour, Poured, Request, Simulate
from orchestrator.states import RESTING, State
from orchestrator.strategies.stage_result import displayed_action
from sim_engine.outcome import PourMeasurement, normalised_spillage

PourState = Literal["asked", "under way", "unknown", "weighed", "failed"]

POOL_RESTS = "pool_rests"
"""Key in a decision's values with which a strategy reports that no simulation is worthwhile now."""


@dataclass
class RecordedPour:
    """A requested pour and its outcome.

    Attributes:
        state: 'under way': it has begun; 'unknown': the run ended during the pour, so it has no outcome.
        outcome: as recorded; None without one.
        measured: the measurement, if it was weighed.
        reason: why it failed.
        answer: the operator's answer about it; '' without one.
        time: when it began, or ended; None before (seconds since 1970).
        seconds: duration, operator and balance included; None if unknown.
    """

    stage: str
    id: int
    request: Pour
    state: PourState = "asked"
    measured: PourMeasurement | None = None
    reason: str = ""
    outcome: Outcome | None = None
    answer: str = ""
    time: float | None = None
    seconds: float | None = None


@dataclass
class Occupancy:
    """Use of the simulator pool over one stage in which the arm pours. Times are seconds of any clock.

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


@dataclass
class RecordedStage:
    """Progress of a stage.

    Attributes:
        simulations, failed_simulations, pours: numbers of finished ones.
        simulations_asked, pours_asked: numbers of requested ones.
    """

    name: str
    occupancy: Occupancy
    closed: bool = False
    simulations: int = 0
    failed_simulations: int = 0
    pours: int = 0
    simulations_asked: int = 0
    pours_asked: int = 0


@dataclass
class RecordedQuestion:
    """A question to the operator. `answer` is None while there is none."""

    time: float
    stage: str
    text: str
    answer: str | None = None


@dataclass(frozen=True)
class RecordedDecision:
    """A reason for a strategy's requests. `simulations_asked` of its stage is the number of requests before it."""

    time: float
    stage: str
    text: str
    values: dict[str, Any]
    simulations_asked: int


@dataclass
class RunRecord:
    """The content of a run's journal.

    Attributes:
        header: name of the campaign, its fingerprint, and when the run was begun.
        ended: when the last entry was written, seconds since 1970.
        reason: why the state was entered.
        at_work_s: seconds during which a process had the run; without pauses.
        cpu_s: CPU seconds of all simulations and suggestions.
        results: JSON of the results of the closed stages by name, in the order in which the stages were closed.
        notes: messages for the operator: time and text.
    """

    header: Header
    ended: float = 0.0
    state: State = State.QUEUED
    reason: str = ""
    at_work_s: float = 0.0
    cpu_s: float = 0.0
    stages: dict[str, RecordedStage] = field(default_factory=dict)
    results: dict[str, dict[str, Any]] = field(default_factory=dict)
    pours: list[RecordedPour] = field(default_factory=list)
    questions: list[RecordedQuestion] = field(default_factory=list)
    notes: list[tuple[float, str]] = field(default_factory=list)
    decisions: list[RecordedDecision] = field(default_factory=list)

    @property
    def unknown_pours(self) -> list[RecordedPour]:
        """Pours that had begun and have no outcome."""
        return [pour for pour in self.pours if pour.state in ("under way", "unknown")]

    @property
    def weighed(self) -> list[RecordedPour]:
        """Pours that were weighed."""
        return [pour for pour in self.pours if pour.measured is not None]

    @property
    def simulations(self) -> int:
        """Number of finished simulations, including failed ones."""
        return sum(stage.simulations for stage in self.stages.values())

    @property
    def occupancies(self) -> dict[str, Occupancy]:
        """Use of the pool in every stage with both simulations and pours."""
        both = (one for one in self.stages.values() if one.simulations_asked and one.pours_asked)
        return {one.name: one.occupancy for one in both if one.occupancy.useful > 0.0}


class RecordReader:
    """Reads a run's journal, and later the entries that were added since the last call.

    Args:
        slots: maximum number of simulations at a time, for the use of the pool.
    """

    def __init__(self, slots: int = 1) -> None:
        self._slots, self._last, self._worked = slots, 0, 0.0
        self._record: RunRecord | None = None
        self._pours: dict[int, RecordedPour] = {}
        self._simulations: set[int] = set()
        self._questions: dict[int, RecordedQuestion] = {}
        self._process: tuple[int, float] | None = None

    def read(self, directory: Path) -> RunRecord:
        """The record of a run, the same object at every call.

        Raises:
            JournalError: there is no journal, or it is damaged.
            CodecError: a pour can't be decoded.
        """
        with JournalReader(directory / JOURNAL_NAME) as journal:
            record = self._record = self._record or RunRecord(journal.header, journal.header.created)
            for entry in journal.entries(after=self._last):
                self._take(record, entry)
                self._last, record.ended = entry.seq, entry.t
        # A process that still has the run, or died with it, is counted until its last entry.
        record.at_work_s = self._worked + (0.0 if self._process is None else record.ended - self._process[1])
        return record

    def _take(self, record: RunRecord, entry: Entry) -> None:
        body, key = entry.body, entry.body.get("id", -1)
        if entry.kind == Kind.CAMPAIGN_STATE:
            self._enter(record, entry)
            return
        if entry.kind == Kind.STAGE_OPENED:
            record.stages[entry.stage] = RecordedStage(entry.stage, Occupancy(self._slots))
            return
        stage = record.stages.get(entry.stage) or RecordedStage(entry.stage, Occupancy(self._slots))
        match entry.kind:
            case Kind.STAGE_CLOSED:
                stage.closed = True
                stage.occupancy.finish()
                record.results[entry.stage] = body["result"]
            case Kind.REQUESTED:
                self._requested(record, stage, entry)
            case Kind.STARTED if key in self._simulations:
                stage.occupancy.simulation_started(entry.t)
            case Kind.FINISHED:
                self._finished(record, stage, entry)
            case Kind.POUR_STARTED:
                stage.occupancy.pour_started(entry.t)
                self._pours[key].state, self._pours[key].time = "under way", entry.t
            case Kind.POUR_WITHDRAWN:
                self._pours[key].state, self._pours[key].time = "asked", entry.t
            case Kind.POUR_FINISHED:
                stage.occupancy.pour_finished(entry.t)
                stage.pours += 1
                self._poured(self._pours[key], entry)
            case Kind.OPERATOR_ASKED:
                self._asked(record, entry, body["question"])
            case Kind.OPERATOR_ANSWERED:
                if key in self._questions:
                    self._questions[key].answer = body["answer"]
                if key in self._pours:
                    self._pours[key].answer = body["answer"]
            case Kind.NOTE:
                record.notes.append((entry.t, body["text"]))
            case Kind.DECISION:
                values = body.get("values") or {}
                if POOL_RESTS in values:
                    stage.occupancy.rests(entry.t)
                record.decisions.append(
                    RecordedDecision(entry.t, entry.stage, body["text"], values, stage.simulations_asked)
                )

    def _enter(self, record: RunRecord, entry: Entry) -> None:
        body = entry.body
        if self._process is not None:
            pid, since = self._process
            # For a process that died, the last entry before the next process's first entry counts as its end.
            until = entry.t if body.get("pid") == pid else max(record.ended, since)
            self._worked += until - since
        record.state, record.reason = State(body["after"]), body.get("reason", "")
        self._process = None if record.state in RESTING else (body.get("pid", 0), entry.t)
        if record.state is not State.RUNNING:
            for stage in record.stages.values():
                stage.occupancy.interrupted()
        if record.state in RESTING or record.state is State.PREPARING:  # the process that poured has ended
            for pour in record.unknown_pours:
                pour.state = "unknown"

    def _requested(self, record: RunRecord, stage: RecordedStage, entry: Entry) -> None:
        key, request = entry.body["id"], entry.body["request"]
        match request["type"]:
            case Simulate.__name__:
                self._simulations.add(key)
                stage.simulations_asked += 1
            case Pour.__name__:
                decoded = decode_request(request)
                assert isinstance(decoded, Pour)
                self._pours[key] = RecordedPour(entry.stage, key, decoded)
                record.pours.append(self._pours[key])
                stage.pours_asked += 1
            case Ask.__name__:
                self._asked(record, entry, request["question"])

    def _asked(self, record: RunRecord, entry: Entry, text: str) -> None:
        # A strategy's question is written when it is requested and again when it is answered.
        if (key := entry.body["id"]) not in self._questions:
            self._questions[key] = RecordedQuestion(entry.t, entry.stage, text)
            record.questions.append(self._questions[key])

    def _finished(self, record: RunRecord, stage: RecordedStage, entry: Entry) -> None:
        outcome = entry.body["outcome"]
        if entry.body["id"] in self._simulations:
            stage.occupancy.simulation_finished(entry.t)
        if outcome["type"] == "Suggested":
            record.cpu_s += outcome["suggestion"]["seconds"]
            return
        stage.simulations += 1
        if outcome["type"] == "Simulated":
            record.cpu_s += outcome["outcome"]["cpu_s"]
            stage.failed_simulations += outcome["outcome"].get("invalid") is not None
        else:
            stage.failed_simulations += 1

    @staticmethod
    def _poured(pour: RecordedPour, entry: Entry) -> None:
        pour.time, pour.seconds = entry.t, entry.body.get("seconds")
        pour.outcome = decode_outcome(entry.body["outcome"])
        match pour.outcome:
            case Poured(measurement):
                pour.state, pour.measured = "weighed", measurement
            case Failed(_, reason):
                pour.state, pour.reason = "failed", reason


def read_record(directory: Path, *, slots: int = 1) -> RunRecord:
    """Read the journal of a run, finished or not.

    Args:
        directory: folder of the run.
        slots: maximum number of simulations at a time, for the use of the pool.

    Raises:
        RunError: there is no journal, it is damaged, or a pour can't be decoded.
    """
    return RecordReader(slots).read(directory)


def read_header(directory: Path) -> Header:
    """Name and fingerprint of a run's campaign, and when the run was begun. Raises JournalError."""
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return journal.header


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


def answers(directory: Path, kind: type[Request]) -> Iterator[RequestOutcome]:
    """Finished requests of one kind, in the order in which they finished."""
    requests: dict[int, Request] = {}
    with JournalReader(directory / JOURNAL_NAME) as journal:
        for entry in journal.entries(kinds=(Kind.REQUESTED, Kind.FINISHED, Kind.POUR_FINISHED)):
            key, body = entry.body["id"], entry.body
            if entry.kind == Kind.REQUESTED:
                if body["request"]["type"] == kind.__name__:
                    requests[key] = decode_request(body["request"])
            elif key in requests:
                outcome = decode_outcome(body["outcome"])
                yield RequestOutcome(entry.stage, key, requests[key], outcome, entry.t, body["seconds"])


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


def read_result(directory: Path, *, seconds: float = 0.0) -> CampaignResult:
    """Result of a run, finished or not, from its journal.

    Raises:
        RunError: there is no journal, it is damaged, or a result can't be decoded.
    """
    record = read_record(directory)
    pours = sum(stage.pours for stage in record.stages.values())
    results = decode_results(record.results)
    return CampaignResult(
        record.header.name, directory, record.state, results, record.simulations, pours, record.cpu_s, seconds
    )
