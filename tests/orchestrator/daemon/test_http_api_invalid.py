"""Requests that are not JSON, or have values that JSON has not: refused with their place, never echoed, never a 500."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.daemon.state.access_tokens import Role
from tests.support.toy_daemon import serving

BODIES = [
    ("/campaigns", '{"text": "a", "priority": NaN}', ["body", "priority"], "finite"),
    ("/campaigns", '{"text": "a", "not_before": 1e400}', ["body", "not_before"], "finite"),
    ("/campaigns", '{"text": "a\\ud800"}', ["body", "text"], "surrogate"),
    ("/campaigns", '{"text": "a", "files": {"x\\udfff": ""}}', ["body", "files", "key"], "surrogate"),
    (
        "/pours",
        '{"id": "a", "source": "b", "receiver": "c", "action": {"x": -Infinity}}',
        ["body", "action", "x"],
        "fin",
    ),
    (
        "/materials/liquids",
        '{"id": "a", "properties": {"density": [1, NaN]}}',
        ["body", "properties", "density", 1],
        "f",
    ),
    ("/materials/vessels", '{"id": "a", "shape": {"profile": "\\udc00"}}', ["body", "shape", "profile"], "surrogate"),
    ("/runs/none/notes", '{"text": "\\ud83d"}', ["body", "text"], "surrogate"),
    ("/questions/1/answer", '{"answer": "\\ud83d"}', ["body", "answer"], "surrogate"),
]


async def test_values_that_json_has_not_are_refused_with_their_field(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        headers = {**served.headers(Role.ADMIN), "Content-Type": "application/json"}
        for path, body, place, text in BODIES:
            answer = await served.http.post(f"/api/v1{path}", content=body, headers=headers)
            assert answer.status_code == 422, (path, answer.text)
            places = {tuple(problem["loc"]): problem["msg"] for problem in answer.json()["detail"]}
            assert any(list(loc)[: len(place)] == place and text in msg for loc, msg in places.items()), answer.text


@pytest.mark.parametrize("media_type", ["application/yaml", "text/plain", "application/x-www-form-urlencoded", ""])
async def test_another_media_type_is_named_and_the_body_is_not_echoed(tmp_path: Path, media_type: str) -> None:
    async with serving(tmp_path) as served:
        headers = {**served.headers(Role.ADMIN), **({"Content-Type": media_type} if media_type else {})}
        for body in ("text: secret", '{"text": "secret"}', '"secret"'):
            answer = await served.http.post("/api/v1/campaigns", content=body, headers=headers)
            assert answer.status_code == 422
            assert "send application/json" in answer.json()["detail"]
            assert "secret" not in answer.text


async def test_no_value_of_an_invalid_request_is_echoed(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        for body in ({"text": ["secret" * 100]}, ["secret"], {"priority": "secret"}, {"files": {"a": ["secret"]}}):
            answer = await served.post("/campaigns", body, status=422)
            assert "secret" not in str(answer)
