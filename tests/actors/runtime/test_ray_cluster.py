"""`ray_cluster`: on a Ray cluster of two nodes: refused before anything starts, or at work although a node dies."""

from __future__ import annotations

import asyncio
import json
import os
import socket
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from actors.runtime.ray_cluster import Node, PinnedNode
from tests.support.local_cluster import LocalCluster
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.ray

ROOT = Path(__file__).parents[3]

PROGRAM = """
import asyncio, json, sys
from pathlib import Path
from actors.laboratory import open_laboratory
from actors.interfaces import RaySettings
from actors.laboratory_settings import LaboratorySettings
from sim_engine.action import DEG, Action
from sim_engine.liquids import SimulationParameters
from sim_engine.scene import PourTask
from tests.support import fake_simulator

def say(*words):
    print(json.dumps(words), flush=True)

async def main(address, log):
    import ray
    action = Action(angular_velocity=60 * DEG, x_offset=0.09, height=0.05, max_angle=100 * DEG, hold_time=0.5)
    spec = LaboratorySettings(name="far", ray=RaySettings(address=address))
    heard = []
    laboratory = open_laboratory(spec, pours=False, make=fake_simulator.make_fake(0.5, Path(log)))
    ray.cloudpickle.register_pickle_by_value(fake_simulator)
    async with laboratory:
        laboratory.listen(lambda notice: (heard.append(notice.text), say("notice", notice.text)))
        pool = laboratory.simulators
        say("size", pool.size)
        tasks = [PourTask(fake_simulator.make_scene(), action, SimulationParameters(), seed) for seed in range(24)]
        results = await asyncio.gather(*(pool.simulate(task) for task in tasks))
        say("seeds", [result.outcome.seed for result in results])
        while not any("is lost" in text for text in heard):
            await asyncio.sleep(0.1)

asyncio.run(main(*sys.argv[1:]))
"""


@pytest.fixture(scope="module")
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster() as cluster:
        cluster.start_node(cpus=1)
        cluster.start_node(cpus=1)
        yield cluster


def decant(folder: Path, address: str, environment: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """`decant run` of a small campaign on a cluster."""
    path = write_campaign(folder, CAMPAIGN.replace("  simulators: 2\n", f"  ray: {{address: '{address}'}}\n"))
    return subprocess.run(
        [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "run", str(path)],
        cwd=folder,
        env={**environment, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )


@pytest.mark.realtime
@pytest.mark.slow
def test_an_address_where_nothing_answers_is_refused_at_once(tmp_path: Path) -> None:
    with socket.socket() as free:
        free.bind(("127.0.0.2", 0))
        address = f"127.0.0.2:{free.getsockname()[1]}"
    done = decant(tmp_path, address, dict(os.environ))
    assert done.returncode == 2
    assert f"Ray cluster at {address}: nothing answers there (Connection refused)" in done.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.realtime
@pytest.mark.slow
def test_a_cluster_without_the_bench_s_resource_is_refused_before_anything_starts(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    done = decant(tmp_path, cluster.address, cluster.environment)
    assert done.returncode == 2
    assert "no node offers 'decant_bench', which arm, balance and bench need" in done.stderr
    assert "--resources='{\"decant_bench\": 1}'" in done.stderr
    assert not (tmp_path / "runs").exists()
    assert [cluster.workers(node) for node in (0, 1)] == [[], []]


@pytest.mark.realtime
@pytest.mark.slow
def test_when_a_node_dies_its_simulations_are_repeated_elsewhere_and_people_are_told(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    log = tmp_path / "log"
    program = subprocess.Popen(
        [sys.executable, "-c", PROGRAM, cluster.address, str(log)],
        env={**cluster.environment, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        end = time.monotonic() + PATIENCE
        while not (log.exists() and log.read_text().count("end") >= 6 and busy_on_both(log)):
            assert time.monotonic() < end, program.poll()
            time.sleep(0.05)
        hold_amid_a_simulation(cluster.workers(1), log)
        cluster.kill_node(1)
        output, errors = program.communicate(timeout=PATIENCE)
    finally:
        program.kill()
    said = [json.loads(line) for line in output.splitlines() if line.startswith("[")]
    assert program.returncode == 0, errors
    assert ["size", 2] in said, "one simulator for each core of the cluster"
    assert ["seeds", list(range(24))] in said, "nothing is lost, and in order"
    told = " ".join(text for kind, text in said if kind == "notice")
    assert "1 simulator(s) lost on" in told
    assert "simulation(s) are repeated by others" in told
    assert "(127.0.0.3) is lost; simulations go on with 1 core(s) on 1 node(s)" in told
    begun, ended = (log.read_text().count(word) for word in ("begin", "end"))
    assert ended in (24, 25), "what was finished there, and not yet answered, may have been done twice"
    assert begun - ended == 1, "the one that was under way there"
    assert cluster.is_alive(), "the cluster is others'"
    assert cluster.workers(0) == []


def hold_amid_a_simulation(workers: list[psutil.Process], log: Path) -> None:
    """Stop the simulator among a node's processes between the begin and the end of a simulation."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        for worker in workers:
            if not under_way(log, worker.pid):
                continue
            worker.suspend()
            if under_way(log, worker.pid):
                return
            worker.resume()  # it ended just before it was stopped
        time.sleep(0.01)
    raise AssertionError(log.read_text())


def under_way(log: Path, pid: int) -> bool:
    """Whether a simulator's last word is that it has begun."""
    words = [line.split()[0] for line in log.read_text().splitlines() if line.split()[1:2] == [str(pid)]]
    return words[-1:] == ["begin"]


def busy_on_both(log: Path) -> bool:
    """Whether two simulators have worked."""
    return len({line.split()[1] for line in log.read_text().splitlines() if line.startswith("end")}) == 2


@pytest.mark.parametrize("turns", range(12))
def test_a_task_that_asks_for_a_dead_node_again_and_again_can_be_cancelled_at_any_moment(turns):
    async def ask_again(node: PinnedNode) -> None:
        while True:
            assert await node.is_gone()

    async def cancelled(node: PinnedNode) -> bool:
        task = asyncio.create_task(ask_again(node))
        for _ in range(turns):
            await asyncio.sleep(0)
        task.cancel()
        done, _ = await asyncio.wait({task}, timeout=0.5)
        while not task.done():
            task.cancel()
            await asyncio.sleep(0.001)
        return bool(done)

    with socket.socket() as free:  # bound and not listening: it refuses connections
        free.bind(("127.0.0.1", 0))
        node = PinnedNode(Node("id", "here", "127.0.0.1", free.getsockname()[1], {}), {})
        assert asyncio.run(cancelled(node))
