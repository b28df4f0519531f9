"""The part of the API that knows former runs: what `decant runs` does. Viewers read, operators tag and note."""

from __future__ import annotations

import asyncio
import json
import tempfile
import zipfile
from collections.abc import Callable
from io import BytesIO
from pathlib import Path
from typing import Annotated, Any, Literal, TypeVar

from fastapi import APIRouter, Depends, HTTPException, Query, Response
from fastapi.responses import FileResponse
from pydantic import BaseModel, ConfigDict, Field, create_model

from orchestrator.catalogue.annotations import AnnotationsError, Note
from orchestrator.catalogue.catalogue_client import LocalCatalogueClient
from orchestrator.catalogue.catalogue_index import TABLES, Catalogue, Column
from orchestrator.catalogue.queries import CONDITIONS, NoSuchRunError
from orchestrator.daemon.access_control import Daemon, Operator, Viewer
from orchestrator.daemon.run_readout import REPORT
from orchestrator.daemon.supervisor import Supervisor
from orchestrator.run_errors import RunError
from sim_engine.resources import MissingExtraError

T = TypeVar("T")

router = APIRouter(tags=["former runs"])

_TYPES: dict[str, Any] = {
    "text": str | None,
    "texts": list[str],
    "integer": int | None,
    "number": float | None,
    "time": float | None,
    "values": dict[str, Any],
}


def _row(name: str, columns: tuple[Column, ...], about: str) -> type[BaseModel]:
    fields: dict[str, Any] = {}
    for column in columns:
        unit = "seconds since 1970" if column.type == "time" else column.unit
        fields[column.name] = (_TYPES[column.type], Field(description=column.meaning + (f" [{unit}]" if unit else "")))
    return create_model(name, __doc__=about, **fields)


def _several(model: Any) -> Any:
    return list[model]


PreviousRunOut = _row("FormerRun", TABLES["run"], "One run, whoever made it.")
PreviousPour = _row("FormerPour", TABLES["pour"], "One pour that had begun.")
_DETAILS: dict[str, Any] = {"notes": (list[Note], ...), "list_of_pours": (_several(PreviousPour), ...)}
PreviousRunDetail = create_model(
    "FormerRunDetail", __base__=PreviousRunOut, __doc__="One run with its notes and its pours.", **_DETAILS
)


def _asked(name: str, **more: Any) -> Callable[..., dict[str, Any]]:
    """A dependency: what is asked for in a request's query."""
    text = Annotated[str | None, Field(max_length=200)]
    fields: dict[str, Any] = {
        name: (text, Field(default=None, description=about)) for name, about in CONDITIONS.items()
    }
    fields["words"] = (
        list[Annotated[str, Field(max_length=200)]],
        Field(default=[], max_length=20, description="Each stands somewhere in a run: its names, tags or notes."),
    )
    fields["limit"] = (int, Field(default=200, ge=1, le=1000, description="The newest so many."))
    model = create_model(name, __config__=ConfigDict(extra="forbid"), **fields, **more)

    def asked(query: Any) -> dict[str, Any]:
        found: dict[str, Any] = query.model_dump()
        return found

    asked.__annotations__["query"] = Annotated[model, Query()]
    return asked


_RUN = (Annotated[str | None, Field(max_length=200)], Field(default=None, description="One run, by its folder's name."))
_FORMATS = (
    list[Literal["csv", "parquet"]],
    Field(default=["csv"], min_length=1, max_length=2, description="One or both."),
)
RunsAsked = Annotated[dict[str, Any], Depends(_asked("RunsAsked"))]
PoursAsked = Annotated[dict[str, Any], Depends(_asked("PoursAsked", run=_RUN))]
ExportAsked = Annotated[dict[str, Any], Depends(_asked("ExportAsked", format=_FORMATS))]


class RunComparison(BaseModel):
    """Runs side by side; one value for each of them."""

    model_config = ConfigDict(use_attribute_docstrings=True)

    runs: list[str]
    """Their folders."""

    settings: dict[str, list[Any]]
    """Those in which they differ: place in the plan → values."""

    outcomes: list[dict[str, Any]]
    """What each came to."""


class TagsIn(BaseModel):
    """Tags to put on a run, and tags to take off."""

    model_config = ConfigDict(extra="forbid")

    add: list[Annotated[str, Field(min_length=1, max_length=60)]] = Field(default=[], max_length=20)
    remove: list[Annotated[str, Field(min_length=1, max_length=60)]] = Field(default=[], max_length=20)


class NoteIn(BaseModel):
    """Something to be remembered of a run."""

    model_config = ConfigDict(extra="forbid")

    text: str = Field(min_length=1, max_length=4000)


class TagsOut(BaseModel):
    """A run's tags."""

    run: str
    tags: list[str]


class NotesOut(BaseModel):
    """A run's notes, the oldest first."""

    run: str
    notes: list[Note]


async def _at_desk(daemon: Supervisor, ask: Callable[[LocalCatalogueClient], T], by: str | None = None) -> T:
    """Ask the catalogue, in a thread: the first time it may have to read many journals."""

    def work() -> T:
        with Catalogue(daemon.settings.state) as catalogue:
            catalogue.refresh()
            return ask(LocalCatalogueClient(catalogue, by))

    try:
        return await asyncio.to_thread(work)
    except NoSuchRunError as error:
        raise HTTPException(404, str(error)) from None
    except (ValueError, MissingExtraError) as error:
        raise HTTPException(422, str(error)) from None
    except (RunError, AnnotationsError, OSError) as error:
        raise HTTPException(409, str(error)) from None


@router.get("/runs", operation_id="runs", response_model=_several(PreviousRunOut))
async def runs(daemon: Daemon, person: Viewer, asked: RunsAsked) -> Any:
    """Runs of this machine, the newest first: the daemon's and, where they share a state directory, the command line's.

    All conditions that are given must hold; names may hold * and ?.
    """
    return await _at_desk(daemon, lambda desk: desk.runs(asked))


@router.get("/pours", operation_id="pours", response_model=_several(PreviousPour))
async def pours(daemon: Daemon, person: Viewer, asked: PoursAsked) -> Any:
    """Pours of all runs, the oldest first: which action was used, what it spilled, and what had been expected."""
    return await _at_desk(daemon, lambda desk: desk.pours(asked))


@router.get("/runs/compare", operation_id="compare_runs")
async def compare(
    daemon: Daemon,
    person: Viewer,
    run: Annotated[list[str], Query(min_length=2, max_length=20, description="Two runs or more.")],
) -> RunComparison:
    """Settings in which runs differ, and what they came to."""
    return RunComparison.model_validate(await _at_desk(daemon, lambda desk: desk.compare(run)))


@router.get(
    "/runs/export",
    operation_id="export_runs",
    response_class=Response,
    responses={200: {"content": {"application/zip": {}}, "description": "runs.*, pours.*, dictionary.csv."}},
)
async def export(daemon: Daemon, person: Viewer, asked: ExportAsked) -> Response:
    """Runs and pours as files for other programs, with a data dictionary, in one archive."""
    formats = dict.fromkeys(asked.pop("format"))

    def written(desk: LocalCatalogueClient) -> bytes:
        archive = BytesIO()
        with tempfile.TemporaryDirectory() as folder, zipfile.ZipFile(archive, "w", zipfile.ZIP_DEFLATED) as packed:
            found = desk.export(Path(folder), asked, list(formats))
            for path in map(Path, found.pop("files")):
                packed.write(path, path.name)
            packed.comment = json.dumps(found).encode()
        return archive.getvalue()

    content = await _at_desk(daemon, written)
    headers = {"Content-Disposition": 'attachment; filename="decant-runs.zip"'}
    return Response(content, media_type="application/zip", headers=headers)


@router.get("/runs/{run}", operation_id="run", response_model=PreviousRunDetail)
async def run(daemon: Daemon, person: Viewer, run: str) -> Any:
    """One run, by its folder's name or the beginning of it: θ*, what it recommends, its pours, tags and notes."""
    return await _at_desk(daemon, lambda desk: desk.run(run))


@router.get(
    "/runs/{run}/report",
    operation_id="run_report",
    response_class=FileResponse,
    responses={200: {"content": {"text/html": {}}, "description": "A page that needs nothing else."}},
)
async def run_report(daemon: Daemon, person: Viewer, run: str) -> FileResponse:
    """The report of a run."""
    path = Path((await _at_desk(daemon, lambda desk: desk.run(run)))["path"]) / REPORT
    if not path.is_file():
        raise HTTPException(404, f"{run} has no report")
    return FileResponse(path, media_type="text/html")


@router.post("/runs/{run}/tags", operation_id="tag_run")
async def tag(daemon: Daemon, person: Operator, run: str, body: TagsIn) -> TagsOut:
    """Put tags on a run, or take them off. They are kept in the run's folder."""
    found = await _at_desk(daemon, lambda desk: desk.tag(run, body.add, body.remove))
    daemon.note(person.name, "tag", detail=f"{found['run']}: {', '.join(found['tags'])}")
    return TagsOut.model_validate(found)


@router.post("/runs/{run}/notes", operation_id="note_run")
async def note(daemon: Daemon, person: Operator, run: str, body: NoteIn) -> NotesOut:
    """Write a note about a run, with date and author. It is kept in the run's folder."""
    found = await _at_desk(daemon, lambda desk: desk.note(run, body.text), person.name)
    daemon.note(person.name, "note", detail=f"{found['run']}: {body.text}")
    return NotesOut.model_validate(found)
