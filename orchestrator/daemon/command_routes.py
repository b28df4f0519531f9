"""The part of the API that does something. Everything is written down with its doer.

Hardware moves for one part of one run, after somebody has read what it will do and typed its name.
"""

from __future__ import annotations

import asyncio
import contextlib
import shutil
from collections.abc import Callable, Iterator
from typing import Annotated

from fastapi import APIRouter, HTTPException, Path, Request

from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.daemon.access_control import Admin, Daemon, Operator, Viewer
from orchestrator.daemon.daemon_store import ENDED, QueueItem
from orchestrator.daemon.query_routes import campaign_out, found_item, status
from orchestrator.daemon.remote_operator import AnswerError, question_json
from orchestrator.daemon.rig_worker import job_of
from orchestrator.daemon.schemas import (
    AnswerIn,
    ArmIn,
    CampaignOut,
    ClearIn,
    EmergencyIn,
    MoveIn,
    QuestionOut,
    StatusOut,
    SubmissionIn,
    WhatMovesOut,
)
from orchestrator.daemon.submissions import Submission, SubmissionError, prepare
from orchestrator.daemon.supervisor import RequestRefusedError, Supervisor
from orchestrator.run_errors import RunError
from orchestrator.runs.motion_envelope import campaign_pours, envelope, envelope_lines, pour_count
from orchestrator.runs.safety_approval import required_checksum


class MotionNotEnabledError(RunError):
    """It can't be armed; the text says why."""


def what_moves(daemon: Supervisor, item: QueueItem) -> WhatMovesOut:
    """What would move, in words; planned anew. Takes seconds.

    Raises:
        NotArmedError: nothing does, or it may not.
    """
    if item.mode != "hardware":
        raise MotionNotEnabledError(f"{item.id} has nothing to arm: its rig is {item.mode}")
    if item.state in ENDED:
        raise MotionNotEnabledError(f"{item.id} is {item.state}")
    try:
        work = job_of(daemon.settings, item, daemon.settings.rig(item.rig))
        required_checksum(work.campaign)
        arm = work.campaign.laboratory.arm
        assert arm is not None
        found = envelope(arm, campaign_pours(work.campaign, work.stages))
    except (ConfigError, RunError, KeyError) as error:
        raise MotionNotEnabledError(str(error)) from None
    if not found.reports:
        raise MotionNotEnabledError(
            f"none of {len(found.refused)} actions could be poured by this arm: {found.refused[0]}"
        )
    lines = [f"pours          up to {pour_count(work.campaign, work.stages)}", *envelope_lines(found)]
    return WhatMovesOut(laboratory=work.campaign.laboratory.name, arm=arm.title, lines=lines)


def arm(daemon: Supervisor, item: QueueItem, moves: WhatMovesOut, typed: str, by: str) -> QueueItem:
    """Arm it.

    Raises:
        NotArmedError: another name was typed.
    """
    if typed != moves.laboratory:
        raise MotionNotEnabledError(
            f"not armed: '{typed}' was typed, and the laboratory is {moves.laboratory}; nothing moves"
        )
    daemon.store.change(item.id, armed=True)
    daemon.note(by, "arm", item.id, moves.laboratory)
    daemon.wake()
    return daemon.item(item.id)


router = APIRouter()


@router.post("/campaigns", status_code=201, operation_id="submit")
async def submit(request: Request, daemon: Daemon, person: Operator, body: SubmissionIn) -> CampaignOut:
    """Queue a campaign. It is checked as `decant run` checks one, and kept as it is now."""
    if bool(body.text) == bool(body.path) or (body.path and body.files):
        raise HTTPException(422, "give either 'text' (with 'files') or 'path'")
    with _refusing():
        daemon.refuse_new_work()
    try:
        submission = Submission(**body.model_dump())
        item = await asyncio.to_thread(prepare, daemon.settings, submission, daemon.new_key(), person.name)
    except SubmissionError as error:
        raise HTTPException(422, str(error)) from None
    with _refusing():
        try:
            return campaign_out(request, daemon, daemon.submit(item))
        except RequestRefusedError:
            await asyncio.to_thread(shutil.rmtree, daemon.settings.snapshots / item.id, ignore_errors=True)
            raise


@router.post("/campaigns/{key}/pause", operation_id="pause")
async def pause(request: Request, daemon: Daemon, person: Operator, key: str) -> CampaignOut:
    """Come to rest at the next checkpoint: a pour that has begun is finished and weighed."""
    return _done(request, daemon, key, lambda: daemon.pause(key, person.name))


@router.post("/campaigns/{key}/stop", operation_id="stop")
async def stop(request: Request, daemon: Daemon, person: Operator, key: str) -> CampaignOut:
    """As pause; then what came of it so far is published, and it does not go on by itself."""
    return _done(request, daemon, key, lambda: daemon.stop(key, person.name))


@router.post("/campaigns/{key}/abort", operation_id="abort")
async def abort(request: Request, daemon: Daemon, person: Operator, key: str) -> CampaignOut:
    """Stop the motion. What is tilted is brought upright once somebody agrees; again: it is left as it is."""
    found_item(daemon, key)
    with _refusing():
        return campaign_out(request, daemon, await daemon.abort(key, person.name))


@router.post("/campaigns/{key}/resume", operation_id="resume")
async def resume(request: Request, daemon: Daemon, person: Operator, key: str) -> CampaignOut:
    """Go on with a campaign that rests. About a pour whose outcome nobody knows somebody is asked first."""
    return _done(request, daemon, key, lambda: daemon.resume(key, person.name))


@router.post("/campaigns/{key}/move", operation_id="move")
async def move(request: Request, daemon: Daemon, person: Operator, key: str, body: MoveIn) -> CampaignOut:
    """Another place in the queue."""
    if body.before:
        found_item(daemon, body.before)
    return _done(
        request, daemon, key, lambda: daemon.move(key, person.name, before=body.before, priority=body.priority)
    )


def _done(request: Request, daemon: Supervisor, key: str, deed: Callable[[], QueueItem]) -> CampaignOut:
    """Something done to a campaign, which may be refused."""
    found_item(daemon, key)
    with _refusing():
        return campaign_out(request, daemon, deed())


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    """What can't be done now is 409, with the reason."""
    try:
        yield
    except (RequestRefusedError, MotionNotEnabledError) as error:
        raise HTTPException(409, str(error)) from None


@router.get("/campaigns/{key}/arming", operation_id="arming")
async def arming(daemon: Daemon, person: Operator, key: str) -> WhatMovesOut:
    """What hardware would do in this campaign, for somebody to read before arming it."""
    item = found_item(daemon, key)
    with _refusing():
        return await asyncio.to_thread(what_moves, daemon, item)


@router.post("/campaigns/{key}/arm", operation_id="arm")
async def arm_it(request: Request, daemon: Daemon, person: Operator, key: str, body: ArmIn) -> CampaignOut:
    """Let hardware move in the coming part of this campaign's run."""
    item = found_item(daemon, key)
    with _refusing():
        moves = await asyncio.to_thread(what_moves, daemon, item)
        return campaign_out(request, daemon, arm(daemon, item, moves, body.laboratory, person.name))


@router.post("/questions/{number}/answer", operation_id="answer")
async def answer(
    daemon: Daemon, person: Operator, number: Annotated[int, Path(ge=0, lt=2**62)], body: AnswerIn
) -> QuestionOut:
    """Answer a question. The first answer counts."""
    try:
        found = daemon.asking.answer(number, body.answer, person.name)
    except KeyError:
        raise HTTPException(404, f"question {number} is not open") from None
    except AnswerError as error:
        raise HTTPException(422, str(error)) from None
    daemon.note(person.name, "answer", found.campaign, f"{found.text} → {found.answer}")
    return QuestionOut.model_validate(question_json(found))


@router.post("/queue/pause", operation_id="pause_queue")
async def pause_queue(request: Request, daemon: Daemon, person: Operator) -> StatusOut:
    """Begin no campaign from now on. What runs goes on."""
    daemon.pause_queue(True, person.name)
    return await status(request, daemon, person)


@router.post("/queue/resume", operation_id="resume_queue")
async def resume_queue(request: Request, daemon: Daemon, person: Operator) -> StatusOut:
    """Begin campaigns again."""
    daemon.pause_queue(False, person.name)
    return await status(request, daemon, person)


@router.post("/emergency-stop", operation_id="emergency_stop")
async def emergency_stop(
    request: Request, daemon: Daemon, person: Viewer, body: EmergencyIn | None = None
) -> StatusOut:
    """Stop every arm, or that of one rig; give up its work, and take nothing new there until it is cleared.

    A viewer's token is enough.
    """
    body = body or EmergencyIn()
    with _known_rig(body.rig):
        await daemon.emergency_stop(person.name, body.reason, body.rig)
    return await status(request, daemon, person)


@router.post("/emergency-stop/clear", operation_id="clear")
async def clear(request: Request, daemon: Daemon, person: Admin, body: ClearIn | None = None) -> StatusOut:
    """Take work again, at one rig or at all. What was given up rests until somebody resumes it."""
    rig = "" if body is None else body.rig
    with _known_rig(rig):
        daemon.clear(person.name, rig)
    return await status(request, daemon, person)


@contextlib.contextmanager
def _known_rig(rig: str) -> Iterator[None]:
    """A rig that the settings do not name is 404."""
    try:
        yield
    except KeyError:
        raise HTTPException(404, f"there is no rig '{rig}'") from None


@router.post("/shutdown", status_code=202, operation_id="shutdown")
async def shutdown(request: Request, daemon: Daemon, person: Admin) -> StatusOut:
    """End the daemon at the next safe point; again: at once."""
    daemon.note(person.name, "shutdown")
    found = await status(request, daemon, person)
    request.app.state.shutdown()
    return found
