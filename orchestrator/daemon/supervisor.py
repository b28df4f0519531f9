"""The supervisor of the daemon: queue, rigs, and the four ways to stop a campaign.

`Supervisor` has one rig worker (`rig_worker`) per rig and one for campaigns without a rig. Two campaigns never lease
the same rig, and rigs do not wait for each other. All campaigns share the simulators. HTTP, access control and the
restart of the process are in other modules.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
import secrets
import shutil
import sqlite3
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from actors.interfaces import LaboratoryError
from actors.laboratory import WarmSimulators
from orchestrator.daemon.daemon_settings import NO_RIG, DaemonSettings, Rig
from orchestrator.daemon.daemon_store import ENDED, STOPPED, WITHDRAWN, DesiredState, QueueItem, Store
from orchestrator.daemon.event_feed import Feed
from orchestrator.daemon.notifications import Counts
from orchestrator.daemon.pour_orders import OrderBook
from orchestrator.daemon.remote_operator import Asking
from orchestrator.daemon.rig_worker import RigWorker, Running, SharedServices, settle
from orchestrator.daemon.run_readout import Pours
from orchestrator.daemon.stop_request import later_stop, recorded_reason, unknown_rig
from orchestrator.learning.run_errors import RunError
from orchestrator.live_view.live_server import LiveView
from orchestrator.records.run_registry import make_state_directory
from orchestrator.runs.run_tasks import POUR

LEAVING = 10.0
"""Time for campaigns to stop after Ray has died [s]; then campaigns that don't pour are given up."""

PAUSED, EMERGENCY = "paused", "emergency"

UNSTORED = (RunError, OSError, sqlite3.Error)
"""Errors of a store that can't be used: none of them prevents a stop."""

LEAVING_STEPS = 4
"""Turns of the event loop in which the orders to stop leave the process, before the disk is written."""

ArmStops = dict[str, asyncio.Task[None]]
"""Stops that are under way, by rig."""

_log = logging.getLogger(__name__)


def _emergency_of(rig: str) -> str:
    """Name of the flag for the emergency stop of one rig."""
    return f"{EMERGENCY} {rig}"


class RequestRefusedError(RunError):
    """The request can't be fulfilled now; the message gives the reason."""


class Supervisor:
    """Runs submitted campaigns.

    Args:
        settings: settings in force.
        live: open live view for the runs.
    """

    def __init__(self, settings: DaemonSettings, live: LiveView | None = None) -> None:
        make_state_directory(settings.state)
        settings.runs.mkdir(parents=True, exist_ok=True)
        settings.snapshots.mkdir(parents=True, exist_ok=True)
        self.settings = settings
        self.store = Store(settings.state / "daemon.sqlite")
        self.feed = Feed(settings.state / "events.sqlite", settings.events, self._feed_broken)
        self.asking = Asking(self.store, self.feed.publish)
        self.warm = WarmSimulators(
            settings.simulators, in_process=settings.in_process, ray=settings.ray, tell=self._warn
        )
        self._shared = SharedServices(settings, self.store, self.feed, self.asking, self.warm, live)
        self.workers: dict[str, RigWorker] = {
            rig.name: RigWorker(self, rig, self._shared) for rig in (*settings.rigs, Rig(NO_RIG))
        }
        self.problems: dict[str, str] = {}
        self.notification_counts: dict[str, Counts] = {}
        self.pours = Pours()
        self.stopping = False
        self.suspect = False
        """Whether the simulators may have failed for good: they are restarted when no campaign uses them."""
        self.left = asyncio.Event()
        self._tasks: list[asyncio.Task[None]] = []
        self.began = time.time()

    async def start(self) -> None:
        """Recover the stored state and start all tasks."""
        await asyncio.to_thread(self._remove_unacknowledged, self.store.ids())
        for item in self.store.active():
            found = f"found {item.state} after the daemon had ended without a word"
            # without a run nothing has begun: it is in the queue again
            self.store.change(item.id, state="paused" if item.run is not None else "queued", reason=found)
            self.feed.publish("CampaignFound", {"state": item.state, "text": found}, item.id)
        for key in OrderBook(self.store).begun():
            await self.settle(self.item(key))
        self._tasks = [asyncio.create_task(self.feed.flushing(), name="feed")]
        self._tasks += [
            asyncio.create_task(worker.work(), name=f"rig {worker.rig.name}") for worker in self.workers.values()
        ]
        self._tasks += [
            asyncio.create_task(worker.watch_arm(), name=f"arm of {worker.rig.name}")
            for worker in self.workers.values()
        ]
        if self.settings.quick_start:
            self._tasks.append(asyncio.create_task(self._warm_up(), name="simulators"))
        self.feed.publish("DaemonStarted", {"rigs": [rig.name for rig in self.settings.rigs]})

    def _remove_unacknowledged(self, known: set[str]) -> None:
        """Delete snapshots of submissions that were not yet acknowledged when the daemon died."""
        for folder in self.settings.snapshots.iterdir():
            if folder.name not in known:
                shutil.rmtree(folder, ignore_errors=True)

    async def _warm_up(self) -> None:
        try:
            await self.warm.open()
        except LaboratoryError as error:
            self._warn(f"the simulators don't start: {error}")
        else:
            self.feed.publish("SimulatorsReady", {"simulators": self.warm.size})

    # ---- restart after Ray has died: work on a dead Ray never ends by itself

    @property
    def lost(self) -> str:
        """Name of the Ray process that has died; '' if all are running."""
        return self.warm.lost

    @property
    def pouring(self) -> bool:
        """Whether a pour is in progress on any rig."""
        return any(worker.running is not None and worker.running.pouring for worker in self.workers.values())

    def leave(self, lost: str) -> None:
        """Stop as much work as possible in order to restart; sets `left` at the end."""
        if not self.stopping:
            self.stopping = True
            self.problem(
                "ray", f"Ray has lost its {lost}: the daemon begins anew, and what ran goes on from its journal"
            )
            self._tasks.append(asyncio.create_task(self._stop_for_restart(), name="leaving"))

    async def _stop_for_restart(self) -> None:
        resting = [asyncio.ensure_future(worker.close()) for worker in self.workers.values()]
        await asyncio.wait(resting, timeout=LEAVING)
        for worker in self.workers.values():
            if worker.running is not None and not worker.running.pouring:
                worker.background(worker.running.give_up())
        await asyncio.wait(resting)
        self.feed.flush()
        self.left.set()

    async def close(self) -> None:
        """Stop all work at the next safe point, or at once after `hurry`."""
        self.stopping = True
        await asyncio.gather(*(worker.close() for worker in self.workers.values()))
        for task in self._tasks:
            task.cancel()
        await asyncio.gather(*self._tasks, return_exceptions=True)
        if not self.left.is_set():  # closing would block if Ray has died
            await self.warm.close()
        self.feed.publish("DaemonStopped", {})
        self.feed.close()
        self.store.close()

    def hurry(self) -> None:
        """Give all work up, after a second request to end."""
        for worker in self.workers.values():
            if worker.running is not None:
                worker.background(worker.running.give_up())

    # ---- the queue

    def new_key(self) -> str:
        """Return a random key that no campaign's id ends with."""
        while True:
            key = secrets.token_hex(3)
            if not self.store.rows("select 1 from campaign where id like ?", f"%{key}"):
                return key

    def submit(self, item: QueueItem) -> QueueItem:
        """Queue a campaign whose snapshot has been checked.

        Raises:
            RequestRefusedError: the daemon or the rig accepts no new work.
        """
        return self.submit_all([item], lambda at: None)[0]

    def submit_all(self, items: Sequence[QueueItem], enter: Callable[[int], None]) -> list[QueueItem]:
        """Queue campaigns whose snapshots have been checked, in their order: all or none.

        Args:
            items: the campaigns.
            enter: called with each index in the same transaction, after its campaign was stored; may raise.

        Raises:
            RequestRefusedError: the daemon or a rig accepts no new work, or `enter` refuses one.
        """
        for rig in {item.rig for item in items}:
            self.refuse_new_work(rig)
        added = []
        with self.store.together():
            for at, item in enumerate(items):
                added.append(replace(item, rank=self.store.last_rank() + 1.0, created=time.time()))
                self.store.add(added[-1])
                enter(at)
        for item in added:
            self.note(item.by, "submit", item.id)
        self.wake()
        return added

    def refuse_new_work(self, rig: str = "") -> None:
        """Raise RequestRefusedError if the daemon or one rig accepts no new work."""
        if self.emergency is not None:
            raise RequestRefusedError("the emergency stop is latched; requests are accepted again after it is cleared")
        if rig in self.emergencies:
            raise RequestRefusedError(
                f"the emergency stop of rig {rig} is latched; it accepts requests again after it is cleared"
            )
        if self.stopping:
            again = "ray" in self.problems
            raise RequestRefusedError(
                "the daemon is just beginning anew; try again" if again else "the daemon is ending"
            )

    def item(self, key: str) -> QueueItem:
        """Return a campaign by its id or a unique prefix of three letters or more. Raises KeyError."""
        found = self.store.item(key)
        if found is None and len(key) >= 3:
            similar = [one for one in self.store.items() if one.id.startswith(key)]
            found = similar[0] if len(similar) == 1 else None
        if found is None:
            raise KeyError(key)
        return found

    def move(self, key: str, by: str, *, before: str | None = None, priority: int | None = None) -> QueueItem:
        """Move a queued campaign in front of another one or to the head (''), or change its priority.

        Raises:
            KeyError: the campaign does not exist.
            RequestRefusedError: it is not queued.
        """
        item = self.item(key)
        if item.state != "queued":
            raise RequestRefusedError(f"{item.id} is {item.state}; only a queued campaign has a place in the queue")
        if priority is not None:
            self.store.change(item.id, priority=priority)
        if before is not None:
            queue = [one for one in self.store.items(["queued"]) if one.id != item.id]
            at = 0 if before == "" else next((i for i, one in enumerate(queue) if one.id == self.item(before).id), None)
            if at is None:
                raise RequestRefusedError(f"{before} is not in the queue")
            level = queue[at].priority if queue else item.priority
            behind = queue[at].rank if queue else 1.0
            ahead = queue[at - 1].rank if at > 0 and queue[at - 1].priority == level else behind - 2.0
            self.store.change(item.id, priority=level, rank=0.5 * (ahead + behind))
        self.note(by, "move", item.id)
        self.wake()
        return self.item(item.id)

    def reserve(self, rig: str, by: str, begins: float, ends: float, note: str) -> dict[str, Any]:
        """Reserve a rig for the campaigns of a user. What runs already is not interrupted.

        Raises:
            RequestRefusedError: another reservation overlaps.
        """
        for one in self.reservations():
            if one["rig"] == rig and one["by"] != by and begins < one["ends"] and one["begins"] < ends:
                raise RequestRefusedError(f"rig {rig} is reserved by {one['by']} (reservation {one['id']})")
        values = rig, by, begins, ends, note
        number = self.store.write(
            "insert into reservation (rig, by, begins, ends, note) values (?, ?, ?, ?, ?)", *values
        )
        self.note(by, "reserve", detail=f"rig {rig}")
        self.wake()
        return next(one for one in self.reservations() if one["id"] == number)

    def reservations(self) -> list[dict[str, Any]]:
        """Return the reservations that have not ended, in the order of their begin."""
        return self.store.rows("select * from reservation where ends > ? order by begins, id", time.time())

    def cancel_reservation(self, number: int, by: str) -> None:
        """Cancel a reservation. Raises KeyError."""
        if not self.store.rows("select id from reservation where id = ?", number):
            raise KeyError(number)
        self.store.write("delete from reservation where id = ?", number)
        self.note(by, "cancel reservation", detail=str(number))
        self.wake()

    def pause_queue(self, paused: bool, by: str) -> None:
        """Start no further campaigns, or start them again. Running campaigns continue."""
        self.store.set_flag(PAUSED, {"by": by, "time": time.time()} if paused else None)
        self.note(by, "pause queue" if paused else "resume queue")
        self.wake()

    @property
    def queue_paused(self) -> bool:
        """Whether the queue is paused."""
        return self.store.flag(PAUSED) is not None

    @property
    def emergency(self) -> dict[str, Any] | None:
        """The active emergency stop of all rigs, with its fields by, time and reason; None if there is none."""
        found: dict[str, Any] | None = self.store.flag(EMERGENCY)
        return found

    @property
    def emergencies(self) -> dict[str, dict[str, Any]]:
        """Active emergency stops of single rigs, by the rig's name."""
        stops = {rig.name: self.store.flag(_emergency_of(rig.name)) for rig in self.settings.rigs}
        return {name: stop for name, stop in stops.items() if stop is not None}

    def is_stopped(self, rig: str) -> bool:
        """Whether a rig may start nothing, because of its own emergency stop or that of all rigs."""
        return self.emergency is not None or rig in self.emergencies

    # ---- one campaign

    def pause(self, key: str, by: str) -> QueueItem:
        """Pause a campaign at the next checkpoint."""
        return self._end(key, by, DesiredState.PAUSE)

    def stop(self, key: str, by: str) -> QueueItem:
        """Stop a campaign: finish the pour and publish the results so far."""
        return self._end(key, by, DesiredState.STOP)

    def _end(self, key: str, by: str, desired: DesiredState) -> QueueItem:
        item = self.item(key)
        running = self._running(item)
        if running is None and item.state in ENDED:
            raise RequestRefusedError(f"{item.id} is {item.state} already")
        if running is not None:
            running.pause()
        self.store.change(item.id, desired_state=str(desired))
        self.note(by, str(desired), item.id)
        if running is None:
            if item.state == "queued":
                self.store.change(
                    item.id, state=WITHDRAWN if desired is DesiredState.STOP else "paused", reason=f"by {by}"
                )
            elif desired is DesiredState.STOP:
                self.store.change(item.id, state=STOPPED, ended=time.time(), reason=f"by {by}")
                if item.task == POUR:
                    self.workers[item.rig].background(self.settle(item, ended=True))
        self.wake()
        return self.item(item.id)

    async def abort(self, key: str, by: str) -> QueueItem:
        """Stop the motion of a campaign; see `Running.abort`."""
        item = self.item(key)
        running = self._running(item)
        if running is None:
            raise RequestRefusedError(f"{item.id} is {item.state}: nothing of it moves")
        stopping = asyncio.create_task(running.abort())
        await asyncio.sleep(0)
        self.store.change(item.id, desired_state=str(DesiredState.ABORT))
        self.note(by, "abort", item.id)
        await stopping
        return self.item(item.id)

    async def settle(self, item: QueueItem, *, ended: bool = False) -> None:
        """Store the result of an ordered pour that rests; see `rig_worker.settle`."""
        worker = self.workers.get(item.rig)
        if worker is not None:
            await settle(self._shared, item, worker.rig, ended=ended)

    def change(self, key: str, by: str, *, hold: bool | None = None, not_before: float | None = None) -> QueueItem:
        """Hold or release a queued campaign, or set its earliest start; 0 removes it.

        Raises:
            KeyError: the campaign does not exist.
            RequestRefusedError: it is not queued.
        """
        item = self.item(key)
        if item.state != "queued":
            raise RequestRefusedError(f"{item.id} is {item.state}; only a queued campaign can be held or postponed")
        if hold is not None:
            self.store.change(item.id, held=hold)
        if not_before is not None:
            self.store.change(item.id, not_before=not_before or None)
        self.note(by, "release" if hold is False else "hold" if hold else "postpone", item.id)
        self.wake()
        return self.item(item.id)

    def resume(self, key: str, by: str) -> QueueItem:
        """Resume a campaign that is at rest.

        Raises:
            RequestRefusedError: it is not at rest, or no new work is accepted.
        """
        item = self.item(key)
        self.refuse_new_work(item.rig)
        if item.state in (STOPPED, WITHDRAWN) and item.run is None:
            self.store.change(item.id, state="queued", desired_state=str(DesiredState.RUN), reason="")
        elif self._running(item) is not None or item.state in ("queued", "finished"):
            raise RequestRefusedError(f"{item.id} is {item.state}; it can be resumed when it is paused")
        else:
            state = "queued" if item.run is None else "paused" if item.state == STOPPED else item.state
            self.store.change(item.id, state=state, desired_state=str(DesiredState.RUN), ended=None)
        self.note(by, "resume", item.id)
        self.wake()
        return self.item(item.id)

    def _running(self, item: QueueItem) -> Running | None:
        worker = self.workers.get(item.rig)
        return worker.running if worker is not None and worker.running is not None and worker.holds(item.id) else None

    def progress(self, item: QueueItem) -> dict[str, Any] | None:
        """Return the progress of a running campaign; None for others."""
        running = self._running(item)
        return None if running is None else running.progress()

    # ---- all of them

    async def stop_arms(self, rig: str, stops: ArmStops) -> None:
        """Begin to stop the arm of a rig, or ('') every arm, and let nothing start there. Part of `emergency_stop`.

        Args:
            rig: an existing rig, or ''.
            stops: stops that the same request has begun; each arm is stopped once. Those that begin are added.
        """
        for worker in self._stops(rig)[1]:
            worker.latched = True
            if worker.running is not None and worker.rig.name not in stops:
                stops[worker.rig.name] = asyncio.create_task(worker.running.emergency())
        for _ in range(LEAVING_STEPS):
            await asyncio.sleep(0)

    def latch_stop(self, by: str, reason: str, rig: str = "") -> None:
        """Store an emergency stop, so that it holds after a restart. Authors and reasons of several are kept."""
        flag, workers = self._stops(rig)
        with contextlib.suppress(*UNSTORED):
            self.store.set_flag(flag, later_stop(self.store.flag(flag), by, reason, time.time()))
            for worker in workers:
                if worker.running is not None:
                    self.store.change(worker.running.item.id, desired_state=str(DesiredState.ABORT))

    async def emergency_stop(
        self,
        by: str,
        reason: object = "",
        rig: object = "",
        *,
        stops: ArmStops | None = None,
        notes: Sequence[str] = (),
    ) -> list[str]:
        """Stop every arm, give all work up, and accept nothing new until `clear`. The arms are stopped first.

        Args:
            by: user who triggers the stop.
            reason: reason, if given; its first 500 printable characters are recorded.
            rig: stop only this rig; '' for all. The stop of all rigs and that of one are set and cleared separately.
                A rig that does not exist stops all.
            stops: stops that the same request has begun before; see `stop_arms`.
            notes: what was changed or ignored in the request.

        Returns:
            These notes, and others on reason and rig. The audit entry has them, too.
        """
        scope, found = self.stop_scope(rig)
        stops = {} if stops is None else stops
        await self.stop_arms(scope, stops)
        text, changes = recorded_reason(reason)
        self.latch_stop(by, text, scope)
        found = [*notes, *found, *changes]
        with contextlib.suppress(*UNSTORED):
            detail = ": ".join(filter(None, (f"rig {scope}" if scope else "", text)))
            self.note(by, "emergency stop", detail=f"{detail} ({'; '.join(found)})".lstrip() if found else detail)
        await asyncio.gather(*stops.values(), return_exceptions=True)
        return found

    def stop_scope(self, rig: object) -> tuple[str, list[str]]:
        """Return the rig that a stop is for, '' for all, and a note if the wanted rig does not exist."""
        if isinstance(rig, str) and (not rig or rig in self.rig_names):
            return rig, []
        return "", [unknown_rig(rig)]

    @property
    def rig_names(self) -> list[str]:
        """Names of the rigs, in the order of the settings."""
        return [rig.name for rig in self.settings.rigs]

    def clear(self, by: str, rig: str = "") -> None:
        """Accept work again. Work that was given up rests until an operator resumes it.

        Args:
            by: user who clears the stop.
            rig: rig whose own emergency stop is cleared; '' for that of all rigs.

        Raises:
            KeyError: the rig does not exist.
        """
        flag, workers = self._stops(rig)
        self.store.set_flag(flag, None)
        for worker in workers:
            worker.latched = self.is_stopped(worker.rig.name)
        self.note(by, "clear emergency stop", detail=f"rig {rig}" if rig else "")
        self.wake()

    def _stops(self, rig: str) -> tuple[str, list[RigWorker]]:
        """Return the flag of an emergency stop and the rig workers it affects. Raises KeyError."""
        if not rig:
            return EMERGENCY, list(self.workers.values())
        if rig not in self.rig_names:
            raise KeyError(rig)
        return _emergency_of(rig), [self.workers[rig]]

    # ---- helpers

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
            self._warn(text)

    def _warn(self, text: str) -> None:
        _log.warning(text)
        self.feed.publish("LogLine", {"level": "warning", "text": text, "stage": ""})

    def _feed_broken(self, text: str) -> None:
        self.problems["events"] = text
        _log.error(text)
