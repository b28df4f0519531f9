"""`emergency_stop`: an emergency stop stops, whatever comes with it: over the API, the command line, SiLA and
MADSci.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import socket
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import HealthCheck, example, given, settings
from hypothesis import strategies as st

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.daemon import PHYSICAL
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.state.access_tokens import Role
from orchestrator.daemon.state.daemon_settings import NO_RIG, Rig
from orchestrator.daemon.state.daemon_store import StoreError
from tests.orchestrator.daemon.integrations.test_madsci_node import node
from tests.orchestrator.daemon.integrations.test_sila_server import needs_cdk, sila
from tests.support.browser import OnPort, on_port
from tests.support.hypothesis_examples import examples
from tests.support.stop_requests import CASES, FORMS, PATH, StopCase, connected, head_of, response, sent, stopped_by
from tests.support.toy_daemon import CAMPAIGN, held, serving
from tests.support.waiting import PATIENCE, wait_for

DECANT = [sys.executable, "-c", "from orchestrator.cli.app import main; main()"]


@pytest.fixture(scope="module")
def lab(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OnPort]:
    with on_port(tmp_path_factory.mktemp("stops")) as found:
        yield found


class Arm:
    """Takes the place of a running campaign: notes when its arm is stopped."""

    def __init__(self) -> None:
        self.item = SimpleNamespace(id="a campaign")
        self.checkpoint = "tilt"
        self.arm_stops = 0
        self.stopped = asyncio.Event()

    async def emergency(self) -> None:
        self.arm_stops += 1
        self.stopped.set()


@contextlib.contextmanager
def tilting(lab: OnPort) -> Iterator[list[Arm]]:
    """Arms of all rigs, which tilt; afterwards the stops are cleared."""
    workers = lab.served.daemon.workers
    before = {name: worker for name, worker in workers.items() if name != NO_RIG}
    arms = [Arm() for _ in before]
    for (name, worker), arm in zip(before.items(), arms, strict=True):
        stub = SimpleNamespace(rig=worker.rig, running=arm, latched=False, arm=None, wake=asyncio.Event())
        workers[name] = stub  # type: ignore[assignment]
    try:
        yield arms
    finally:
        workers |= before
        for name in ("", *lab.served.supervisor.stops.rig_names):
            lab.do(lab.served.post("/emergency-stop/clear", {"rig": name}, role=Role.ADMIN))


def stopped(lab: OnPort, arm: Arm) -> None:
    """Wait until the arm was stopped."""
    lab.do(asyncio.wait_for(arm.stopped.wait(), PATIENCE))


@pytest.mark.parametrize("case", CASES, ids=lambda case: case.name)
def test_a_valid_token_stops_the_arm_whatever_the_body(lab: OnPort, case: StopCase) -> None:
    with tilting(lab) as (arm,):
        found = stopped_by(lab.url, lab.served.tokens[Role.VIEWER], case, lambda: stopped(lab, arm))
        assert found["emergency"]["by"] == "viewer"
        assert arm.arm_stops == 1
        (entry,) = lab.do(audit(lab, 1))
        assert all(note in entry["detail"] for note in found["notes"])


@pytest.mark.parametrize("name", ["late", "bad chunks", "form"])
def test_a_pour_is_given_up_whatever_the_body(tmp_path: Path, name: str) -> None:
    (case,) = [one for one in CASES if one.name == name]
    with on_port(tmp_path) as lab:
        key = lab.do(lab.served.submit())
        laboratory = lab.do(lab.served.pouring())
        stop = asyncio.wait_for(laboratory.bench.stopped.wait(), PATIENCE)
        stopped_by(lab.url, lab.served.tokens[Role.VIEWER], case, lambda: lab.do(stop))
        lab.do(lab.served.until(key, "unknown"))
        assert laboratory.arm_stops == len(laboratory.bench.aborted) == 1


async def audit(lab: OnPort, count: int) -> list[dict[str, Any]]:
    return lab.served.daemon.store.audit(limit=count)


def test_a_client_that_leaves_after_the_head_has_stopped_the_arm(lab: OnPort) -> None:
    case = StopCase("left", b"", ("Content-Length: 19",))
    with tilting(lab) as (arm,):
        before = len(lab.do(audit(lab, 1000)))
        with sent(lab.url, lab.served.tokens[Role.VIEWER], case):
            pass
        stopped(lab, arm)
        wait_for(lambda: len(lab.do(audit(lab, 1000))) > before, "the stop's audit entry")


@pytest.mark.parametrize("late", [False, True])
def test_an_abort_takes_any_body_and_a_trailing_slash(tmp_path: Path, late: bool) -> None:
    with on_port(tmp_path) as lab:
        key = lab.do(lab.served.submit())
        laboratory = lab.do(lab.served.pouring())
        headers = ("Content-Length: 9000000",)
        case = StopCase("abort", b"" if late else b"x", headers, path=f"/api/v1/campaigns/{key}/abort/")
        with sent(lab.url, lab.served.tokens[Role.OPERATOR], case) as connection:
            lab.do(asyncio.wait_for(laboratory.bench.stopped.wait(), PATIENCE))
            assert response(connection)[0] == 200
        lab.do(lab.served.post(f"/campaigns/{key}/abort"))


@pytest.mark.parametrize("token", ["", "a wrong one, but long enough"])
def test_without_a_valid_token_nothing_is_stopped_and_the_answer_says_how(lab: OnPort, token: str) -> None:
    with sent(lab.url, token, StopCase("none", b"{}", ("Content-Length: 2",))) as connection:
        status, found = response(connection)
    assert status == 401
    assert found["detail"].startswith("NOT STOPPED: ")
    assert PHYSICAL in found["detail"]
    assert lab.do(lab.served.get("/status"))["emergency"] is None


@pytest.mark.parametrize("name", FORMS)
def test_a_valid_token_stops_the_arm_in_every_form_of_a_request(lab: OnPort, name: str) -> None:
    head = head_of(FORMS[name], lab.url, lab.served.tokens[Role.VIEWER])
    with tilting(lab) as (arm,), connected(lab.url) as connection:
        connection.sendall(head)
        status, found = response(connection)
        assert status == 200, found
        assert arm.arm_stops == 1
        assert (found["emergency"]["by"], found["notes"]) == ("viewer", [])


def test_a_stop_that_arrives_byte_by_byte_after_another_request_stops(lab: OnPort) -> None:
    token = lab.served.tokens[Role.VIEWER]
    first = head_of("GET /healthz HTTP/1.1|Host: {host}", lab.url, token)
    with tilting(lab) as (arm,), connected(lab.url) as connection:
        connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
        connection.sendall(first)
        assert response(connection)[0] == 200
        for byte in head_of("|POST {path}?reason=glass on it HTTP/1.1|Host: {host}|{token}", lab.url, token):
            connection.sendall(bytes([byte]))
        status, found = response(connection)
        assert (status, arm.arm_stops) == (200, 1)
        assert found["emergency"]["reason"] == "glass on it"


REFUSED = {
    "no token": ("POST {path} HTTP/1.1|Host: {host}", 401),
    "wrong tokens": ("POST {path} HTTP/1.1|Host: {host}|Authorization: Bearer a, Bearer b", 401),
    "wrong token under another name": ("POST {path} HTTP/1.1|Host: evil.example|Authorization: Bearer a", 421),
    "no token in HTTP/1.0": ("POST {path} HTTP/1.0", 421),
    "no token in absolute form": ("POST http://evil.example{path} HTTP/1.1|Host: {host}", 421),
    "GET": ("GET {path} HTTP/1.1|Host: {host}|{token}", 405),
    "DELETE": ("DELETE {path}/ HTTP/1.1|Host: {host}|{token}", 405),
    "OPTIONS": ("OPTIONS {path} HTTP/1.1|Host: {host}", 405),
    "no host": ("POST {path} HTTP/1.1|{token}", 400),
    "two hosts": ("POST {path} HTTP/1.1|Host: a|Host: b|{token}", 400),
    "abort of nothing": ("POST /api/v1/campaigns/nothing/abort HTTP/1.1|Host: {host}|{token}", 404),
}


@pytest.mark.parametrize("name", REFUSED)
def test_every_refusal_of_a_stop_begins_with_not_stopped_and_names_the_physical_one(lab: OnPort, name: str) -> None:
    form, status = REFUSED[name]
    with tilting(lab) as (arm,), connected(lab.url) as connection:
        connection.sendall(head_of(form, lab.url, lab.served.tokens[Role.ADMIN]))
        found = response(connection)
        assert found[0] == status
        assert found[1]["detail"].startswith("NOT STOPPED: ")
        assert PHYSICAL in found[1]["detail"]
        assert ("sent with POST" in found[1]["detail"]) == (status == 405)
        assert arm.arm_stops == 0
    assert lab.do(lab.served.get("/status"))["emergency"] is None


def test_a_viewer_who_may_not_abort_reads_that_nothing_was_stopped(lab: OnPort) -> None:
    told = lab.do(lab.served.post("/campaigns/any/abort", role=Role.VIEWER, status=403))
    assert told["detail"].startswith("NOT STOPPED: viewer is a viewer")


@pytest.mark.parametrize(
    ("form", "status"),
    [
        ("GET {path} HTTP/1.1|Host: evil.example|{token}", 421),
        ("GET http://evil.example{path} HTTP/1.1|Host: {host}|{token}", 421),
        ("GET {path} HTTP/1.0|{token}", 421),
        ("GET {path} HTTP/1.1|Host: {host}|Authorization: Bearer a, {bearer}", 401),
        ("GET http://{host}{path} HTTP/1.1|Host: evil.example|{token}", 200),
        ("POST {path} HTTP/1.1|Host: {host}|{token}", 405),
    ],
)
def test_other_requests_keep_the_checks_of_host_and_token(lab: OnPort, form: str, status: int) -> None:
    head = head_of(form.replace("{path}", "/api/v1/status"), lab.url, lab.served.tokens[Role.ADMIN])
    with connected(lab.url) as connection:
        connection.sendall(head)
        found = response(connection)
    assert found[0] == status
    assert "NOT STOPPED" not in str(found[1])


TYPES = st.sampled_from(
    ["application/json", "text/plain", "application/x-www-form-urlencoded", "multipart/form-data", "application/xml"]
) | st.text(st.characters(min_codepoint=0x21, max_codepoint=0xFF, exclude_characters="\x7f"), max_size=30)
VALUES = st.recursive(st.none() | st.booleans() | st.floats() | st.text(), lambda kind: st.lists(kind, max_size=3))
BODIES = (
    st.binary(max_size=300)
    | st.dictionaries(st.sampled_from(["reason", "rig", "x"]), VALUES).map(lambda value: json.dumps(value).encode())
    | st.text(max_size=100).map(lambda text: text.encode("utf-16"))
)


@example(body=b"\x00", kind="application/json", query="")
@example(body=b"[" * 200_000, kind="", query="&&=%")
@example(body=b'{"reason": ' + b"9" * 5000 + b"}", kind="application/json", query="rig=&rig=x")
@given(body=BODIES, kind=TYPES, query=st.text(st.characters(min_codepoint=0x21, max_codepoint=0x7E), max_size=20))
@settings(max_examples=examples(60), deadline=None, suppress_health_check=list(HealthCheck))
def test_any_bytes_of_any_type_stop(lab: OnPort, body: bytes, kind: str, query: str) -> None:
    headers = (f"Content-Length: {len(body)}", f"Content-Type: {kind}")
    case = StopCase("any", body, headers, path=f"{PATH}?{query.replace('#', '')}")
    with sent(lab.url, lab.served.tokens[Role.VIEWER], case) as connection:
        status, found = response(connection)
    assert status == 200
    assert found["emergency"]["by"] == "viewer"
    assert len(found["emergency"]["reason"]) <= 500
    assert found["emergency"]["reason"].isprintable()
    lab.do(lab.served.post("/emergency-stop/clear", role=Role.ADMIN))


def two_rigs(folder: Path) -> tuple[Rig, ...]:
    path = folder / "numbers.yaml"
    path.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    return tuple(Rig(name, path, load_laboratory(path)) for name in ("left", "right"))


@pytest.fixture(scope="module")
def pair(tmp_path_factory: pytest.TempPathFactory) -> Iterator[OnPort]:
    folder = tmp_path_factory.mktemp("pair")
    with on_port(folder, campaign=CAMPAIGN, rigs=two_rigs(folder)) as found:
        yield found


@pytest.mark.parametrize(
    ("case", "rigs"),
    [
        (StopCase("query", b"", ("Content-Length: 9",), path=f"{PATH}?rig=left"), ["left"]),
        (StopCase("again", path=f"{PATH}?rig=left&rig=left"), ["left"]),
        (StopCase("body", b'{"rig": "left"}', ("Content-Length: 15",)), ["left", "right"]),
        (StopCase("both", b'{"rig": "right"}', ("Content-Length: 16",), path=f"{PATH}?rig=left"), ["left"]),
        (StopCase("twice", path=f"{PATH}?rig=left&rig=right"), ["left", "right"]),
        (StopCase("unknown", path=f"{PATH}?rig=Left"), ["left", "right"]),
        (StopCase("all", path=f"{PATH}?rig="), ["left", "right"]),
    ],
    ids=lambda value: getattr(value, "name", ""),
)
def test_one_of_several_rigs_is_stopped_if_the_query_names_it_and_all_otherwise(
    pair: OnPort, case: StopCase, rigs: list[str]
) -> None:
    with tilting(pair) as arms:
        with sent(pair.url, pair.served.tokens[Role.VIEWER], case) as connection:
            stopped(pair, arms[0])
            connection.sendall(case.rest)
            status, found = response(connection)
        assert status == 200
        assert [arm.arm_stops for arm in arms] == [1, len(rigs) - 1]
        assert (found["emergency"] is not None) == (len(rigs) == 2)
        if len(rigs) == 1:
            assert next(rig["emergency"] for rig in found["rigs"] if rig["name"] == "left")["by"] == "viewer"
            assert not pair.served.daemon.workers["right"].latched


async def test_the_stop_of_one_rig_is_latched_and_cleared_by_itself(tmp_path: Path) -> None:
    (rig, _) = two_rigs(tmp_path)
    async with serving(tmp_path, held, rigs=(rig,)) as served:
        found = await served.post("/emergency-stop?rig=left&reason=glass")
        (stopped_rig,) = [one for one in found["rigs"] if one["name"] == "left"]
        assert stopped_rig["emergency"]["reason"] == "glass"
        await served.post("/emergency-stop/clear", {"rig": "left"}, role=Role.ADMIN)
        assert (await served.get("/status"))["emergency"] is None


async def test_stops_at_once_keep_all_authors_and_reasons(tmp_path: Path) -> None:
    async with serving(tmp_path, held) as served:
        await served.submit()
        laboratory = await served.pouring()
        people = (Role.VIEWER, "glass"), (Role.ADMIN, "smoke")
        await asyncio.gather(*(served.post(f"/emergency-stop?reason={why}", role=role) for role, why in people))
        assert laboratory.arm_stops == 2  # the second order reaches an arm that did not take the first one
        found = (await served.get("/status"))["emergency"]
        assert sorted(found["by"].split(", ")) == ["admin", "viewer"]
        assert sorted(found["reason"].split("; ")) == ["glass", "smoke"]
        await served.post("/emergency-stop?reason=glass", role=Role.VIEWER)
        assert (await served.get("/status"))["emergency"] == found
        entries = [one for one in served.daemon.store.audit() if one["what"] == "emergency stop"]
        assert sorted((one["by"], one["detail"]) for one in entries) == [
            ("admin", "smoke"), ("viewer", "glass"), ("viewer", "glass"),
        ]  # fmt: skip


async def test_a_disk_that_cannot_be_used_prevents_no_stop(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*arguments: Any) -> Any:
        raise StoreError("the disk is full")

    async with serving(tmp_path, held) as served:
        await served.submit()
        laboratory = await served.pouring()
        with monkeypatch.context() as patch:
            for name in ("set_flag", "flag", "note", "questions", "items", "change"):
                patch.setattr(served.daemon.store, name, full)
            found = await served.post("/emergency-stop")
            assert laboratory.arm_stops == 1
            assert "the state of the daemon can't be read: see its log" in found["notes"]
            async with node(served) as http:
                assert (await http.post("/admin/safety_stop")).status_code == 200
            assert laboratory.arm_stops == 2


@pytest.mark.parametrize("reason", ["x" * 10_000, "\ud800\x00", None, 5, {1, 2}, [[]] * 3])
@pytest.mark.parametrize("rig", ["", "Nothing", None])
def test_the_supervisor_stops_for_any_reason_and_rig(lab: OnPort, reason: Any, rig: Any) -> None:
    with tilting(lab) as (arm,):
        notes = lab.do(lab.served.supervisor.stops.stop("library", reason, rig))
        assert arm.arm_stops == 1
        assert ("there is no rig" in "".join(notes)) == (rig != "")
        record = lab.do(lab.served.get("/status"))["emergency"]
        assert record["by"] == "library"
        assert len(record["reason"]) <= 500


@pytest.mark.parametrize("path", ["/safety_stop", "//safety_stop/", "/AdminCommands.SAFETY_STOP", "/SAFETY%5fstop?x"])
def test_the_madsci_node_stops_with_any_body_and_spelling(lab: OnPort, path: str) -> None:
    async def ask() -> Any:
        async with node(lab.served) as http:
            return (await http.post(f"/admin{path}", content=b'{"reason": \xff')).json()

    with tilting(lab) as (arm,):
        assert lab.do(ask())["success"]
        assert arm.arm_stops == 1


def length(number: int) -> bytes:
    """A length as protobuf encodes it."""
    return bytes([number]) if number < 128 else bytes([number & 127 | 128]) + length(number >> 7)


def parameters(reason: bytes) -> bytes:
    """The parameters of `EmergencyStop` as protobuf encodes them: a message with one string."""
    text = b"\x0a" + length(len(reason)) + reason
    return b"\x0a" + length(len(text)) + text


@needs_cdk
def test_sila_stops_for_any_reason(lab: OnPort) -> None:
    import grpc

    call = "/sila2.org.decant.station.pouringstation.v1.PouringStation/EmergencyStop"
    folder = lab.served.daemon.settings.state.parent
    requests = {
        "501": parameters(b"x" * 501),
        "too long for SiLA": parameters(b"x" * (2**21 + 1)),
        "not UTF-8": parameters(b"Gl\xe4s"),
        "no parameter": b"",
        "not protobuf": b"\xff\xff\xff",
    }
    with sila(folder, lab.url) as (host, port), grpc.insecure_channel(f"{host}:{port}") as channel:
        for name, request in requests.items():
            with tilting(lab) as (arm,):
                assert channel.unary_unary(call)(request, timeout=PATIENCE) == b"", name
                assert arm.arm_stops == 1, name


def estop(lab: OnPort, *options: str | bytes) -> subprocess.CompletedProcess[str]:
    state = str(lab.served.daemon.settings.state)
    return subprocess.run(
        [*DECANT, "estop", "--url", lab.url, "--state", state, *options],
        capture_output=True, text=True, env=child_environment(), timeout=PATIENCE, check=False,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("options", "reason", "said"),
    [
        (["--reason", "x" * 100_000], "x" * 500, "note: the reason has"),
        ([b"--reason", b"Gl\xe4s \xff"], "Gl\N{REPLACEMENT CHARACTER}s \N{REPLACEMENT CHARACTER}", ""),
        (["--rig", "Nothing", "glass", "--now", "on the table"], "glass --now on the table", "no rig 'Nothing'"),
        pytest.param([b"--rig", b"\xff"], "", "there is no rig", marks=pytest.mark.slow),
    ],
    ids=["long", "bytes", "words", "rig"],
)
def test_the_command_line_stops_whatever_comes_with_it(
    lab: OnPort, options: list[str | bytes], reason: str, said: str
) -> None:
    with tilting(lab) as (arm,):
        done = estop(lab, *options)
        assert arm.arm_stops == 1, done.stderr
        assert done.returncode == 0
        assert done.stdout.startswith("EMERGENCY STOP: the work is abandoned")
        assert said in done.stderr
        assert lab.do(lab.served.get("/status"))["emergency"]["reason"] == reason


def test_words_never_clear_a_stop(lab: OnPort) -> None:
    lab.do(lab.served.post("/emergency-stop"))
    done = estop(lab, "--clear", "left")
    assert (done.returncode, done.stdout) == (2, "")
    assert "nothing was cleared" in done.stderr
    assert lab.do(lab.served.get("/status"))["emergency"] is not None
    lab.do(lab.served.post("/emergency-stop/clear", role=Role.ADMIN))


def test_a_stop_that_reaches_no_daemon_names_the_physical_one(tmp_path: Path) -> None:
    with (
        Client("http://127.0.0.1:9", tmp_path, "a token of some length") as client,
        pytest.raises(DaemonError, match="THE STOP WAS NOT CONFIRMED: press the physical emergency stop"),
    ):
        client.emergency_stop("glass")


def test_the_client_sends_any_reason(lab: OnPort) -> None:
    with Client(lab.url, token=lab.served.tokens[Role.VIEWER]) as client:
        for reason, rig in (("x" * 3_000_000, ""), ("\ud800", "\udcff"), ("", "x" * 3000)):
            assert client.emergency_stop(reason, rig)["emergency"]["by"] == "viewer"
            lab.do(lab.served.post("/emergency-stop/clear", role=Role.ADMIN))
