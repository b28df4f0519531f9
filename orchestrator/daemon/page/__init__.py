"""The operator's page: three files that the daemon serves by itself, which need nothing from elsewhere.

The page holds no data and needs no token; it talks to the API with the token that somebody gives it.
"""

from __future__ import annotations

from importlib.resources import files

from fastapi import APIRouter, Response

FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/show.js": ("show.js", "text/javascript; charset=utf-8"),
    "/talk.js": ("talk.js", "text/javascript; charset=utf-8"),
}
"""Path → file and its type."""

HEADERS = {
    "Content-Security-Policy": (
        "default-src 'none'; script-src 'self'; style-src 'self'; connect-src 'self'; img-src 'self' data:; "
        "base-uri 'none'; form-action 'none'; frame-ancestors 'none'"
    ),
    "X-Content-Type-Options": "nosniff",
    "X-Frame-Options": "DENY",
    "Referrer-Policy": "no-referrer",
    "Cross-Origin-Opener-Policy": "same-origin",
    "Cross-Origin-Resource-Policy": "same-origin",
    "Permissions-Policy": "camera=(), microphone=(), geolocation=()",
    "Cache-Control": "no-cache",
}
"""Whatever finds its way into the page can load nothing, send nothing elsewhere, and stand in nobody's frame."""


def page_router() -> APIRouter:
    """The page's routes; they are no part of the API's description."""
    router = APIRouter(include_in_schema=False)
    for path, (name, kind) in FILES.items():
        content = files(__package__).joinpath(name).read_bytes()
        router.add_api_route(path, _served(content, kind), methods=["GET", "HEAD"])
    return router


def _served(content: bytes, kind: str):  # type: ignore[no-untyped-def]  # FastAPI reads the signature of what it gets
    async def serve() -> Response:
        return Response(content, media_type=kind, headers=HEADERS)

    return serve
