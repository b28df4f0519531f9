"""What happens at one rig: it takes a campaign from the queue, keeps it until it rests, and takes the next.

One campaign on one rig, from its snapshot to its published results; and the ways to end it sooner.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Protocol

from actors.bench.bench_factory import needs_person
from actors.interfaces import Laboratory, LaboratoryError, Stoppable
from actors.laboratory import open_laboratory
from actors.simulators.shared_pool import WarmSimulators
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.daemon.campaign_progress import CampaignProgress
from orchestrator.daemon.daemon_settings import DaemonSettings, Rig
from orchestrator.daemon.daemon_store import AT_REST, ENDED, STOPPED, DesiredState, QueueItem, Store
from orchestrator.daemon.event_feed import Feed
from orchestrator.daemon.remote_operator import Asking, RemoteOperator, RunQuestions
from orchestrator.daemon.run_readout import prune_recordings
from orchestrator.daemon.submission_bundle import CAMPAIGN, THETA, load_confined
from orchestrator.journal.disk_reserve import MB, free_space
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader
from orchestrator.journal.journal_check import check_journal, has_begun
from orchestrator.journal.journal_file import JournalError
from orchestrator.journal.run_record import CampaignResult, read_result
from orchestrator.live_view.live_server import LiveView, recorder_of
from orchestrator.live_view.rerun_subscriber import RerunMonitor
from orchestrator.results.publishing import not_simulated, publish
from orchestrator.run_errors import RunError
from orchestrator.runs.events import CampaignStateChanged, Watcher
from orchestrator.runs.request_executor import PourUnknownError, RequestExecutorError
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.run_folder import create_run
from orchestrator.runs.run_tasks import RunTask, Verb, check_job, job, read_theta
from orchestrator.runs.stages import scenes_of
from orchestrator.runs.unknown_pours import OperatorNeededError
from orchestrator.states import State
from orchestrator.strategies.campaign_plan import CampaignPlan

MOVING = ("approach", "tilt", "hold", "return")
"""Checkpoints of a pour during which the arm moves."""

BETWEEN_CANCELS = 1.0
"""Longest time that a run has to take note of a pause before it is told to give everything up [s]."""

STOP_DEADLINE = 5.0
"""Longest time that is waited for an arm to confirm that it was stopped [s]; everything else goes on meanwhile."""

_log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Common:
    """What all campaigns of a daemon share."""

    settings: DaemonSettings
    store: Store
    feed: Feed
    asking: Asking
    warm: WarmSimulators
    live: LiveView | None = None


def job_of(settings: DaemonSettings, item: QueueItem, rig: Rig) -> RunTask:
    """The work of a submitted campaign, from its snapshot. Takes a moment, and no event loop.

    Raises:
        ConfigError, JobError: it can't be used.
    """
    folder = settings.snapshots / item.id
    plan = load_confined(folder / CAMPAIGN, [folder.resolve()], rig.source)
    given = read_theta(folder / THETA, plan) if (folder / THETA).is_file() else None
    # A daemon never repeats a pour by itself: whoever is there is asked, whatever the campaign says.
    plan = replace(plan, on_unknown="ask", outputs=replace(plan.outputs, directory=settings.runs))
    verb: Verb = item.verb  # type: ignore[assignment]  # written by us
    return job(plan, verb, given)


def _warnings_of(plan: CampaignPlan) -> list[str]:
    """All that is suspicious about a campaign, or not simulated. Takes a moment, and no event loop.

    Raises:
        JobError: it can't run.
    """
    found: list[str] = []
    check_job(plan, warn=lambda problem: found.append(str(problem)))
    return list(dict.fromkeys([*found, *not_simulated(plan, found.append)]))


class Running:
    """One part of a campaign's run: from now until it rests.

    Args:
        common: what it shares with others.
        item: which campaign.
        rig: that it has leased.
    """

    def __init__(self, common: Common, item: QueueItem, rig: Rig) -> None:
        self._common, self.item, self._rig = common, item, rig
        self.watching: CampaignProgress | None = None
        self._laboratory: Laboratory | None = None
        self._task: asyncio.Task[CampaignResult] | None = None
        self._aborting = self._giving_up = False
        self._asked_to_end = False

    async def run(self, checksum: str = "") -> CampaignResult:
        """Run until it rests.

        Args:
            checksum: of the safety settings that were accepted, where hardware was armed.

        Raises:
            asyncio.CancelledError: it was paused, stopped, aborted.
            RunError, LaboratoryError, ConfigError, OSError: it can't go on.
        """
        work = await asyncio.to_thread(job_of, self._common.settings, self.item, self._rig)
        submitted_before = self.item.run is not None
        directory = await asyncio.to_thread(self._directory, work.plan)
        if not submitted_before:
            for text in await asyncio.to_thread(_warnings_of, work.plan):
                self._log_warning(text)
        # Before anything is written: a lost journal must not look like a run that was never begun.
        begun = await asyncio.to_thread(self._begun, directory)
        await self._common.warm.open()
        self.watching = CampaignProgress(work.plan)
        monitor = self._recording(work.plan, directory)
        watchers: list[Watcher] = [self._common.feed.watcher(self.item.id), self.watching, self._note_state]
        if monitor is not None:
            watchers.append(monitor)
        try:
            result = await self._run(work, directory, begun, watchers, checksum)
        finally:
            if monitor is not None:
                await asyncio.to_thread(monitor.close)
        await asyncio.to_thread(publish, work.plan, result, monitor)
        return result

    async def _run(
        self, work: RunTask, directory: Path, begun: bool, watchers: list[Watcher], checksum: str
    ) -> CampaignResult:
        spec = work.plan.laboratory
        spec = replace(
            spec, in_process=spec.in_process or self._common.settings.in_process, accepted_checksum=checksum, ray=None
        )
        asking, key, rig = self._common.asking, self.item.id, self._rig.name
        load = next(iter(scenes_of(work.plan).values())).liquid.mass  # a campaign has one liquid
        operator = RemoteOperator(asking, key, rig, self._announce) if work.pours and needs_person(spec) else None
        self._laboratory = open_laboratory(
            spec,
            need_bench=work.pours,
            operator=operator,
            kept=self._common.warm.share(),
            optimizer=self._common.warm.optimizer(),
        )
        self._task = asyncio.create_task(
            run_campaign(
                work.plan,
                self._laboratory,
                directory,
                resume=begun,
                watchers=watchers,
                ask_operator=RunQuestions(asking, self._common.store, key, rig, load, lambda: self._look(work.plan)),
                stages=work.stages,
            ),
            name=f"campaign {key}",
        )
        if self._asked_to_end:
            self._task.cancel()
        return await self._task

    def _directory(self, plan: CampaignPlan) -> Path:
        if self.item.run is None:
            return create_run(plan)
        directory = self._common.settings.runs / self.item.run
        if not directory.is_dir():
            raise JournalError(
                f"{directory}: the folder of this run is missing, and pours may have been made in it. Nothing was "
                "poured now. Restore the folder from a copy, or submit the campaign again"
            )
        return directory

    def _begun(self, directory: Path) -> bool:
        """Whether a run was begun in that folder.

        Raises:
            JournalDamagedError: its journal is lost or damaged.
        """
        path = directory / JOURNAL_NAME
        if has_begun(path):
            check_journal(path).require()
            return True
        return False

    def note_run(self, directory: Path) -> None:
        """Write down which folder the run has, before anything happens in it."""
        self.item = replace(self.item, run=directory.name)
        self._common.store.change(self.item.id, run=directory.name)

    def _recording(self, plan: CampaignPlan, directory: Path) -> RerunMonitor | None:
        if self.item.run != directory.name:
            self.note_run(directory)
        live = self._common.live
        return recorder_of(plan, directory, self._log_warning, live if live is not None and live.alive else None)

    def _log_warning(self, text: str) -> None:
        self._common.feed.tell("LogLine", {"level": "warning", "text": text, "stage": ""}, self.item.id)

    def _note_state(self, event: Any) -> None:
        if isinstance(event, CampaignStateChanged):
            # Finished is what has been published: killed before that, it is taken up again for it.
            done = event.after == State.FINISHED
            state, reason = ("running", "being published") if done else (event.after, event.reason)
            self._common.store.change(self.item.id, state=state, reason=reason)

    def _announce(self, text: str, seconds: float) -> None:
        self._common.feed.tell("Announced", {"rig": self._rig.name, "text": text, "seconds": seconds}, self.item.id)

    def _look(self, plan: CampaignPlan) -> dict[str, str]:
        from orchestrator.daemon.run_readout import found_at

        return found_at(plan.laboratory)

    # ---- ending it sooner

    def pause(self) -> None:
        """Come to rest at the next safe point: simulations are dropped, a pour that has begun is finished, weighed."""
        self._asked_to_end = True
        if self._task is not None:
            self._task.cancel()

    async def abort(self) -> None:
        """Stop the motion now. What was tilted is brought upright when somebody has agreed to it.

        Where nothing moves, what is under way is given up; so it is when this is called again.
        """
        moving = self.watching is not None and self.watching.checkpoint in MOVING
        if not moving or self._aborting:
            self.pause()
            await self.give_up()
            return
        self._aborting = True
        stopping = asyncio.create_task(self.stop_arm())
        await asyncio.sleep(0)
        self.pause()
        await stopping

    async def emergency(self) -> None:
        """Stop the motion now and give everything up: nobody is asked, nothing is brought upright."""
        stopping = asyncio.create_task(self.stop_arm())
        await asyncio.sleep(0)
        self.pause()
        await asyncio.gather(stopping, self.give_up())

    async def stop_arm(self) -> None:
        """Past everything that waits for it."""
        laboratory: object = self._laboratory
        if isinstance(laboratory, Stoppable):
            try:
                async with asyncio.timeout(STOP_DEADLINE):
                    await laboratory.stop_arm()
            except (LaboratoryError, TimeoutError) as error:
                text = f"the arm of {self._rig.name} did not confirm that it was stopped ({error}): use its own button"
                _log.error(text)
                self._common.feed.tell("LogLine", {"level": "error", "text": text, "stage": ""}, self.item.id)

    async def give_up(self) -> None:
        """Told to pause already: now give up the pour as well. It is UNKNOWN if it had begun."""
        if self._giving_up or self._task is None:
            return
        self._giving_up = True
        # Two cancellations at once would count as one.
        await asyncio.wait({self._task}, timeout=0.05)
        if self.watching is not None:
            noted = asyncio.ensure_future(self.watching.winding_down.wait())
            await asyncio.wait({self._task, noted}, timeout=BETWEEN_CANCELS, return_when=asyncio.FIRST_COMPLETED)
            noted.cancel()
        self._task.cancel()

    async def tidy(self) -> None:
        """After a stop: what came of it so far is published as of a run that was finished."""

        def work() -> None:
            made = job_of(self._common.settings, self.item, self._rig)
            assert self.item.run is not None
            directory = self._common.settings.runs / self.item.run
            if (directory / JOURNAL_NAME).is_file():
                with JournalReader(directory / JOURNAL_NAME) as journal:
                    result = read_result(journal, directory)
                publish(made.plan, result)

        if self.item.run is not None:
            await asyncio.to_thread(work)

    @property
    def pouring(self) -> bool:
        """Whether a pour of it is under way."""
        return self.watching is not None and self.watching.checkpoint != ""


RETRY = 30.0
"""Before a lane that was kept from beginning looks again [s]."""


class Whole(Protocol):
    """What a lane needs of the daemon that it is a part of.

    Attributes:
        lanes: all of them, by their rigs' names.
        stopping: nothing is begun any more.
        suspect: the simulators may be gone.
    """

    lanes: dict[str, Lane]
    stopping: bool
    suspect: bool

    def is_stopped(self, rig: str) -> bool:
        """Whether an emergency stop is latched that holds for a rig."""
        ...

    @property
    def queue_paused(self) -> bool:
        """Whether nothing is begun from the queue."""
        ...

    def problem(self, key: str, text: str | None) -> None:
        """Something is wrong, or (None) is no longer."""
        ...


class Lane:
    """What happens at one rig: one campaign after the other.

    Args:
        daemon: whose queue it serves.
        rig: that campaigns lease here.
        common: what all of them share.
    """

    def __init__(self, daemon: Whole, rig: Rig, common: Common) -> None:
        self._daemon, self.rig, self._common = daemon, rig, common
        self.running: Running | None = None
        self.wake = asyncio.Event()
        self.latched = daemon.is_stopped(rig.name)
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
            item = self._next()
            if item is None:
                with contextlib.suppress(TimeoutError):
                    async with asyncio.timeout(RETRY):
                        await self.wake.wait()
                continue
            self._resting.clear()
            try:
                await self._run(item)
            finally:
                self.running = None
                self._resting.set()

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

    def _next(self) -> QueueItem | None:
        if self.latched or self._daemon.stopping or self._common.warm.lost:
            return None
        store = self._common.store
        mine = [one for one in store.items([*AT_REST]) if one.rig == self.rig.name and one.wish == DesiredState.RUN]
        begun = sorted(
            (one for one in mine if one.run is not None and one.state not in ENDED), key=lambda one: one.begun or 0.0
        )
        queued = [one for one in mine if one.state == "queued"]
        if self._daemon.queue_paused:
            queued = []
        found = next((one for one in (*begun, *queued) if one.mode != "hardware" or one.armed), None)
        return found if found is not None and self._has_room() else None

    def _has_room(self) -> bool:
        settings = self._common.settings
        free = free_space(settings.state)
        text = (
            f"{free / MB:.0f} MB are free on the disk of {settings.state}, and no campaign is begun below "
            f"{settings.keep_free / MB:.0f} MB (keep_free): make room"
        )
        self._daemon.problem("disk", text if free < settings.keep_free else None)
        return free >= settings.keep_free

    async def _run(self, item: QueueItem) -> None:
        store, feed = self._common.store, self._common.feed
        self.running = running = Running(self._common, item, self.rig)
        store.change(item.id, state="preparing", reason="", begun=item.begun or time.time(), armed=False)
        feed.tell("CampaignLeased", {"rig": self.rig.name}, item.id)
        if self._daemon.suspect and not any(one.running for one in self._daemon.lanes.values() if one is not self):
            self._daemon.suspect = False
            await self._common.warm.close()
        state, reason, wish = "failed", "", DesiredState.PAUSE
        result: CampaignResult | None = None
        try:
            result = await running.run(self._checksum(item))
            state, reason = "finished", ""
        except asyncio.CancelledError:
            task = asyncio.current_task()
            if task is not None and task.cancelling():
                raise
            state, reason, wish = self._ended_by_people(item)
        except OperatorNeededError as error:
            state, reason, wish = "paused", str(error), self._kept_wish(item)
        except PourUnknownError as error:
            state, reason, wish = "unknown", str(error), self._kept_wish(item)
        except (RunError, LaboratoryError, ConfigError, OSError) as error:
            needs_person = getattr(error, "exit_code", 1) == 3
            self._daemon.suspect |= isinstance(error, LaboratoryError | RequestExecutorError)
            state, reason = ("paused" if needs_person else "failed"), str(error)
        except Exception as error:
            state, reason = "failed", f"{type(error).__name__}: {error}"
            _log.exception("campaign %s failed", item.id)
        if state in ("failed", "paused") and (lost := self._common.warm.lost):
            # No fault of the campaign's, and nobody's wish: it goes on when there is a Ray again.
            state, reason, wish = "paused", f"Ray had lost its {lost}", self._kept_wish(item)
        await self._leave(running, state, reason, wish)
        if result is None and state != "finished":
            _log.warning("campaign %s: %s: %s", item.id, state, reason, extra={"campaign": item.id})

    def _checksum(self, item: QueueItem) -> str:
        if self.rig.source is None or self.rig.mode != "hardware":
            return ""
        from orchestrator.runs.safety_approval import accepted_checksum

        return accepted_checksum(self.rig.source) or ""

    def _kept_wish(self, item: QueueItem) -> DesiredState:
        """Somebody has to answer before it goes on: it goes on to ask, unless people want something else of it."""
        found = self._common.store.item(item.id)
        return DesiredState.RUN if found is None else DesiredState(found.wish)

    def _ended_by_people(self, item: QueueItem) -> tuple[str, str, DesiredState]:
        found = self._common.store.item(item.id)
        wish = DesiredState.PAUSE if found is None else DesiredState(found.wish)
        state = "unknown" if found is not None and found.state == "unknown" else "paused"
        reason = found.reason if found is not None else ""
        return state, reason, wish

    async def _leave(self, running: Running, state: str, reason: str, wish: DesiredState) -> None:
        store, key = self._common.store, running.item.id
        if wish is DesiredState.STOP and state != "finished":
            state = STOPPED
            try:
                await running.tidy()
            except Exception as error:  # what is in the journal is safe
                reason = f"what came of it could not be published: {error}"
                _log.exception("campaign %s: not published", key)
        ended = time.time() if state in ENDED else None
        store.change(key, state=state, reason=reason, wish=str(wish), ended=ended)
        self.running = None  # whoever hears that it rests may have it go on
        self._common.feed.tell("CampaignRests", {"state": state, "reason": reason, "rig": self.rig.name}, key)
        with contextlib.suppress(OSError):
            busy = {one.running.item.run for one in self._daemon.lanes.values() if one.running is not None}
            await asyncio.to_thread(prune_recordings, self._common.settings, {name for name in busy if name})
            await self._common.warm.tidy()
