"""The one way to run a campaign: the command line, the daemon, the library and the study call it.

    request = run_task(plan)                      # one function for each task: `orchestrator.runs.run_tasks`
    report = RunService().check(request)          # problems and warnings; nothing is written or started
    with closing(RunService().start(request, RunResources(in_process=True))) as handle:
        result = await handle.wait()
    published = publish_run(handle)               # orchestrator.reports.publishing

`RunRequest` is what shall run, `RunResources` are the handles of this process, and `RunHandle` controls one run.
Signals, queues and caches belong to the callers.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Protocol

from actors.interfaces import Laboratory, Operator, Optimizer, RaySettings, Stoppable
from actors.laboratory_settings import LaboratorySettings
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.materials.vessel_account import LaboratoryPlaces, VesselAccount
from orchestrator.records.events import Event, Subscriber
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import check_journal, has_begun
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import CampaignResult, RunState
from orchestrator.records.states import State
from orchestrator.runs.resume import AskOperator
from orchestrator.runs.run_folder import create_run
from orchestrator.runs.stages import StageDefinition

if TYPE_CHECKING:
    from actors.interfaces import SimulatorPool
    from orchestrator.campaigns.yaml.yaml_errors import Problem

MOVING = ("approach", "tilt", "hold", "return", "dose")
"""Checkpoints of a pour during which the arm moves."""

BETWEEN_CANCELS = 1.0
"""Longest time for a run to notice a pause before its pour is abandoned [s]."""

STOP_DEADLINE = 5.0
"""Longest time for an arm to confirm that it has stopped [s]; everything else proceeds meanwhile."""


class RunTaskError(RunError, ValueError):
    """The campaign can't run as requested; the text lists every problem."""

    exit_code = 2


@dataclass(frozen=True)
class RunRequest:
    """What shall run.

    Attributes:
        campaign: its plan, without the parts that its task leaves out.
        stages: to run.
        folder: of the run; None: a new one, which is entered in the catalogue.
        resume: continue the run in `folder`; `RunService.with_folder` sets it if a run was begun there.
        as_written: the vessels are those of the campaign's file.
    """

    campaign: CampaignPlan
    stages: Sequence[StageDefinition]
    folder: Path | None = None
    resume: bool = False
    as_written: bool = True

    @property
    def pours(self) -> bool:
        """Whether it needs a bench."""
        return any(stage.pours for stage in self.stages)


class Recorder(Protocol):
    """A subscriber that writes a recording of the run.

    Attributes:
        path: of the recording.
        dropped: number of events that it lacks.
    """

    @property
    def path(self) -> Path: ...  # noqa: D102

    @property
    def dropped(self) -> int: ...  # noqa: D102

    def __call__(self, event: Event, /) -> None:
        """Take an event; never waits."""

    def close(self) -> object:
        """Finish the file. May block, and may be called twice."""


@dataclass(frozen=True)
class RunResources:
    """Handles of this process that a run uses. Shared ones stay open.

    Attributes:
        in_process: everything in this process, without Ray.
        plain_processes: simulators in plain processes; see `actors.laboratory.open_laboratory`.
        simulators: a shared pool instead of the laboratory's own.
        ray: cluster on which the shared pool runs. The cluster of the campaign's laboratory is then not used.
        optimizer: a shared one instead of the laboratory's own.
        operator: answers the questions of the bench, where a person does.
        ask_operator: asked about pours whose outcome is unknown, and for further mixtures; None: the run pauses.
        approved_checksum: of the safety settings that were accepted for the controller of hardware.
        subscribers: receive every event.
        recorder: makes the recorder of a plan and a run's folder, or None if there is no recording.
        laboratory: makes another laboratory than that of the campaign, from its settings and whether it needs a bench.
    """

    in_process: bool = False
    plain_processes: bool = False
    simulators: SimulatorPool | None = None
    ray: RaySettings | None = None
    optimizer: Optimizer | None = None
    operator: Operator | None = None
    ask_operator: AskOperator | None = None
    approved_checksum: str = ""
    subscribers: Sequence[Subscriber] = ()
    recorder: Callable[[CampaignPlan, Path], Recorder | None] | None = None
    laboratory: Callable[[LaboratorySettings, bool], Laboratory] | None = None

    def settings(self, campaign: CampaignPlan) -> LaboratorySettings:
        """The campaign's laboratory as it is opened with these resources."""
        spec = campaign.laboratory
        return spec.with_values(
            in_process=self.in_process or spec.in_process,
            accepted_checksum=self.approved_checksum,
            ray=self.ray if self.simulators is not None else spec.ray,
        )


@dataclass(frozen=True)
class CheckReport:
    """Result of the checks before a run.

    Attributes:
        problems: each prevents the run.
        warnings: suspicious, but not wrong.
    """

    problems: tuple[str, ...]
    warnings: tuple[str, ...]

    def require(self) -> None:
        """Refuse a run that has problems.

        Raises:
            RunTaskError: with all of them.
        """
        if self.problems:
            raise RunTaskError("\n".join(self.problems))


class RunService:
    """Checks and starts runs. It has no state: every call stands alone."""

    def check(self, request: RunRequest, *, doing: Callable[[str], None] = lambda text: None) -> CheckReport:
        """Check everything that needs no laboratory: draws of θ, vessels, loads, motions. Writes and starts nothing.

        Args:
            request: of the run.
            doing: called with the step that is under way.
        """
        from orchestrator.campaigns.campaign_checks import check_campaign

        warned: list[Problem] = []
        checked = check_campaign(request.campaign, as_written=request.as_written, warn=warned.append, doing=doing)
        problems = [str(fault) for fault in checked]
        return CheckReport(tuple(problems), tuple(dict.fromkeys(map(str, warned))))

    def check_laboratory(self, request: RunRequest, resources: RunResources) -> None:
        """Check that packages and machines which the laboratory needs are there. Starts nothing that stays.

        Raises:
            LaboratoryError: something is missing; the text names it.
        """
        from actors.laboratory import check_laboratory

        pours = request.pours and resources.laboratory is None  # another laboratory brings its own
        check_laboratory(resources.settings(request.campaign), pours=pours, plain_processes=resources.plain_processes)

    def with_folder(self, request: RunRequest) -> RunRequest:
        """The request with its folder, made if it names none, and with `resume` if a run was begun there.

        Raises:
            JournalDamagedError: a run was begun there, and its journal is lost or damaged.
            NoSpaceError, OSError: the folder can't be made.
        """
        if request.folder is None:
            return replace(request, folder=create_run(request.campaign))
        path = request.folder / JOURNAL_NAME
        if request.resume or not has_begun(path):
            return request
        check_journal(path).require()  # before anything is written: a lost journal must not look like a new run
        return replace(request, resume=True)

    def start(self, request: RunRequest, resources: RunResources) -> RunHandle:
        """Open what a run needs. The run proceeds while `RunHandle.wait` is awaited, in the event loop of the caller.

        The laboratory's processes and devices are started there, too, after the journal was checked.

        Args:
            request: that has passed the checks.
            resources: to run it with.

        Raises:
            LaboratoryError: the laboratory can't be opened.
            RunError, OSError: see `with_folder`; or the recording can't be written.
        """
        from actors.laboratory import open_laboratory

        spec = resources.settings(request.campaign)
        if request.resume:
            spec = spec.resumed()
        if resources.laboratory is not None:
            laboratory = resources.laboratory(spec, request.pours)
        else:
            laboratory = open_laboratory(
                spec,
                pours=request.pours,
                plain_processes=resources.plain_processes,
                operator=resources.operator,
                simulators=resources.simulators,
                optimizer=resources.optimizer,
                record=LaboratoryPlaces(VesselAccount.open(), spec.name) if spec.places and request.pours else None,
            )
        request = self.with_folder(request)
        assert request.folder is not None
        recorder = None if resources.recorder is None else resources.recorder(request.campaign, request.folder)
        return RunHandle(request, resources, laboratory, request.folder, recorder)


class RunHandle:
    """One run of this process, which `wait` runs once. Call `close` afterwards, however it ends.

    The methods that end it sooner may be called before `wait`, too.

    Attributes:
        folder: of the run.
        campaign: its plan.
        recorder: of its recording; None without one.
        result: after `wait`.
        state: what the run's events say so far.
        begun: whether there were any: a resumption can be refused before.
    """

    def __init__(
        self,
        request: RunRequest,
        resources: RunResources,
        laboratory: Laboratory,
        folder: Path,
        recorder: Recorder | None,
    ) -> None:
        self._request, self._laboratory, self.recorder = request, laboratory, recorder
        self.campaign, self.folder, self.state = request.campaign, folder, RunState(Header(request.campaign.name, {}))
        self._ask_operator = resources.ask_operator
        self._subscribers: list[Subscriber] = [*resources.subscribers, self._note]
        if recorder is not None:
            self._subscribers.append(recorder)
        if (series := request.campaign.dispense) is not None and series.accounted:
            carried = bool(request.campaign.laboratory.places)
            self._subscribers.append(VesselAccount.open().follow(series, carried=carried))
        self.begun = self._pausing = self._aborting = self._abandoning = False
        self._winding_down = asyncio.Event()
        self.result: CampaignResult | None = None
        self._task: asyncio.Task[CampaignResult] | None = None

    @property
    def checkpoint(self) -> str:
        """Checkpoint of the pour that is under way; '' between pours."""
        return self.state.checkpoint

    def _note(self, event: Event) -> None:
        self.begun = True
        self.state.take(event)
        if self.state.state in (State.PAUSING, State.PAUSED, State.UNKNOWN, State.FAILED, State.STOPPING):
            self._winding_down.set()

    async def wait(self) -> CampaignResult:
        """Run to the end. Cancelling the waiting task pauses the run; cancelling it again abandons a pour.

        Raises:
            asyncio.CancelledError: it was paused, aborted or stopped.
            RunError, LaboratoryError: it can't begin, continue or end; see `run_campaign`.
        """
        from orchestrator.runs.run_engine import run_campaign

        work = run_campaign(
            self._request.campaign,
            self._laboratory,
            self.folder,
            resume=self._request.resume,
            subscribers=self._subscribers,
            ask_operator=self._ask_operator,
            stages=self._request.stages,
        )
        self._task = asyncio.ensure_future(work)
        if self._pausing:
            self._task.cancel()
        self.result = await self._task
        return self.result

    def close(self) -> None:
        """Close the recording. May block, and may be called twice."""
        if self.recorder is not None:
            self.recorder.close()

    # ---- ending it sooner

    def pause(self) -> None:
        """Pause at the next safe point: simulations are dropped; a pour that has begun is finished and weighed."""
        self._pausing = True
        if self._task is not None:
            self._task.cancel()

    async def abort(self) -> None:
        """Stop the motion now; the arm brings a tilted pourer upright after consent.

        If nothing moves, or on a second call, the pour is abandoned.

        Raises:
            LaboratoryError, TimeoutError: the arm did not confirm that it stopped; the run pauses in any case.
        """
        if self.checkpoint not in MOVING or self._aborting:
            self.pause()
            await self.abandon_pour()
            return
        self._aborting = True
        stopping = asyncio.create_task(self._stop_arm())
        await asyncio.sleep(0)
        self.pause()
        await stopping

    async def emergency_stop(self) -> None:
        """Stop the motion now and abandon the pour, without consent and without bringing the pourer upright.

        Raises:
            LaboratoryError, TimeoutError: the arm did not confirm that it stopped; the pour is abandoned in any case.
        """
        stopping = asyncio.create_task(self._stop_arm())
        await asyncio.sleep(0)
        self.pause()
        await asyncio.wait({stopping, asyncio.ensure_future(self.abandon_pour())})
        await stopping

    async def _stop_arm(self) -> None:
        """Bypasses everything that waits for the arm."""
        laboratory: object = self._laboratory
        if isinstance(laboratory, Stoppable):
            async with asyncio.timeout(STOP_DEADLINE):
                await laboratory.stop_arm()

    async def abandon_pour(self) -> None:
        """After `pause`: abandon the pour as well. Its outcome is UNKNOWN if it had begun."""
        if self._abandoning or self._task is None:
            return
        self._abandoning = True
        # Two cancellations at once would count as one.
        await asyncio.wait({self._task}, timeout=0.05)
        noted = asyncio.ensure_future(self._winding_down.wait())
        await asyncio.wait({self._task, noted}, timeout=BETWEEN_CANCELS, return_when=asyncio.FIRST_COMPLETED)
        noted.cancel()
        self._task.cancel()
