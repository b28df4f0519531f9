"""`http_api`: the API's description, as committed, is that of the API."""

from __future__ import annotations

from pathlib import Path

from orchestrator.daemon.http_api import openapi_text

COMMITTED = Path(__file__).parents[3] / "docs" / "openapi.json"


def test_the_committed_description_is_current() -> None:
    assert COMMITTED.read_text(encoding="utf-8") == openapi_text(), (
        "python -c 'from orchestrator.daemon.http_api import *; write_openapi(Path(\"docs/openapi.json\"))'"
    )
