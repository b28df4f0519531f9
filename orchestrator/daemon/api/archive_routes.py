"""Routes of the HTTP API for the catalogue of previous runs; for the operator's page.

Viewers list runs and read reports. Operators add notes. Queries run in a thread, since the first
one may read many journals. The catalogue itself is in `orchestrator.catalogue`.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any, TypeVar

from fastapi import APIRouter, HTTPException, Query
from fastapi.responses import FileResponse
from pydantic import BaseModel, Field

from orchestrator.catalogue.annotations import Note
from orchestrator.catalogue.catalogue import Catalogue, NoSuchRunError
from orchestrator.catalogue.control_charts import LaboratoryChart
from orchestrator.catalogue.run_reading import PreviousRun
from orchestrator.daemon.api.access_control import Daemon, Operator, Viewer
from orchestrator.daemon.api.schemas import text_response
from orchestrator.daemon.rigs.pour_request import RequestModel
from orchestrator.daemon.rigs.rig_worker import SharedServices
from orchestrator.daemon.state.run_readout import REPORT
from orchestrator.learning.run_errors import RunError

T = TypeVar("T")

router = APIRouter(tags=["previous runs"])


class NoteIn(RequestModel):
    """A note about a run."""

    text: str = Field(min_length=1, max_length=4000)


class NotesOut(BaseModel):
    """A run's notes, the oldest first."""

    run: str
    notes: list[Note]


async def _in_catalogue(daemon: SharedServices, query: Callable[[Catalogue], T]) -> T:
    """Query the catalogue in a thread: the first query may read many journals."""

    def work() -> T:
        with Catalogue(daemon.settings.state) as catalogue:
            catalogue.refresh()
            return query(catalogue)

    try:
        return await asyncio.to_thread(work)
    except NoSuchRunError as error:
        raise HTTPException(404, str(error)) from None
    except ValueError as error:
        raise HTTPException(422, str(error)) from None
    except (RunError, OSError) as error:
        raise HTTPException(409, str(error)) from None


@router.get("/runs", operation_id="runs", response_model=list[PreviousRun])  # type: ignore[valid-type]
async def runs(
    daemon: Daemon,
    person: Viewer,
    words: Annotated[
        list[Annotated[str, Field(max_length=200)]],
        Query(max_length=20, description="Words that must all occur in a run's names or notes."),
    ] = [],  # noqa: B006  FastAPI copies it
    limit: Annotated[int, Query(ge=1, le=1000, description="Return at most this many, the newest.")] = 200,
) -> Any:
    """List the runs of this machine, newest first; also those of the command line that uses the state directory."""
    return await _in_catalogue(daemon, lambda catalogue: catalogue.runs({"words": words, "limit": limit}))


@router.get("/runs/charts", operation_id="run_charts")
async def charts(daemon: Daemon, person: Viewer) -> list[LaboratoryChart]:
    """Return the control charts of all laboratories: daily means with limits from their history, and violations.

    The charts of a laboratory begin again with a note on one of its runs that starts with 'new limits'.
    """
    return await _in_catalogue(daemon, lambda catalogue: catalogue.charts({}))


@router.get(
    "/runs/{run}/report",
    operation_id="run_report",
    response_class=FileResponse,
    responses={200: text_response("text/html", "A self-contained HTML page.")},
)
async def run_report(daemon: Daemon, person: Viewer, run: str) -> FileResponse:
    """Return the report of a run."""
    path = Path((await _in_catalogue(daemon, lambda catalogue: catalogue.run(run)))["path"]) / REPORT
    if not path.is_file():
        raise HTTPException(404, f"{run} has no report")
    return FileResponse(path, media_type="text/html")


@router.post("/runs/{run}/notes", operation_id="note_run")
async def note(daemon: Daemon, person: Operator, run: str, body: NoteIn) -> NotesOut:
    """Add a note to a run, with date and author. It is stored in the run's folder."""
    entry = await _in_catalogue(daemon, lambda catalogue: catalogue.note(run, body.text, person.name))
    daemon.note(person.name, "note", detail=f"{entry['run']}: {body.text}")
    return NotesOut.model_validate(entry)
