"""Routes of the HTTP API that change something; every command is recorded with its author.

The routes submit, pause, stop, abort, resume and move campaigns, enable motion, answer questions, and handle emergency
stops and shutdown. Motion is enabled for the coming part of one run, after the operator has read what will move and
typed the laboratory's name. Read-only routes are in `query_routes` and `archive_routes`.
"""

from __future__ import annotations

import asyncio
import contextlib
import logging
from collections.abc import Iterator
from typing import Annotated, Any

from fastapi import APIRouter, HTTPException, Path, Query, Request, Response
from fastapi.responses import JSONResponse

from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.daemon.api.access_control import Admin, Daemon, EarlyResponse, Operator, Orders, Queue, Stops, Viewer
from orchestrator.daemon.api.query_routes import campaign_out, found_item, status
from orchestrator.daemon.api.schemas import (
    AnswerIn,
    CampaignOut,
    ClearIn,
    EnableIn,
    EndingOut,
    MoveIn,
    StatusOut,
    StoppedOut,
    WhatMovesOut,
)
from orchestrator.daemon.rigs.campaign_queue import RequestRefusedError
from orchestrator.daemon.rigs.emergency_stop import UNSTORED, recorded_reason
from orchestrator.daemon.rigs.pour_request import SubmissionIn
from orchestrator.daemon.rigs.remote_operator import AnswerError
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import SubmissionError, run_request
from orchestrator.daemon.state.daemon_store import ENDED, QuestionOut, QueueItem
from orchestrator.learning.run_errors import RunError
from orchestrator.runs.motion_approval import campaign_pours, envelope, envelope_lines, pour_count, required_checksum

_log = logging.getLogger(__name__)


class MotionNotEnabledError(RunError):
    """Motion can't be enabled; the message gives the reason."""


def what_moves(daemon: SharedServices, item: QueueItem) -> WhatMovesOut:
    """Plan the campaign's motions again and describe them for the operator. Takes seconds.

    Raises:
        MotionNotEnabledError: nothing would move, or motion is not allowed.
    """
    if item.mode != "hardware":
        raise MotionNotEnabledError(f"{item.id} has no motion to enable: its rig is {item.mode}")
    if item.state in ENDED:
        raise MotionNotEnabledError(f"{item.id} is {item.state}")
    try:
        work = run_request(daemon.settings, item, daemon.settings.rig(item.rig))
        arm = work.campaign.laboratory.expected_arm
        assert arm is not None, "a laboratory of hardware has an arm"
        required_checksum(work.campaign)
        paths = envelope(arm, campaign_pours(work.campaign, work.stages))
    except (ConfigError, RunError, KeyError) as error:
        raise MotionNotEnabledError(str(error)) from None
    if not paths.reports:
        raise MotionNotEnabledError(
            f"none of {len(paths.refused)} actions could be poured by this arm: {paths.refused[0]}"
        )
    lines = [f"pours          up to {pour_count(work.campaign, work.stages)}", *envelope_lines(paths)]
    return WhatMovesOut(laboratory=work.campaign.laboratory.name, arm=arm.title, lines=lines)


def enable_motion(daemon: SharedServices, item: QueueItem, moves: WhatMovesOut, typed: str, by: str) -> None:
    """Enable motion.

    Raises:
        MotionNotEnabledError: the typed name is not the laboratory's.
    """
    if typed != moves.laboratory:
        raise MotionNotEnabledError(
            f"motion is not enabled: '{typed}' was typed, and the laboratory is {moves.laboratory}; nothing moves"
        )
    daemon.store.change(item.id, motion_enabled=True)
    daemon.note(by, "enable motion", item.id, moves.laboratory)
    daemon.wake()


StoppedRig = Annotated[
    list[str] | None, Query(description="Stop only this rig; '' for all. A rig that does not exist stops all.")
]
StopReason = Annotated[list[str] | None, Query(description="Text for the records; its first 500 characters are kept.")]

router = APIRouter()


@router.post(
    "/campaigns",
    status_code=201,
    operation_id="submit",
    responses={200: {"model": CampaignOut, "description": "A campaign that this request has queued before."}},
)
async def submit(
    daemon: Daemon, queue: Queue, orders: Orders, person: Operator, body: SubmissionIn, response: Response
) -> CampaignOut:
    """Take a campaign: it is loaded, stored with its files, checked as by `decant run`, and then queued.

    The response comes before the check, which may take minutes: the state is 'checking', and then 'queued', or
    'refused' with the reason. Later changes of the campaign's files don't affect it. Repeated with the same `id` and
    the same content, the call returns the campaign and queues nothing; a refused campaign frees its id for another one.
    """
    if bool(body.text) == bool(body.path) or (body.path and body.files):
        raise HTTPException(422, "give either 'text' (with 'files') or 'path'")
    with _refusing():
        try:
            item, new = await orders.campaign(body, person.name)
        except SubmissionError as error:
            raise HTTPException(422, str(error)) from None
    if not new:
        response.status_code = 200
    return campaign_out(daemon, queue, item)


@router.post("/campaigns/{key}/pause", operation_id="pause")
async def pause(daemon: Daemon, queue: Queue, person: Operator, key: str) -> CampaignOut:
    """Pause at the next checkpoint; a pour that has started is finished and weighed."""
    with _refusing():
        return campaign_out(daemon, queue, queue.pause(key, person.name))


@router.post("/campaigns/{key}/stop", operation_id="stop")
async def stop(daemon: Daemon, queue: Queue, person: Operator, key: str) -> CampaignOut:
    """Stop at the next checkpoint and publish the results so far. The campaign does not continue by itself."""
    with _refusing():
        return campaign_out(daemon, queue, queue.stop(key, person.name))


@router.post("/campaigns/{key}/abort", operation_id="abort")
async def abort(daemon: Daemon, queue: Queue, person: Operator, key: str) -> CampaignOut:
    """Stop the motion. A tilted vessel is brought upright after the operator agrees, or left after a second abort."""
    with _refusing():
        return campaign_out(daemon, queue, await queue.abort(key, person.name))


@router.post("/campaigns/{key}/resume", operation_id="resume")
async def resume(daemon: Daemon, queue: Queue, person: Operator, key: str) -> CampaignOut:
    """Resume a paused campaign. If the outcome of a pour is unknown, the operator enters it first."""
    with _refusing():
        return campaign_out(daemon, queue, queue.resume(key, person.name))


@router.post("/campaigns/{key}/move", operation_id="move")
async def move(daemon: Daemon, queue: Queue, person: Operator, key: str, body: MoveIn) -> CampaignOut:
    """Move a campaign to another place in the queue, or change its earliest start."""
    if body.before:
        found_item(queue, body.before)
    with _refusing():
        return campaign_out(daemon, queue, queue.move(key, person.name, **body.model_dump()))


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """Convert a refusal to a response with status 409 and the reason, an unknown campaign to one with status 404."""
    try:
        yield
    except KeyError as error:
        raise HTTPException(404, f"there is no campaign '{error.args[0][:80]}'") from None
    except (RequestRefusedError, MotionNotEnabledError) as error:
        raise HTTPException(409, str(error)) from None


@router.get("/campaigns/{key}/motion", operation_id="motion")
async def motion(daemon: Daemon, queue: Queue, person: Operator, key: str) -> WhatMovesOut:
    """Describe the motion of this campaign, to be read before motion is enabled."""
    item = found_item(queue, key)
    with _refusing():
        return await asyncio.to_thread(what_moves, daemon, item)


@router.post("/campaigns/{key}/enable", operation_id="enable")
async def enable(daemon: Daemon, queue: Queue, person: Operator, key: str, body: EnableIn) -> CampaignOut:
    """Enable motion in the coming part of this campaign's run."""
    item = found_item(queue, key)
    with _refusing():
        moves = await asyncio.to_thread(what_moves, daemon, item)
        enable_motion(daemon, item, moves, body.laboratory, person.name)
        return campaign_out(daemon, queue, queue.item(item.id))


@router.post("/questions/{number}/answer", operation_id="answer")
async def answer(
    daemon: Daemon, person: Operator, number: Annotated[int, Path(ge=0, lt=2**62)], body: AnswerIn
) -> QuestionOut:
    """Answer a question. The first answer counts."""
    try:
        question = daemon.asking.answer(number, body.answer, person.name)
    except KeyError:
        raise HTTPException(404, f"question {number} is not open") from None
    except AnswerError as error:
        raise HTTPException(422, str(error)) from None
    daemon.note(person.name, "answer", question.campaign, f"{question.text} → {question.answer}")
    return question


@router.post("/queue/pause", operation_id="pause_queue")
async def pause_queue(daemon: Daemon, queue: Queue, stops: Stops, person: Operator) -> StatusOut:
    """Start no further campaigns. Running campaigns continue."""
    queue.pause_all(True, person.name)
    return await status(daemon, stops, person)


@router.post("/queue/resume", operation_id="resume_queue")
async def resume_queue(daemon: Daemon, queue: Queue, stops: Stops, person: Operator) -> StatusOut:
    """Start campaigns again."""
    queue.pause_all(False, person.name)
    return await status(daemon, stops, person)


@router.post("/emergency-stop", operation_id="emergency_stop", response_model=StoppedOut)
async def emergency_stop(
    request: Request, daemon: Daemon, stops: Stops, person: Viewer, rig: StoppedRig = None, reason: StopReason = None
) -> Response:
    """Stop every arm, or the arm of one rig, and give up its work. The rig takes no new work until the stop is cleared.

    A viewer's token is sufficient. Rig and reason are in the query; a body is never read, and nothing in the request
    prevents the stop: what can't be used is shortened, replaced or ignored, and `notes` report it.
    """
    rigs, reasons = list(dict.fromkeys(rig or [""])), dict.fromkeys(reason or [])
    body = request.headers.get("content-length", "0").strip("0") or "transfer-encoding" in request.headers
    notes = ["a body is not read: rig and reason belong into the query"] if body else []
    if others := sorted(request.query_params.keys() - {"rig", "reason"}):
        names = ", ".join(recorded_reason(name)[0][:60] for name in others[:5])
        notes.append(f"ignored in the query: {names}" + (" and others" if len(others) > 5 else ""))
    notes = await stops.stop(
        person.name, "; ".join(filter(None, reasons)), rigs[0] if len(rigs) == 1 else rigs, notes=notes
    )
    try:
        state: dict[str, Any] = (await status(daemon, stops, person)).model_dump(mode="json")
    except UNSTORED as error:
        _log.error("the state can't be read after an emergency stop: %s", error)
        state = {}
        notes.append("the state of the daemon can't be read: see its log")
    response = EarlyResponse if body else JSONResponse
    return response({**state, "notes": notes})


@router.post("/emergency-stop/clear", operation_id="clear")
async def clear(daemon: Daemon, stops: Stops, person: Admin, body: ClearIn | None = None) -> StatusOut:
    """Clear an emergency stop of one rig, or of all. Work that was given up rests until an operator resumes it."""
    rig = "" if body is None else body.rig
    try:
        stops.clear(person.name, rig)
    except KeyError:
        raise HTTPException(404, f"there is no rig '{rig}'") from None
    return await status(daemon, stops, person)


@router.post("/shutdown", status_code=202, operation_id="shutdown")
async def shutdown(request: Request, daemon: Daemon, queue: Queue, stops: Stops, person: Admin) -> EndingOut:
    """Shut the daemon down at the next safe point; a second request gives up what it still waits for."""
    daemon.note(person.name, "shutdown")
    state = (await status(daemon, stops, person)).model_dump()
    at_once, waits_for = daemon.stopping, queue.running_work()
    request.app.state.shutdown()
    return EndingOut.model_validate({**state, "stopping": True, "waits_for": waits_for, "at_once": at_once})
