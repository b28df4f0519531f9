"""The recipes of docs/recipes, each executed with the real package in an environment of its own.

$DECANT_PREFECT_PYTHON, $DECANT_BLUESKY_PYTHON and $DECANT_AX_PYTHON name interpreters with those packages. The queue
server needs Redis: `redis-server` on the path, or $DECANT_REDIS_SERVER.
"""

from __future__ import annotations

import asyncio
import contextlib
import importlib.util
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import types
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML

from actors.runtime.child_process import child_environment
from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.state.access_tokens import Role, token_of
from tests.support.other_environments import ALONE, python_with, told
from tests.support.station_process import station_process
from tests.support.waiting import PATIENCE, wait_for

RECIPES = Path(__file__).parents[1] / "docs" / "recipes"

pytestmark = pytest.mark.slow


def poured(folder: Path) -> int:
    path = folder / "poured"
    return len(path.read_text().splitlines()) if path.exists() else 0


def access(folder: Path, url: str) -> dict[str, str]:
    return {"DECANT_URL": url, "DECANT_TOKEN": token_of(folder / "state/tokens", Role.OPERATOR) or ""}


@contextlib.contextmanager
def api(folder: Path, url: str) -> Iterator[Client]:
    with Client(url, folder / "state", token_of(folder / "state/tokens", Role.ADMIN)) as client:
        yield client


def run(python: str, *arguments: str, **environment: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [python, *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
        env=child_environment({**ALONE, **environment}),
    )


def test_the_script_pours_once_and_waits_for_the_operator_after_the_daemon_was_killed(tmp_path: Path) -> None:
    order = ("plate-1:7", "beaker", "vial-1", "30 g", "1 g")
    script = str(RECIPES / "pour_script.py")
    with station_process(tmp_path, "held") as (url, node, daemon):
        environment = child_environment({**ALONE, **access(tmp_path, url)})
        process = subprocess.Popen([sys.executable, script, *order], stdout=subprocess.PIPE, text=True, env=environment)
        try:
            wait_for(lambda: poured(tmp_path) == 1, "the pour begins")
            daemon.kill()
            daemon.wait()
            ports = (int(one.rpartition(":")[2]) for one in (url, node))
            with station_process(tmp_path, "none", *ports), api(tmp_path, url) as own:
                question = wait_for(lambda: next(iter(own.get("/questions")), {}), "a question")
                own.post(f"/questions/{question['id']}/answer", {"answer": "weighed 2 60"})
                said, _ = process.communicate(timeout=PATIENCE)
                assert process.returncode == 0
                assert json.loads(said)["received_g"] == pytest.approx(38.0)
                again = run(sys.executable, script, *order, **access(tmp_path, url))
                assert json.loads(again.stdout)["received_g"] == pytest.approx(38.0)
                refused = run(sys.executable, script, "plate-1:8", *order[1:3], "30 kg", "1 g", **access(tmp_path, url))
                assert refused.returncode == 1
                assert "plate-1:8: beaker" in refused.stderr
        finally:
            process.kill()
            process.wait()
            assert process.stdout is not None
            process.stdout.close()
    assert poured(tmp_path) == 1


@pytest.mark.parametrize("optimiser", ["stand-in", "Ax"])
def test_the_closed_loop_pours_what_its_optimiser_proposes_within_one_run(tmp_path: Path, optimiser: str) -> None:
    """With Ax, $DECANT_AX_PYTHON needs Decant, too."""
    python = sys.executable if optimiser == "stand-in" else python_with("ax", "AX")
    process = subprocess.run(
        [python, str(RECIPES / "mixtures_loop.py"), "2"], capture_output=True, text=True, timeout=600, check=False,
        cwd=tmp_path, env=child_environment({"XDG_STATE_HOME": str(tmp_path / "state")}),
    )  # fmt: skip
    assert process.returncode == 0, process.stderr[-3000:]
    lines = [json.loads(line) for line in process.stdout.splitlines() if line.startswith("{")]
    assert lines[0]["cups"] == 4
    assert lines[-1]["cups"] == 8
    assert 0.0 < lines[0]["best"] <= lines[-1]["best"] <= 1.0
    assert sum(lines[-1]["shares"]) == pytest.approx(1.0, abs=0.01)
    (table,) = (tmp_path / "runs").glob("loop-*/mixtures.csv")
    assert len(table.read_text().splitlines()) == 1 + 8 * 3


def test_a_flow_of_prefect_fills_vials_and_pours_nothing_again_in_its_second_run(tmp_path: Path) -> None:
    python = python_with("prefect", "PREFECT")
    with station_process(tmp_path, "station") as (url, _, _):
        environment = {
            **access(tmp_path, url),
            "PREFECT_HOME": str(tmp_path / "prefect"),
            "PREFECT_SERVER_ANALYTICS_ENABLED": "false",
            "PREFECT_SERVER_EPHEMERAL_STARTUP_TIMEOUT_SECONDS": "300",
            "DO_NOT_TRACK": "1",
        }
        arguments = (str(RECIPES / "prefect_flow.py"), "plate-1", "beaker", "30 g", "vial-1")
        first, second = (run(python, *arguments, **environment) for _ in range(2))
        assert first.returncode == 0, first.stderr[-3000:]
        assert "{'vial-1': " in first.stdout
        assert second.stdout == first.stdout
        assert poured(tmp_path) == 1
        wrong = run(python, *arguments[:-1], "nothing", **environment)
        assert wrong.returncode == 1
        assert "there is no vessel 'nothing'" in wrong.stderr


BLUESKY = """
import json, sys
sys.path.insert(0, sys.argv[1])
from bluesky import RunEngine
from bluesky.protocols import Movable, Readable, Status
from bluesky.utils import FailedStatus
from bluesky_station import PourStatus, fill_vials, station
engine, documents = RunEngine({}), []
assert isinstance(station, Movable) and isinstance(station, Readable) and isinstance(PourStatus(), Status)
for _ in range(2):
    engine(fill_vials("plate-1", "beaker", "30 g", ["vial-1"]), lambda name, doc: documents.append([name, doc]))
try:
    engine(fill_vials("plate-1", "beaker", "30 g", ["nothing"]))
    refused = ""
except FailedStatus as error:
    refused = str(error.__cause__ or error)
events = [doc["data"] for name, doc in documents if name == "event"]
plans = [doc["plan"] for name, doc in documents if name == "start"]
units = [doc["data_keys"]["station_received"]["units"] for name, doc in documents if name == "descriptor"]
print("TOLD " + json.dumps({"events": events, "plans": plans, "units": units, "refused": refused}))
"""


def test_a_plan_of_bluesky_fills_vials_and_its_documents_have_the_weights(tmp_path: Path) -> None:
    python = python_with("bluesky", "BLUESKY")
    with station_process(tmp_path, "station") as (url, _, _):
        found = told(python, BLUESKY, str(RECIPES), **access(tmp_path, url))
        with api(tmp_path, url) as own:
            result = own.get("/pours")[0]["result"]
    assert [one["station_received"] for one in found["events"]] == [result["received_g"]] * 2
    assert (found["plans"], found["units"]) == (["plate-1"] * 2, ["g"] * 2)
    assert "there is no vessel 'nothing'" in found["refused"]
    assert poured(tmp_path) == 1


QUEUE = """
import json, sys, time
from bluesky_queueserver import ZMQCommSendThreads
manager = ZMQCommSendThreads(zmq_server_address=sys.argv[1], timeout_recv=200_000)
def ask(method, **params):
    answer = manager.send_message(method=method, params=params or None)
    assert answer.get("success", True), answer
    return answer
def until(**wanted):
    while not all(ask("status")[key] == value for key, value in wanted.items()):
        time.sleep(0.2)
until(manager_state="idle")
ask("environment_open")
until(worker_environment_exists=True, manager_state="idle")
item = {"item_type": "plan", "name": "fill_vials", "args": ["plate-1", "beaker", "30 g", ["vial-1"]]}
for _ in range(2):
    ask("queue_item_add", item=item, user="test", user_group="primary")
ask("queue_start")
until(items_in_history=2, manager_state="idle")
history = [one["result"]["exit_status"] for one in ask("history_get")["items"]]
ask("environment_close")
until(worker_environment_exists=False, manager_state="idle")
ask("manager_stop")
print("TOLD " + json.dumps(history))
"""


PERMISSIONS = """
user_groups:
  root: {allowed_plans: [null], allowed_devices: [null]}
  primary: {allowed_plans: [":.*"], allowed_devices: [":?.*:depth=5"]}
"""


def end_group(process: subprocess.Popen[bytes]) -> None:
    """End a program with all processes that it started."""
    with contextlib.suppress(ProcessLookupError):
        os.killpg(process.pid, signal.SIGKILL)
    process.wait()


def free_ports(count: int) -> list[int]:
    with contextlib.ExitStack() as opened:
        sockets = [opened.enter_context(socket.create_server(("127.0.0.1", 0))) for _ in range(count)]
        return [one.getsockname()[1] for one in sockets]


def test_the_queue_server_of_bluesky_runs_the_plan(tmp_path: Path) -> None:
    python = python_with("bluesky_queueserver", "BLUESKY")
    redis = os.environ.get("DECANT_REDIS_SERVER") or shutil.which("redis-server")
    if redis is None:
        pytest.skip("no Redis ($DECANT_REDIS_SERVER)")
    startup = tmp_path / "startup"
    startup.mkdir()
    (startup / "00-engine.py").write_text("from bluesky import RunEngine\nRE = RunEngine({})\n")
    shutil.copy(RECIPES / "bluesky_station.py", startup / "10-station.py")
    (startup / "user_group_permissions.yaml").write_text(PERMISSIONS)
    redis_port, control, info = free_ports(3)
    manager = [
        *("-c", "from bluesky_queueserver.manager.start_manager import start_manager; start_manager()"),
        *("--startup-dir", str(startup), "--redis-addr", f"127.0.0.1:{redis_port}"),
        *("--zmq-control-addr", f"tcp://127.0.0.1:{control}", "--zmq-info-addr", f"tcp://127.0.0.1:{info}"),
    ]
    with contextlib.ExitStack() as opened:
        url, _, _ = opened.enter_context(station_process(tmp_path, "station"))
        environment = child_environment({**ALONE, **access(tmp_path, url), "HOME": str(tmp_path)})
        for program in (
            [redis, "--port", str(redis_port), "--bind", "127.0.0.1", "--save", "", "--dir", str(tmp_path)],
            [python, *manager],
        ):
            with (tmp_path / "log").open("a") as log:
                process = subprocess.Popen(program, env=environment, stdout=log, stderr=log, start_new_session=True)
            opened.callback(end_group, process)
        history = told(python, QUEUE, f"tcp://127.0.0.1:{control}")
        with api(tmp_path, url) as own:
            assert [one["state"] for one in own.get("/pours")] == ["weighed"]
    assert history == ["completed", "completed"]
    assert poured(tmp_path) == 1


class StandIn:
    """Base class of a device or a task, as EOS documents it; EOS is not on PyPI."""

    DevicesType = ParametersType = ResourcesType = dict[str, Any]
    OutputType = tuple[Any, Any, Any]


def eos_class(name: str, *parts: str) -> Any:
    path = RECIPES.joinpath("eos", *parts)
    spec = importlib.util.spec_from_file_location(f"recipe_{parts[-2]}", path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return getattr(module, name)


def test_the_device_of_eos_pours_where_stand_ins_take_the_place_of_its_base_classes(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, base in (("eos.devices.base_device", "BaseDevice"), ("eos.tasks.base_task", "BaseTask")):
        module = types.ModuleType(name)
        setattr(module, base, StandIn)
        monkeypatch.setitem(sys.modules, name, module)
    settings = YAML(typ="safe").load(RECIPES / "eos/devices/pouring_station/device.yml")
    task_file = YAML(typ="safe").load(RECIPES / "eos/tasks/pour/task.yml")
    assert task_file["devices"]["station"]["type"] == settings["type"]
    station = eos_class("PouringStation", "devices", "pouring_station", "device.py")()
    pour = eos_class("Pour", "tasks", "pour", "task.py")()
    given = {name: one.get("value") for name, one in task_file["input_parameters"].items()}
    given |= {"order_id": "run-1:fill", "source": "beaker", "receiver": "vial-1", "amount": 30.0}

    async def work(url: str) -> tuple[Any, Any]:
        (tmp_path / "token").write_text(access(tmp_path, url)["DECANT_TOKEN"])
        parameters = {**settings["init_parameters"], "url": url, "token_file": str(tmp_path / "token")}
        assert set(parameters) == set(settings["init_parameters"])
        await station._initialize(parameters)
        assert "ready" in await station._report()
        made = [await pour._execute({"station": station}, given, {}) for _ in range(2)]
        with pytest.raises(RuntimeError, match="there is no vessel 'nothing'"):
            station.pour({"id": "run-1:other", "source": "nothing", "receiver": "vial-1", "amount": "30 g"})
        await station._cleanup()
        return made[0], made[1]

    with station_process(tmp_path, "station") as (url, _, _):
        first, second = asyncio.run(work(url))
    assert first == second
    assert set(first[0]) == set(task_file["output_parameters"])
    assert first[0]["received"] > 0.0
    assert poured(tmp_path) == 1
