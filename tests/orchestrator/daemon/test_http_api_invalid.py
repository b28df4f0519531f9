"""Requests that are not JSON, or have values that JSON has not: refused with their place, never echoed, never a 500."""

from __future__ import annotations

import gzip
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


@pytest.mark.parametrize(
    ("body", "status", "message"),
    [
        # requests.post(json=json.dumps(…)), as in questions about FastAPI's "value is not a valid dict"
        (
            b'"{\\"text\\": \\"secret\\"}"',
            422,
            "the body should be one JSON object, {…}; it is a text: was it encoded twice?",
        ),
        # DataFrame.to_json(orient="records")
        (b'[{"text": "secret"}]', 422, "the body should be one JSON object, {…}"),
        # str() of a dict of Python, a comma after the last value, and a body that is cut off
        (b"{'text': 'secret'}", 422, "JSON decode error: Expecting property name enclosed in double quotes"),
        (b'{"text": "secret",}', 422, "JSON decode error: "),  # Python 3.13 names the comma
        (b'{"text": "secret', 422, "JSON decode error: Unterminated string starting at"),
        # str with an umlaut as data=, which http.client encodes in Latin-1, and a compressed body
        ('{"text": "Krüge"}'.encode("latin-1"), 400, "the body is not text in UTF-8; send JSON in UTF-8"),
        (gzip.compress(b'{"text": "secret"}', mtime=0), 400, "not compressed"),
        # what PowerShell and .NET write is read
        (b'\xef\xbb\xbf{"text": "name: x"}', 422, "key 'laboratory' is missing"),
        ('{"text": "name: x"}'.encode("utf-16"), 422, "key 'laboratory' is missing"),
    ],
)
async def test_bodies_as_clients_send_them_are_read_or_refused_with_the_cause(
    tmp_path: Path, body: bytes, status: int, message: str
) -> None:
    async with serving(tmp_path) as served:
        headers = {**served.headers(Role.ADMIN), "Content-Type": "application/json"}
        answer = await served.http.post("/api/v1/campaigns", content=body, headers=headers)
        assert answer.status_code == status, answer.text
        assert message in str(answer.json()["detail"])
        assert "secret" not in answer.text


async def test_no_value_of_an_invalid_request_is_echoed(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        for body in ({"text": ["secret" * 100]}, ["secret"], {"priority": "secret"}, {"files": {"a": ["secret"]}}):
            answer = await served.post("/campaigns", body, status=422)
            assert "secret" not in str(answer)
