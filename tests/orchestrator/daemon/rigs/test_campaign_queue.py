"""`campaign_queue`: the queue of a running daemon: order, priorities, pauses, several rigs, and what was submitted
staying as it was.
"""

from __future__ import annotations

import asyncio
import contextlib
import gc
import json
import re
import socket
import threading
import time
from datetime import UTC, datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import httpx
import pytest
from pydantic import ValidationError
from typer.testing import CliRunner

from actors.interfaces import OperatorQuestion
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.cli import queue_commands
from orchestrator.cli.app import app
from orchestrator.cli.queue_commands import submit
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.rigs.pour_request import SubmissionIn
from orchestrator.daemon.rigs.submissions import Submission, SubmissionError, pack, prepare, run_request
from orchestrator.daemon.state.access_tokens import Role
from orchestrator.daemon.state.daemon_settings import NO_RIG, DaemonSettings, Rig
from orchestrator.daemon.state.daemon_store import QueueItem
from orchestrator.daemon.state.run_readout import RunReadouts
from orchestrator.reports.progress_state import CHECKPOINT_WORDS
from orchestrator.runs.run_service import RunHandle, RunRequest
from sim_engine.prediction_band import CalibrationResidual
from tests.support.small_campaign import NARROW, write_campaign
from tests.support.toy_daemon import CAMPAIGN, HeldLaboratory, campaign_in, held, run, serving
from tests.support.waiting import PATIENCE


async def test_submitted_campaigns_run_to_their_end_one_after_the_other(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        first, second = await served.submit(), await served.submit()
        found = await served.until(second, "finished")
        assert found["summary"]["pours"] == 3
        assert [pour["state"] for pour in found["pours_made"]] == ["weighed"] * 3
        assert found["pours_made"] == found["summary"]["outcome"]["pours_made"]
        before = await served.get(f"/campaigns/{first}")
        assert before["state"] == "finished"
        assert before["ended"] <= found["begun"]
        assert before["run"] != found["run"]


def test_nothing_of_a_campaign_stays_in_memory_when_the_next_one_has_begun(tmp_path: Path) -> None:
    def handles() -> list[RunHandle]:
        # isinstance would raise at a dead weak proxy of another test
        return [one for one in gc.get_objects() if type(one) is RunHandle]

    async def work() -> None:
        async with serving(tmp_path) as served:
            finished = 0
            # only the last one stays; one that a reader still holds when garbage is collected goes with the next one
            while finished < 3 or (len(handles()) > len(of_other_tests) + 1 and finished < 9):
                await served.until(await served.submit(), "finished")
                finished += 1
            assert len(handles()) <= len(of_other_tests) + 2

    gc.collect()
    of_other_tests = handles()
    gc.disable()  # Python itself would collect cycles much later
    try:
        run(work())
    finally:
        gc.enable()


async def test_pours_are_shown_as_they_are_now_from_one_reading_of_the_campaign(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    read: list[str] = []

    def counted(settings: DaemonSettings, item: QueueItem, rig: Rig) -> RunRequest:
        read.append(item.id)
        return run_request(settings, item, rig)

    monkeypatch.setattr("orchestrator.daemon.api.query_routes.run_request", counted)
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        shown = [(await served.get(f"/campaigns/{key}"))["pours_made"] for _ in range(2)]
        assert [[pour["state"] for pour in pours] for pours in shown] == [["under way"]] * 2
        laboratory.bench.go.set()
        found = await served.until(key, "finished")
        assert [pour["state"] for pour in found["pours_made"]] == ["weighed"] * 3
        settings, item = served.daemon.settings, served.supervisor.queue.item(key)
        plan = run_request(settings, item, settings.rig(item.rig)).campaign
        afresh = RunReadouts().of(settings.runs / str(item.run), lambda: plan, live=False)["pours_made"]
        assert found["pours_made"] == [pour.model_dump() for pour in afresh]
    assert len(read) == 1


async def test_higher_priorities_come_first_and_people_may_change_the_order(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        a, b, c = [await served.submit() for _ in range(3)]
        d = await served.submit(priority=5)

        async def order() -> list[str]:
            return [one["id"] for one in await served.get("/campaigns", state="queued")]

        assert await order() == [d, a, b, c]
        await served.post(f"/campaigns/{c}/move", {"before": b})
        assert await order() == [d, a, c, b]
        await served.post(f"/campaigns/{b}/move", {"before": ""})
        assert await order() == [b, d, a, c]
        await served.post(f"/campaigns/{a}/move", {"priority": 9})
        assert await order() == [a, b, d, c]
        assert not served.laboratories
        await served.post(f"/campaigns/{d}/stop")
        await served.post("/queue/resume")
        for one in (a, b, c):
            await served.until(one, "finished")
        begun = [(await served.get(f"/campaigns/{one}"))["begun"] for one in (a, b, c)]
        assert begun[0] < begun[1] < begun[2]
        assert (await served.get(f"/campaigns/{d}"))["state"] == "withdrawn"


async def test_a_queued_campaign_is_what_it_was_when_it_was_submitted(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        key = await served.submit()
        for path in tmp_path.glob("*.yaml"):
            path.write_text("changed: later\n")
        await served.post("/queue/resume")
        assert (await served.until(key, "finished", "failed"))["state"] == "finished"


async def test_the_queue_outlives_the_daemon(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        keys = [await served.submit(), await served.submit(priority=1)]
    async with serving(tmp_path) as served:
        assert (await served.get("/status"))["queue_paused"]
        assert [one["id"] for one in await served.get("/campaigns")] == [keys[1], keys[0]]
        await served.post("/queue/resume")
        for key in keys:
            await served.until(key, "finished")


async def test_two_campaigns_never_hold_the_same_rig_and_two_rigs_pour_at_once(tmp_path: Path) -> None:
    laboratory = tmp_path / "numbers.yaml"
    laboratory.write_text("{name: numbers, bench: {liquid: {particles: 400}, time_scale: 0}}\n")
    spec = load_laboratory(laboratory)
    rigs = (Rig("left", laboratory, spec), Rig("right", laboratory, spec))
    async with serving(tmp_path, held, rigs=rigs) as served:
        keys = [await served.submit(rig=rig) for rig in ("left", "left", "right")]
        await served.until(keys[2], "running")
        await served.until(keys[0], "running")
        assert (await served.get(f"/campaigns/{keys[1]}"))["state"] == "queued"
        holders = {rig["name"]: rig["campaign"] for rig in await served.get("/rigs")}
        assert holders == {"left": keys[0], "right": keys[2], "none": None}
        assert len(served.laboratories) == 2
        for one in served.laboratories:
            one.bench.go.set()
        await served.until(keys[1], "running")
        served.laboratories[-1].bench.go.set()
        for key in keys:
            await served.until(key, "finished")


async def test_a_campaign_for_no_rig_there_is_is_refused_with_those_there_are(tmp_path: Path) -> None:
    campaign_in(tmp_path)
    async with serving(tmp_path, HeldLaboratory) as served:
        from orchestrator.campaigns.file_loading import load_campaign
        from orchestrator.daemon.rigs.submissions import pack

        text, files = pack(load_campaign(served.campaign))
        told = await served.post("/campaigns", {"text": text, "files": files, "rig": "lefft"}, status=422)
        assert told["detail"] == "there is no rig 'lefft'; there are virtual"
        assert not list((tmp_path / "state/campaigns").iterdir())


async def test_a_plan_for_another_receiver_with_another_theta_is_submitted_as_decant_plan_makes_it(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    theta, bowl = tmp_path / "theta.json", tmp_path / "bowl.yaml"
    theta.write_text('{"friction": 0.21}', encoding="utf-8")
    bowl.write_text(NARROW.replace("narrow", "bowl"), encoding="utf-8")
    sent: dict[str, Any] = {}

    class Told:
        def submit(self, body: Any) -> dict[str, Any]:
            sent.update(body)
            return {"id": "x", "state": "queued", "rig": "none", "waits_for": ""}

    monkeypatch.setattr(
        "orchestrator.cli.queue_commands.connected_client", lambda url, state: contextlib.nullcontext(Told())
    )
    arguments = ["queue", "submit", str(campaign_in(tmp_path)), "--parameters", str(theta), "--receiver", str(bowl)]
    refused = CliRunner().invoke(app, arguments)
    assert refused.exit_code == 2
    assert "--task plan" in refused.stderr
    assert not sent
    assert CliRunner().invoke(app, [*arguments, "--task", "plan"]).exit_code == 0
    async with serving(tmp_path) as served:
        key = (await served.post("/campaigns", sent))["id"]
        found = await served.until(key, "finished")
        plan = run_request(served.daemon.settings, served.supervisor.queue.item(key), Rig(NO_RIG)).campaign
        assert plan.parameters.friction == 0.21
        assert found["name"] == plan.name == "cup-plan"
        assert [scene.receiver.name for scene in plan.deployment.scenes] == ["bowl"]  # type: ignore[union-attr]
        assert len(found["summary"]["outcome"]["receivers"]) == 1


def test_draws_of_theta_travel_to_a_daemon_with_the_campaign_that_is_planned(tmp_path: Path) -> None:
    theta = tmp_path / "theta.json"
    rows = [{"theta": {"friction": friction}, "weight": 1.0} for friction in (0.1, 0.3)]
    content = {"theta": {"friction": 0.2}, "posterior": rows, "remaining_discrepancy": {"shift": 0.25}}
    theta.write_text(json.dumps(content), encoding="utf-8")
    sent: list[dict[str, Any]] = []

    class Client:
        def submit(self, body: dict[str, Any]) -> dict[str, Any]:
            sent.append(body)
            return {"id": "small-1", "state": "queued", "rig": "none", "waits_for": ""}

    @contextlib.contextmanager
    def connected(url: Any, state: Any) -> Any:
        yield Client()

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("orchestrator.cli.queue_commands.connected_client", connected)
        submit(load_campaign(write_campaign(tmp_path, CAMPAIGN)).source, task="plan", parameters=theta, as_json=True)
    (body,) = sent
    settings = DaemonSettings(tmp_path / "state", in_process=True)
    submission = Submission(text=body["text"], files=body["files"], task="plan")
    item = prepare(settings, submission, "00000a", "somebody")
    planned = run_request(settings, item, settings.rig(item.rig)).campaign
    assert planned.parameters.friction == 0.2
    assert planned.deployment is not None
    assert {one.friction for one in planned.deployment.thetas} == {0.1, 0.3}
    assert planned.deployment.left_over == CalibrationResidual(0.25)


async def test_warnings_of_the_check_and_a_missing_recording_are_reported_as_the_run_begins(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("orchestrator.live_view.rerun_subscriber.installed", lambda module: False)
    far = CAMPAIGN.replace("[60 mm, 100 mm]", "[60 mm, 500 mm]").replace("recording: false", "recording: true")
    write_campaign(tmp_path, far)
    async with serving(tmp_path) as served:
        key = await served.submit()
        await served.until(key, "finished")
        told: list[str] = []
        async for one in served.daemon.feed.read(0, key, beat=0.05):
            if one is None:
                break
            body = json.loads(one.data)
            if body["type"] == "LogLine" and body["level"] == "warning":
                told.append(body["text"])
        assert sum("x_offset" in text and "can a stream hit" in text for text in told) == 1
        assert sum(text.startswith("no recording: it needs Rerun") for text in told) == 1


async def test_a_campaign_that_names_a_cluster_uses_the_daemon_s_simulators_and_connects_to_nothing(
    tmp_path: Path,
) -> None:
    with socket.socket() as cluster:
        cluster.bind(("127.0.0.1", 0))
        cluster.listen()
        cluster.setblocking(False)
        port = cluster.getsockname()[1]
        async with serving(tmp_path) as served:
            text = served.campaign.read_text(encoding="utf-8")
            named = text.replace("simulators: 2", f"simulators: 2\n  ray: {{address: '127.0.0.1:{port}'}}")
            assert named != text
            served.campaign.write_text(named, encoding="utf-8")
            await served.until(await served.submit(), "finished")
        with pytest.raises(BlockingIOError):
            cluster.accept()


async def test_a_campaign_that_is_sent_again_with_its_id_is_queued_once(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        text, files = pack(load_campaign(served.campaign))
        body = {"id": "study-1", "text": text, "files": files}
        first, second = await asyncio.gather(*(served.post("/campaigns", body) for _ in range(2)))
        assert first["id"] == second["id"] == (await served.post("/campaigns", body, status=200))["id"]
        assert [one["caller_id"] for one in await served.get("/campaigns")] == ["study-1"]
        assert (await served.get("/campaigns/study-1"))["id"] == first["id"]
        told = await served.post("/campaigns", {**body, "priority": 1}, status=409)
        assert told["detail"].startswith(f"id study-1 belongs to another campaign, {first['id']}")
        for _ in range(2):  # without an id, every request is another campaign
            await served.submit()
        assert len(await served.get("/campaigns")) == 3
        await served.post("/queue/resume")
        await served.until(first["id"], "finished")
        assert (await served.post("/campaigns", body, status=200))["id"] == first["id"]


async def test_a_campaign_waits_for_its_earliest_start_and_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async with serving(tmp_path) as served:
        start = datetime.now(UTC).replace(microsecond=0) + timedelta(days=90)
        late = await served.submit(not_before=start.astimezone(timezone(timedelta(hours=1))).isoformat())
        early = await served.submit(not_before=(datetime.now(UTC) + timedelta(seconds=0.3)).isoformat())
        await served.until(early, "finished")
        found = await served.get(f"/campaigns/{late}")
        assert found["state"] == "queued"
        assert found["not_before"] == start.timestamp()
        assert found["waits_for"] == f"its earliest start, {start.astimezone().isoformat(' ')}"
        paths = "/status", "/campaigns", "/questions", f"/campaigns/{late}"
        answers = {path: await served.get(path) for path in paths}
        client = SimpleNamespace(get=lambda path, **query: answers[path])
        monkeypatch.setattr(queue_commands, "connected_client", lambda *where: contextlib.nullcontext(client))
        for key in (None, late):
            queue_commands.list_campaigns(key)
            shown = capsys.readouterr().out
            assert f"its earliest start, {queue_commands.local_time(start.timestamp())}" in shown, key
            assert shown.count(time.strftime("%Z", time.localtime(start.timestamp()))) >= 2
            assert "+00:00" not in shown
        await served.post(f"/campaigns/{late}/move", {"not_before": 0})
        await served.until(late, "finished")


@pytest.mark.parametrize(
    ("value", "text"),
    [
        ("2026-11-27T08:00", "has no zone: '2026-11-27T08:00Z' is the time in UTC"),
        ("20261127", "has no zone"),
        ("tomorrow", "should be a time with its zone, such as '2026-11-27T08:00:00+01:00'"),
        ("1764230400", "should be a time with its zone"),
        ("", "should be a time with its zone"),
        (float("inf"), "finite number"),
        (3600, "3600 is in the year 1970 as seconds since 1970, and a start should be within a year; counted from now"),
        ("2126-11-27T08:00:00+01:00", "is in the year 2126"),
        (-5, "is in the year 1970"),
        (1e300, "is in the year"),
    ],
)
def test_an_earliest_start_that_is_no_time_is_refused(value: object, text: str) -> None:
    with pytest.raises(ValidationError, match=re.escape(text)):
        SubmissionIn.model_validate({"not_before": value})


def test_an_earliest_start_in_milliseconds_is_refused_with_both_readings() -> None:
    """As `Date.now()` of JavaScript gives it: such a campaign would wait for ever."""
    now = int(time.time())
    shown = datetime.fromtimestamp(now).astimezone().isoformat()
    text = f"is in the year 5.*; in milliseconds it would be '{re.escape(shown)}': give {now} if that is meant"
    with pytest.raises(ValidationError, match=text):
        SubmissionIn.model_validate({"not_before": 1000 * now})
    assert SubmissionIn.model_validate({"not_before": now + 60}).not_before == now + 60


PERSON_AT_BENCH = "  arm: {kind: simulated}\n  balance: {kind: simulated}\n  operator: {answers: person}\n  bench:"


def _held_check(monkeypatch: pytest.MonkeyPatch, go: threading.Event, error: str = "") -> list[str]:
    """Checks that wait until the test lets them go on."""
    begun: list[str] = []

    def check(settings: DaemonSettings, item: QueueItem) -> None:
        begun.append(item.id)
        assert go.wait(PATIENCE)
        if error:
            raise SubmissionError(error)

    monkeypatch.setattr("orchestrator.daemon.rigs.campaign_queue.check", check)
    return begun


async def test_a_submission_is_answered_before_its_check_and_then_queued(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    begun = _held_check(monkeypatch, go)
    async with serving(tmp_path) as served:
        text, files = pack(load_campaign(served.campaign))
        body = {"id": "rack-1", "text": text, "files": files}
        first = await served.post("/campaigns", body, status=201)
        assert first["state"] == "checking"
        assert first["waits_for"].startswith("its check")
        again = await served.post("/campaigns", body, status=200)
        assert again["id"] == first["id"]
        go.set()
        await served.until(first["id"], "finished")
        assert begun == [first["id"]]


async def test_what_the_check_finds_is_the_reason_of_a_refused_campaign_whose_id_is_free_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    go.set()
    _held_check(monkeypatch, go, "cups touch: x_offset ≥ 88 mm would clear it")
    async with serving(tmp_path) as served:
        text, files = pack(load_campaign(served.campaign))
        body = {"id": "rack-1", "text": text, "files": files}
        key = (await served.post("/campaigns", body))["id"]
        refused = await served.checked(key)
        assert refused["state"] == "refused"
        assert refused["reason"] == "cups touch: x_offset ≥ 88 mm would clear it"
        assert refused["ended"] is not None
        assert not (served.daemon.settings.snapshots / key).exists()
        assert (await served.post("/campaigns", body, status=200))["id"] == key
        told = await served.post(f"/campaigns/{key}/resume", status=409)
        assert "is refused" in told["detail"]
        _held_check(monkeypatch, go)
        other = await served.post("/campaigns", {**body, "text": text.replace('"seed": 3', '"seed": 4')}, status=201)
        assert other["id"] != key
        await served.until(other["id"], "finished")


def test_a_check_that_the_daemon_s_end_interrupts_is_made_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    never = threading.Event()
    _held_check(monkeypatch, never)
    keys: list[str] = []

    async def begin() -> None:
        async with serving(tmp_path) as served:
            text, files = pack(load_campaign(served.campaign))
            keys.append((await served.post("/campaigns", {"text": text, "files": files}))["id"])

    async def go_on() -> None:
        async with serving(tmp_path) as served:
            await served.until(keys[0], "finished")

    try:
        run(begin())
        monkeypatch.undo()
        run(go_on())
    finally:
        never.set()


async def test_a_campaign_that_is_stopped_during_its_check_stays_withdrawn(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    go = threading.Event()
    _held_check(monkeypatch, go)
    async with serving(tmp_path) as served:
        text, files = pack(load_campaign(served.campaign))
        stopped, paused = [(await served.post("/campaigns", {"text": text, "files": files}))["id"] for _ in range(2)]
        await served.post(f"/campaigns/{stopped}/stop")
        await served.post(f"/campaigns/{paused}/pause")
        go.set()
        await served.until(paused, "paused")
        assert (await served.get(f"/campaigns/{stopped}"))["state"] == "withdrawn"
        await served.post(f"/campaigns/{paused}/resume")
        await served.until(paused, "finished")


async def test_the_same_content_by_another_path_or_as_text_is_the_same_campaign(tmp_path: Path) -> None:
    for folder in ("a", "b"):
        (tmp_path / folder).mkdir()
        write_campaign(tmp_path / folder, CAMPAIGN).rename(tmp_path / folder / f"{folder}.yaml")
    async with serving(tmp_path, roots=(tmp_path,)) as served:
        await served.post("/queue/pause")
        first = await served.post("/campaigns", {"id": "x", "path": "a/a.yaml"}, status=201)
        second = await served.post("/campaigns", {"id": "x", "path": "b/b.yaml"}, status=200)
        text, files = pack(load_campaign(tmp_path / "a" / "a.yaml"))
        third = await served.post("/campaigns", {"id": "x", "text": text, "files": files}, status=200)
        assert first["id"] == second["id"] == third["id"]
        vessel = tmp_path / "b" / "narrow.yaml"
        vessel.write_text(vessel.read_text(encoding="utf-8").replace("mm", "cm", 1), encoding="utf-8")
        if load_campaign(tmp_path / "b" / "b.yaml"):
            await served.post("/campaigns", {"id": "x", "path": "b/b.yaml"}, status=409)


def test_the_command_waits_for_the_check_and_makes_an_id(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    campaign, states, sent = campaign_in(tmp_path), ["checking", "checking", "refused"], list[dict[str, Any]]()

    def item() -> dict[str, Any]:
        return {"id": "cup-1", "state": states.pop(0), "rig": "virtual", "waits_for": "", "reason": "cups touch"}

    client = SimpleNamespace(submit=lambda body: sent.append(body) or item(), get=lambda path: item())
    monkeypatch.setattr(queue_commands, "connected_client", lambda *where: contextlib.nullcontext(client))
    result = CliRunner().invoke(app, ["queue", "submit", str(campaign)])
    assert result.exit_code == 2
    assert "cups touch" in result.stderr
    assert not states
    assert SubmissionIn.model_validate(sent[0]).id.startswith("small-")


def test_a_submission_without_a_response_is_sent_again_with_its_id(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    seen: list[bytes] = []

    def respond(request: httpx.Request) -> httpx.Response:
        seen.append(request.content)
        if len(seen) == 1:
            raise httpx.ReadTimeout("timed out")
        return httpx.Response(201, json={"id": "a"})

    with Client("http://127.0.0.1:9", tmp_path, token="x" * 20) as client:
        client._http = httpx.Client(base_url=client.url, transport=httpx.MockTransport(respond))
        assert client.submit({"id": "a", "text": "b"}) == {"id": "a"}
    assert seen[0] == seen[1]


async def test_a_shutdown_says_what_it_waits_for_and_that_a_second_one_does_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    async with serving(tmp_path, held) as served:
        key = await served.submit()
        laboratory = await served.pouring()
        ending = await served.post("/shutdown", role=Role.ADMIN)
        assert ending["waits_for"] == [
            f"{key} at rig virtual: the pour under way, which is weighed (now {CHECKPOINT_WORDS['tilt']})"
        ]
        assert not ending["at_once"]
        client = SimpleNamespace(post=lambda path: ending)
        monkeypatch.setattr(queue_commands, "connected_client", lambda *where: contextlib.nullcontext(client))
        queue_commands.shutdown()
        told = capsys.readouterr()
        assert ending["waits_for"][0] in told.out
        assert "a second 'decant server stop' does not wait" in told.err
        served.daemon.stopping = True
        assert (await served.post("/shutdown", role=Role.ADMIN))["at_once"]
        laboratory.bench.go.set()


async def test_a_shutdown_names_the_open_question(tmp_path: Path) -> None:
    def asking() -> HeldLaboratory:
        laboratory = held()
        laboratory.bench.question = OperatorQuestion(about="refill", text="Fill the pourer", wants="done", hands=True)
        return laboratory

    async with serving(tmp_path, asking) as served:
        served.campaign.write_text(CAMPAIGN.replace("  bench:", PERSON_AT_BENCH).replace("scale: 0", "scale: 50"))
        await served.submit()
        question = await served.question()
        (line,) = (await served.post("/shutdown", role=Role.ADMIN))["waits_for"]
        assert f"the answer to question {question['id']}" in line
        assert line.endswith("Fill the pourer")
        await served.post(f"/questions/{question['id']}/answer", {"answer": "done"})
