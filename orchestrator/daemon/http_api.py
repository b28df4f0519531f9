"""The daemon over HTTP. No call reaches a device but those that stop it."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

from fastapi import FastAPI, Response

from orchestrator.daemon import archive_routes as archive
from orchestrator.daemon import command_routes as deeds
from orchestrator.daemon import query_routes as looks
from orchestrator.daemon.access_control import Daemon, RequestGuard, Tokens
from orchestrator.daemon.page import page_router
from orchestrator.daemon.schemas import HealthOut, ProblemOut
from orchestrator.daemon.supervisor import Supervisor

V1 = "/api/v1"

_ERRORS: dict[int | str, dict[str, Any]] = {
    code: {"model": ProblemOut, "description": text}
    for code, text in {
        400: "The request can't be read.",
        401: "No token, or one that is not known.",
        403: "The token's role is not enough.",
        404: "There is no such thing.",
        409: "Not now: the detail says why.",
        413: "Too large.",
        421: "Called by a name that this machine does not have.",
        422: "What was sent can't be used; the detail says what is wrong, where, and what would be right.",
        429: "Too many wrong tokens from this address.",
    }.items()
}

Live = Callable[[str | None], str | None]
"""Where the live view of a campaign is, or of all with None; None where there is none."""


def create_app() -> FastAPI:
    """The application, without the daemon that it will speak for."""
    app = FastAPI(
        title="Decant",
        version="1",
        description="A laboratory that teaches a robot arm to pour: its queue, its questions, its events.",
        docs_url=None,
        redoc_url=None,
        openapi_url=None,
    )
    app.include_router(looks.router, prefix=V1, responses=_ERRORS)
    app.include_router(deeds.router, prefix=V1, responses=_ERRORS)
    app.include_router(archive.router, prefix=V1, responses=_ERRORS)
    app.add_api_route("/healthz", _health, operation_id="health", response_model=HealthOut)
    app.add_api_route(
        "/readyz",
        _readiness,
        operation_id="readiness",
        response_model=HealthOut,
        responses={503: {"model": HealthOut, "description": "Not ready; the problems say why."}},
    )
    app.include_router(page_router())
    app.state.live = _nowhere
    app.state.shutdown = _nothing
    return app


def serve_app(daemon: Supervisor, tokens: Tokens, shutdown: Callable[[], None], live: Live | None = None) -> FastAPI:
    """The application, guarded.

    Args:
        daemon: that it speaks for.
        tokens: of those who may speak.
        shutdown: begins the daemon's end.
        live: where the live view is.
    """
    app = create_app()
    app.state.daemon, app.state.tokens, app.state.shutdown = daemon, tokens, shutdown
    app.state.live = live or _nowhere
    app.add_middleware(RequestGuard, limit=daemon.settings.body_limit, host=daemon.settings.host)
    return app


def openapi_text() -> str:
    """The API's description, as it stands in docs/openapi.json."""
    return json.dumps(create_app().openapi(), indent=1, ensure_ascii=False) + "\n"


def write_openapi(path: Path) -> None:
    """Write that file."""
    path.write_text(openapi_text(), encoding="utf-8")


async def _health(daemon: Daemon) -> HealthOut:
    """The daemon answers. Needs no token."""
    return HealthOut(ok=True)


async def _readiness(daemon: Daemon, response: Response) -> HealthOut:
    """Simulators are up, and nothing has to be mended. Needs no token, and says no more than that."""
    problems = [] if daemon.warm.ready else ["simulators are starting"]
    problems += [f"problem: {key}" for key in daemon.problems]
    if daemon.emergency is not None or daemon.emergencies:
        problems.append("emergency stop")
    if daemon.stopping:
        problems.append("ending")
    response.status_code = 503 if problems else 200
    return HealthOut(ok=not problems, problems=problems)


def _nowhere(campaign: str | None) -> str | None:
    return None


def _nothing() -> None:
    """Before there is anything to end."""
