"""`ray_cleanup`: however a program that uses Ray ends: no process, no folder, nothing in the home folder, nothing
on the network.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from actors.interfaces import LaboratoryError
from actors.runtime import ray_runtime
from actors.runtime.child_process import child_environment
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.ray

PROGRAM = """
import asyncio, json, os, signal, sys, time
import psutil
from actors.runtime.ray_runtime import RayStart, keep_signals, ray_folder, start_ray, stop_ray
from actors.laboratory_settings import LaboratorySettings

class Spinner:
    def pid(self): return os.getpid()
    def spin(self):
        while True: pass

def open_ports():
    me = psutil.Process()
    processes = [me, *me.children(recursive=True)]
    return sorted({c.laddr.ip for p in processes for c in p.net_connections() if c.status == "LISTEN"})

async def main(how, patience):
    caught = asyncio.Event()
    if how == "own handler":
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, caught.set)
    await asyncio.to_thread(start_ray, RayStart())
    keep_signals()
    import ray
    actor = ray.remote(Spinner).remote()
    ray.get(actor.pid.remote())
    actor.spin.remote()
    pids = [p.pid for p in psutil.Process().children(recursive=True)]
    print(json.dumps({"pids": pids, "folder": str(ray_folder()), "listens": open_ports()}), flush=True)
    await asyncio.wait_for(caught.wait(), float(patience))
    print(json.dumps("caught"), flush=True)

asyncio.run(main(*sys.argv[1:]))
"""


FOREIGN = {
    "RAY_grpc_enable_http_proxy": "1",
    "http_proxy": "http://127.0.0.1:9",
    "https_proxy": "http://127.0.0.1:9",
    "RAY_USE_TLS": "1",
    "RAY_TLS_SERVER_CERT": "/nonexistent/server.crt",
    "RAY_REDIS_ADDRESS": "192.0.2.1:6379",
    "RAY_ADDRESS": "192.0.2.1:6379",
    "RAY_NAMESPACE": "elsewhere",
}
"""Settings for another Ray (ray-project/ray #23526, #39191, #37757). A private one that got them would not start."""


def start(how: str, home: Path, **variables: str) -> tuple[subprocess.Popen[str], dict[str, list[int] | str]]:
    environment = {**os.environ, "HOME": str(home), **variables}
    environment.pop("TMPDIR", None)
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, how, str(PATIENCE)],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env=environment,
        start_new_session=True,
    )
    line = program.stdout.readline()
    assert line, program.communicate(timeout=PATIENCE)[1]
    return program, json.loads(line)


def left(facts) -> list[str]:
    """Processes of the program that still run, by title."""
    names = []
    for pid in facts["pids"]:
        with contextlib.suppress(psutil.Error):
            process = psutil.Process(pid)
            if process.status() != psutil.STATUS_ZOMBIE:
                names.append(process.name())
    return names


def assert_clean(facts, home: Path, seconds: float = 15.0) -> None:
    end = time.monotonic() + seconds
    while (left(facts) or Path(facts["folder"]).exists()) and time.monotonic() < end:
        time.sleep(0.1)
    assert left(facts) == []
    assert not Path(facts["folder"]).exists()
    assert list(home.iterdir()) == []


@pytest.mark.slow
@pytest.mark.realtime
def test_no_helper_of_ray_runs_that_nobody_uses_and_kill_9_leaves_nothing(tmp_path):
    program, facts = start("wait", tmp_path)
    lines = [word for pid in facts["pids"] if psutil.pid_exists(pid) for word in psutil.Process(pid).cmdline()]
    program.kill()
    program.communicate(timeout=PATIENCE)
    names = {Path(word).name for word in lines}
    assert {"raylet", "gcs_server"} <= names
    assert not {"dashboard.py", "monitor.py", "log_monitor.py"} & names
    assert_clean(facts, tmp_path)


@pytest.mark.realtime
@pytest.mark.slow
def test_ctrl_c_leaves_nothing(tmp_path):
    program, facts = start("wait", tmp_path)
    os.killpg(program.pid, signal.SIGINT)
    _, errors = program.communicate(timeout=PATIENCE)
    assert "KeyboardInterrupt" in errors
    assert_clean(facts, tmp_path)


@pytest.mark.slow
@pytest.mark.realtime
def test_sigterm_ends_in_order_without_a_frightening_stack(tmp_path):
    program, facts = start("wait", tmp_path)
    program.terminate()
    _, errors = program.communicate(timeout=PATIENCE)
    assert program.returncode == 128 + signal.SIGTERM
    assert "SIGTERM received" not in errors
    assert_clean(facts, tmp_path)


@pytest.mark.realtime
def test_a_normal_end_leaves_nothing_was_closed_to_the_network_and_kept_the_loops_own_signal_handler(tmp_path):
    program, facts = start("own handler", tmp_path, **FOREIGN)  # with settings for another Ray, which do not reach it
    program.terminate()
    output, errors = program.communicate(timeout=PATIENCE)
    assert errors == ""
    assert json.loads(output) == "caught"
    assert program.returncode == 0
    assert len(facts["pids"]) > 5
    assert all(address.removeprefix("::ffff:") in ("127.0.0.1", "::1") for address in facts["listens"])
    assert_clean(facts, tmp_path)


@pytest.mark.realtime
def test_clusters_of_dead_programs_are_removed_and_those_of_living_ones_kept(tmp_path):
    dead, alive = tmp_path / "dead", tmp_path / "alive"
    for folder in (dead, alive):
        folder.mkdir()
        (folder / "alive").touch()
    holder = subprocess.Popen(
        [
            sys.executable,
            "-c",
            "import fcntl, sys; f = open(sys.argv[1]); fcntl.flock(f, fcntl.LOCK_EX); print(flush=True); input()",
            str(alive / "alive"),
        ],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=child_environment(),
    )
    try:
        holder.stdout.readline()
        assert ray_runtime.prune_clusters(tmp_path) == [dead]
        assert not dead.exists()
        assert alive.exists()
    finally:
        holder.kill()
        holder.communicate()
    assert ray_runtime.prune_clusters(tmp_path) == [alive]


@pytest.mark.realtime
def test_a_ray_of_somebody_else_in_this_process_is_neither_taken_over_nor_ended(ray_running, monkeypatch):
    import ray

    monkeypatch.setattr(ray_runtime, "_session", None)
    with pytest.raises(LaboratoryError, match="Ray of its own"):
        ray_runtime.start_ray(ray_runtime.RayStart())
    assert ray.is_initialized()


def test_logs_of_workers_that_are_gone_are_removed_and_those_of_living_ones_kept(tmp_path: Path) -> None:
    logs = tmp_path / "session_1" / "logs"
    logs.mkdir(parents=True)
    gone = subprocess.Popen([sys.executable, "-c", ""], env=child_environment())
    gone.wait()
    names = {pid: [f"worker-a1-01-{pid}.out", f"worker-a1-01-{pid}.err", f"python-core-worker-a1_{pid}.log"]
             for pid in (gone.pid, os.getpid())}  # fmt: skip
    for name in [*names[gone.pid], *names[os.getpid()], "raylet.out", "python-core-driver-01_1.log"]:
        (logs / name).write_text("a line")
    assert ray_runtime.forget_ray_logs(tmp_path) == 3
    assert {path.name for path in logs.iterdir()} == {
        *names[os.getpid()], "raylet.out", "python-core-driver-01_1.log"
    }  # fmt: skip


def test_a_class_is_made_one_of_actors_once_however_many_there_are(ray_running) -> None:
    from actors.runtime.remote_object import RayDevice, actor_class

    before = actor_class.cache_info().currsize
    devices = [RayDevice(str(number), Counter) for number in range(3)]
    assert actor_class.cache_info().currsize == before + 1
    assert [asyncio.run(one.call("add", deadline=PATIENCE)) for one in devices] == [1, 1, 1]
    for one in devices:
        asyncio.run(one.close())


async def test_a_process_that_hangs_is_given_up_long_before_the_deadline(
    ray_running: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    from actors.runtime import remote_object as device

    monkeypatch.setattr(device, "LOOK_INTERVAL", 0.2)
    monkeypatch.setattr(device, "LOOK_DEADLINE", 1.0)
    counter = device.RayDevice("counter", Counter, looked_after=True)
    assert await counter.call("add", 1.0, deadline=PATIENCE) == 1, "what takes longer than a look is waited for"
    os.kill(await counter.pid(), signal.SIGSTOP)
    with pytest.raises(device.DeviceLostError, match="no answer to 'add'") as lost:
        await counter.call("add", deadline=PATIENCE)
    assert f"within {PATIENCE:.3g} s" not in str(lost.value)
    assert await counter.revive()
    assert await counter.call("add", deadline=PATIENCE) == 1
    await counter.close()


class Counter:
    """Counts."""

    def __init__(self) -> None:
        self._count = 0

    def add(self, seconds: float = 0.0) -> int:
        time.sleep(seconds)  # how long this call takes
        self._count += 1
        return self._count
