"""`sila_server`: the SiLA 2 server, called by the unmodified client of the package sila2 in an environment of its
own.
"""

from __future__ import annotations

import contextlib
import json
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from actors.runtime.child_process import child_environment
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.state.access_tokens import Role, token_of
from sim_engine.resources import installed
from tests.support.other_environments import line, python_with, running, told
from tests.support.station_process import station_process
from tests.support.toy_daemon import campaign_in
from tests.support.waiting import wait_for

DECANT = [sys.executable, "-c", "from orchestrator.cli.app import main; main()"]

needs_cdk = pytest.mark.skipif(not installed("unitelabs"), reason="the extra 'sila' is not installed")


@contextlib.contextmanager
def sila(folder: Path, url: str, *options: str) -> Iterator[tuple[str, str]]:
    """`decant server sila` for a daemon; yields the address."""
    process = subprocess.Popen(
        [*DECANT, "server", "sila", "--url", url, "--state", str(folder / "state"), "--port", "0", *options],
        stderr=subprocess.PIPE,
        text=True,
        env=child_environment(),
    )
    try:
        assert process.stderr is not None
        said = process.stderr.readline()
        assert said.startswith("serving SiLA 2 at "), said + process.stderr.read()
        host, _, port = said.split()[4].rpartition(":")
        yield host, port
        process.terminate()
        assert process.wait(60) == 0
    finally:
        process.kill()
        process.wait()
        if process.stderr is not None:
            process.stderr.close()


@contextlib.contextmanager
def api(folder: Path, url: str) -> Iterator[Client]:
    with Client(url, folder / "state", token_of(folder / "state/tokens", Role.ADMIN)) as client:
        yield client


def poured(folder: Path) -> int:
    path = folder / "poured"
    return len(path.read_text().splitlines()) if path.exists() else 0


CLIENT = """
import json, os, sys, time, traceback, warnings
from sila2.client import SilaClient
from sila2.framework import DefinedExecutionError
warnings.simplefilter("ignore")
def fail(*error):
    traceback.print_exception(*error)
    os._exit(1)  # threads of the client's subscriptions would keep the process
sys.excepthook = fail
client = SilaClient(sys.argv[1], int(sys.argv[2]), insecure=True)
station = client.PouringStation
def pour(key, amount=30.0, receiver="vial-1", action=()):
    return station.Pour(key, "beaker", receiver, amount, 1.0, list(action), "", "")
def end(command):
    while not command.done:
        time.sleep(0.05)
    try:
        return command.get_responses()._asdict()
    except DefinedExecutionError as error:
        return [error.fully_qualified_identifier.split("/")[-1], error.message]
def refused(call, *arguments):
    try:
        call(*arguments)
    except DefinedExecutionError as error:
        return [error.fully_qualified_identifier.split("/")[-1], error.message]
def tell(told):
    print("TOLD " + json.dumps(told), flush=True)
    os._exit(0)
"""

POURS = """
states, vessels = [], []
station.State.subscribe().add_callback(states.append)
station.Vessels.subscribe().add_callback(lambda found: vessels.append({one.VesselId: one.Mass for one in found}))
first = pour("plan:1")
steps = first.subscribe_to_intermediate_responses()
made = end(first)
again = end(pour("plan:1"))
other = end(pour("plan:1", amount=20.0))
unknown = end(pour("plan:2", receiver="nothing"))
much = end(pour("plan:3", amount=5000.0))
station.Weigh("beaker", 90.5, 0.1, "", "after a filling")
low, high = station.PredictPour("beaker", "vial-1", 5.0, 1.0, [], "", "")[:2]
while not any(abs(one["beaker"] - 90.5) < 1e-6 for one in vessels):
    time.sleep(0.05)
wrong = end(pour("plan:4", amount=0.0, action=[("angular_velocity", "100 mm")]))
campaign = end(station.RunCampaign("study:1", sys.argv[3], ""))
campaign_again = end(station.RunCampaign("study:1", sys.argv[3], ""))
station.EmergencyStop("a test")
while states[-1] != "stopped":
    time.sleep(0.05)
tell({
    "made": made, "again": again, "other": other, "unknown": unknown, "much": much, "low": low, "high": high,
    "wrong": wrong, "campaign": campaign, "campaign_again": campaign_again, "states": states,
    "steps": [one.State for one in steps], "refused": end(pour("plan:5")),
    "no order": refused(station.Cancel, "nothing"), "progress": first.progress,
    "uuid": str(client.SiLAService.ServerUUID.get()), "features": list(client.SiLAService.ImplementedFeatures.get()),
})
"""


@needs_cdk
@pytest.mark.slow
def test_the_unmodified_client_of_sila2_pours_once_weighs_runs_a_campaign_and_observes(tmp_path: Path) -> None:
    python = python_with("sila2", "SILA")
    campaign = campaign_in(tmp_path)
    with station_process(tmp_path, "station") as (url, _, _), sila(tmp_path, url) as address:
        found = told(python, CLIENT + POURS, *address, str(campaign))
        with api(tmp_path, url) as client:
            assert [one["id"] for one in client.get("/pours")] == ["plan:1"]
            assert [one["caller_id"] for one in client.get("/campaigns")].count("study:1") == 1
            assert client.get("/status")["emergency"] is not None
    assert found["made"] == found["again"]
    result = json.loads(found["made"]["Details"])
    assert found["made"]["ReceivedMass"] == result["result"]["received_g"]
    assert found["progress"] == 1.0
    assert "running" in found["steps"]
    assert found["other"][0] == "OrderRefusedError"
    assert "plan:1 belongs to another order" in found["other"][1]
    assert found["unknown"][0] == "InvalidOrderError"
    assert "there is no vessel 'nothing'" in found["unknown"][1]
    assert found["much"][0] == "OrderRefusedError"
    assert found["low"] < found["high"]
    assert found["wrong"][0] == "InvalidOrderError"
    assert "angular_velocity" in found["wrong"][1]
    assert found["campaign"] == found["campaign_again"]
    assert json.loads(found["campaign"]["Details"])["state"] == "finished"
    assert found["states"][-1] == "stopped"
    assert found["refused"][0] == "OrderRefusedError"
    assert "emergency stop" in found["refused"][1]
    assert found["no order"][0] == "InvalidOrderError"
    assert not any("ConnectionConfiguration" in one for one in found["features"]), "no connections to other machines"
    assert poured(tmp_path) == 1 + 3, "one pour, and three of the campaign"


QUEUED = """
waiting, cancelled = pour("plan:1", amount=5.0), pour("plan:2", amount=5.0)
steps = [one.subscribe_to_intermediate_responses() for one in (waiting, cancelled)]
queued = [next(one).State for one in steps]
station.Pause("plan:1")
paused = next(steps[0]).State
station.Cancel("plan:2")
gone = end(cancelled)
print("HELD", flush=True)
sys.stdin.readline()
station.Resume("plan:1")
tell({"queued": queued, "paused": paused, "gone": gone, "waited": end(waiting)})
"""


@needs_cdk
@pytest.mark.slow
def test_orders_that_wait_are_paused_resumed_and_cancelled(tmp_path: Path) -> None:
    python = python_with("sila2", "SILA")
    with station_process(tmp_path, "station") as (url, _, _), sila(tmp_path, url) as address, api(tmp_path, url) as own:
        own.post("/queue/pause")
        with running(python, CLIENT + QUEUED, *address) as process:
            line(process, "HELD")
            own.post("/queue/resume")
            assert process.stdin is not None
            process.stdin.write("go on\n")
            process.stdin.flush()
            found = json.loads(line(process, "TOLD "))
    assert (found["queued"], found["paused"]) == (["queued", "queued"], "paused")
    assert found["gone"][0] == "OrderCancelledError"
    assert found["waited"]["ReceivedMass"] > 0.0
    assert poured(tmp_path) == 1


KILLED = """
command = pour("plan:1")
for step in command.subscribe_to_intermediate_responses():
    print("STATE", step.State, flush=True)
    if step.State in ("unknown", "waiting for operator"):
        break
questions = []
while not questions:
    questions = list(station.Questions.get())
print("QUESTION", flush=True)
tell({"questions": questions, "made": end(command), "again": end(pour("plan:1"))})
"""


@needs_cdk
@pytest.mark.slow
def test_a_pour_whose_daemon_is_killed_stays_a_running_command_until_the_operator_has_answered(tmp_path: Path) -> None:
    python = python_with("sila2", "SILA")
    with contextlib.ExitStack() as opened:
        with station_process(tmp_path, "held") as (url, _, daemon), api(tmp_path, url):
            address = opened.enter_context(sila(tmp_path, url))
            client = opened.enter_context(running(python, CLIENT + KILLED, *address))
            wait_for(lambda: poured(tmp_path) == 1, "the pour begins")
            daemon.kill()
            daemon.wait()
        port = int(url.rpartition(":")[2])
        with station_process(tmp_path, "none", port) as (url, _, _), api(tmp_path, url) as own:
            line(client, "QUESTION")
            question: dict[str, Any] = wait_for(lambda: next(iter(own.get("/questions")), None), "a question") or {}
            own.post(f"/questions/{question['id']}/answer", {"answer": "weighed 2 60"})
            found = json.loads(line(client, "TOLD "))
    assert found["made"] == found["again"]
    assert found["made"]["ReceivedMass"] == pytest.approx(38.0)
    assert len(found["questions"]) == 1
    assert poured(tmp_path) == 1


TLS = """
import json, sys
from pathlib import Path
from sila2.client import SilaClient
ca, certificate, key = (Path(name).read_bytes() for name in sys.argv[3:])
def state(**more):
    try:
        return SilaClient("localhost", int(sys.argv[2]), root_certs=ca, **more).PouringStation.State.get()
    except Exception as error:
        return type(error).__name__
print("TOLD " + json.dumps([state(cert_chain=certificate, private_key=key), state()]), flush=True)
"""


def certificate(folder: Path, name: str) -> tuple[str, str]:
    """A certificate for localhost that signed itself, and its key."""
    files = str(folder / f"{name}.pem"), str(folder / f"{name}.key")
    subprocess.run(
        ["openssl", "req", "-x509", "-newkey", "rsa:2048", "-nodes", "-days", "2", "-subj", "/CN=localhost",
         "-addext", "subjectAltName=DNS:localhost,IP:127.0.0.1", "-out", files[0], "-keyout", files[1]],
        check=True, capture_output=True, env=child_environment(),
    )  # fmt: skip
    return files


@needs_cdk
@pytest.mark.slow
@pytest.mark.skipif(shutil.which("openssl") is None, reason="openssl makes the certificates")
def test_with_tls_only_clients_of_the_authority_reach_the_station(tmp_path: Path) -> None:
    python = python_with("sila2", "SILA")
    server, own = certificate(tmp_path, "server"), certificate(tmp_path, "client")
    options = ("--certificate", server[0], "--key", server[1], "--clients", own[0])
    with station_process(tmp_path, "station") as (url, _, _), sila(tmp_path, url, *options) as address:
        admitted, refused = told(python, TLS, *address, server[0], *own)
    assert admitted in ("ready", "not ready")
    assert refused not in ("ready", "not ready")


@needs_cdk
@pytest.mark.parametrize(
    ("options", "problem"),
    [
        (["--host", "0.0.0.0"], "other machines reach this address"),
        (["--certificate", "pyproject.toml"], "--certificate and --key belong together"),
        (["--clients", "pyproject.toml"], "--clients needs --certificate"),
    ],
)
def test_an_address_that_others_reach_needs_tls(options: list[str], problem: str) -> None:
    from orchestrator.daemon.integrations.sila_server import SilaServerError, check_address

    chosen = dict(zip(options[::2], map(Path, options[1::2]), strict=True))
    with pytest.raises(SilaServerError, match=problem):
        check_address(
            options[1] if options[0] == "--host" else "127.0.0.1",
            chosen.get("--certificate"), chosen.get("--key"), chosen.get("--clients"),
        )  # fmt: skip


@pytest.mark.skipif(installed("unitelabs"), reason="the extra 'sila' is installed")
def test_without_the_extra_the_command_names_it() -> None:
    from typer.testing import CliRunner

    from orchestrator.cli.app import app

    done = CliRunner().invoke(app, ["server", "sila"])
    assert done.exit_code == 2
    assert "pip install 'decant-pouring[sila]'" in done.output
