"""`http_api`: the API's description, as committed, is that of the API."""

from __future__ import annotations

import json
from pathlib import Path

from orchestrator.daemon.http_api import openapi_text
from tests.support.toy_daemon import serving

COMMITTED = Path(__file__).parents[3] / "docs" / "openapi.json"


async def test_the_served_description_is_the_committed_one(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        assert (await served.http.get("/api/v1/openapi.json")).text == COMMITTED.read_text(encoding="utf-8")


def test_a_start_is_described_as_it_is_accepted_and_texts_as_text() -> None:
    document = json.loads(COMMITTED.read_text(encoding="utf-8"))
    for model in ("SubmissionIn", "PourIn", "MoveIn"):
        options = document["components"]["schemas"][model]["properties"]["not_before"]["anyOf"][0]["anyOf"]
        assert [option["type"] for option in options] == ["number", "string"]
    for path in ("/events", "/metrics", "/campaigns/{key}/report", "/runs/{run}/report"):
        (content,) = document["paths"][f"/api/v1{path}"]["get"]["responses"]["200"]["content"].values()
        assert content["schema"] == {"type": "string"}, path


def test_the_committed_description_is_current() -> None:
    assert COMMITTED.read_text(encoding="utf-8") == openapi_text(), (
        "python -c 'from orchestrator.daemon.http_api import *; write_openapi(Path(\"docs/openapi.json\"))'"
    )
