"""Runs the stages of a campaign on a laboratory and resumes interrupted runs.

`run_campaign` is the entry point. It opens the journal and the laboratory, settles pours with unknown outcome, runs
each stage with a `StageScheduler`, and records the campaign's state. Parsing of files and displays are outside this
module.
"""

from __future__ import annotations

import asyncio
import os
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path

from actors.dosing.dose_series import source_of
from actors.interfaces import Laboratory, LaboratoryError, Notice, Telling
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Pour
from orchestrator.learning.run_errors import RunError
from orchestrator.learning.stage_result import StageResult
from orchestrator.records.codec import Results
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    CampaignStateChanged,
    LogLine,
    SpeculationProgressed,
    StageClosed,
    StageOpened,
    Subscriber,
)
from orchestrator.records.journal import JOURNAL_NAME, Journal
from orchestrator.records.journal_file import Header, JournalError, NoSpaceError
from orchestrator.records.run_record import CampaignResult, read_result
from orchestrator.records.states import RESTING, State, check_transition
from orchestrator.runs.request_executor import Deadlines, RequestExecutor, RequestExecutorError
from orchestrator.runs.request_forecast import RequestForecast
from orchestrator.runs.resume import (
    AskOperator,
    OperatorNeededError,
    StageHistory,
    read_history,
    settle_unknown_pours,
)
from orchestrator.runs.run_folder import (
    FIGURES,
    dose_film_file,
    dose_moments,
    film_file,
    write_film,
    write_provenance,
)
from orchestrator.runs.stage_scheduler import StageScheduler
from orchestrator.runs.stages import StageDefinition, recommended_pours, scenes_of, stage_seed, stages_of
from sim_engine.errors import reason_of
from sim_engine.outcome import RecordedFrames
from sim_engine.scene import Scene

RECORDED_SIMULATIONS, FRAME_RATE = 6, 10.0
"""Number of a stage's simulations that are recorded with their particles, and their frames per simulated second."""


async def run_campaign(
    plan: CampaignPlan,
    laboratory: Laboratory,
    run_directory: Path,
    *,
    resume: bool = False,
    subscribers: Sequence[Subscriber] = (),
    ask_operator: AskOperator | None = None,
    stages: Sequence[StageDefinition] | None = None,
    deadlines: Deadlines | None = None,
) -> CampaignResult:
    """Run a campaign to its end, or resume one.

    Cancelling the awaiting task pauses the run: simulations are dropped, a pour that has begun is finished and weighed,
    then `asyncio.CancelledError` is raised. A second cancellation also abandons the pour, whose outcome is then
    UNKNOWN.

    Args:
        laboratory: not opened yet. It is opened here, after all checks that do not need it, and closed here.
        run_directory: the directory of the journal.
        resume: continue with the journal in `run_directory`; otherwise there must be none.
        ask_operator: called for pours whose outcome is unknown, and for further mixtures; None if nobody is present.
        stages: replaces the stages of the plan.
        deadlines: replaces the default deadlines.

    Raises:
        RunError: the run can't begin or continue. Another process runs it (JournalError), its journal doesn't fit
            (RunError), the operator is needed (OperatorNeededError), the disk has too little space for
            a pour's records (NoSpaceError), or the laboratory or a strategy fails.
        LaboratoryError: the laboratory can't be opened.
    """
    run = _RunEngine(
        plan,
        laboratory,
        run_directory,
        subscribers,
        ask_operator,
        tuple(stages_of(plan) if stages is None else stages),
        deadlines or _default_deadlines(plan),
    )
    return await run.run(resume)


def _default_deadlines(plan: CampaignPlan) -> Deadlines:
    """Deadlines of a plan: with an operator who weighs, a pause waits for a pour as long as a question may take; where
    another program pours, a pour may take a month.
    """
    usual, laboratory = Deadlines(), plan.laboratory
    if laboratory.mode == "external":
        return replace(usual, pour=30 * 86400.0)
    if not laboratory.needs_person:
        return usual
    return replace(usual, pour_grace=max(usual.pour_grace, laboratory.operator.deadline))


@dataclass
class _RunEngine:
    """One process's part of a campaign's run."""

    _plan: CampaignPlan
    _laboratory: Laboratory
    _directory: Path
    _subscribers: Sequence[Subscriber]
    _ask_operator: AskOperator | None
    _stages: tuple[StageDefinition, ...]
    _deadlines: Deadlines

    def __post_init__(self) -> None:
        self._scenes = scenes_of(self._plan)
        self._state = State.QUEUED
        self._unknown_pours = False
        self._begin = time.monotonic()
        names = [stage.name for stage in self._stages]
        if not names or len(set(names)) != len(names):
            raise RunError(f"a campaign needs stages with different names, got: {', '.join(names) or 'none'}")

    async def run(self, resume: bool) -> CampaignResult:
        path, header = self._directory / JOURNAL_NAME, Header(self._plan.name, fingerprint(self._plan))
        self._journal = (Journal.resume if resume else Journal.create)(path, header, self._subscribers)
        try:
            if not resume:
                write_provenance(self._directory, self._plan)
            self._state = self._journal.state()
            if self._state is State.FINISHED:
                return self._close()
            if any(stage.pours for stage in self._stages):
                self._journal.reserve_space()
            try:
                await self._run_stages(resume)
            except asyncio.CancelledError:
                if not self._is_finished():
                    self._come_to_rest(State.PAUSED, "stopped on request")
                raise
            except (OperatorNeededError, NoSpaceError) as error:
                self._come_to_rest(State.PAUSED, str(error))
                raise
            except Exception as error:
                if self._is_finished():  # the results are complete; only the cleanup failed
                    self._journal.log("warning", f"while closing the laboratory: {error}")
                else:
                    self._come_to_rest(State.FAILED, reason_of(error))
                    raise
            return self._close()
        finally:
            self._journal.close()

    async def _run_stages(self, resume: bool) -> None:
        histories = {stage.name: read_history(self._journal, stage.name) for stage in self._stages}
        self._unknown_pours = any(history.unknown_pours() for history in histories.values())
        if self._state not in RESTING:
            state = State.UNKNOWN if self._unknown_pours else State.PAUSED
            self._enter(state, "found interrupted: its process ended without a word")
        self._enter(State.PREPARING, "resumed" if resume else "begun")
        for stage in self._stages:
            history = histories[stage.name]
            if history.unknown_pours():
                histories[stage.name] = await self._settle(stage, history)
        async with self._laboratory as laboratory:
            if isinstance(laboratory, Telling):
                laboratory.listen(self._on_notice)
            self._check_bench(laboratory, histories)
            deployment = self._plan.deployment
            executor = RequestExecutor(
                laboratory,
                self._scenes,
                self._deadlines,
                FRAME_RATE,
                self._ask_operator,
                repeats=self._plan.on_unknown == "repeat",
                arm=self._plan.laboratory.expected_arm,
                made_by_arm=() if deployment is None else {scene.name for scene in deployment.scenes},
                filmed=self._keep_dose if self._plan.outputs.figures else None,
            )
            executor.speculation.changed = lambda running, waiting: self._journal.append(
                SpeculationProgressed(running=running, waiting=waiting)
            )
            opened = CampaignOpened(
                name=self._plan.name,
                run_directory=self._directory,
                stages=tuple(stage.name for stage in self._stages),
                mode=laboratory.bench.mode if laboratory.bench is not None else "none",
                simulators=laboratory.simulators.size,
                resumed=resume,
            )
            self._journal.append(opened)
            self._log_idle_simulators(laboratory.simulators.size)
            self._enter(State.RUNNING)
            results: dict[str, StageResult] = {}
            try:
                for index, stage in enumerate(self._stages, start=1):
                    results[stage.name] = await self._run_stage(stage, index, histories[stage.name], results, executor)
                if self._plan.outputs.figures:
                    await self._film(results, executor)
            finally:
                await executor.speculation.close()
            self._enter(State.FINISHED)

    async def _run_stage(
        self,
        stage: StageDefinition,
        index: int,
        history: StageHistory,
        results: Results,
        executor: RequestExecutor,
    ) -> StageResult:
        seed = stage_seed(self._plan.seed, stage.name)
        resumed, done = history.seed is not None, history.result is not None
        opened = StageOpened(
            stage=stage.name, index=index, count=len(self._stages), seed=seed, resumed=resumed, replayed=done
        )
        (self._journal.publish if resumed else self._journal.append)(opened)
        if history.result is not None:
            closed = StageClosed(stage=stage.name, replayed=True, result=history.result)
            self._journal.publish(*history.finished, closed)
            return history.result
        scheduler = StageScheduler(
            stage.name,
            await asyncio.to_thread(stage.build, results, seed),  # a simulated dose takes seconds
            journal=self._journal,
            executor=executor,
            capacity=self._plan.parallel_simulations,
            recordings=RECORDED_SIMULATIONS if self._plan.outputs.recording else 0,
            on_pausing=lambda reason: self._enter(State.PAUSING, reason),
            on_stopping=lambda reason: self._enter(State.STOPPING, reason),
        )
        scheduler.restore(history)
        used = executor.speculation.used
        try:
            with self._speculating(stage, index, results, executor):
                result = await scheduler.run()
        finally:
            self._unknown_pours = bool(scheduler.unknown_pours)
        if executor.speculation.used > used:
            count = executor.speculation.used - used
            text = f"{count} simulation(s) of {stage.name} were made while the arm was pouring before"
            self._journal.log("note", text, stage=stage.name, kept=True)
        return result

    async def _film(self, results: Results, executor: RequestExecutor) -> None:
        """Simulate the recommended pours once more and keep their particles, for the report's pictures."""
        for receiver, request in recommended_pours(self._plan, results).items():
            path = film_file(self._directory / FIGURES, receiver)
            if path.is_file():
                continue
            try:
                if (frames := await executor.film(request)) is not None:
                    write_film(path, frames)
            except (LaboratoryError, OSError) as error:  # a picture less
                self._journal.log("warning", f"no picture of the recommended pour into {receiver}: {error}")

    def _keep_dose(self, request: Pour, scene: Scene, frames: RecordedFrames) -> None:
        """Keep some moments of a dose of particles, for the report's picture."""
        try:
            assert request.dose is not None
            held = source_of(scene, request.dose).mass
            write_film(dose_film_file(self._directory / FIGURES, request.number), dose_moments(scene, held, frames))
        except OSError as error:  # a picture less
            self._journal.log("warning", f"no picture of dose {request.number}: {error}")

    @contextmanager
    def _speculating(
        self, stage: StageDefinition, index: int, results: Results, executor: RequestExecutor
    ) -> Iterator[None]:
        """While the arm pours, run simulations that later stages will request, if the pool does not share the arm's
        CPUs."""
        later = self._stages[index - 1 :]
        if not stage.pours or len(later) < 2 or not executor.simulators.separate:
            yield
            return
        forecast = RequestForecast(
            later, results, self._plan.seed, self._plan.parallel_simulations, executor.speculation, executor.suggest
        )
        task = asyncio.create_task(forecast.run(), name=f"forecast during {stage.name}")
        try:
            yield
        finally:
            task.cancel()
            executor.speculation.pause()
            # Not awaited: an error in speculative execution appears again when its stage runs.
            task.add_done_callback(lambda task: task.cancelled() or task.exception())

    async def _settle(self, stage: StageDefinition, history: StageHistory) -> StageHistory:
        await settle_unknown_pours(
            self._journal,
            history,
            stage.name,
            plan=self._plan,
            scenes=self._scenes,
            ask=self._ask_operator,
            on_waiting=lambda question: self._enter(State.WAITING_FOR_OPERATOR, question),
        )
        if self._state is State.WAITING_FOR_OPERATOR:
            self._enter(State.PREPARING, "answered")
        self._unknown_pours = False
        return read_history(self._journal, stage.name)

    def _check_bench(self, laboratory: Laboratory, histories: Mapping[str, StageHistory]) -> None:
        needing = [s.name for s in self._stages if s.pours and histories[s.name].result is None]
        if not needing:
            return
        if laboratory.bench is None:
            raise RequestExecutorError(
                f"stage {needing[0]} pours, but the laboratory '{self._plan.laboratory.name}' has no bench; add one to "
                "its file, or calibrate on records"
            )
        if laboratory.bench.mode != self._plan.laboratory.mode:
            raise RequestExecutorError(
                f"the plan is for a {self._plan.laboratory.mode} bench, but the laboratory's is {laboratory.bench.mode}"
            )

    def _log_idle_simulators(self, simulators: int) -> None:
        slots = self._plan.parallel_simulations
        if simulators > slots:
            self._journal.log(
                "info",
                f"{simulators} simulators, but this campaign keeps at most {slots} simulation(s) in flight: "
                f"{simulators - slots} will have nothing to do; 'parallel_simulations' in the campaign changes that",
            )

    def _on_notice(self, notice: Notice) -> None:
        """Write a notice of the laboratory to the journal and publish it."""
        try:
            self._journal.append(LogLine(**vars(notice), kept=True))
        except JournalError:  # the next important write ends the run; until then the display shows everything
            self._journal.log("error", f"can't be written down: {notice.text}")

    def _enter(self, state: State, reason: str = "") -> None:
        if state is self._state:
            return
        check_transition(self._state, state)
        before, self._state = self._state, state
        self._journal.append(CampaignStateChanged(before=before, after=state, reason=reason, pid=os.getpid()))

    def _is_finished(self) -> bool:
        return self._state is State.FINISHED

    def _come_to_rest(self, state: State, reason: str) -> None:
        if self._unknown_pours:
            state, reason = State.UNKNOWN, f"{reason}, while a pour was under way: its outcome is unknown"
        try:
            self._enter(state, reason)
        except JournalError as problem:  # the next process finds the run interrupted
            self._journal.log("error", f"can't write that the run is {state}: {problem}")
        self._journal.append(CampaignClosed(state=str(self._state), results=self._journal.stage_results()))

    def _close(self) -> CampaignResult:
        result = read_result(self._directory, seconds=time.monotonic() - self._begin)
        self._journal.append(CampaignClosed(state=str(result.state), results=result.results))
        return result
