"""The queue of the daemon's campaigns: what is submitted, its order, and what operators want of each.

`CampaignQueue` stores every wish before it acts on it. The rig workers (`rig_worker`) take campaigns from the store.
"""

from __future__ import annotations

import asyncio
import secrets
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

from orchestrator.daemon.daemon_store import ENDED, PAUSED, STOPPED, WITHDRAWN, DesiredState, QueueItem
from orchestrator.daemon.emergency_stop import EmergencyStops
from orchestrator.daemon.rig_worker import SharedServices
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.run_tasks import POUR


class RequestRefusedError(RunError):
    """The request can't be fulfilled now; the message gives the reason."""


class CampaignQueue:
    """Submitted campaigns, and the reservations of rigs.

    Args:
        shared: what the parts of the daemon share.
        stops: emergency stops; while one is latched, no work is accepted.
    """

    def __init__(self, shared: SharedServices, stops: EmergencyStops) -> None:
        self._shared, self._store, self._stops = shared, shared.store, stops

    def new_key(self) -> str:
        """Return a random key that no campaign's id ends with."""
        while True:
            key = secrets.token_hex(3)
            if not self._store.rows("select 1 from campaign where id like ?", f"%{key}"):
                return key

    def submit(self, items: Sequence[QueueItem], enter: Callable[[int], None] = lambda at: None) -> list[QueueItem]:
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
        with self._store.together():
            for at, item in enumerate(items):
                last = self._store.rows("select coalesce(max(rank), 0) as rank from campaign")[0]["rank"]
                added.append(replace(item, rank=float(last) + 1.0, created=time.time()))
                self._store.add(added[-1])
                enter(at)
        for item in added:
            self._shared.note(item.by, "submit", item.id)
        self._shared.wake()
        return added

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
        """Return a campaign by its id or a unique prefix of three letters or more. Raises KeyError."""
        found = self._store.item(key)
        if found is None and len(key) >= 3:
            similar = [one for one in self._store.items() if one.id.startswith(key)]
            found = similar[0] if len(similar) == 1 else None
        if found is None:
            raise KeyError(key)
        return found

    def _queued(self, key: str, what: str) -> QueueItem:
        item = self.item(key)
        if item.state != "queued":
            raise RequestRefusedError(f"{item.id} is {item.state}; only a queued campaign {what}")
        return item

    def move(self, key: str, by: str, *, before: str | None = None, priority: int | None = None) -> QueueItem:
        """Move a queued campaign in front of another one or to the head (''), or change its priority.

        Raises:
            KeyError: the campaign does not exist.
            RequestRefusedError: it is not queued.
        """
        item = self._queued(key, "has a place in the queue")
        if priority is not None:
            self._store.change(item.id, priority=priority)
        if before is not None:
            queue = [one for one in self._store.items(["queued"]) if one.id != item.id]
            at = 0 if before == "" else next((i for i, one in enumerate(queue) if one.id == self.item(before).id), None)
            if at is None:
                raise RequestRefusedError(f"{before} is not in the queue")
            level = queue[at].priority if queue else item.priority
            behind = queue[at].rank if queue else 1.0
            ahead = queue[at - 1].rank if at > 0 and queue[at - 1].priority == level else behind - 2.0
            self._store.change(item.id, priority=level, rank=0.5 * (ahead + behind))
        self._shared.note(by, "move", item.id)
        self._shared.wake()
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
        number = self._store.write(
            "insert into reservation (rig, by, begins, ends, note) values (?, ?, ?, ?, ?)", *values
        )
        self._shared.note(by, "reserve", detail=f"rig {rig}")
        self._shared.wake()
        return next(one for one in self.reservations() if one["id"] == number)

    def reservations(self) -> list[dict[str, Any]]:
        """Return the reservations that have not ended, in the order of their begin."""
        return self._store.rows("select * from reservation where ends > ? order by begins, id", time.time())

    def cancel_reservation(self, number: int, by: str) -> None:
        """Cancel a reservation. Raises KeyError."""
        if not self._store.rows("select id from reservation where id = ?", number):
            raise KeyError(number)
        self._store.write("delete from reservation where id = ?", number)
        self._shared.note(by, "cancel reservation", detail=str(number))
        self._shared.wake()

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
            if item.state == "queued":
                self._store.change(
                    item.id, state=WITHDRAWN if desired is DesiredState.STOP else "paused", reason=f"by {by}"
                )
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

    def change(self, key: str, by: str, *, hold: bool | None = None, not_before: float | None = None) -> QueueItem:
        """Hold or release a queued campaign, or set its earliest start; 0 removes it.

        Raises:
            KeyError: the campaign does not exist.
            RequestRefusedError: it is not queued.
        """
        item = self._queued(key, "can be held or postponed")
        if hold is not None:
            self._store.change(item.id, held=hold)
        if not_before is not None:
            self._store.change(item.id, not_before=not_before or None)
        self._shared.note(by, "release" if hold is False else "hold" if hold else "postpone", item.id)
        self._shared.wake()
        return self.item(item.id)

    def resume(self, key: str, by: str) -> QueueItem:
        """Resume a campaign that is at rest.

        Raises:
            RequestRefusedError: it is not at rest, or no new work is accepted.
        """
        item = self.item(key)
        self.refuse_new_work(item.rig)
        if item.state in (STOPPED, WITHDRAWN) and item.run is None:
            self._store.change(item.id, state="queued", desired_state=str(DesiredState.RUN), reason="")
        elif self._shared.running(item) is not None or item.state in ("queued", "finished"):
            raise RequestRefusedError(f"{item.id} is {item.state}; it can be resumed when it is paused")
        else:
            state = "queued" if item.run is None else "paused" if item.state == STOPPED else item.state
            self._store.change(item.id, state=state, desired_state=str(DesiredState.RUN), ended=None)
        self._shared.note(by, "resume", item.id)
        self._shared.wake()
        return self.item(item.id)
