"""Takes the orders of other programs, pours and campaigns, once each, whatever happens to the connection.

`Ordering.pour` places an order and returns it; the same order again returns the pour that exists. `Ordering.campaign`
does the same for a campaign. `Ordering.pour_out` is the state of a pour with its result. An order is placed in a task
of its own, so a caller that disconnects does not interrupt it.
"""

from __future__ import annotations

import asyncio
import shutil
import time
from collections.abc import Callable, Coroutine
from typing import Any, Literal, TypeVar

from actors.interfaces import InvalidActionError, LaboratoryError
from orchestrator.daemon.rigs.campaign_queue import CampaignQueue, RequestRefusedError
from orchestrator.daemon.rigs.materials import SURE, Materials
from orchestrator.daemon.rigs.pour_orders import (
    OrderBook,
    OrderError,
    PlacedOrder,
    PourOrder,
    PredictionOut,
    WeighedOut,
    refusal,
    settled_pour,
)
from orchestrator.daemon.rigs.pour_request import PourIn, ResponseModel, SubmissionIn
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import Submission, planned_order, prepare, receive
from orchestrator.daemon.state.daemon_store import REFUSED, QueueItem
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.stages import POUR

WAIT = 0.1
"""Interval at which a waiting call reads the state of its pour [s]."""

RESTING = ("weighed", "failed", "unknown", "cancelled", "paused", "dry run")
"""States in which a pour does not change by itself."""


PourState = Literal[
    "dry run", "queued", "running", "waiting for operator", "paused", "weighed", "failed", "unknown", "cancelled"
]

Placed = TypeVar("Placed")


class LimitsOut(ResponseModel):
    """Limits of a pour from this source into this receiver."""

    available_g: float
    """In the source for certain, without amounts that are promised to other pours."""

    room_ml: float
    """Free volume of the receiver up to the brim."""


class PourOut(ResponseModel):
    """An ordered pour."""

    id: str
    campaign: str
    """Id of its campaign in the queue; '' for a dry run."""

    state: PourState
    """'unknown': it has begun and has no outcome; an operator reports it. It is never repeated by software."""

    reason: str
    """Reason of the state."""

    needs_enabling: bool
    """It waits until an operator enables the motion of the hardware."""

    source: str
    receiver: str
    amount_g: float | None
    order: dict[str, Any]
    """The request."""

    limits: LimitsOut | None = None
    """Only in a dry run."""

    predicted: PredictionOut | None
    result: WeighedOut | None
    run: str | None
    """Name of its run's folder."""

    created: float | None
    ended: float | None
    seconds_left: float | None = None
    """Expected time until it ends, while it runs."""


class Ordering:
    """Orders of one daemon.

    Args:
        daemon: what the parts of the daemon share.
        queue: takes the orders.
    """

    def __init__(self, daemon: SharedServices, queue: CampaignQueue) -> None:
        self._daemon, self._queue = daemon, queue
        self.materials, self.book = Materials(daemon.store, daemon.settings.laboratories), OrderBook(daemon.store)
        self._placing: dict[str, asyncio.Task[Any]] = {}

    async def pour(self, request: PourIn, by: str) -> PourOut:
        """Place an order, or return the pour that this order has made already.

        Args:
            request: the order.
            by: who orders it.

        Raises:
            OrderError, MaterialError, SubmissionError: the order is invalid.
            RequestRefusedError: it can't be served now, or its id belongs to another order.
        """
        if request.dry_run:
            return await self._dry_run(request, by)
        body = request.model_dump()
        if await self._once(f"pour {request.id}", lambda: self._place(request, body, by)) != body:
            raise RequestRefusedError(
                f"id {request.id} belongs to another order; give every pour an id of its own. Nothing was queued"
            )
        return await self.pour_out(request.id)

    async def campaign(self, request: SubmissionIn, by: str) -> tuple[QueueItem, bool]:
        """Take a campaign to be checked and queued, or return the one that the same content with the same id made.

        Args:
            request: the campaign; without an id, every call queues one.
            by: who submits it.

        Returns:
            The campaign, and whether this request made it.

        Raises:
            SubmissionError: the campaign can't be loaded.
            RequestRefusedError: no new work is accepted, or the id belongs to another campaign.
        """
        key = self._queue.new_key()
        return await self._once(f"campaign {key}", lambda: self._place_campaign(request, key, by))

    async def _place_campaign(self, request: SubmissionIn, key: str, by: str) -> tuple[QueueItem, bool]:
        if self._daemon.store.by_caller_id(request.id) is None:
            self._queue.refuse_new_work()
        after = None if request.after is None else self._queue.resolved_after(request.after.model_dump())
        submission = Submission(**request.model_dump(exclude={"id", "after"}), after=after)
        item = await asyncio.to_thread(receive, self._daemon.settings, submission, key, by)
        earlier = self._daemon.store.by_caller_id(request.id)
        if earlier is not None:
            if earlier.body_hash == item.body_hash:
                await self._forget(item)
                return earlier, False
            if earlier.state != REFUSED:
                await self._forget(item)
                raise RequestRefusedError(
                    f"id {request.id} belongs to another campaign, {earlier.id}; give every campaign an id of its own. "
                    "Nothing was queued"
                )
            self._daemon.store.change(earlier.id, caller_id="")
        return await self._enqueue(item.model_copy(update={"caller_id": request.id})), True

    async def _once(self, key: str, work: Callable[[], Coroutine[Any, Any, Placed]]) -> Placed:
        """Do the same work once for all who ask for it while it lasts; a caller that leaves does not end it."""
        task = self._placing.get(key)
        if task is None:
            task = self._placing[key] = asyncio.create_task(work(), name=key)
            task.add_done_callback(lambda done: self._placing.pop(key, None))
        placed: Placed = await asyncio.shield(task)
        return placed

    async def _place(self, request: PourIn, body: dict[str, Any], by: str) -> dict[str, Any]:
        """Place an order if its id has none; return the request that the id belongs to."""
        if (earlier := self.book.find(request.id)) is not None:
            return earlier.body
        item, order, predicted = await self._prepared(request, by)

        def enter() -> None:
            """Within the transaction of its campaign: the amounts of orders before it are promised already."""
            if reason := refusal(order, self.materials, self._daemon.settings.rig(item.rig).spec):
                raise RequestRefusedError(f"{order.id}: {reason}")
            self.book.add(order, item.id, body, predicted)

        await self._enqueue(item, enter)
        return body

    async def _enqueue(self, item: QueueItem, enter: Callable[[], None] = lambda: None) -> QueueItem:
        try:
            return self._queue.submit(item, enter)
        except BaseException:
            await self._forget(item)
            raise

    async def _prepared(self, request: PourIn, by: str) -> tuple[QueueItem, PourOrder, PredictionOut | None]:
        """Check an order and store its snapshot; return them, and the prediction if it is wanted."""
        settings = self._daemon.settings
        order = PourOrder.of(request, self.materials)
        rig = self._rig(order, request.rig)
        if reason := refusal(order, self.materials, settings.rig(rig).spec):
            raise RequestRefusedError(reason)
        self._queue.refuse_new_work(rig)
        submission = Submission(
            task=POUR, rig=rig, priority=request.priority, order=order, not_before=request.not_before
        )
        item = await asyncio.to_thread(prepare, settings, submission, self._queue.new_key(), by)
        try:
            predicted = await self._predicted(item) if request.predict or request.dry_run else None
        except BaseException:
            await self._forget(item)
            raise
        return item, order, predicted

    def _rig(self, order: PourOrder, wanted: str) -> str:
        """The rig of a pour: the given one, that of the vessels, or the only one."""
        standing = {vessel: rig for vessel in (order.source, order.receiver) if (rig := self.materials.rig_of(vessel))}
        if len(set(standing.values()) | ({wanted} if wanted else set())) > 1:
            told = ", ".join(f"{vessel} stands at {rig}" for vessel, rig in standing.items())
            raise OrderError(f"rig: {told}" + (f", and {wanted} is wanted" if wanted else "") + "; move a vessel")
        names = [rig.name for rig in self._daemon.settings.rigs]
        name = wanted or next(iter(standing.values()), names[0] if len(names) == 1 else "")
        if name not in names:
            raise OrderError(f"rig: name one of {', '.join(names)}, or register the positions of the vessels")
        return name

    async def _predicted(self, item: QueueItem) -> PredictionOut:
        settings, warm = self._daemon.settings, self._daemon.warm
        planned = await asyncio.to_thread(planned_order, settings, item, settings.rig(item.rig))
        if planned.order.amount is None:
            await warm.open()
        try:
            return await planned.predict(warm.share)
        except (InvalidActionError, LaboratoryError) as error:
            raise OrderError(str(error)) from None

    async def _dry_run(self, request: PourIn, by: str) -> PourOut:
        item, order, predicted = await self._prepared(request, by)
        await self._forget(item)
        held, target = self.materials.content(order.source), self.materials.content(order.receiver)
        density = self.materials.liquid(order.liquid).density
        sure = (held.mass or 0.0) - SURE * held.deviation - self.materials.promised(order.source)
        room = self.materials.vessel(order.receiver).capacity - (target.mass or 0.0) / density
        return PourOut(
            id=order.id,
            campaign="",
            state="dry run",
            reason="nothing was poured",
            needs_enabling=False,
            source=order.source,
            receiver=order.receiver,
            amount_g=_grams(order.amount),
            order=request.model_dump(),
            limits=LimitsOut(available_g=1e3 * max(sure, 0.0), room_ml=1e6 * max(room, 0.0)),
            predicted=predicted,
            result=None,
            run=None,
            created=None,
            ended=None,
        )

    async def _forget(self, item: QueueItem) -> None:
        await asyncio.to_thread(shutil.rmtree, self._daemon.settings.snapshots / item.id, ignore_errors=True)

    # ---- states and results

    async def pour_out(self, key: str) -> PourOut:
        """Return a pour by its caller's id. Raises KeyError."""
        placed = self._placed(key)
        item = self._queue.item(placed.campaign)
        state, reason = await self._state(item, placed.result)
        placed = self._placed(key)
        progress = self._daemon.progress(item)
        return PourOut(
            id=key,
            campaign=item.id,
            state=state,
            reason=reason,
            needs_enabling=item.mode == "hardware" and not item.motion_enabled and state in ("queued", "paused"),
            source=placed.source,
            receiver=placed.receiver,
            amount_g=_grams(placed.amount),
            order=placed.body,
            predicted=placed.predicted,
            result=placed.result,
            run=item.run,
            created=item.created,
            ended=item.ended,
            seconds_left=None if progress is None else progress["seconds_left"],
        )

    def _placed(self, key: str) -> PlacedOrder:
        placed = self.book.find(key)
        if placed is None:
            raise KeyError(key)
        return placed

    async def _state(self, item: QueueItem, result: WeighedOut | None) -> tuple[PourState, str]:
        if result is not None:
            reason = item.reason or result.end
            if result.within_tolerance is False:
                reason = f"missed its tolerance: {result.received_g:.2f} g received, {result.error_g:+.2f} g off"
            return result.state, reason
        if item.state == "queued":
            return "queued", item.reason or self._queue.waits_for(item)
        if item.state in ("stopped", "withdrawn"):
            return "cancelled", item.reason
        if item.state in ("unknown", "waiting for operator") or (
            item.state in ("paused", "failed") and await self._begun(item)
        ):
            open_question = [q for q in self._daemon.store.questions(campaign=item.id) if q.kind == "bench"]
            return "waiting for operator" if open_question else "unknown", item.reason
        if item.state == "paused":
            return "paused", item.reason
        return ("failed" if item.state in ("failed", "finished") else "running"), item.reason

    async def _begun(self, item: QueueItem) -> bool:
        """Whether the journal of a resting pour has a beginning and no outcome."""
        if item.run is None:
            return False
        settings = self._daemon.settings
        try:
            rig = settings.rig(item.rig)
            settled = await asyncio.to_thread(settled_pour, settings.runs / item.run, settings.snapshots / item.id, rig)
        except (RunError, OSError, KeyError, ValueError):
            return True  # unreadable: it may have begun
        return settled is not None and settled.pour.state in ("under way", "unknown")

    async def wait(self, key: str, seconds: float) -> PourOut:
        """Return a pour as soon as it rests, or after a time [s]. Raises KeyError."""
        end = time.monotonic() + seconds
        while True:
            pour = await self.pour_out(key)
            if pour.state in RESTING or time.monotonic() >= end or self._daemon.stopping:
                return pour
            await asyncio.sleep(WAIT)

    def campaign_of(self, key: str) -> str:
        """Return the campaign's id of a pour. Raises KeyError."""
        return self._placed(key).campaign


def _grams(mass: float | None) -> float | None:
    return None if mass is None else 1e3 * mass
