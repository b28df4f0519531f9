"""The queue of the daemon's campaigns: what is submitted, its order, and what operators want of each.

`CampaignQueue` stores every wish before it acts on it. The rig workers (`rig_worker`) take campaigns from the store.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import shutil
import threading
import time
from collections.abc import Callable
from datetime import datetime
from typing import Literal

from orchestrator.daemon.rigs.emergency_stop import EmergencyStops
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import SubmissionError, check
from orchestrator.daemon.state.daemon_store import (
    CHECKING,
    ENDED,
    PAUSED,
    REFUSED,
    STOPPED,
    WITHDRAWN,
    DesiredState,
    QueueItem,
)
from orchestrator.learning.run_errors import RunError
from orchestrator.reports.progress_state import CHECKPOINT_WORDS
from orchestrator.runs.stages import POUR
from sim_engine.errors import reason_of

_log = logging.getLogger(__name__)


class RequestRefusedError(RunError):
    """The request can't be fulfilled now; the message gives the reason."""


CHECKS = 2
"""Number of campaigns that are checked at a time."""


async def _in_thread(work: Callable[[], None]) -> None:
    """Do work in a thread that the end of the program does not wait for."""
    loop, done = asyncio.get_running_loop(), asyncio.get_running_loop().create_future()

    def settle(error: BaseException | None) -> None:
        if not done.done():
            done.set_result(None) if error is None else done.set_exception(error)

    def run() -> None:
        error: BaseException | None = None
        try:
            work()
        except BaseException as raised:
            error = raised
        with contextlib.suppress(RuntimeError):  # the loop has ended
            loop.call_soon_threadsafe(settle, error)

    threading.Thread(target=run, name="check", daemon=True).start()
    await done


class CampaignQueue:
    """Submitted campaigns.

    Args:
        shared: what the parts of the daemon share.
        stops: emergency stops; while one is latched, no work is accepted.
    """

    def __init__(self, shared: SharedServices, stops: EmergencyStops) -> None:
        self._shared, self._store, self._stops = shared, shared.store, stops
        self._checks: set[asyncio.Task[None]] = set()
        self._free_check = asyncio.Semaphore(CHECKS)

    def new_key(self) -> str:
        """Return a random key that no campaign's id ends with."""
        while True:
            key = secrets.token_hex(3)
            if not self._store.rows("select 1 from campaign where id like ?", f"%{key}"):
                return key

    def submit(self, item: QueueItem, enter: Callable[[], None] = lambda: None) -> QueueItem:
        """Queue a campaign whose snapshot is stored; one that is not checked yet is checked first.

        Args:
            item: the campaign.
            enter: called in the same transaction, after the campaign was stored; may raise.

        Raises:
            RequestRefusedError: the daemon or a rig accepts no new work, or `enter` refuses one.
        """
        self.refuse_new_work(item.rig)
        with self._store.together():
            last = self._store.rows("select coalesce(max(rank), 0) as rank from campaign")[0]["rank"]
            queued = item.model_copy(update={"rank": float(last) + 1.0, "created": time.time()})
            self._store.add(queued)
            enter()
        self._shared.note(item.by, "submit", item.id)
        if queued.state == CHECKING:
            self.check(queued)
        self._shared.wake()
        return queued

    def check(self, item: QueueItem) -> None:
        """Start the check of a received campaign; it is then queued, or refused with the reason."""
        task = asyncio.create_task(self._check(item), name=f"check {item.id}")
        self._checks.add(task)
        task.add_done_callback(self._checks.discard)

    async def _check(self, item: QueueItem) -> None:
        state, reason = "queued", ""
        async with self._free_check:
            try:
                await _in_thread(lambda: check(self._shared.settings, item))
            except SubmissionError as error:
                state, reason = REFUSED, str(error)
            except Exception as error:
                _log.exception("the check of %s failed", item.id)
                state, reason = REFUSED, f"the check failed: {reason_of(error)}"
        now = self.item(item.id)
        if state == REFUSED and now.run is None:
            self._store.change(item.id, state=state, reason=reason, ended=time.time())
            snapshot = self._shared.settings.snapshots / item.id
            await asyncio.to_thread(shutil.rmtree, snapshot, ignore_errors=True)
        elif now.state == CHECKING:
            state = "queued" if now.desired_state == DesiredState.RUN else "paused"
            self._store.change(item.id, state=state)
        self._shared.feed.publish("CampaignChecked", {"state": state, "reason": reason}, item.id)
        self._shared.wake()

    async def close(self) -> None:
        """End all checks; they begin again when the daemon starts."""
        for task in self._checks:
            task.cancel()
        await asyncio.gather(*self._checks, return_exceptions=True)

    def refuse_new_work(self, rig: str = "") -> None:
        """Raise RequestRefusedError if the daemon or one rig accepts no new work."""
        if reason := self._stops.refusal(rig):
            raise RequestRefusedError(reason)
        if self._shared.stopping:
            again = "ray" in self._shared.problems
            raise RequestRefusedError(
                "the daemon is just beginning anew; try again" if again else "the daemon is ending"
            )

    def item(self, key: str) -> QueueItem:
        """Return a campaign by its id, its caller's id or a unique prefix of three letters or more. Raises KeyError."""
        entry = self._store.item(key) or self._store.by_caller_id(key)
        if entry is None and len(key) >= 3:
            similar = [queued for queued in self._store.items() if queued.id.startswith(key)]
            entry = similar[0] if len(similar) == 1 else None
        if entry is None:
            raise KeyError(key)
        return entry

    def _queued(self, key: str, change: str) -> QueueItem:
        item = self.item(key)
        if item.state != "queued":
            raise RequestRefusedError(f"{item.id} is {item.state}; only a queued campaign {change}")
        return item

    def move(
        self,
        key: str,
        by: str,
        *,
        before: str | None = None,
        priority: int | None = None,
        not_before: float | None = None,
        after: dict[str, str] | Literal[""] | None = None,
    ) -> QueueItem:
        """Move a queued campaign in front of another one or to the head (''), or change when it may start.

        Args:
            key: id of the campaign.
            by: who moves it.
            before: id of the other campaign.
            priority: another priority.
            not_before: another earliest start; 0 for none.
            after: another campaign that has to end first; '' for none.

        Raises:
            KeyError: the campaign does not exist.
            RequestRefusedError: it is not queued.
        """
        item = self._queued(key, "has a place in the queue")
        if priority is not None:
            self._store.change(item.id, priority=priority)
        if not_before is not None:
            self._store.change(item.id, not_before=not_before or None)
        if after is not None:
            self._store.change(item.id, after=self.resolved_after(after, item.id) if after else None)
        if before is not None:
            queue = [e for e in self._store.items(["queued"]) if e.id != item.id]
            at = 0 if before == "" else next((i for i, e in enumerate(queue) if e.id == self.item(before).id), None)
            if at is None:
                raise RequestRefusedError(f"{before} is not in the queue")
            level = queue[at].priority if queue else item.priority
            behind = queue[at].rank if queue else 1.0
            ahead = queue[at - 1].rank if at > 0 and queue[at - 1].priority == level else behind - 2.0
            self._store.change(item.id, priority=level, rank=0.5 * (ahead + behind))
        self._shared.note(by, "move", item.id)
        self._shared.wake()
        return self.item(item.id)

    def resolved_after(self, after: dict[str, str], key: str = "") -> dict[str, str]:
        """Return a condition with the whole id of its campaign.

        Args:
            after: the condition.
            key: id of the campaign that waits; '' for a new one.

        Raises:
            RequestRefusedError: there is no such campaign, or it waits for this one.
        """
        try:
            first = self.item(after["campaign"])
        except KeyError:
            raise RequestRefusedError(f"after: there is no campaign '{after['campaign']}'") from None
        chain: QueueItem | None = first
        while chain is not None:
            if chain.id == key:
                raise RequestRefusedError(f"after: {first.id} waits for {key} itself")
            chain = None if chain.after is None else self._store.item(chain.after["campaign"])
        return {**after, "campaign": first.id}

    def pause_all(self, paused: bool, by: str) -> None:
        """Start no further campaigns, or start them again. Running campaigns continue."""
        self._store.set_flag(PAUSED, {"by": by, "time": time.time()} if paused else None)
        self._shared.note(by, "pause queue" if paused else "resume queue")
        self._shared.wake()

    def pause(self, key: str, by: str) -> QueueItem:
        """Pause a campaign at the next checkpoint."""
        return self._end(key, by, DesiredState.PAUSE)

    def stop(self, key: str, by: str) -> QueueItem:
        """Stop a campaign: finish the pour and publish the results so far."""
        return self._end(key, by, DesiredState.STOP)

    def _end(self, key: str, by: str, desired: DesiredState) -> QueueItem:
        item = self.item(key)
        running = self._shared.running(item)
        if running is None and item.state in ENDED:
            raise RequestRefusedError(f"{item.id} is {item.state} already")
        if running is not None:
            running.pause()
        self._store.change(item.id, desired_state=str(desired))
        self._shared.note(by, str(desired), item.id)
        if running is None:
            if item.state in ("queued", CHECKING):
                if desired is DesiredState.STOP or item.state == "queued":
                    state = WITHDRAWN if desired is DesiredState.STOP else "paused"
                    self._store.change(item.id, state=state, reason=f"by {by}")
            elif desired is DesiredState.STOP:
                self._store.change(item.id, state=STOPPED, ended=time.time(), reason=f"by {by}")
                if item.task == POUR and (worker := self._shared.workers.get(item.rig)) is not None:
                    worker.background(worker.settle(item, ended=True))
        self._shared.wake()
        return self.item(item.id)

    async def abort(self, key: str, by: str) -> QueueItem:
        """Stop the motion of a campaign; see `Running.abort`."""
        item = self.item(key)
        running = self._shared.running(item)
        if running is None:
            raise RequestRefusedError(f"{item.id} is {item.state}: nothing of it moves")
        stopping = asyncio.create_task(running.abort())
        await asyncio.sleep(0)
        self._store.change(item.id, desired_state=str(DesiredState.ABORT))
        self._shared.note(by, "abort", item.id)
        await stopping
        return self.item(item.id)

    def waits_for(self, item: QueueItem) -> str:
        """Return what has to happen before a campaign starts or continues, with the command; '' if only its turn."""
        shared, worker = self._shared, self._shared.workers.get(item.rig)
        if question := next(iter(self._store.questions(campaign=item.id)), None):
            where = f"on the daemon's page, or with 'decant queue answer {question.id}'"
            return f"an operator has to answer question {question.id} {where}: {question.text}"
        if item.state in ENDED or (worker is not None and worker.holds(item.id)):
            return ""
        if item.state == CHECKING:
            return "its check: the vessels, the motions and the devices"
        if worker is None:
            return f"an administrator has to add rig {item.rig} to the daemon's settings again"
        if self._stops.holds(item.rig):
            return "an administrator has to clear the emergency stop: 'decant estop --clear'"
        if item.desired_state != DesiredState.RUN:
            return f"an operator has to resume it: 'decant queue resume {item.id}'"
        if item.mode == "hardware" and not item.motion_enabled:
            return f"an operator has to enable its motion: 'decant queue enable {item.id}'"
        if item.state == "queued" and shared.queue_paused:
            return "the queue is paused: the command 'resume', or 'decant queue resume'"
        if item.state == "queued" and (reason := shared.waits_for_another(item)):
            return reason
        if item.state == "queued" and item.not_before is not None and item.not_before > time.time():
            begins = datetime.fromtimestamp(item.not_before).astimezone()
            return f"its earliest start, {begins.isoformat(' ', 'seconds')}"
        return ""

    def running_work(self) -> list[str]:
        """What has to come to rest before the daemon can end, by campaign."""
        lines = []
        for rig, worker in self._shared.workers.items():
            if (running := worker.running) is None:
                continue
            key = running.item.id
            question = next(iter(self._store.questions(campaign=key)), None)
            if question is not None:
                rest = f"the answer to question {question.id} ('decant queue answer {question.id} …'): {question.text}"
            else:
                step = CHECKPOINT_WORDS.get(running.checkpoint, running.checkpoint)
                rest = (
                    f"the pour under way, which is weighed (now {step})" if running.pouring else "its next safe point"
                )
            lines.append(f"{key} at rig {rig}: {rest}")
        return lines

    def resume(self, key: str, by: str) -> QueueItem:
        """Resume a campaign that is at rest.

        Raises:
            RequestRefusedError: it is not at rest, or no new work is accepted.
        """
        item = self.item(key)
        self.refuse_new_work(item.rig)
        if item.state in (STOPPED, WITHDRAWN) and item.run is None:
            self._store.change(item.id, state="queued", desired_state=str(DesiredState.RUN), reason="")
        elif self._shared.running(item) is not None or item.state in ("queued", "finished", REFUSED):
            raise RequestRefusedError(f"{item.id} is {item.state}; it can be resumed when it is paused")
        elif item.state == CHECKING:
            self._store.change(item.id, desired_state=str(DesiredState.RUN))
        else:
            state = "queued" if item.run is None else "paused" if item.state == STOPPED else item.state
            self._store.change(item.id, state=state, desired_state=str(DesiredState.RUN), ended=None)
        self._shared.note(by, "resume", item.id)
        self._shared.wake()
        return self.item(item.id)
