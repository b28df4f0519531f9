"""The state of a run, counted from its events, and the only reader of journals outside the engine.

- `RunState.take` counts an event; displays, daemon and library give it events as they happen. `read_record` gives it
  those of a journal, and goes on where it stopped for pages that ask again at every event.
- `RunPour.row` is the one row of a pour, for report, catalogue, API and library.
- `answers` yields finished requests with their outcomes.
- `read_result` returns the `CampaignResult`: state, counts, costs, and the results of the stages. The verdict of a run
  is in `orchestrator.records.verdict`.

Nothing here checks the journal (`orchestrator.records.journal_check`).
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal

from actors.interfaces import PourProgress
from orchestrator.learning.requests import (
    Answered,
    Ask,
    Failed,
    Outcome,
    Pour,
    Poured,
    Request,
    Simulate,
    Simulated,
    Suggested,
)
from orchestrator.learning.stage_result import displayed_action, weighed_masses
from orchestrator.learning.strategy import Progress
from orchestrator.records.codec import Results
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    DecisionMade,
    Event,
    Kind,
    LogLine,
    OperatorAnswered,
    OperatorAsked,
    PourCorrected,
    PourProgressed,
    PourWithdrawn,
    Requested,
    RequestFinished,
    RequestStarted,
    SpeculationProgressed,
    StageClosed,
    StageOpened,
    StrategyProgressed,
)
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.journal_file import Header
from orchestrator.records.states import RESTING, State
from sim_engine.outcome import PourMeasurement

Row = dict[str, Any]

PourState = Literal["asked", "under way", "unknown", "weighed", "failed"]


NOT_REPORTED = Progress()
"""Progress of a stage whose strategy has not reported any."""


@dataclass
class RunPour:
    """A requested pour and its outcome.

    Attributes:
        state: 'under way': it has begun; 'unknown': the run ended during the pour, so it has no outcome.
        outcome: as recorded; None without one.
        answer: the operator's answer about it, or the correction of its outcome; '' without one.
        time: when it began, or ended; None before (seconds since 1970).
        seconds: duration, operator and balance included; None if unknown.
        progress: last reported, while the run is followed.
        attempts: how often it was begun.
    """

    stage: str
    id: int
    request: Pour
    state: PourState = "asked"
    outcome: Outcome | None = None
    answer: str = ""
    time: float | None = None
    seconds: float | None = None
    progress: PourProgress | None = None
    attempts: int = 0

    @property
    def measured(self) -> PourMeasurement | None:
        """The measurement, if it was weighed."""
        return self.outcome.measurement if isinstance(self.outcome, Poured) else None

    @property
    def reason(self) -> str:
        """Why it failed."""
        return self.outcome.reason if isinstance(self.outcome, Failed) else ""

    @property
    def refused(self) -> bool:
        """Whether it was refused before anything moved."""
        return isinstance(self.outcome, Failed) and self.outcome.kind == "invalid_action"

    def row(self) -> Row:
        """The one row of a pour in numbers: action in display units, prediction, masses [g] and spillage r.

        A mass that nobody has weighed is None; without an outcome there are no masses.
        """
        row: Row = {"number": self.request.number, **displayed_action(self.request.action.values())}
        row["predicted"] = None if self.request.predicted is None else self.request.predicted.mean
        match self.outcome:
            case Poured(weighed):
                row |= weighed_masses(weighed).model_dump()
            case Failed(kind, reason):
                row["failed"] = f"{kind}: {reason}"
        return row

    def finish(self, event: RequestFinished) -> None:
        """Take the outcome."""
        self.time, self.seconds = event.time, event.seconds
        self._take(event.outcome)

    def correct(self, event: PourCorrected) -> None:
        """Take the outcome that a person states instead; `answer` keeps the former one."""
        before = self.outcome
        was = f"failed ({before.reason})" if isinstance(before, Failed) else "without an outcome"
        if isinstance(before, Poured):
            told = before.measurement
            was = f"{1e3 * told.spilled:.5g} g spilled and {1e3 * told.retained:.5g} g retained"
        self.answer = f"corrected{' by ' * bool(event.by)}{event.by}, before: {was}"
        self._take(event.outcome)

    def _take(self, outcome: Outcome) -> None:
        self.outcome, self.state = outcome, "weighed" if isinstance(outcome, Poured) else "failed"


@dataclass
class Occupancy:
    """Use of the simulator pool over one stage in which the arm pours. Times are seconds of any clock.

    The time counts from the first request to the end of the last pour.

    Attributes:
        slots: maximum number of simulations at a time.
        busy, total: slot seconds: used by simulations; of all time.
        waits: waiting times of the arm, from a pour's outcome to the beginning of the next pour.
    """

    slots: int
    busy: float = 0.0
    total: float = 0.0
    waits: list[float] = field(default_factory=list)

    _now: float | None = None
    _running: int = 0
    _poured_at: float | None = None
    _last_pour: tuple[float, float] | None = None

    def simulation_started(self, time: float) -> None:
        """A simulation was handed to the pool."""
        self._pass(time)
        self._running += 1

    def simulation_finished(self, time: float) -> None:
        """A simulation finished."""
        self._pass(time)
        self._running = max(self._running - 1, 0)

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
        self._last_pour = (self.busy, self.total)

    def interrupted(self) -> None:
        """The run was paused or killed: nothing runs, and counting restarts with the next event."""
        self._now, self._running, self._poured_at = None, 0, None

    def finish(self) -> None:
        """The stage is finished. The time after its last pour is not counted."""
        if self._last_pour is not None:
            self.busy, self.total = self._last_pour

    @property
    def fraction(self) -> float | None:
        """Busy share of the time; None if nothing was simulated during pours."""
        return self.busy / self.total if self.total > 0.0 else None

    def _pass(self, time: float) -> None:
        seconds = 0.0 if self._now is None else time - self._now
        self.total += self.slots * seconds
        self.busy += min(self._running, self.slots) * seconds
        self._now = time


@dataclass
class RecordedStage:
    """Progress of a stage.

    Attributes:
        simulations, failed_simulations, pours: numbers of finished ones.
        simulations_asked, pours_asked: numbers of requested ones.
        progress: last reported by the strategy, while the run is followed.
        opened_at, closed_at: times of its first event that was not replayed, and of its end.
    """

    name: str
    occupancy: Occupancy
    simulations: int = 0
    failed_simulations: int = 0
    pours: int = 0
    simulations_asked: int = 0
    pours_asked: int = 0
    progress: Progress = NOT_REPORTED
    opened_at: float | None = None
    closed_at: float | None = None


@dataclass
class RecordedQuestion:
    """A question to the operator, or to the program that `proposes` mixtures. `answer` is None while there is none."""

    id: int
    time: float
    stage: str
    text: str
    answer: str | None = None
    proposes: bool = False


@dataclass(frozen=True)
class RecordedDecision:
    """A reason for a strategy's requests. `simulations_asked` of its stage is the number of requests before it."""

    time: float
    stage: str
    text: str
    values: dict[str, float]
    simulations_asked: int


# More than 20 fields: the one count of a run for all readers.
@dataclass
class RunState:
    """What a run has done, and what it is doing: all counting of its events, read from its journal or as they happen.

    Attributes:
        header: name of the campaign, its fingerprint, and when the run was begun.
        slots: maximum number of simulations at a time, for the use of the pool.
        ended: time of the last event, seconds since 1970.
        reason: why the state was entered.
        cpu_s: CPU seconds of all simulations and suggestions.
        closed: the events that closed stages by name, in order, with their results.
        opened: the stage that was opened last.
        notes: messages for the operator that the journal has: time, text, and what each is about.
        running: ids of running simulations.
        pour: the pour that was begun last.
        checkpoint: of the pour that is under way; '' without one.
        question: that is open at the operator's terminal.
        entries, open_requests: number of entries that were read, and the unfinished requests among them.
        simulators, ahead: as last told; only of a run that is followed.
    """

    header: Header
    slots: int = 1
    ended: float = 0.0
    state: State = State.QUEUED
    reason: str = ""
    cpu_s: float = 0.0
    stages: dict[str, RecordedStage] = field(default_factory=dict)
    closed: dict[str, StageClosed] = field(default_factory=dict)
    opened: StageOpened = field(default_factory=StageOpened)
    pours: list[RunPour] = field(default_factory=list)
    questions: list[RecordedQuestion] = field(default_factory=list)
    notes: list[tuple[float, str, str | None]] = field(default_factory=list)
    decisions: list[RecordedDecision] = field(default_factory=list)
    failures: Counter[str] = field(default_factory=Counter)
    running: set[int] = field(default_factory=set)
    pour: RunPour | None = None
    checkpoint: str = ""
    question: str = ""
    simulators: int = 0
    entries: int = 0
    open_requests: dict[int, Requested] = field(default_factory=dict)
    ahead: SpeculationProgressed = field(default_factory=lambda: SpeculationProgressed(running=0, waiting=0))

    _worked: float = 0.0
    _process: tuple[int, float] | None = None
    _pours: dict[int, RunPour] = field(default_factory=dict)
    _questions: dict[int, RecordedQuestion] = field(default_factory=dict)

    @property
    def at_work_s(self) -> float:
        """Seconds during which a process had the run, without pauses.

        A process that still has the run, or died with it, is counted until its last entry.
        """
        return self._worked + (0.0 if self._process is None else self.ended - self._process[1])

    @property
    def results(self) -> Results:
        """Results of the closed stages by name, in order. Raises RunError for one that can't be decoded."""
        return {name: event.result for name, event in self.closed.items()}

    @property
    def unknown_pours(self) -> list[RunPour]:
        """Pours that had begun and have no outcome."""
        return [pour for pour in self.pours if pour.state in ("under way", "unknown")]

    @property
    def weighed(self) -> list[RunPour]:
        """Pours that were weighed."""
        return [pour for pour in self.pours if pour.measured is not None]

    @property
    def simulations(self) -> int:
        """Number of finished simulations, including failed ones."""
        return sum(stage.simulations for stage in self.stages.values())

    @property
    def simulated(self) -> int:
        """Number of simulations that can be used."""
        return self.simulations - self.failures.total()

    @property
    def finished_pours(self) -> int:
        """Number of finished pours, including failed ones."""
        return sum(stage.pours for stage in self.stages.values())

    @property
    def occupancies(self) -> dict[str, Occupancy]:
        """Use of the pool in every stage with both simulations and pours."""
        both = (stage for stage in self.stages.values() if stage.simulations_asked and stage.pours_asked)
        return {stage.name: stage.occupancy for stage in both if stage.occupancy.total > 0.0}

    def take(self, event: Event) -> None:
        """Count an event."""
        stage = self._stage(event.stage) if event.stage else None
        match event:
            case CampaignOpened():
                self.simulators = event.simulators
                for name in event.stages:
                    self._stage(name)
            case CampaignStateChanged():
                self._enter(event)
            case CampaignClosed():
                self.state = State(event.state)
            case LogLine():
                if event.kept:
                    self.notes.append((event.time, event.text, event.about))
                if event.asked:
                    self.question = event.text
            case SpeculationProgressed():
                self.ahead = event
            case PourProgressed():
                self.checkpoint = event.progress.checkpoint
                if self.checkpoint not in ("operator", "tare"):
                    self.question = ""
                if self.pour is not None:
                    self.pour.progress = event.progress
            case _ if stage is not None:
                self._take_of_stage(stage, event)
        self.ended = event.time

    def _stage(self, name: str) -> RecordedStage:
        if name not in self.stages:
            self.stages[name] = RecordedStage(name, Occupancy(self.slots))
        return self.stages[name]

    def _take_of_stage(self, stage: RecordedStage, event: Event) -> None:
        match event:
            case StageOpened():
                self.opened = event
                # A replayed stage has no known duration; the first live event starts its clock.
                stage.opened_at = None if event.replayed else event.time
            case StageClosed():
                stage.closed_at = event.time
                stage.occupancy.finish()
                self.closed[event.stage] = event
            case StrategyProgressed():
                stage.progress = event.progress
                stage.opened_at = event.time if stage.opened_at is None else stage.opened_at
            case Requested(request=Simulate()):
                stage.simulations_asked += 1
            case Requested(request=Pour()):
                self._pour(event)
                stage.pours_asked += 1
            case RequestStarted(request=Simulate()):
                self.running.add(event.id)
                stage.occupancy.simulation_started(event.time)
            case RequestStarted(request=Pour()):
                stage.occupancy.pour_started(event.time)
                self.pour = self._pour(event)
                self.pour.state, self.pour.time, self.pour.attempts = "under way", event.time, event.attempt
            case PourWithdrawn():
                self._pours[event.id].state, self._pours[event.id].time = "asked", event.time
            case RequestFinished(request=Pour()):
                stage.occupancy.pour_finished(event.time)
                stage.pours += 1
                self.checkpoint = ""
                pour = self._pour(event)
                pour.finish(event)
                if pour.refused:
                    self.pour = pour  # it may never have started
            case RequestFinished(request=Ask(text) as request, outcome=Answered(answer)):
                question = self._question(event, text)
                question.answer, question.proposes = answer, request.proposals is not None
            case RequestFinished():
                self._finished(stage, event)
            case PourCorrected():
                self._pours[event.id].correct(event)
            case Requested(request=Ask(text)) | OperatorAsked(question=text):
                self._question(event, text)
            case OperatorAnswered():
                for asked_for in (self._questions.get(event.id), self._pours.get(event.id)):
                    if asked_for is not None:
                        asked_for.answer = event.answer
            case DecisionMade(decision=decision):
                self.decisions.append(
                    RecordedDecision(event.time, event.stage, decision.text, decision.values, stage.simulations_asked)
                )

    def _enter(self, event: CampaignStateChanged) -> None:
        if self._process is not None:
            pid, since = self._process
            # For a process that died, the last entry before the next process's first entry counts as its end.
            until = event.time if event.pid == pid else max(self.ended, since)
            self._worked += until - since
        self.state, self.reason = event.after, event.reason
        self._process = None if self.state in RESTING else (event.pid, event.time)
        if self.state is not State.RUNNING:
            for stage in self.stages.values():
                stage.occupancy.interrupted()
        if self.state in RESTING or self.state is State.PREPARING:  # the process that poured has ended
            self.running.clear()
            for pour in self.unknown_pours:
                pour.state = "unknown"

    def _pour(self, event: Requested | RequestStarted | RequestFinished) -> RunPour:
        if event.id not in self._pours:
            assert isinstance(event.request, Pour)
            self._pours[event.id] = RunPour(event.stage, event.id, event.request)
            self.pours.append(self._pours[event.id])
        return self._pours[event.id]

    def _question(self, event: Requested | RequestFinished | OperatorAsked, text: str) -> RecordedQuestion:
        if event.id not in self._questions:
            self._questions[event.id] = RecordedQuestion(event.id, event.time, event.stage, text)
            self.questions.append(self._questions[event.id])
        return self._questions[event.id]

    def _finished(self, stage: RecordedStage, event: RequestFinished) -> None:
        match event.outcome:
            case Suggested(suggestion):
                self.cpu_s += suggestion.seconds
                return
            case Simulated(outcome):
                self.cpu_s += outcome.cpu_s
                failed = outcome.invalid
            case outcome:
                failed = outcome.reason if isinstance(outcome, Failed) else ""
        stage.occupancy.simulation_finished(event.time)
        self.running.discard(event.id)
        stage.simulations += 1
        if failed is not None:
            stage.failed_simulations += 1
            self.failures[failed.partition(":")[0]] += 1


def read_record(directory: Path, *, slots: int = 1, earlier: RunState | None = None) -> RunState:
    """Read the journal of a run, finished or not.

    Args:
        directory: folder of the run.
        slots: maximum number of simulations at a time, for the use of the pool.
        earlier: what was read before; it takes the events that were added since, and is returned.

    Raises:
        RunError: there is no journal, it is damaged, or a pour can't be decoded.
    """
    with JournalReader(directory / JOURNAL_NAME) as journal:
        record = earlier or RunState(journal.header, slots, journal.header.created)
        for seq, event in journal.events(record.open_requests, after=record.entries):
            record.take(event)
            record.entries = seq
    return record


def read_header(directory: Path) -> Header:
    """Name and fingerprint of a run's campaign, and when the run was begun. Raises JournalError."""
    with JournalReader(directory / JOURNAL_NAME) as journal:
        return journal.header


def answers(directory: Path, kind: type[Request]) -> Iterator[RequestFinished]:
    """Finished requests of one kind, in the order in which they finished."""
    with JournalReader(directory / JOURNAL_NAME) as journal:
        for _, event in journal.events(kinds=(Kind.REQUESTED, Kind.FINISHED, Kind.POUR_FINISHED)):
            if isinstance(event, RequestFinished) and isinstance(event.request, kind):
                yield event


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
    return CampaignResult(
        record.header.name,
        directory,
        record.state,
        record.results,
        record.simulations,
        record.finished_pours,
        record.cpu_s,
        seconds,
    )
