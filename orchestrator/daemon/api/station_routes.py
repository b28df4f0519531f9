"""Routes of the HTTP API for other programs: ordered pours and materials.

The logic is in `ordering` and `materials`. A refusal has status 409 with the reason, an invalid order 422.
"""

from __future__ import annotations

import contextlib
from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Query, Response
from pydantic import Field

from actors.places import PlaceName
from orchestrator.daemon.api.access_control import Daemon, Operator, Orders, Queue, Viewer
from orchestrator.daemon.rigs.campaign_queue import RequestRefusedError
from orchestrator.daemon.rigs.materials import MaterialError, MaterialsOut, mass_of
from orchestrator.daemon.rigs.ordering import Ordering, PourOut
from orchestrator.daemon.rigs.pour_request import CallerId, PourIn, Quantity, RequestModel
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import SubmissionError
from orchestrator.learning.run_errors import RunError
from orchestrator.materials.vessel_account import AccountOut

LONGEST_WAIT = 600.0
"""Longest time that a request may wait for its pour [s]."""

router = APIRouter(tags=["station"])

ResourceId = Annotated[str, Field(pattern=r"^[A-Za-z0-9][A-Za-z0-9._-]{0,59}$")]

Wait = Annotated[float, Query(ge=0.0, le=LONGEST_WAIT, description="Return as soon as the pour rests [s].")]


class LiquidIn(RequestModel):
    """A liquid."""

    id: ResourceId
    code: str = Field(default="", max_length=80)
    """Bar code."""

    properties: dict[str, Any] = Field(default_factory=dict, max_length=10)
    """As in a campaign's `liquid`, without its mass: {'name': 'ethanol'}, or density and viscosity."""


class PositionIn(RequestModel):
    """A place at a rig where one vessel can stand."""

    id: PlaceName
    """In a laboratory with places, the name of one of them, such as 'rack/A1'."""

    code: str = Field(default="", max_length=80)
    rig: str = Field(max_length=60)
    note: str = Field(default="", max_length=200)


class VesselIn(RequestModel):
    """A vessel, registered as empty."""

    id: ResourceId
    code: str = Field(default="", max_length=80)
    shape: dict[str, Any] = Field(max_length=10)
    """As in a vessel file: {'profile': {'unit': 'mm', 'inner': [[0, 0], [30, 0], [30, 70]], 'wall': '4 mm'}}."""

    position: str = Field(default="", max_length=60)


class PlaceIn(RequestModel):
    """Another position of a vessel."""

    position: str = Field(max_length=80)
    """Id or code; '' for none."""


class WeighingIn(RequestModel):
    """The content of a vessel, as weighed by an operator."""

    mass: Quantity
    deviation: Quantity = "0.1 g"
    """Standard deviation of the mass."""

    liquid: str = Field(default="", max_length=80)
    """Id or code; '' keeps the present one."""

    note: str = Field(default="", max_length=200)


class HandPourIn(RequestModel):
    """A pour that a person has made and weighed."""

    id: CallerId
    source: str = Field(max_length=200)
    """Id or code, or LABORATORY/VESSEL for the source of a campaign."""

    receiver: str = Field(max_length=200)
    """As `source`."""

    mass: Quantity
    """Weighed in the receiver."""

    deviation: Quantity = "0.1 g"
    """Standard deviation of the mass."""

    note: str = Field(default="", max_length=200)


@contextlib.contextmanager
def _answering() -> Iterator[None]:
    """Convert refusals and errors to responses."""
    try:
        yield
    except RequestRefusedError as error:
        raise HTTPException(409, str(error)) from None
    except (MaterialError, SubmissionError) as error:
        raise HTTPException(422, str(error)) from None
    except KeyError as error:
        raise HTTPException(404, f"there is no '{str(error.args[0])[:80]}'") from None
    except OSError as error:
        raise HTTPException(503, f"the account of the vessels can't be used: {error}") from None
    except RunError as error:
        raise HTTPException(422 if error.exit_code == 2 else 409, str(error)) from None


# ---- pours


@router.post(
    "/pours",
    status_code=201,
    operation_id="order_pour",
    responses={200: {"model": PourOut, "description": "A dry run, or a pour that this order has made before."}},
)
async def order_pour(orders: Orders, person: Operator, body: PourIn, response: Response, wait: Wait = 0.0) -> PourOut:
    """Pour an amount or an action from one vessel into another, or predict it.

    The call is idempotent: repeated with the same `id` and the same order, it returns the pour and never pours again.
    Another order with the same `id` is refused.
    """
    with _answering():
        if body.dry_run or orders.book.find(body.id) is not None:
            response.status_code = 200
        pour = await orders.pour(body, person.name)
        return await orders.wait(body.id, wait) if wait and not body.dry_run else pour


@router.get("/pours", operation_id="pours")
async def pours(
    orders: Orders,
    person: Viewer,
    limit: Annotated[int, Query(ge=1, le=1000)] = 100,
    source: Annotated[str, Query(max_length=60, description="Only pours from this vessel.")] = "",
) -> list[PourOut]:
    """List ordered pours, newest first."""
    return [await orders.pour_out(key) for key in orders.book.ids(limit, source)]


@router.get("/pours/{key}", operation_id="pour")
async def pour(orders: Orders, person: Viewer, key: str, wait: Wait = 0.0) -> PourOut:
    """Return one pour by its caller's id."""
    with _answering():
        return await orders.wait(key, wait)


@router.post("/pours/{key}/cancel", operation_id="cancel_pour")
async def cancel_pour(queue: Queue, orders: Orders, person: Operator, key: str) -> PourOut:
    """Remove a pour from the queue. A pour that has begun is finished and weighed."""
    with _answering():
        campaign = orders.campaign_of(key)
        if (await orders.pour_out(key)).result is None and queue.item(campaign).state != "withdrawn":
            queue.stop(campaign, person.name)
        return await orders.pour_out(key)


@router.post("/pours/{key}/pause", operation_id="pause_pour")
async def pause_pour(queue: Queue, orders: Orders, person: Operator, key: str) -> PourOut:
    """Pause before the pour begins. A pour that has begun is finished and weighed."""
    with _answering():
        queue.pause(orders.campaign_of(key), person.name)
        return await orders.pour_out(key)


@router.post("/pours/{key}/resume", operation_id="resume_pour")
async def resume_pour(queue: Queue, orders: Orders, person: Operator, key: str) -> PourOut:
    """Resume a paused pour. If its outcome is unknown, an operator is asked first."""
    with _answering():
        queue.resume(orders.campaign_of(key), person.name)
        return await orders.pour_out(key)


# ---- materials


@router.get("/materials", operation_id="materials")
async def materials(daemon: Daemon, orders: Orders, person: Viewer) -> MaterialsOut:
    """List liquids, vessels with their contents, and positions."""
    return orders.materials.everything(daemon.running_laboratories)


@router.get("/materials/account", operation_id="account")
async def account(
    orders: Orders,
    person: Viewer,
    vessel: Annotated[str, Query(max_length=200)] = "",
    limit: Annotated[int, Query(ge=1, le=100_000)] = 1000,
) -> list[AccountOut]:
    """Return the last entries of the account of one vessel or of all, oldest first."""
    with _answering():
        name = vessel if not vessel or "/" in vessel else orders.materials.vessel(vessel).id
        return [content.entry for content in reversed(orders.materials.account.history(name, limit))]


@router.post("/materials/liquids", status_code=201, operation_id="add_liquid")
async def add_liquid(daemon: Daemon, orders: Orders, person: Operator, body: LiquidIn) -> MaterialsOut:
    """Register a liquid."""
    with _answering():
        orders.materials.add_liquid(body.id, body.code, body.properties)
    return _changed(daemon, orders, person.name, "register liquid", body.id)


@router.post("/materials/positions", status_code=201, operation_id="add_position")
async def add_position(daemon: Daemon, orders: Orders, person: Operator, body: PositionIn) -> MaterialsOut:
    """Register a position of a rig."""
    if body.rig not in daemon.workers:
        raise HTTPException(404, f"there is no rig '{body.rig}'")
    with _answering():
        orders.materials.add_position(body.id, body.code, body.rig, body.note)
    return _changed(daemon, orders, person.name, "register position", body.id)


@router.post("/materials/vessels", status_code=201, operation_id="add_vessel")
async def add_vessel(daemon: Daemon, orders: Orders, person: Operator, body: VesselIn) -> MaterialsOut:
    """Register an empty vessel."""
    with _answering():
        orders.materials.add_vessel(body.id, body.code, body.shape, body.position, person.name)
    return _changed(daemon, orders, person.name, "register vessel", body.id)


@router.post("/materials/vessels/{key:path}/weighed", operation_id="weigh_vessel")
async def weigh_vessel(daemon: Daemon, orders: Orders, person: Operator, key: str, body: WeighingIn) -> MaterialsOut:
    """Correct the content of a vessel by a weighing, or enter a filling."""
    with _answering():
        mass, deviation = mass_of(body.mass, "mass"), mass_of(body.deviation, "deviation")
        orders.materials.weigh(key, mass, deviation, body.liquid, person.name, body.note)
    return _changed(daemon, orders, person.name, "weigh vessel", f"{key}: {body.mass}")


@router.post("/materials/pours", operation_id="enter_pour_by_hand")
async def enter_pour_by_hand(daemon: Daemon, orders: Orders, person: Operator, body: HandPourIn) -> MaterialsOut:
    """Enter a pour that a person has made and weighed. A repeated call with the same `id` changes nothing."""
    with _answering():
        mass, deviation = mass_of(body.mass, "mass"), mass_of(body.deviation, "deviation")
        orders.materials.poured_by_hand(body.id, body.source, body.receiver, mass, deviation, person.name, body.note)
    return _changed(
        daemon, orders, person.name, "enter pour", f"{body.id}: {body.mass} from {body.source} into {body.receiver}"
    )


@router.post("/materials/vessels/{key:path}/place", operation_id="place_vessel")
async def place_vessel(daemon: Daemon, orders: Orders, person: Operator, key: str, body: PlaceIn) -> MaterialsOut:
    """Record that a vessel was moved to another position, or to a place of its laboratory."""
    with _answering():
        orders.materials.place(key, body.position, person.name)
    return _changed(daemon, orders, person.name, "place vessel", f"{key}: {body.position or 'nowhere'}")


def _changed(daemon: SharedServices, orders: Ordering, by: str, change: str, detail: str) -> MaterialsOut:
    daemon.note(by, change, detail=detail)
    return orders.materials.everything(daemon.running_laboratories)
