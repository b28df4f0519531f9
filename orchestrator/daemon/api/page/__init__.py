"""The operator page: static files that the daemon serves, without resources from other servers.

The page contains no data and needs no token itself. It calls the API with the token that the user enters.
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
"""Path → file name and media type."""

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
"""Security headers: injected content can't load resources, send data elsewhere, or run in a frame."""


def page_router() -> APIRouter:
    """Return the page's routes; the API's description does not include them."""
    router = APIRouter(include_in_schema=False)
    for path, (name, kind) in FILES.items():
        content = files(__package__).joinpath(name).read_bytes()
        router.add_api_route(path, _served(content, kind), methods=["GET", "HEAD"])
    return router


def _served(content: bytes, kind: str):  # type: ignore[no-untyped-def]  # FastAPI reads its result's signature
    async def serve() -> Response:
        return Response(content, media_type=kind, headers=HEADERS)

    return serve
