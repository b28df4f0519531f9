"""The FastAPI application of the daemon: routes, operator page, health checks and OpenAPI description.

`create_app` makes the application without a daemon; `serve_app` connects it to a `Supervisor` and adds access control.
No call reaches a device, except the commands that stop motion.
"""

from __future__ import annotations

import asyncio
import errno
import json
import logging
from collections.abc import Callable
from functools import cache
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Request, Response
from fastapi.exceptions import RequestValidationError
from fastapi.responses import JSONResponse
from starlette.exceptions import HTTPException as AnyHTTPException

from orchestrator.daemon.api import archive_routes, command_routes, query_routes, station_routes
from orchestrator.daemon.api.access_control import Daemon, RequestGuard, Stops, invalid, refused
from orchestrator.daemon.api.page import page_router
from orchestrator.daemon.api.schemas import HealthOut, ProblemOut
from orchestrator.daemon.rigs.ordering import Ordering
from orchestrator.daemon.rigs.supervisor import Supervisor
from orchestrator.daemon.state.access_tokens import Tokens
from orchestrator.daemon.state.daemon_store import StoreError
from orchestrator.learning.stage_result import ResultPart
from sim_engine.settings.model import meanings

V1 = "/api/v1"

_log = logging.getLogger(__name__)

_ERRORS: dict[int | str, dict[str, Any]] = {
    code: {"model": ProblemOut, "description": text}
    for code, text in {
        400: "The request can't be read.",
        401: "The token is missing or unknown.",
        403: "The token's role is not sufficient.",
        404: "Not found.",
        409: "Not possible now; the detail gives the reason.",
        413: "The request is too large.",
        421: "The host name is not one of this machine.",
        422: "The request is invalid; the detail gives the problem, its place and a remedy.",
        429: "Too many wrong tokens from this address.",
    }.items()
}


def create_app() -> FastAPI:
    """Make the application without a daemon."""
    app = FastAPI(
        title="Decant",
        version="1",
        description="A laboratory in which a robot arm learns to pour: queue, questions and events.",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
    )
    app.include_router(query_routes.router, prefix=V1, responses=_ERRORS)
    app.include_router(command_routes.router, prefix=V1, responses=_ERRORS)
    app.include_router(station_routes.router, prefix=V1, responses=_ERRORS)
    app.include_router(archive_routes.router, prefix=V1, responses=_ERRORS)
    app.add_api_route("/healthz", _health, operation_id="health", response_model=HealthOut)
    app.add_api_route(
        "/readyz",
        _readiness,
        operation_id="readiness",
        response_model=HealthOut,
        responses={503: {"model": HealthOut, "description": "Not ready; the problems give the reasons."}},
    )
    app.add_api_route(f"{V1}/openapi.json", _description, include_in_schema=False)
    app.include_router(page_router())
    for kind in (StoreError, OSError):
        app.add_exception_handler(kind, _not_stored)
    app.add_exception_handler(AnyHTTPException, refused)
    app.add_exception_handler(RequestValidationError, invalid)
    app.state.shutdown = _nothing
    return app


def serve_app(daemon: Supervisor, tokens: Tokens, shutdown: Callable[[], None]) -> FastAPI:
    """Make the application for a daemon, with access control.

    Args:
        daemon: daemon to serve.
        tokens: accepted tokens.
        shutdown: starts the daemon's shutdown.
    """
    app, settings = create_app(), daemon.shared.settings
    app.state.daemon, app.state.queue, app.state.stops = daemon.shared, daemon.queue, daemon.stops
    app.state.tokens, app.state.shutdown = tokens, shutdown
    daemon.shared.token_problems = lambda: tokens.problems
    app.state.ordering = Ordering(daemon.shared, daemon.queue)
    app.add_middleware(
        RequestGuard,
        limit=settings.body_limit,
        host=settings.host,
        tokens=tokens,
        names=settings.names,
        counted=daemon.shared.counted,
    )
    return app


def openapi_text() -> str:
    """Return the API's OpenAPI description, as in docs/openapi.json."""
    document = create_app().openapi()
    waiting: list[type[ResultPart]] = [ResultPart]
    while waiting:
        model = waiting.pop()
        waiting += model.__subclasses__()
        properties = document["components"]["schemas"].get(model.__name__, {}).get("properties", {})
        for name, text in meanings(model).items():
            if text and name in properties:
                properties[name].setdefault("description", text)
    return json.dumps(document, indent=1, ensure_ascii=False) + "\n"


def write_openapi(path: Path) -> None:
    """Write the OpenAPI description to a file."""
    path.write_text(openapi_text(), encoding="utf-8")


@cache
def _description_text() -> str:
    return openapi_text()


async def _description() -> Response:
    """Return the API's OpenAPI description, from which programs generate clients. Needs no token."""
    return Response(await asyncio.to_thread(_description_text), media_type="application/json")


async def _health(daemon: Daemon) -> HealthOut:
    """Return success if the daemon responds. Needs no token."""
    return HealthOut(ok=True)


async def _readiness(daemon: Daemon, stops: Stops, response: Response) -> HealthOut:
    """Check that simulators are running and no problem is open. Needs no token and returns no details."""
    problems = [] if daemon.warm.ready else ["simulators are starting"]
    problems += [f"problem: {key}" for key in daemon.problems]
    if stops.active:
        problems.append("emergency stop")
    if daemon.stopping:
        problems.append("ending")
    response.status_code = 503 if problems else 200
    return HealthOut(ok=not problems, problems=problems)


async def _not_stored(request: Request, error: Exception) -> JSONResponse:
    """Refuse a command that could not be stored; the log has the paths. A deadline that was missed is no such error."""
    if isinstance(error, OSError) and error.errno not in (errno.ENOSPC, errno.EDQUOT, errno.EROFS, errno.EIO):
        raise error
    _log.error("%s %s: %s", request.method, request.url.path, error)
    return JSONResponse({"detail": "the daemon can't use its disk; is it full? Make room, then repeat the call"}, 507)


def _nothing() -> None:
    """Shutdown handler of an application without a daemon."""
