"""`access_control`: who gets in, and with what: tokens, roles, guessing, paths that lead elsewhere, files that blow
up, sheer size.
"""

from __future__ import annotations

import base64
import http.client
import itertools
import json
import os
import socket
import stat
import sys
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import httpx
import pytest
from typer.testing import CliRunner

from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.cli.app import app
from orchestrator.daemon.api.access_control import DRAIN
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.rigs.submissions import SubmissionBundleError, unpack
from orchestrator.daemon.state.access_tokens import (
    FAILURES,
    WINDOW,
    Role,
    TokenFileError,
    Tokens,
    TooManyFailuresError,
    token_of,
)
from orchestrator.records.run_registry import enter
from tests.support.browser import on_port
from tests.support.toy_daemon import Served, held, serving

LOOKING = (
    *("/status", "/campaigns", "/campaigns/x", "/questions", "/rigs", "/events", "/metrics", "/campaigns/x/report"),
    *("/runs", "/pours", "/runs/x/report"),
)
DOING = (
    "/campaigns",
    "/campaigns/x/pause",
    "/campaigns/x/resume",
    "/campaigns/x/stop",
    "/campaigns/x/abort",
    "/campaigns/x/move",
    "/campaigns/x/enable",
    "/questions/1/answer",
    "/queue/pause",
    "/queue/resume",
    "/runs/x/notes",
    "/emergency-stop/clear",
    "/shutdown",
)


async def test_nothing_but_health_is_told_without_a_token_and_viewers_do_nothing(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        for path in LOOKING:
            assert (await served.http.get(f"/api/v1{path}")).status_code == 401, path
        for path in (*DOING, "/emergency-stop"):
            assert (await served.http.post(f"/api/v1{path}", json={})).status_code == 401, path
        for path in DOING:
            answer = await served.http.post(f"/api/v1{path}", json={}, headers=served.headers(Role.VIEWER))
            assert answer.status_code == 403, path
        assert (await served.http.get("/healthz")).json() == {"ok": True, "problems": []}
        assert (await served.http.get("/readyz")).status_code in (200, 503)
        for path in ("/docs", "/openapi.json", "/api/v1/docs", "/redoc"):
            assert (await served.http.get(path)).status_code == 404


def test_every_route_asks_for_a_token(tmp_path: Path) -> None:
    from orchestrator.daemon.http_api import create_app

    described = create_app().openapi()["paths"]
    open_to_all = {path for path, verbs in described.items() for verb in verbs.values() if "security" not in verb}
    assert open_to_all == {"/healthz", "/readyz"}


async def test_wrong_tokens_from_an_address_bar_wrong_ones_and_never_the_right_one(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        await served.submit()
        await served.pouring()
        for number in range(FAILURES + 2):
            answer = await served.http.get("/api/v1/status", headers={"Authorization": f"Bearer guess {number}"})
            assert answer.status_code == (401 if number < FAILURES else 429)
        assert int(answer.headers["Retry-After"]) <= WINDOW + 1
        for role in Role:
            await served.get("/status", role=role)
        await served.post("/emergency-stop", role=Role.VIEWER)
        assert served.laboratories[0].arm_stops == 1


def test_guesses_are_forgotten_after_a_while_and_do_not_bar_others(tmp_path: Path) -> None:
    now = [0.0]
    tokens = Tokens(tmp_path / "tokens", clock=lambda: now[0])
    for _ in range(FAILURES):
        assert tokens.person("guess", "here") is None
    with pytest.raises(TooManyFailuresError, match="60 s"):
        tokens.person("guess", "here")
    assert tokens.person("guess", "there") is None
    now[0] = WINDOW + 1.0
    assert tokens.person("guess", "here") is None


def test_tokens_are_made_once_for_their_owner_alone_and_refused_where_others_can_read_them(tmp_path: Path) -> None:
    path = tmp_path / "state" / "tokens"
    Tokens(path)
    text = path.read_text()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600
    assert [line.split()[0] for line in text.splitlines()[1:]] == ["admin", "operator", "viewer"]
    Tokens(path)
    assert path.read_text() == text
    path.chmod(0o640)
    with pytest.raises(TokenFileError, match="others may read the tokens"):
        Tokens(path)


def test_a_bad_line_has_no_effect_and_the_others_have_theirs(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    tokens = Tokens(path)
    good = token_of(path, Role.OPERATOR) or ""
    text, secret = path.read_text(), "Geheimes-Wort"
    bad = [f"operator tablet {secret}", f"chief tablet {secret * 2}", f"viewer a b {secret * 2}", "viewer a sha256:12"]
    path.write_text(text + "\n".join([*bad, f"viewer late {secret * 2} until=tomorrow"]) + "\n")
    assert tokens.find(good) is not None
    assert [problem.partition(": ")[0] for problem in tokens.problems] == [f"tokens:{line}" for line in range(5, 10)]
    assert "decant server token add" in tokens.problems[0]
    assert secret not in "".join(tokens.problems)
    assert Tokens(path).find(good) is not None


async def test_tokens_are_added_expired_and_revoked_while_the_daemon_runs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with serving(tmp_path) as served:
        state = ["--state", str(served.daemon.settings.state)]

        def token(*arguments: str, code: int = 0) -> str:
            result = CliRunner().invoke(app, ["server", "token", *arguments, *state])
            assert result.exit_code == code, result.output
            return result.stdout.strip() or result.stderr

        async def status(secret: str) -> httpx.Response:
            return await served.http.get("/api/v1/status", headers={"Authorization": f"Bearer {secret}"})

        anna, screen = token("add", "operator", "anna"), token("add", "viewer", "screen", "--days", "2")
        assert (await status(anna)).json()["person"] == {"name": "anna", "role": "operator"}
        assert (await status(screen)).json()["person"] == {"name": "screen", "role": "viewer"}
        assert "revoke it first" in token("add", "viewer", "anna", code=2)
        assert "is no name" in token("add", "viewer", "an na", code=2)
        text = served.daemon.settings.tokens.read_text()
        assert anna not in text
        assert "sha256:" in text
        shown = token("list")
        assert "operator  anna" in shown
        assert "in plain text" in shown.splitlines()[0]
        now = time.time()
        with monkeypatch.context() as later:
            later.setattr("orchestrator.daemon.state.access_tokens.time.time", lambda: now + 3 * 86_400)
            assert (await status(screen)).status_code == 401
            assert (await status(anna)).status_code == 200
        token("revoke", "anna")
        assert (await status(anna)).status_code == 401
        assert "there is no token of anna" in token("revoke", "anna", code=2)
        with served.daemon.settings.tokens.open("a") as file:
            file.write("operator tablet short\n")
        problems = (await served.get("/status"))["problems"]
        assert any("this line has no effect" in problem for problem in problems)


def test_a_file_that_others_may_read_by_now_changes_nothing(tmp_path: Path) -> None:
    path = tmp_path / "tokens"
    tokens = Tokens(path)
    good = token_of(path, Role.VIEWER) or ""
    path.chmod(0o644)
    assert tokens.find(good) is not None
    assert "others may read the tokens" in tokens.problems[0]
    path.chmod(0o600)
    assert tokens.find(good) is not None
    assert tokens.problems == []


async def test_the_local_command_line_acts_as_the_local_user(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("DECANT_TOKEN", raising=False)
    monkeypatch.setenv("LOGNAME", "ada")
    async with serving(tmp_path) as served:
        state = served.daemon.settings.state
        with (state / "tokens").open("a") as file:
            file.write(f"admin boss {'x' * 30}\n")
        with Client("http://127.0.0.1:1", state) as client:
            headers = client._http.headers
        for name, recorded in (("ada", "ada (local)"), ("a\nb", "somebody (local)")):
            sent = {"Authorization": headers["Authorization"], "Decant-User": name.replace("\n", " ")}
            answer = await served.http.post("/api/v1/queue/pause", headers=sent)
            assert answer.json()["person"] == {"name": recorded, "role": "admin"}
            assert served.daemon.store.audit(limit=1)[0]["by"] == recorded
        assert headers["Decant-User"] == "ada"
        # the header of somebody with a token of their own changes nothing
        sent = {**served.headers(Role.OPERATOR), "Decant-User": "boss"}
        assert (await served.http.get("/api/v1/status", headers=sent)).json()["person"]["name"] == "operator"


def first_run(state: Path) -> None:
    enter([state.parent / "run"], state)


def first_look_at_runs(state: Path) -> None:
    Catalogue(state).close()


def first_daemon(state: Path) -> None:
    Tokens(state / "tokens")


@pytest.mark.parametrize("existing", [False, True])
@pytest.mark.parametrize("begin", [first_run, first_look_at_runs, first_daemon])
def test_only_its_owner_reads_the_state_directory_whatever_makes_it(
    tmp_path: Path, begin: Callable[[Path], None], existing: bool
) -> None:
    state = tmp_path / "state"
    before = os.umask(0o022)
    try:
        if existing:
            state.mkdir()
            assert stat.S_IMODE(state.stat().st_mode) == 0o755
        begin(state)
    finally:
        os.umask(before)
    assert stat.S_IMODE(state.stat().st_mode) == 0o700


BOMB = "a: &a [x, x, x, x, x, x, x, x, x, x]\n" + "".join(
    f"{chr(98 + i)}: &{chr(98 + i)} [{', '.join([f'*{chr(97 + i)}'] * 10)}]\n" for i in range(8)
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        pytest.param(BOMB, "more than 20000 values", id="aliases of aliases"),
        pytest.param("[" * 5000, "nested more than", id="depth"),
        pytest.param("name: !!python/object/apply:os.system [touch x]\n", "a list; put it in quotes", id="code"),
        pytest.param("laboratory: ../../tokens\nname: x\nseed: 1\n", "lies outside", id="the daemon's own files"),
        pytest.param("laboratory: /etc/passwd\nname: x\nseed: 1\n", "lies outside", id="the system's files"),
        pytest.param("pourer: /nonexistent/x.yaml\nname: x\nseed: 1\n", "lies outside", id="what is not there"),
        pytest.param("\x00\x01", "not YAML", id="not text"),
    ],
)
async def test_what_is_submitted_neither_looks_elsewhere_nor_blows_up(tmp_path: Path, text: str, said: str) -> None:
    async with serving(tmp_path) as served:
        told = await served.post("/campaigns", {"text": text}, status=422)
        assert said in told["detail"]
        assert "daemon:" not in told["detail"], "a file's content was shown"
        assert_no_place_of_the_server(told["detail"], tmp_path)
        assert list((tmp_path / "state/campaigns").iterdir()) == []


@pytest.mark.parametrize(
    "name",
    [
        "../../../../x",
        "a/../x",
        "../campaign/campaign.yaml",
        "/etc/x",
        "a/../../x",
        "a//b",
        ".hidden",
        "campaign.yaml",
        "a\x00b",
        "x" * 200,
        "",
    ],
)
def test_files_go_nowhere_but_into_the_snapshot(tmp_path: Path, name: str) -> None:
    with pytest.raises(SubmissionBundleError, match="is not a name for one"):
        unpack("name: x\n", {name: base64.b64encode(b"x").decode()}, tmp_path / "snapshot")
    assert list(tmp_path.iterdir()) == []


async def test_a_link_in_a_root_does_not_lead_out_of_it(tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    outside = tmp_path / "outside.yaml"
    outside.write_text("name: secret\n")
    (root / "link.yaml").symlink_to(outside)
    (root / "refers.yaml").write_text("name: x\npourer: ../outside.yaml\nlaboratory: link.yaml\nseed: 1\n")
    async with serving(tmp_path, roots=(root,)) as served:
        for path in ("link.yaml", "../outside.yaml", str(outside), "nothing.yaml", "/etc/passwd"):
            told = await served.post("/campaigns", {"path": path}, status=422)
            assert "no such campaign in the folders that may be read" in told["detail"], path
        told = await served.post("/campaigns", {"path": "refers.yaml"}, status=422)
        assert told["detail"].count("lies outside") == 2
        assert_no_place_of_the_server(told["detail"], tmp_path)
        assert "secret" not in told["detail"]


async def test_a_disk_error_is_refused_without_paths_of_the_server(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        snapshots = tmp_path / "state/campaigns"
        snapshots.rmdir()
        snapshots.symlink_to(tmp_path / "nothing" / "there")
        told = await served.post("/campaigns", {"text": "name: x\nseed: 1\n"}, status=422)
        assert_no_place_of_the_server(told["detail"], tmp_path)


def assert_no_place_of_the_server(text: str, folder: Path) -> None:
    for place in (folder, folder.resolve(), Path.cwd(), Path.home(), Path(sys.prefix)):
        assert str(place) not in text, text


async def test_a_campaign_in_a_root_is_submitted_by_its_path(tmp_path: Path) -> None:
    async with serving(tmp_path, roots=(tmp_path,)) as served:
        key = (await served.post("/campaigns", {"path": "small.yaml"}))["id"]
        await served.until(key, "finished")


async def test_ten_megabytes_are_not_read(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        text = "x" * 10_000_000
        told = await served.post("/campaigns", {"text": text}, status=413)
        assert told["detail"] == "more than 4 MB are not read"

        async def pieces() -> Any:  # of unknown length
            for _ in range(100):
                yield b"x" * 100_000

        answer = await served.http.post("/api/v1/campaigns", headers=served.headers(), content=pieces())
        assert answer.status_code == 413


@pytest.mark.parametrize("known_length", [True, False])
@pytest.mark.parametrize("megabytes", [5, 60])
def test_a_body_that_is_too_large_is_answered_before_the_connection_closes(
    tmp_path: Path, megabytes: int, known_length: bool
) -> None:
    """Over a real socket, with a client that sends everything before it reads: a reset would lose the answer."""
    body = itertools.repeat(b"x" * 1_000_000, megabytes)
    with on_port(tmp_path) as lab:
        connection = http.client.HTTPConnection(lab.url.removeprefix("http://"), timeout=60)
        headers = lab.served.headers() | ({"Content-Length": str(megabytes * 1_000_000)} if known_length else {})
        connection.request("POST", "/api/v1/campaigns", body, headers, encode_chunked=not known_length)
        answer = connection.getresponse()
        assert answer.status == 413
        assert "more than 4 MB are not read" in json.loads(answer.read())["detail"]
        connection.close()


def test_a_client_that_waits_for_100_continue_is_refused_at_once(tmp_path: Path) -> None:
    with on_port(tmp_path) as lab:
        host, _, port = lab.url.removeprefix("http://").partition(":")
        with socket.create_connection((host, int(port)), timeout=DRAIN / 2) as connection:
            connection.sendall(
                f"POST /api/v1/campaigns HTTP/1.1\r\nHost: {host}:{port}\r\nContent-Length: 900000000\r\n"
                "Expect: 100-continue\r\n\r\n".encode()
            )
            with connection.makefile("rb") as answer:
                assert answer.read().startswith(b"HTTP/1.1 413 ")  # to the end: the connection is closed, too


async def test_another_name_for_this_machine_is_not_answered(tmp_path: Path) -> None:
    async def ask(served: Served, host: str) -> int:
        answer = await served.http.get("/healthz", headers={"Host": host})
        return answer.status_code

    async with serving(tmp_path) as served:
        for host in ("localhost:8377", "127.0.0.1", "[::1]:1", "[::1]"):
            assert await ask(served, host) == 200, host
        for host in ("evil.example", "evil.example:8377", "127.0.0.1.evil.example", ""):
            assert await ask(served, host) == 421, host
        answer = await served.http.options(
            "/api/v1/status", headers={"Origin": "http://evil.example", "Access-Control-Request-Method": "GET"}
        )
        assert "access-control-allow-origin" not in answer.headers
