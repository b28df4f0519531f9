"""The work of one rig: `RigWorker` takes a campaign from the queue, keeps it until it rests, and takes the next.

`Running` is one campaign at the rig, from its snapshot to its published results, with the ways to end it sooner.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from collections import Counter
from collections.abc import Awaitable, Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from actors.arm.arm_settings import ArmSettings, arm_kind
from actors.interfaces import DeviceCheck, LaboratoryError
from actors.laboratory import WarmSimulators
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.daemon.rigs.materials import Materials
from orchestrator.daemon.rigs.pour_orders import OrderBook, OrderError, PourOrder, refusal, renewed, settled_pour
from orchestrator.daemon.rigs.remote_operator import Asking, RemoteOperator, RunQuestions
from orchestrator.daemon.rigs.submissions import run_request
from orchestrator.daemon.state.daemon_settings import NO_RIG, DaemonSettings, Rig
from orchestrator.daemon.state.daemon_store import ENDED, PAUSED, STOPPED, DesiredState, QueueItem, Store
from orchestrator.daemon.state.event_feed import Feed
from orchestrator.daemon.state.notifications import Counts
from orchestrator.daemon.state.run_readout import RunReadouts, found_at, prune_recordings, verdict_at
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Pour
from orchestrator.learning.run_errors import RunError
from orchestrator.live_view.live_server import LiveView
from orchestrator.live_view.rerun_subscriber import RerunMonitor, recorder_of
from orchestrator.records.events import CampaignStateChanged, Event, LogLine, RequestFinished, RequestStarted
from orchestrator.records.journal_file import MB, JournalError, free_space
from orchestrator.records.run_clock import run_time
from orchestrator.records.run_record import CampaignResult
from orchestrator.records.run_registry import make_state_directory
from orchestrator.records.states import State
from orchestrator.records.verdict import outcome_of
from orchestrator.reports.progress_state import CHECKPOINT_WORDS, ProgressState
from orchestrator.reports.publishing import publish_run, publish_so_far
from orchestrator.reports.validity_warnings import not_simulated
from orchestrator.runs.request_executor import PourUnknownError, RequestExecutorError
from orchestrator.runs.resume import OperatorNeededError
from orchestrator.runs.run_service import RunHandle, RunRequest, RunResources, RunService
from orchestrator.runs.stages import POUR
from sim_engine.errors import reason_of

_log = logging.getLogger(__name__)


class SharedServices:
    """What the parts of a daemon share: settings, store, events, questions, simulators, rig workers.

    Args:
        settings: settings in force.
        live: open live view for the runs.

    Attributes:
        workers: the rig workers, by the names of their rigs.
        problems: problems for the operator, by subject.
        token_problems: returns those of the token file.
        stopping: whether nothing starts any more.
        counted: since the start: (subject, rig, outcome) → number, and ('http', status, '').
        rested: set when a campaign comes to rest; the charts of the laboratories are then read.
        suspect: whether the simulators may have failed for good: they are restarted when no campaign uses them.
    """

    def __init__(self, settings: DaemonSettings, live: LiveView | None = None) -> None:
        make_state_directory(settings.state)
        settings.runs.mkdir(parents=True, exist_ok=True)
        settings.snapshots.mkdir(parents=True, exist_ok=True)
        self.settings, self.live = settings, live
        self.store = Store(settings.state / "daemon.sqlite")
        self.feed = Feed(settings.state / "events.sqlite", settings.events, self._feed_broken)
        self.asking = Asking(self.store, self.feed.publish)
        self.warm = WarmSimulators(
            settings.simulators, in_process=settings.in_process, ray=settings.ray, tell=self.warn
        )
        self.workers = {rig.name: RigWorker(self, rig) for rig in (*settings.rigs, Rig(NO_RIG))}
        self.problems: dict[str, str] = {}
        self.token_problems: Callable[[], list[str]] = list
        self.notification_counts: dict[str, Counts] = {}
        self.pours = RunReadouts()
        self.counted: Counter[tuple[str, str, str]] = Counter()
        self._begun: dict[str, str] = {}
        self._asked: set[str] = set()
        self.stopping = self.suspect = False
        self.rested = asyncio.Event()
        self.began = time.time()

    @property
    def live_url(self) -> str | None:
        """URL of the live view; None if there is none."""
        return None if self.live is None else self.live.url

    @property
    def queue_paused(self) -> bool:
        """Whether the queue is paused."""
        return self.store.flag(PAUSED) is not None

    def running(self, item: QueueItem) -> Running | None:
        """Return the part of a campaign's run that is in progress; None if it rests."""
        worker = self.workers.get(item.rig)
        return worker.running if worker is not None and worker.holds(item.id) else None

    def progress(self, item: QueueItem) -> dict[str, Any] | None:
        """Return the progress of a running campaign; None for others."""
        running = self.running(item)
        return None if running is None else running.progress()

    @property
    def running_laboratories(self) -> list[str]:
        """Names of the laboratories in which campaigns run."""
        return [worker.running.laboratory for worker in self.workers.values() if worker.running is not None]

    def waits_for_another(self, item: QueueItem) -> str:
        """The campaign that has to end before one may start, with its state; '' if none has."""
        if item.after is None:
            return ""
        first = self.store.item(item.after["campaign"])
        if first is None:
            return ""
        if first.state not in ENDED:
            return f"the end of {first.id}, which is {first.state}"
        if item.after["verdict"] == "any" or (first.verdict or {}).get("word") == item.after["verdict"]:
            return ""
        reached = first.state if first.verdict is None else f"{first.state}, {first.verdict['word']}"
        wanted = item.after["verdict"]
        return f"an operator: {first.id} is {reached}, and has to be {wanted}; remove the condition, or take it out"

    def count_finished(self, rig: str) -> Callable[[Event], None]:
        """Return a subscriber that counts a rig's pours and doses by outcome, and faults of unattended pours."""

        def receive(event: Event) -> None:
            if isinstance(event, LogLine) and event.about == "fault":
                self.counted["faults", rig, "fault"] += 1
            if not isinstance(event, RequestStarted | RequestFinished) or not isinstance(event.request, Pour):
                return
            kind = self._begun[rig] = "pours" if event.request.dose is None else "doses"
            if isinstance(event, RequestFinished) and not event.replayed:
                outcome = outcome_of(event.request, event.outcome)
                counted = outcome == "unknown" and rig in self._asked
                self.counted[kind, rig, outcome] += not counted
                self._asked.discard(rig)

        return receive

    def count_unknown(self, rig: str) -> None:
        """Count a rig's pour or dose that a person is asked about; not again if the answer leaves it unknown."""
        self.counted[self._begun.get(rig, "pours"), rig, "unknown"] += 1
        self._asked.add(rig)

    def wake(self) -> None:
        """Wake all rig workers after a change."""
        for worker in self.workers.values():
            worker.wake.set()

    def note(self, by: str, what: str, campaign: str = "", detail: str = "") -> None:
        """Store, publish and log an audit entry."""
        self.store.note(by, what, campaign, detail)
        self.feed.publish("AuditEntry", {"by": by, "what": what, "detail": detail}, campaign)
        _log.info("%s: %s %s", by, what, campaign, extra={"by": by, "what": what, "campaign": campaign})

    def problem(self, key: str, text: str | None) -> None:
        """Report a problem for the operator, or remove it with None."""
        if text is None:
            self.problems.pop(key, None)
        elif self.problems.get(key) != text:
            self.problems[key] = text
            self.warn(text)

    def warn(self, text: str) -> None:
        """Log and publish a warning."""
        _log.warning(text)
        self.feed.publish("LogLine", {"level": "warning", "text": text, "stage": ""})

    def _feed_broken(self, text: str) -> None:
        self.problems["events"] = text
        _log.error(text)


def _prepared(request: RunRequest) -> tuple[RunRequest, list[str]]:
    """The request with its folder, and what is suspicious about a new run. Takes a moment, and no event loop.

    Raises:
        RunError, OSError: it can't run.
    """
    service, warned = RunService(), list[str]()
    if request.folder is None:
        report = service.check(request)
        report.require()
        warned += report.warnings
        warned += not_simulated(request.campaign, warned.append)
    elif not request.folder.is_dir():
        raise JournalError(
            f"{request.folder}: the folder of this run is missing, and pours may have been made in it. Nothing was "
            "poured now. Restore the folder from a copy, or submit the campaign again"
        )
    return service.with_folder(request), list(dict.fromkeys(warned))


class Running:
    """One part of a campaign's run: from now until it rests.

    Args:
        common: what it shares with others.
        item: which campaign.
        rig: that it has leased.

    Attributes:
        laboratory: name of its laboratory; '' before its run begins.
    """

    def __init__(self, common: SharedServices, item: QueueItem, rig: Rig) -> None:
        self._shared, self.item, self._rig = common, item, rig
        self.laboratory = ""
        self._progress: ProgressState | None = None
        self._handle: RunHandle | None = None
        self._asked_to_end = False

    async def run(self, checksum: str = "") -> CampaignResult:
        """Run until it rests.

        Args:
            checksum: of the safety settings that were accepted, where motion of hardware is enabled.

        Raises:
            asyncio.CancelledError: it was paused, stopped, aborted.
            RunError, LaboratoryError, ConfigError, OSError: it can't go on.
        """
        if self.item.task == POUR and self.item.run is None:
            await self._renew_order()
        vessels = Materials(self._shared.store).on_rig(self._rig.name)
        prepared = await asyncio.to_thread(run_request, self._shared.settings, self.item, self._rig, vessels)
        request, warned = await asyncio.to_thread(_prepared, prepared)
        assert request.folder is not None
        self.laboratory = request.campaign.laboratory.name
        for text in warned:
            self._log_warning(text)
        await self._shared.warm.open()
        if self.item.run != request.folder.name:
            self.note_run(request.folder)
        self._progress = ProgressState(request.campaign)
        self._handle = handle = RunService().start(request, self._resources(request, checksum))
        if self._asked_to_end:
            handle.pause()
        try:
            result = await handle.wait()
        finally:
            await asyncio.to_thread(handle.close)
        await asyncio.to_thread(publish_run, handle)
        return result

    async def _renew_order(self) -> None:
        """Check the materials of an ordered pour again, since other pours came before it, and take its load from them.

        Raises:
            OrderError: they can't serve it any more; nothing has moved.
        """
        folder = self._shared.settings.snapshots / self.item.id
        order = await asyncio.to_thread(PourOrder.read, folder)
        materials = Materials(self._shared.store)
        order = renewed(order, materials)
        if reason := refusal(order, materials, self._rig.spec):
            raise OrderError(f"{reason}. Nothing was poured")
        await asyncio.to_thread(order.write, folder)

    def _resources(self, request: RunRequest, checksum: str) -> RunResources:
        asking, key, rig = self._shared.asking, self.item.id, self._rig.name
        plan, live = request.campaign, self._shared.live
        asks = request.pours and plan.laboratory.needs_person
        assert self._progress is not None

        def recorder(plan: CampaignPlan, run: Path) -> RerunMonitor | None:
            return recorder_of(plan, run, self._log_warning, live.stream if live is not None and live.alive else "")

        return RunResources(
            in_process=self._shared.settings.in_process,
            simulators=self._shared.warm.share(),
            ray=self._shared.warm.ray,
            optimizer=self._shared.warm.optimizer(),
            operator=RemoteOperator(asking, key, rig, self._announce) if asks else None,
            ask_operator=RunQuestions(asking, self._shared.store, key, rig, lambda: found_at(plan.laboratory)),
            approved_checksum=checksum,
            subscribers=[
                self._shared.feed.subscriber(key),
                self._progress,
                self._note_state,
                self._shared.count_finished(rig),
            ],
            recorder=recorder,
        )

    def note_run(self, directory: Path) -> None:
        """Write down which folder the run has, before anything happens in it."""
        self.item = self.item.model_copy(update={"run": directory.name})
        self._shared.store.change(self.item.id, run=directory.name)

    def _log_warning(self, text: str) -> None:
        self._shared.feed.publish("LogLine", {"level": "warning", "text": text, "stage": ""}, self.item.id)

    def _note_state(self, event: Event) -> None:
        if isinstance(event, CampaignStateChanged):
            # Finished is what has been published: killed before that, it is taken up again for it.
            done = event.after == State.FINISHED
            state, reason = ("running", "being published") if done else (event.after, event.reason)
            self._shared.store.change(self.item.id, state=state, reason=reason)

    def _announce(self, text: str, seconds: float) -> None:
        self._shared.feed.publish("Announced", {"rig": self._rig.name, "text": text, "seconds": seconds}, self.item.id)

    # ---- ending it sooner

    def pause(self) -> None:
        """Come to rest at the next safe point; see `RunHandle.pause`."""
        self._asked_to_end = True
        if self._handle is not None:
            self._handle.pause()

    async def abort(self) -> None:
        """Stop the motion now, or abandon the pour; see `RunHandle.abort`."""
        self._asked_to_end = True
        if self._handle is not None:
            await self._confirmed(self._handle.abort())

    async def emergency(self) -> None:
        """Stop the motion now and abandon the pour; see `RunHandle.emergency_stop`."""
        self._asked_to_end = True
        if self._handle is not None:
            await self._confirmed(self._handle.emergency_stop())

    async def _confirmed(self, stop: Awaitable[None]) -> None:
        """Log it if the arm does not confirm a stop."""
        try:
            await stop
        except (LaboratoryError, TimeoutError) as error:
            text = f"the arm of {self._rig.name} did not confirm that it was stopped ({error}): use its own button"
            _log.error(text)
            self._shared.feed.publish("LogLine", {"level": "error", "text": text, "stage": ""}, self.item.id)

    async def give_up(self) -> None:
        """Paused already: now abandon the pour as well; see `RunHandle.abandon_pour`."""
        if self._handle is not None:
            await self._handle.abandon_pour()

    async def tidy(self) -> None:
        """After a stop: publish the results so far, as those of a finished run."""

        def work() -> None:
            publish_so_far(run_request(self._shared.settings, self.item, self._rig))

        if self.item.run is not None:
            await asyncio.to_thread(work)

    @property
    def checkpoint(self) -> str:
        """Of the pour that is under way; '' between pours."""
        return "" if self._handle is None else self._handle.checkpoint

    def progress(self) -> dict[str, Any] | None:
        """JSON-ready: stage, counts, the pour in words, and how long it still takes [s] where that is known.

        None before it has begun.
        """
        progress = self._progress
        if progress is None:
            return None
        opened = progress.run.opened
        stage = progress.run.stages.get(opened.stage)
        done = stage.progress if stage is not None else None
        pour = progress.run.pour
        return {
            "stage": opened.stage,
            "stage_index": opened.index,
            "stage_count": opened.count,
            "simulations": done.simulations if done else 0,
            "of_simulations": done.of_simulations if done else 0,
            "pours": done.pours if done else 0,
            "of_pours": done.of_pours if done else 0,
            "simulators_busy": progress.busy,
            "line": progress.counts_line(),
            "pour": progress.pour_line(),
            "dose": progress.dose_line(),
            "checkpoint": self.checkpoint,
            "checkpoint_words": CHECKPOINT_WORDS.get(self.checkpoint, ""),
            "fraction": pour.progress.fraction if pour is not None and pour.progress is not None else None,
            "seconds_left": progress.forecast.left(run_time()),
        }

    @property
    def pouring(self) -> bool:
        """Whether a pour of it is under way."""
        return self.checkpoint != ""


RETRY = 30.0
"""Time after which a rig that could not begin a campaign tries again [s]."""


@dataclass(frozen=True)
class ArmStatus:
    """Whether the arm of a rig can move, as last read while no campaign used it.

    Attributes:
        check: result and remedy, as in `decant robot check`.
        time: of the first reading with this result, in seconds since 1970.
    """

    check: DeviceCheck
    time: float


def _readiness(arm: ArmSettings) -> DeviceCheck | None:
    try:
        return arm_kind(arm).readiness()
    except (LaboratoryError, OSError, ValueError) as error:
        return DeviceCheck("motion", "fail", str(error), "see 'decant robot check'")


class RigWorker:
    """What happens at one rig: one campaign after the other.

    Args:
        shared: what the rigs share.
        rig: that campaigns lease here.

    Attributes:
        latched: whether an emergency stop holds for the rig; see `EmergencyStops`.
    """

    def __init__(self, shared: SharedServices, rig: Rig) -> None:
        self._shared, self.rig = shared, rig
        self.running: Running | None = None
        self.wake = asyncio.Event()
        self.latched = False
        self.arm: ArmStatus | None = None
        self._reading_arm = asyncio.Lock()
        self._background: set[asyncio.Task[None]] = set()
        self._resting = asyncio.Event()
        self._resting.set()

    def holds(self, key: str) -> bool:
        """Whether that campaign has the rig."""
        return self.running is not None and self.running.item.id == key

    async def work(self) -> None:
        """Until cancelled."""
        while True:
            self.wake.clear()
            async with self._reading_arm:  # no run begins during a reading, and no reading during a run
                item = self._next()
                self.running = None if item is None else Running(self._shared, item, self.rig)
            if item is None or self.running is None:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(self._pause()):
                        await self.wake.wait()
                continue
            self._resting.clear()
            try:
                await self._run(self.running)
            finally:
                self.running = None
                self._resting.set()

    async def watch_arm(self) -> None:
        """Keep `arm` current while no campaign uses the rig, until cancelled.

        A reading changes nothing on the controller, and no run begins before it has ended.
        """
        spec = self.rig.spec
        if spec is None or spec.arm is None or spec.mode != "hardware":
            return
        while True:
            async with self._reading_arm:
                if self.running is None and not self._shared.stopping:
                    check = await asyncio.to_thread(_readiness, spec.arm)
                    self._show_arm(check)
            await asyncio.sleep(self._shared.settings.arm_interval)

    def _show_arm(self, check: DeviceCheck | None) -> None:
        if check is None:
            self.arm = None
        elif self.arm is None or self.arm.check != check:
            self.arm = ArmStatus(check, time.time())
            body = {"rig": self.rig.name, "state": check.state, "text": check.found, "advice": check.advice}
            self._shared.feed.publish("ArmStatusChanged", body)

    async def close(self) -> None:
        """Come to rest."""
        if self.running is not None:
            self.running.pause()
        await self._resting.wait()

    def background(self, work: Any) -> None:
        """Do something beside."""
        task = asyncio.ensure_future(work)
        self._background.add(task)
        task.add_done_callback(self._background.discard)

    async def settle(self, item: QueueItem, *, ended: bool) -> None:
        """Store the result of an ordered pour and enter it in the account, if its journal has an outcome.

        Args:
            item: campaign of the order.
            ended: whether the campaign does not continue.
        """
        if item.run is None:
            return
        settings = self._shared.settings
        try:
            run, snapshot = settings.runs / item.run, settings.snapshots / item.id
            settled = await asyncio.to_thread(settled_pour, run, snapshot, self.rig)
            OrderBook(self._shared.store).settle(item, settled, ended=ended)
        except (RunError, OSError, ValueError) as error:
            _log.error("pour of %s is not in the account: %s", item.id, error)
            text = f"its outcome could not be entered in the account of the materials: {error}"
            self._shared.feed.publish("LogLine", {"level": "error", "text": text, "stage": ""}, item.id)

    def _next(self) -> QueueItem | None:
        if self.latched or self._shared.stopping or self._shared.warm.lost:
            return None
        store = self._shared.store
        mine = store.wanted(self.rig.name)
        begun = sorted((c for c in mine if c.run is not None), key=lambda c: c.begun or 0.0)
        now = time.time()
        queued = [c for c in mine if c.state == "queued" and (c.not_before is None or c.not_before <= now)]
        queued = [c for c in queued if not self._shared.waits_for_another(c)]
        if self._shared.queue_paused:
            queued = []
        following = next((c for c in (*begun, *queued) if c.mode != "hardware" or c.motion_enabled), None)
        return following if following is not None and self._has_room() else None

    def _pause(self) -> float:
        """Time until the queue is read again at the latest [s]: sooner if a campaign may start by its time."""
        times = self._shared.store.coming(self.rig.name, time.time())
        return min([RETRY, *(max(at - time.time(), 0.01) for at in times)])

    def _has_room(self) -> bool:
        settings = self._shared.settings
        free = free_space(settings.state)
        text = (
            f"{free / MB:.0f} MB are free on the disk of {settings.state}, and no campaign is begun below "
            f"{settings.keep_free / MB:.0f} MB (keep_free): make room"
        )
        self._shared.problem("disk", text if free < settings.keep_free else None)
        return free >= settings.keep_free

    async def _run(self, running: Running) -> None:
        store, feed, item = self._shared.store, self._shared.feed, running.item
        self._show_arm(None)
        begun = item.begun or time.time()
        store.change(item.id, state="preparing", reason="", begun=begun, motion_enabled=False, verdict=None)
        feed.publish("CampaignLeased", {"rig": self.rig.name}, item.id)
        if self._shared.suspect and not any(w.running for w in self._shared.workers.values() if w is not self):
            self._shared.suspect = False
            await self._shared.warm.close()
        state, reason, desired = "failed", "", DesiredState.PAUSE
        result: CampaignResult | None = None
        try:
            result = await running.run(self._checksum(item))
            state, reason, desired = "finished", "", DesiredState.RUN
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            state, reason, desired = self._ended_by_people(item)
        except OperatorNeededError as error:
            state, reason, desired = "paused", str(error), self._kept_desired_state(item)
        except PourUnknownError as error:
            state, reason, desired = "unknown", str(error), self._kept_desired_state(item)
        except (RunError, LaboratoryError, ConfigError, OSError) as error:
            needs_person = getattr(error, "exit_code", 1) == 3
            self._shared.suspect |= isinstance(error, LaboratoryError | RequestExecutorError)
            state, reason = ("paused" if needs_person else "failed"), str(error)
        except Exception as error:
            state, reason = "failed", reason_of(error)
            _log.exception("campaign %s failed", item.id)
        if state in ("failed", "paused") and (lost := self._shared.warm.lost):
            # No fault of the campaign's, and no operator's: it continues when there is a Ray again.
            state, reason, desired = "paused", f"Ray had lost its {lost}", self._kept_desired_state(item)
        await self._leave(running, state, reason, desired)
        if result is None and state != "finished":
            _log.warning("campaign %s: %s: %s", item.id, state, reason, extra={"campaign": item.id})

    def _checksum(self, item: QueueItem) -> str:
        if self.rig.source is None or self.rig.mode != "hardware":
            return ""
        from orchestrator.runs.motion_approval import accepted_checksum

        return accepted_checksum(self.rig.source) or ""

    def _kept_desired_state(self, item: QueueItem) -> DesiredState:
        """Somebody has to answer before it goes on: it goes on to ask, unless people want something else of it."""
        stored = self._shared.store.item(item.id)
        return DesiredState.RUN if stored is None else DesiredState(stored.desired_state)

    def _ended_by_people(self, item: QueueItem) -> tuple[str, str, DesiredState]:
        stored = self._shared.store.item(item.id)
        desired = DesiredState.PAUSE if stored is None else DesiredState(stored.desired_state)
        state = "unknown" if stored is not None and stored.state == "unknown" else "paused"
        reason = stored.reason if stored is not None else ""
        return state, reason, desired

    async def _leave(self, running: Running, state: str, reason: str, desired: DesiredState) -> None:
        store, key = self._shared.store, running.item.id
        if running.item.task == POUR:
            await self.settle(running.item, ended=desired is DesiredState.STOP)
        if desired is DesiredState.STOP and state != "finished":
            state = STOPPED
            try:
                await running.tidy()
            except Exception as error:  # what is in the journal is safe
                reason = f"its results could not be published: {error}"
                _log.exception("campaign %s: not published", key)
        ended, run = time.time() if state in ENDED else None, running.item.run
        verdict = None if run is None else await asyncio.to_thread(verdict_at, self._shared.settings.runs / run)
        if state == "unknown":
            self._shared.count_unknown(self.rig.name)
        word = state if verdict is None or ended is None else verdict["word"]
        self._shared.counted["campaigns_ended", self.rig.name, word] += 1
        store.change(key, state=state, reason=reason, desired_state=str(desired), ended=ended, verdict=verdict)
        self.running = None  # whoever hears that it rests may have it go on
        body = {"state": state, "reason": reason, "rig": self.rig.name, "verdict": verdict}
        self._shared.feed.publish("CampaignRests", body, key)
        if state == "finished" and (verdict is None or verdict["word"] != "complete"):
            _log.warning("campaign %s: %s", key, "no verdict" if verdict is None else verdict["text"])
        self._shared.rested.set()
        self._shared.wake()  # campaigns of other rigs may wait for this one
        with contextlib.suppress(OSError):
            busy = {worker.running.item.run for worker in self._shared.workers.values() if worker.running is not None}
            await asyncio.to_thread(prune_recordings, self._shared.settings, {name for name in busy if name})
            await self._shared.warm.tidy()
