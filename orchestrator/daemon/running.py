"""One campaign on one rig, from its snapshot to its published results; and the ways to end it sooner."""

from __future__ import annotations

import asyncio
import logging
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actors.bench.opening import needs_person
from actors.laboratory import open_laboratory
from actors.protocols import Laboratory, LaboratoryError, Stoppable
from actors.warm import WarmSimulators
from orchestrator.campaign import run_campaign
from orchestrator.daemon.feed import Feed
from orchestrator.daemon.packing import CAMPAIGN, THETA, load_confined
from orchestrator.daemon.people import Asking, RemoteOperator, RunQuestions
from orchestrator.daemon.settings import Rig, Settings
from orchestrator.daemon.store import Item, Store
from orchestrator.daemon.watching import Watching
from orchestrator.events import CampaignStateChanged, Watcher
from orchestrator.jobs import Job, Verb, check_job, job, read_theta
from orchestrator.journal import JOURNAL_NAME, JournalReader
from orchestrator.journal_check import check_journal, has_begun
from orchestrator.journal_file import JournalError
from orchestrator.monitor.live import LiveView, recorder_of
from orchestrator.monitor.monitor import RerunMonitor
from orchestrator.plan import CampaignPlan
from orchestrator.publish import not_simulated, publish
from orchestrator.run_result import CampaignResult, read_result
from orchestrator.runs import create_run
from orchestrator.stages import scenes_of
from orchestrator.states import State

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

    settings: Settings
    store: Store
    feed: Feed
    asking: Asking
    warm: WarmSimulators
    live: LiveView | None = None


def job_of(settings: Settings, item: Item, rig: Rig) -> Job:
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

    def __init__(self, common: Common, item: Item, rig: Rig) -> None:
        self._common, self.item, self._rig = common, item, rig
        self.watching: Watching | None = None
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
        self.watching = Watching(work.plan)
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
        self, work: Job, directory: Path, begun: bool, watchers: list[Watcher], checksum: str
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
        from orchestrator.daemon.looking import found_at

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
