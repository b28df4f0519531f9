"""Read-only routes of the HTTP API: status, campaigns, questions, rigs, events, reports and metrics.

Commands are in `command_routes`; previous runs are in `archive_routes`. `measures` reads the metrics from the daemon at
each request, so that nothing is counted twice or stored.
"""

from __future__ import annotations

import asyncio
import importlib.metadata
import threading
import time
from collections.abc import AsyncIterator, Iterable
from dataclasses import asdict
from pathlib import Path
from typing import Annotated, Any, get_args

from fastapi import APIRouter, Header, HTTPException, Query, Response
from fastapi.responses import FileResponse, StreamingResponse
from prometheus_client import CollectorRegistry, ProcessCollector, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from pydantic import Field

from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.daemon.api.access_control import Daemon, Queue, Stops, Viewer
from orchestrator.daemon.api.schemas import CampaignDetailOut, CampaignOut, RigOut, StatusOut, text_response
from orchestrator.daemon.rigs.campaign_queue import CampaignQueue
from orchestrator.daemon.rigs.emergency_stop import EmergencyStops
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.rigs.submissions import run_request
from orchestrator.daemon.state.daemon_store import ENDED, QuestionOut, QueueItem
from orchestrator.daemon.state.run_readout import REPORT, summary_of
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal_file import free_space
from orchestrator.records.verdict import VerdictWord
from sim_engine.settings.plugin_registry import DISTRIBUTION

READERS = 400
"""Largest number of concurrent event streams."""

BEAT = 15.0
"""Interval of comments on a silent event stream, so that both ends detect a lost connection [s]."""

router = APIRouter()


@router.get("/status", operation_id="status")
async def status(daemon: Daemon, stops: Stops, person: Viewer) -> StatusOut:
    """Return the state of the daemon, and who asks."""
    return StatusOut.model_validate(
        {
            "version": importlib.metadata.version(DISTRIBUTION),
            "time": time.time(),
            "began": daemon.began,
            "stopping": daemon.stopping,
            "ready": daemon.warm.ready and not daemon.problems and not daemon.stopping,
            "problems": [*daemon.problems.values(), *daemon.token_problems()],
            "person": {"name": person.name, "role": person.role.name.lower()},
            "queue_paused": daemon.queue_paused,
            "emergency": stops.of_all,
            "simulators": daemon.warm.size,
            "rigs": rigs_out(daemon, stops),
            "campaigns": daemon.store.counts(),
            "questions": len(daemon.store.questions()),
            "last_event": daemon.feed.last,
            "live": daemon.live_url,
        }
    )


@router.get("/rigs", operation_id="rigs")
async def rigs(daemon: Daemon, stops: Stops, person: Viewer) -> list[RigOut]:
    """List the laboratories, with the campaign that leases each."""
    return rigs_out(daemon, stops)


def rigs_out(daemon: SharedServices, stops: EmergencyStops) -> list[RigOut]:
    """Convert the rigs to their response models."""
    rigs = []
    for name, worker in daemon.workers.items():
        campaign, checkpoint, arm, told = None, "", worker.arm, None
        if worker.running is not None:
            campaign, checkpoint = worker.running.item.id, worker.running.checkpoint
        rig = {"name": name, "mode": worker.rig.mode, "campaign": campaign, "checkpoint": checkpoint}
        if arm is not None:
            check = arm.check
            told = {"state": check.state, "text": check.found, "advice": check.advice, "time": arm.time}
        rigs.append(RigOut.model_validate({**rig, "emergency": stops.of_rigs.get(name), "arm": told}))
    return rigs


@router.get("/campaigns", operation_id="campaigns")
async def campaigns(
    daemon: Daemon,
    queue: Queue,
    person: Viewer,
    state: Annotated[list[str] | None, Query(max_length=20, description="Only campaigns in these states.")] = None,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> list[CampaignOut]:
    """List campaigns: running ones, then the queue in its order, then the others, newest first."""
    return [campaign_out(daemon, queue, item) for item in daemon.store.items(state or (), limit)]


@router.get("/campaigns/{key}", operation_id="campaign")
async def campaign(daemon: Daemon, queue: Queue, person: Viewer, key: str) -> CampaignDetailOut:
    """Return one campaign with its pours and its summary."""
    item = found_item(queue, key)
    summary: dict[str, Any] | None = None
    seen: dict[str, Any] = {}
    if item.run is not None:
        directory = daemon.settings.runs / item.run

        # A process that was killed leaves a journal that ends in the middle of the pour.
        live = daemon.progress(item) is not None

        def read() -> tuple[dict[str, Any], dict[str, Any] | None]:
            def plan() -> CampaignPlan:
                return run_request(daemon.settings, item, daemon.settings.rig(item.rig)).campaign

            return daemon.pours.of(directory, plan, live=live), summary_of(directory)

        try:
            seen, summary = await asyncio.to_thread(read)
        except (ConfigError, RunError, KeyError):  # for example, a rig that the settings no longer contain
            summary = await asyncio.to_thread(summary_of, directory)
    table = campaign_out(daemon, queue, item).model_dump()
    audit = daemon.store.audit(item.id)
    return CampaignDetailOut.model_validate({**table, **seen, "summary": summary, "audit": audit})


@router.get(
    "/campaigns/{key}/report",
    operation_id="report",
    response_class=FileResponse,
    responses={200: text_response("text/html", "A self-contained HTML page.")},
)
async def report(daemon: Daemon, queue: Queue, person: Viewer, key: str) -> FileResponse:
    """Return the report of a campaign's run."""
    item = found_item(queue, key)
    path = None if item.run is None else daemon.settings.runs / item.run / REPORT
    if path is None or not path.is_file():
        raise HTTPException(404, f"{item.id} has no report yet")
    return FileResponse(path, media_type="text/html")


@router.get("/questions", operation_id="questions")
async def questions(
    daemon: Daemon,
    person: Viewer,
    answered: Annotated[bool, Query(description="All questions, newest first.")] = False,
    limit: Annotated[int, Query(ge=1, le=1000)] = 200,
) -> list[QuestionOut]:
    """List questions to the operator: the open ones, oldest first."""
    return daemon.store.questions(only_open=not answered, limit=limit)


@router.get(
    "/events",
    operation_id="events",
    response_class=StreamingResponse,
    responses={
        200: text_response("text/event-stream", "Server-sent events: id, event, data (JSON)."),
        503: {"description": "Too many readers."},
    },
)
async def events(
    daemon: Daemon,
    queue: Queue,
    person: Viewer,
    campaign: Annotated[str | None, Query(max_length=80, description="Only events of this campaign.")] = None,
    kind: Annotated[
        list[Annotated[str, Field(max_length=60)]] | None,
        Query(max_length=20, description="Only events of these types, such as QuestionAsked."),
    ] = None,
    after: Annotated[int | None, Query(ge=0, description="Id of the last event seen; 0 for all stored events.")] = None,
    last_event_id: Annotated[str | None, Header(description="The same, as browsers send it.")] = None,
    until: Annotated[bool, Query(description="End with the newest event at the time of the request.")] = False,
) -> Response:
    """Stream events as they happen; each has an id to continue from."""
    if daemon.feed.readers >= READERS:
        raise HTTPException(503, f"{READERS} readers are at it already")
    if last_event_id is not None and last_event_id.isascii() and last_event_id.isdigit():
        after = int(last_event_id[:18])
    only = None if campaign is None else found_item(queue, campaign).id
    newest = daemon.feed.last

    async def stream() -> AsyncIterator[str]:
        yield ": from here on\n\n"
        if until and after is None:
            return
        async for sent in daemon.feed.read(after, only, kind or (), until=newest if until else None, beat=BEAT):
            yield ": still here\n\n" if sent is None else f"id: {sent.id}\nevent: {sent.type}\ndata: {sent.data}\n\n"

    return StreamingResponse(stream(), media_type="text/event-stream", headers={"Cache-Control": "no-store"})


@router.get(
    "/metrics",
    operation_id="metrics",
    response_class=Response,
    responses={200: text_response("text/plain", "Prometheus' text format.")},
)
async def metrics(daemon: Daemon, stops: Stops, person: Viewer) -> Response:
    """Return the metrics in Prometheus' text format."""
    return Response(measures(daemon, stops), media_type="text/plain; version=0.0.4; charset=utf-8")


def found_item(queue: CampaignQueue, key: str) -> QueueItem:
    """Return a campaign by its id or a prefix of it. Raises HTTPException 404."""
    try:
        return queue.item(key)
    except KeyError:
        raise HTTPException(404, f"there is no campaign '{key[:80]}'") from None


def campaign_out(daemon: SharedServices, queue: CampaignQueue, item: QueueItem) -> CampaignOut:
    """Convert a campaign to its response model."""
    table, progress = item.model_dump(), daemon.progress(item)
    waits = item.state not in ENDED and progress is None
    run: Path | None = None if item.run is None else daemon.settings.runs / item.run
    return CampaignOut.model_validate(
        {
            **table,
            "needs_enabling": item.mode == "hardware" and not item.motion_enabled and waits,
            "followers": daemon.store.followers(item.id),
            "waits_for": queue.waits_for(item),
            "progress": progress,
            "report": run is not None and (run / REPORT).is_file(),
            "live": None if progress is None else daemon.live_url,
        }
    )


COUNTED = {
    "pours": "Pours of an action since the daemon's start, by outcome.",
    "doses": "Doses of an amount since the daemon's start; missed: beyond the tolerance.",
    "faults": "Faults of unattended pours since the daemon's start.",
    "campaigns_ended": "Runs that came to an end or to rest since the daemon's start, by verdict or state.",
}
"""Subjects that are counted, with their descriptions."""

_POURED = ("made", "refused", "failed", "unknown")
OUTCOMES = {
    "pours": _POURED,
    "doses": ("missed", *_POURED),
    "faults": ("fault",),
    "campaigns_ended": (*get_args(VerdictWord), "failed", "paused", "unknown"),
}
"""Outcomes by subject. All of them have a value from the start on, so that the first increase is seen."""


class _Collector:
    """Reads the current values when Prometheus collects them."""

    def __init__(self, daemon: SharedServices, stops: EmergencyStops) -> None:
        self._daemon, self._stops = daemon, stops

    def collect(self) -> Iterable[Metric]:
        """Yield the metrics, as prometheus_client's collectors do."""
        daemon = self._daemon
        campaigns = GaugeMetricFamily("decant_campaigns", "Campaigns in each state.", labels=["state"])
        for state, count in daemon.store.counts().items():
            campaigns.add_metric([state], count)
        yield campaigns
        busy = GaugeMetricFamily("decant_rig_busy", "Whether a campaign has the rig.", labels=["rig"])
        for name, worker in daemon.workers.items():
            busy.add_metric([name], float(worker.running is not None))
        yield busy
        for subject, text in COUNTED.items():
            counted = CounterMetricFamily(f"decant_{subject}", text, labels=["rig", "outcome"])
            rigs = daemon.workers if subject == "campaigns_ended" else [rig.name for rig in daemon.settings.rigs]
            for rig in rigs:
                for outcome in OUTCOMES[subject]:
                    counted.add_metric([rig, outcome], daemon.counted[subject, rig, outcome])
            yield counted
        errors = CounterMetricFamily("decant_http_responses", "Responses of the API, by status.", labels=["status"])
        for (subject, status, _), count in sorted(daemon.counted.items()):
            if subject == "http":
                errors.add_metric([status], count)
        yield errors
        words = GaugeMetricFamily(
            "decant_notifications", "Notifications sent to receivers.", labels=["receiver", "outcome"]
        )
        for receiver, counts in daemon.notification_counts.items():
            for outcome, count in asdict(counts).items():
                words.add_metric([receiver, outcome], count)
        yield words
        single = {
            "decant_questions_open": ("Questions that wait for an answer.", len(daemon.store.questions())),
            "decant_emergency_stop": ("Whether an emergency stop is latched.", self._stops.active),
            "decant_queue_paused": ("Whether no campaign is begun.", daemon.queue_paused),
            "decant_simulators": ("Simulators in the pool.", daemon.warm.size),
            "decant_events_last": ("Number of the newest event.", daemon.feed.last),
            "decant_readers": ("Readers of events.", daemon.feed.readers),
            "decant_problems": ("Problems that people should solve.", len(daemon.problems)),
            "decant_disk_free_bytes": ("Room on the state directory's disk.", free_space(daemon.settings.state)),
            "decant_threads": ("Threads of the daemon's process.", threading.active_count()),
        }
        for name, (text, value) in single.items():
            yield GaugeMetricFamily(name, text, value=float(value))


def measures(daemon: SharedServices, stops: EmergencyStops) -> bytes:
    """Return all metrics in Prometheus' text format."""
    registry = CollectorRegistry()
    registry.register(_Collector(daemon, stops))
    ProcessCollector(registry=registry)
    return generate_latest(registry)
