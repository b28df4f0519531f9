"""Takes orders of other programs: pours and batches, once each, whatever happens to the connection.

`Ordering.pour` places an order and returns it; the same order again returns the pour that exists. `Ordering.batch`
takes a list of pours and campaigns, or none of them. `Ordering.pour_out` is the state of a pour with its result. An
order is placed in a task of its own, so a caller that disconnects does not interrupt it.
"""

from __future__ import annotations

import asyncio
import json
import shutil
import time
from collections.abc import Callable, Coroutine, Sequence
from dataclasses import dataclass
from typing import Any

from actors.interfaces import InvalidActionError, LaboratoryError
from orchestrator.daemon.campaign_queue import CampaignQueue, RequestRefusedError
from orchestrator.daemon.daemon_store import QueueItem
from orchestrator.daemon.materials import SURE, Materials
from orchestrator.daemon.pour_orders import OrderBook, OrderError, PourOrder, settled_pour
from orchestrator.daemon.pour_request import PourIn
from orchestrator.daemon.rig_worker import SharedServices
from orchestrator.daemon.station_schemas import BatchIn
from orchestrator.daemon.submissions import Submission, planned_order, prepare
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.run_tasks import POUR

WAIT = 0.1
"""Interval at which a waiting call reads the state of its pour [s]."""

RESTING = ("weighed", "failed", "unknown", "cancelled", "paused", "dry run")
"""States in which a pour does not change by itself."""


class DifferentOrderError(RequestRefusedError):
    """The id belongs to another order."""


@dataclass(frozen=True)
class Prepared:
    """A checked submission, not yet in the queue.

    Attributes:
        item: with its snapshot.
        order: of a pour, with its request and its prediction; None for a campaign.
    """

    item: QueueItem
    order: tuple[PourOrder, dict[str, Any], dict[str, Any] | None] | None = None


class Ordering:
    """Orders of one daemon.

    Args:
        daemon: what the parts of the daemon share.
        queue: takes the orders.
    """

    def __init__(self, daemon: SharedServices, queue: CampaignQueue) -> None:
        self._daemon, self._queue = daemon, queue
        self.materials, self.book = Materials(daemon.store), OrderBook(daemon.store)
        self._placing: dict[str, asyncio.Task[Any]] = {}

    async def pour(self, request: PourIn, by: str) -> dict[str, Any]:
        """Place an order, or return the pour that this order has made already.

        Args:
            request: the order.
            by: who orders it.

        Returns:
            The pour, as `PourOut`.

        Raises:
            OrderError, MaterialError, SubmissionError: the order is invalid.
            RequestRefusedError: it can't be served now, or its id belongs to another order.
        """
        if request.dry_run:
            return await self._dry_run(request, by)
        await self._once(f"pour {request.id}", lambda: self._place(request, by))
        return await self.pour_out(request.id)

    async def _once(self, key: str, work: Callable[[], Coroutine[Any, Any, None]]) -> None:
        """Do the same work once for all who ask for it while it lasts; a caller that leaves does not end it."""
        task = self._placing.get(key)
        if task is None:
            task = self._placing[key] = asyncio.create_task(work(), name=key)
            task.add_done_callback(lambda done: self._placing.pop(key, None))
        await asyncio.shield(task)

    async def _place(self, request: PourIn, by: str) -> None:
        body = request.model_dump()
        if (known := self.book.find(request.id)) is not None:
            if known["body"] != body:
                raise DifferentOrderError(
                    f"id {request.id} belongs to another order; give every pour an id of its own. Nothing was queued"
                )
            return
        prepared = await self._prepared(request, by)
        await self._enqueue([prepared])

    async def _prepared(self, request: PourIn, by: str, batch: str = "") -> Prepared:
        """Check an order and store its snapshot.

        Args:
            request: the order.
            by: who orders it.
            batch: id of its batch.
        """
        settings = self._daemon.settings
        order = PourOrder.of(request, self.materials)
        if reason := self._refusal(order):
            raise RequestRefusedError(reason)
        rig = self._rig(order, request.rig)
        self._queue.refuse_new_work(rig)
        submission = Submission(
            task=POUR, rig=rig, priority=request.priority, order=order, batch=batch, held=request.hold,
            not_before=request.not_before,
        )  # fmt: skip
        item = await asyncio.to_thread(prepare, settings, submission, self._queue.new_key(), by)
        try:
            predicted = await self._predicted(item) if request.predict or request.dry_run else None
        except BaseException:
            await self._forget([item])
            raise
        return Prepared(item, (order, request.model_dump(), predicted))

    def _refusal(self, order: PourOrder) -> str:
        more = order.tolerance
        return self.materials.refusal(order.source, order.receiver, order.liquid, order.amount, more, pour=order.id)

    def _rig(self, order: PourOrder, wanted: str) -> str:
        """The rig of a pour: the given one, that of the vessels, or the only one."""
        standing = {vessel: rig for vessel in (order.source, order.receiver) if (rig := self.materials.rig_of(vessel))}
        if len(set(standing.values()) | ({wanted} if wanted else set())) > 1:
            told = ", ".join(f"{vessel} stands at {rig}" for vessel, rig in standing.items())
            raise OrderError(f"rig: {told}" + (f", and {wanted} is wanted" if wanted else "") + "; move a vessel")
        names = [rig.name for rig in self._daemon.settings.rigs]
        found = wanted or next(iter(standing.values()), names[0] if len(names) == 1 else "")
        if found not in names:
            raise OrderError(f"rig: name one of {', '.join(names)}, or register the positions of the vessels")
        return found

    async def _predicted(self, item: QueueItem) -> dict[str, Any]:
        settings, warm = self._daemon.settings, self._daemon.warm
        planned = await asyncio.to_thread(planned_order, settings, item, settings.rig(item.rig))
        if planned.order.amount is None:
            await warm.open()
        try:
            return await planned.predict(warm.share)
        except (InvalidActionError, LaboratoryError) as error:
            raise OrderError(str(error)) from None

    async def _dry_run(self, request: PourIn, by: str) -> dict[str, Any]:
        prepared = await self._prepared(request, by)
        await self._forget([prepared.item])
        assert prepared.order is not None
        order, body, predicted = prepared.order
        held, there = self.materials.content(order.source), self.materials.content(order.receiver)
        density = self.materials.liquid(order.liquid).density
        sure = (held.mass or 0.0) - SURE * held.deviation - self.materials.promised(order.source)
        room = self.materials.vessel(order.receiver).capacity - (there.mass or 0.0) / density
        return {
            **{"id": order.id, "campaign": "", "state": "dry run", "reason": "nothing was poured"},
            **{"needs_enabling": False, "source": order.source, "receiver": order.receiver},
            **{"amount_g": _grams(order.amount), "order": body, "predicted": predicted, "result": None},
            "limits": {"available_g": 1e3 * max(sure, 0.0), "room_ml": 1e6 * max(room, 0.0)},
            **{"run": None, "created": None, "ended": None},
        }

    async def _enqueue(self, prepared: Sequence[Prepared], first: Callable[[], object] = lambda: None) -> None:
        """Add submissions to the queue, all or none; `first` is called in the same transaction."""

        def enter(at: int) -> None:
            if at == 0:
                first()
            self._enter(prepared[at])

        try:
            self._queue.submit([one.item for one in prepared], enter)
        except BaseException:
            await self._forget([one.item for one in prepared])
            raise

    def _enter(self, one: Prepared) -> None:
        """Within the transaction of its campaign: the amounts of orders before it are promised already."""
        if one.order is None:
            return
        order, body, predicted = one.order
        if reason := self._refusal(order):
            raise RequestRefusedError(f"{order.id}: {reason}")
        self.book.add(order, one.item.id, body, predicted)

    async def _forget(self, items: Sequence[QueueItem]) -> None:
        for item in items:
            await asyncio.to_thread(shutil.rmtree, self._daemon.settings.snapshots / item.id, ignore_errors=True)

    # ---- batches

    async def batch(self, request: BatchIn, by: str) -> dict[str, Any]:
        """Queue all items of a batch or none; the same batch again returns the one that exists.

        Raises:
            OrderError, MaterialError, SubmissionError: an item is invalid; the message begins with its place.
            RequestRefusedError: an item can't be served now, or the id belongs to another batch.
        """
        await self._once(f"batch {request.id}", lambda: self._place_batch(request, by))
        return await self.batch_out(request.id)

    async def _place_batch(self, request: BatchIn, by: str) -> None:
        store, body = self._daemon.store, json.dumps(request.model_dump())
        if known := store.rows("select body from batch where id = ?", request.id):
            if known[0]["body"] != body:
                raise DifferentOrderError(f"id {request.id} belongs to another batch. Nothing was queued")
            return
        self._queue.refuse_new_work()
        prepared: list[Prepared] = []
        at = 0
        try:
            for at, item in enumerate(request.items):  # noqa: B007  used in the message
                if item.pour is not None:
                    pour = item.pour
                    if pour.dry_run:
                        raise OrderError("dry_run: belongs to a single pour")
                    if self.book.find(pour.id) is not None or pour.id in _ids(prepared):
                        raise OrderError(f"id {pour.id} belongs to a pour already; give every pour an id of its own")
                    pour = pour.model_copy(
                        update={"hold": pour.hold or request.hold, "not_before": pour.not_before or request.not_before}
                    )
                    prepared.append(await self._prepared(pour, by, request.id))
                else:
                    assert item.campaign is not None
                    submission = Submission(
                        **item.campaign.model_dump(),
                        batch=request.id, held=request.hold, not_before=request.not_before,
                    )  # fmt: skip
                    key = self._queue.new_key()
                    prepared.append(
                        Prepared(await asyncio.to_thread(prepare, self._daemon.settings, submission, key, by))
                    )
        except RunError as error:
            await self._forget([one.item for one in prepared])
            kind = type(error) if isinstance(error, RequestRefusedError) else OrderError
            raise kind(f"items.{at}: {error}. Nothing of the batch was queued") from None
        except BaseException:
            await self._forget([one.item for one in prepared])
            raise
        values = request.id, request.name, by, time.time(), body

        statement = "insert into batch (id, name, by, created, body) values (?, ?, ?, ?, ?)"
        await self._enqueue(prepared, lambda: store.write(statement, *values))

    async def batch_out(self, key: str) -> dict[str, Any]:
        """Return a batch as `BatchOut`. Raises KeyError."""
        found = self._daemon.store.rows("select id, name, by, created from batch where id = ?", key)
        if not found:
            raise KeyError(key)
        items: list[dict[str, Any]] = []
        for item in self._daemon.store.batch_items(key):
            row = self.book.of_campaign(item.id)
            state = item.state if row is None else (await self._state(item, row))[0]
            items.append(
                {
                    **{"campaign": item.id, "pour": "" if row is None else row["id"], "state": state},
                    **{"reason": item.reason, "held": item.held, "not_before": item.not_before},
                    **{"priority": item.priority, "result": None if row is None else row["result"]},
                }
            )
        states: dict[str, int] = {}
        for one in items:
            states[one["state"]] = states.get(one["state"], 0) + 1
        return {**found[0], "states": states, "items": items}

    def batches(self, limit: int) -> list[str]:
        """Return the ids of batches, newest first."""
        return [row["id"] for row in self._daemon.store.rows("select id from batch order by rowid desc limit ?", limit)]

    # ---- states and results

    async def pour_out(self, key: str) -> dict[str, Any]:
        """Return a pour as `PourOut`. Raises KeyError."""
        row = self.book.find(key)
        if row is None:
            raise KeyError(key)
        item = self._queue.item(row["campaign"])
        state, reason = await self._state(item, row)
        row = self.book.find(key) or row
        progress = self._daemon.progress(item)
        return {
            **{"id": key, "campaign": item.id, "state": state, "reason": reason},
            "needs_enabling": item.mode == "hardware" and not item.motion_enabled and state in ("queued", "paused"),
            **{"source": row["source"], "receiver": row["receiver"], "amount_g": _grams(row["amount"])},
            **{"order": row["body"], "predicted": row["predicted"], "result": row["result"], "run": item.run},
            **{"created": item.created, "ended": item.ended},
            "seconds_left": None if progress is None else progress["seconds_left"],
        }

    async def _state(self, item: QueueItem, row: dict[str, Any]) -> tuple[str, str]:
        if row["result"] is not None:
            return str(row["result"]["state"]), item.reason or str(row["result"]["end"])
        if item.state == "queued":
            return "queued", "held" if item.held else item.reason
        if item.state in ("stopped", "withdrawn"):
            return "cancelled", item.reason
        if item.state in ("unknown", "waiting for operator") or (
            item.state in ("paused", "failed") and await self._begun(item)
        ):
            open_question = [one for one in self._daemon.store.questions(campaign=item.id) if one.kind == "bench"]
            return "waiting for operator" if open_question else "unknown", item.reason
        if item.state in ("paused", "failed"):
            return item.state, item.reason
        return ("failed" if item.state == "finished" else "running"), item.reason

    async def _begun(self, item: QueueItem) -> bool:
        """Whether the journal of a resting pour has a beginning and no outcome."""
        if item.run is None:
            return False
        settings = self._daemon.settings
        try:
            rig = settings.rig(item.rig)
            found = await asyncio.to_thread(settled_pour, settings.runs / item.run, settings.snapshots / item.id, rig)
        except (RunError, OSError, KeyError, ValueError):
            return True  # unreadable: it may have begun
        return found is not None and found.pour.state in ("under way", "unknown")

    async def wait(self, key: str, seconds: float) -> dict[str, Any]:
        """Return a pour as soon as it rests, or after a time [s]. Raises KeyError."""
        end = time.monotonic() + seconds
        while True:
            found = await self.pour_out(key)
            if found["state"] in RESTING or time.monotonic() >= end or self._daemon.stopping:
                return found
            await asyncio.sleep(WAIT)

    def campaign_of(self, key: str) -> str:
        """Return the campaign's id of a pour. Raises KeyError."""
        row = self.book.find(key)
        if row is None:
            raise KeyError(key)
        return str(row["campaign"])


def _ids(prepared: Sequence[Prepared]) -> set[str]:
    return {one.order[0].id for one in prepared if one.order is not None}


def _grams(mass: float | None) -> float | None:
    return None if mass is None else 1e3 * mass
