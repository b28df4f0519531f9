"""`madsci_node`: the daemon as a MADSci node: the calls of madsci.client 0.8.1, replayed, and by the client where
it is installed.
"""

from __future__ import annotations

import contextlib
import json
from collections.abc import AsyncIterator
from pathlib import Path
from typing import Any

import httpx
import pytest

from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.integrations.madsci_node import PERSON, create_node, new_ulid
from orchestrator.daemon.rigs.ordering import Ordering
from orchestrator.daemon.rigs.pour_request import PourIn
from orchestrator.daemon.state.access_tokens import Role, token_of
from orchestrator.daemon.state.daemon_settings import MadsciSettings
from tests.support.other_environments import line, python_with, running, told
from tests.support.station import order, rigs_in, set_up, until_pour
from tests.support.station_process import node_process, station_process
from tests.support.toy_daemon import Served, held, serving
from tests.support.waiting import PATIENCE, wait_for

ARGS = {
    "source": "beaker",
    "receiver": "vial-1",
    "action": {"angular_velocity": "100 deg/s", "x_offset": "70 mm"},
    "predict": False,
}


def ordering(served: Served) -> Ordering:
    return Ordering(served.daemon, served.supervisor.queue)


@contextlib.asynccontextmanager
async def node(served: Served, address: str = "127.0.0.1") -> AsyncIterator[httpx.AsyncClient]:
    app = create_node(
        served.supervisor, Ordering(served.daemon, served.supervisor.queue), MadsciSettings(allow=["127.0.0.0/8"])
    )
    transport = httpx.ASGITransport(app=app, client=(address, 1))
    async with httpx.AsyncClient(transport=transport, base_url="http://node") as http:
        yield http


async def created(http: httpx.AsyncClient, name: str = "pour", **changes: Any) -> str:
    answer = await http.post(f"/action/{name}", json={"args": ARGS | changes})
    assert answer.status_code == 200, answer.text
    return str(answer.json()["action_id"])


async def test_a_started_action_is_poured_once_however_often_its_start_is_repeated(tmp_path: Path) -> None:
    async with serving(tmp_path, held, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        async with node(served) as http:
            info = (await http.get("/info")).json()
            assert len(info["node_id"]) == len(new_ulid()) == 26
            assert set(info["actions"]) == {"pour", "predict_pour", "run_campaign"}
            key = await created(http)
            assert (await http.get(f"/action/pour/{key}/status")).json() == "not_started"
            for _ in range(3):
                assert (await http.post(f"/action/pour/{key}/start")).json()["status"] == "running"
            await served.pouring()
            assert (await http.get("/status")).json()["running_actions"] == [key]
            served.laboratories[0].bench.go.set()
            found = await until_pour(served, key, "weighed")
            result = (await http.post(f"/action/pour/{key}/start")).json()
            assert result["status"] == "succeeded"
            assert result["json_result"]["result"]["received_g"] == found["result"]["received_g"]
            assert len(served.laboratories[0].bench.poured) == 1
            history = (await http.get("/action", params={"action_id": key})).json()
            assert history[key][0]["status"] == "succeeded"
            wrong = await created(http, source="nothing")
            refused = (await http.post(f"/action/pour/{wrong}/start")).json()
            assert refused["status"] == "failed"
            assert "there is no vessel 'nothing'" in refused["errors"][0]["message"]
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served) as http:
        assert (await http.get("/info")).json()["node_id"] == info["node_id"]
        assert (await http.get(f"/action/{key}/result")).json()["status"] == "succeeded"


async def test_admin_commands_stop_and_hold_the_node_and_only_a_person_clears_a_stop(tmp_path: Path) -> None:
    async with serving(tmp_path, held, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        async with node(served) as http:

            async def admin(command: str) -> Any:
                return (await http.post(f"/admin/{command}")).json()

            assert (await admin("AdminCommands.LOCK"))["success"]
            key = await created(http)
            refused = (await http.post(f"/action/pour/{key}/start")).json()
            assert refused["status"] == "not_ready"
            assert refused["errors"][0]["message"] == "the node is locked"
            assert (await admin("unlock"))["success"]
            await http.post(f"/action/pour/{key}/start")
            laboratory = await served.pouring()
            waiting = await created(http, receiver="vial-2")
            await http.post(f"/action/pour/{waiting}/start")
            assert (await admin("safety_stop"))["success"]
            assert laboratory.arm_stops == 1
            await until_pour(served, key, "unknown")
            assert (await http.get(f"/action/{key}/status")).json() == "unknown"
            assert not (await http.get("/status")).json()["ready"]
            assert "administrator" in (await admin("reset"))["errors"][0]["message"]
            assert not (await admin("shutdown"))["success"]
            assert (await admin("cancel"))["success"]
            assert (await http.get(f"/action/{waiting}/status")).json() == "cancelled"
            await served.post("/emergency-stop/clear", role=Role.ADMIN)
            assert (await admin("reset"))["success"]
            await admin("lock")
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served) as http:
        assert (await http.get("/status")).json()["locked"]


def messages(found: dict[str, Any]) -> str:
    return "; ".join(one["message"] for one in found["errors"])


async def test_an_action_whose_order_was_stored_when_the_daemon_was_killed_is_started(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served) as http:
        await set_up(served)
        await served.post("/queue/pause")
        unsent = await created(http)
        key = await created(http)
        await ordering(served).pour(PourIn.model_validate({**ARGS, "id": key}), PERSON)
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served) as http:
        found = (await http.get(f"/action/{unsent}/result")).json()
        assert found["status"] == "not_started"
        assert "nothing moved" in messages(found)
        for answer in (await http.get(f"/action/{key}/result"), await http.post(f"/action/pour/{key}/start")):
            assert answer.json()["status"] == "running"
            assert "the queue is paused" in messages(answer.json())
        campaign = (await served.get(f"/pours/{key}"))["campaign"]
        served.daemon.store.change(campaign, mode="hardware")
        found = (await http.get(f"/action/{key}/result")).json()
        assert found["status"] == "running"
        assert f"decant queue enable {campaign}" in messages(found)
        served.daemon.store.change(campaign, mode="virtual")
        await http.post("/admin/resume")
        pour = await until_pour(served, key, "weighed")
        found = (await http.get(f"/action/{key}/result")).json()
        assert found["status"] == "succeeded"
        assert found["json_result"]["result"]["received_g"] == pour["result"]["received_g"]
        assert len(await served.get("/pours")) == 1


@pytest.mark.parametrize("answer", ["weighed 2 60", "cancel"])
async def test_a_pour_without_outcome_states_what_has_to_be_done_until_it_is_settled(
    tmp_path: Path, answer: str
) -> None:
    async with serving(tmp_path, held, rigs=rigs_in(tmp_path)) as served, node(served) as http:
        await set_up(served)
        key = await created(http)
        await http.post(f"/action/pour/{key}/start")
        await served.pouring()
        campaign = (await served.get(f"/pours/{key}"))["campaign"]
        await http.post("/admin/safety_stop")
        await served.until(campaign, "unknown", "paused")
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served) as http:

        async def told(act: str) -> None:
            found = (await http.get(f"/action/{key}/result")).json()
            assert found["status"] == "unknown"
            assert "the outcome is unknown" in messages(found)
            assert act in messages(found)
            assert act in messages((await http.get("/status")).json())

        await told("decant estop --clear")
        await served.post("/emergency-stop/clear", role=Role.ADMIN)
        await told(f"decant queue resume {campaign}")
        other = await created(http, receiver="vial-2")
        refused = (await http.post(f"/action/pour/{other}/start")).json()
        assert refused["status"] == "failed"
        assert f"pour {key} has begun and has no outcome" in messages(refused)
        await served.post(f"/campaigns/{campaign}/resume")
        question = (await served.question())["id"]
        await until_pour(served, key, "unknown")
        await told(f"decant queue answer {question}")
        if answer == "cancel":
            await http.post("/admin/cancel")
            await served.until(campaign, "stopped")
            found = (await http.get(f"/action/{key}/result")).json()
            assert found["status"] == "failed"  # final: the client waits for ever for an 'unknown' action
            assert "weigh beaker and vial-1" in messages(found)
        else:
            await served.post(f"/questions/{question}/answer", {"answer": answer})
            await until_pour(served, key, "weighed")
            found = (await http.get(f"/action/{key}/result")).json()
            assert found["status"] == "succeeded"
            assert found["json_result"]["result"]["received_g"] == pytest.approx(38.0)
        assert (await http.get("/status")).json()["errors"] == []
        assert sum(len(one.bench.poured) for one in served.laboratories) == 0


async def test_an_address_that_is_not_listed_reaches_nothing(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served, node(served, "10.1.1.1") as http:
        for path in ("/info", "/status"):
            assert (await http.get(path)).status_code == 403
        assert (await http.post("/admin/safety_stop")).status_code == 403
        assert served.supervisor.stops.of_all is None


CLIENT = """
import json, sys
from madsci.client.node.rest_node_client import RestNodeClient
from madsci.common.types.action_types import ActionRequest
from madsci.common.types.node_types import AdminCommands
client = RestNodeClient(url=sys.argv[1])
args = json.loads(sys.argv[2])
info = client.get_info()
told = {"node": info.node_name, "ready": client.get_status().ready, "state": sorted(client.get_state())}
def act(name, **changes):
    request = ActionRequest(action_name=name, args={**args, **changes})
    return client.send_action(request, await_result=True, timeout=300)
told["predicted"] = act("predict_pour", amount="30 g").status.value
told["poured"] = act("pour", amount="30 g").status.value
told["refused"] = act("pour", amount="30 kg").status.value
for command in (AdminCommands.LOCK, AdminCommands.UNLOCK, AdminCommands.PAUSE, AdminCommands.RESUME):
    told[command.value] = client.send_admin_command(command).success
told["safety_stop"] = client.send_admin_command(AdminCommands.SAFETY_STOP).success
told["stopped"] = client.get_status().stopped
told["history"] = len(client.get_action_history())
print("TOLD " + json.dumps(told))
"""


@pytest.mark.slow
def test_the_unmodified_client_of_madsci_pours(tmp_path: Path) -> None:
    """Set $DECANT_MADSCI_PYTHON to an interpreter with madsci.client 0.8.1 in an environment of its own."""
    python = python_with("madsci.client", "MADSCI")
    with node_process(tmp_path) as url:
        found = told(python, CLIENT, url, json.dumps({"source": "beaker", "receiver": "vial-1"}))
    assert found["predicted"] == found["poured"] == "succeeded"
    assert found["refused"] == "failed"
    assert found["safety_stop"]
    assert found["stopped"]
    assert found["history"] == 3


PATIENT = """
import json, sys, time
import httpx
from madsci.client.node.rest_node_client import RestNodeClient
from madsci.common.types.action_types import ActionRequest
from madsci.common.types.node_types import AdminCommands
client = RestNodeClient(url=sys.argv[1])
def started(receiver="vial-1"):
    action = {"angular_velocity": "100 deg/s", "x_offset": "70 mm"}
    args = {"source": "beaker", "receiver": receiver, "action": action, "predict": False}
    return client.send_action(ActionRequest(action_name="pour", args=args), await_result=False)
def patiently(call):
    while True:
        try:
            return call()
        except httpx.TransportError:  # the daemon is restarted, and the three repetitions of the client have failed
            time.sleep(0.2)
def settled(key):
    return patiently(lambda: client.await_action_result(key, timeout=500))
"""

CANCEL = """
pouring = started()
waiting = started("vial-2")
print("STARTED", flush=True)
sys.stdin.readline()
cancelled = client.send_admin_command(AdminCommands.CANCEL).success
left = settled(waiting.action_id)
print("CANCELLED", flush=True)
found = settled(pouring.action_id)
print("TOLD " + json.dumps({"cancelled": cancelled, "waiting": left.status.value, "pouring": found.status.value,
    "received": found.json_result["result"]["received_g"], "busy": client.get_status().busy}), flush=True)
"""


@pytest.mark.slow
def test_a_cancel_of_madsci_ends_what_waits_and_finishes_the_pour_that_has_begun(tmp_path: Path) -> None:
    python = python_with("madsci.client", "MADSCI")
    with station_process(tmp_path, "held") as (_, node, _), running(python, PATIENT + CANCEL, node) as client:
        line(client, "STARTED")
        wait_for(lambda: poured(tmp_path) == 1, "the pour begins")
        assert client.stdin is not None
        client.stdin.write("go on\n")
        client.stdin.flush()
        line(client, "CANCELLED")
        (tmp_path / "go").touch()
        found = json.loads(line(client, "TOLD "))
    assert found["cancelled"]
    assert found["waiting"] == "cancelled"
    assert found["pouring"] == "succeeded"
    assert found["received"] > 0.0
    assert poured(tmp_path) == 1


RESTART = """
try:
    started()
except httpx.TransportError:
    pass  # the daemon was killed before it had answered; the history has the action
print("SENT", flush=True)
key, = patiently(client.get_action_history)
if sys.argv[2] == "pouring":
    while (found := patiently(lambda: client.get_action_result(key))).status.value != "unknown":
        time.sleep(0.1)
    again = started("vial-2")
    status = client.get_status()
    print("WAITS " + json.dumps({"error": found.errors[0].message, "node": [one.message for one in status.errors],
        "ready": status.ready, "again": again.status.value, "refused": again.errors[0].message}), flush=True)
found = settled(key)
print("TOLD " + json.dumps([key, found.status.value, found.json_result["result"]["received_g"]]), flush=True)
"""


@pytest.mark.slow
@pytest.mark.parametrize("stage", ["queued", "leased", "pouring"])
def test_a_daemon_that_is_killed_and_started_again_in_the_middle_pours_once_for_madsci(
    tmp_path: Path, stage: str
) -> None:
    python = python_with("madsci.client", "MADSCI")
    with station_process(tmp_path, "held"):
        pass  # registers the vessels
    with contextlib.ExitStack() as opened:
        with station_process(tmp_path, stage) as (url, node, daemon):
            client = opened.enter_context(running(python, PATIENT + RESTART, node, stage))
            assert daemon.wait(PATIENCE) == -9
        ports = (int(one.rpartition(":")[2]) for one in (url, node))
        with station_process(tmp_path, "none", *ports) as (url, node, _):
            token = token_of(tmp_path / "state/tokens", Role.ADMIN)
            with Client(url, tmp_path / "state", token) as own:
                if stage == "pouring":  # only an operator can state its outcome
                    waits = json.loads(line(client, "WAITS "))
                    (question,) = own.get("/questions")
                    own.post(f"/questions/{question['id']}/answer", {"answer": "weighed 2 60"})
                    for text in (waits["error"], *waits["node"]):
                        assert f"decant queue answer {question['id']}" in text
                    assert not waits["ready"]
                    assert waits["again"] == "failed"
                    assert "has begun and has no outcome" in waits["refused"]
                key, status, received = json.loads(line(client, "TOLD "))
                again = httpx.post(f"{node}/action/pour/{key}/start").json()
                assert len(own.get("/pours")) == 1
    assert status == "succeeded"
    assert again["json_result"]["result"]["received_g"] == received
    if stage == "pouring":
        assert received == pytest.approx(38.0)
    assert poured(tmp_path) == 1


def poured(folder: Path) -> int:
    path = folder / "poured"
    return len(path.read_text().splitlines()) if path.exists() else 0


async def test_an_order_of_the_api_and_one_of_the_node_share_the_account(tmp_path: Path) -> None:
    async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
        await set_up(served)
        await served.post("/queue/pause")
        await served.post("/pours", order("mine", amount="60 g"))
        async with node(served) as http:
            assert (await http.get("/status")).json()["paused"]
            await served.post("/queue/resume")
            key = await created(http, amount="60 g", receiver="vial-2")
            refused = (await http.post(f"/action/pour/{key}/start")).json()
            assert refused["status"] == "failed"
