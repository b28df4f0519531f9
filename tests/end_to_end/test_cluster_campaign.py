"""Whole campaigns on a Ray cluster of two nodes, of which one is lost, or the program itself."""

from __future__ import annotations

import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import psutil
import pytest

from orchestrator.records.journal import Entry, Kind
from tests.support import small_campaign
from tests.support.command_process import (
    PATIENCE,
    ROOT,
    Workplace,
    ended,
    finished_in,
    logical,
    pour_under_way,
    started_after_they_were_finished,
)
from tests.support.local_cluster import LocalCluster

pytestmark = [pytest.mark.ray, pytest.mark.slow]

RUN = ("run", "small.yaml")
RESUME = (*RUN, "--resume")
CALIBRATION = 40
"""Simulations: enough for a node to be lost among them, and for another one to be of use."""

LONGER = small_campaign.CAMPAIGN.replace("  simulations: 6\n", f"  simulations: {CALIBRATION}\n").replace("300", "800")
SLOW_ARM = LONGER.replace("time_scale: 0", "time_scale: 20").replace(f"simulations: {CALIBRATION}", "simulations: 6")


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster() as cluster:
        yield cluster


@pytest.fixture
def places(cluster: LocalCluster, tmp_path: Path) -> Iterator[Callable[[str, bool], Workplace]]:
    """Makes workplaces on the cluster, or beside it with a Ray of their own."""
    made: list[Workplace] = []

    def make(campaign: str, on_cluster: bool) -> Workplace:
        folder = tmp_path / f"place-{len(made)}"
        folder.mkdir()
        if on_cluster:
            campaign = campaign.replace("  simulators: 2\n", f"  ray: {{address: '{cluster.address}'}}\n")
        small_campaign.write_campaign(folder, campaign)
        made.append(Workplace(folder, cluster.environment if on_cluster else None))
        return made[-1]

    yield make
    for place in made:
        place.close()


def until(what: Callable[[], object], process: subprocess.Popen[str] | None = None, seconds: float = PATIENCE) -> None:
    end = time.monotonic() + seconds
    while not what():
        assert process is None or process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.05)


def notes(entries: list[Entry]) -> str:
    return "\n".join(entry.body["text"] for entry in entries if entry.kind == Kind.NOTE)


def title(worker: psutil.Process) -> str:
    return str(worker.cmdline()[0].partition(".")[0])


def assert_same_run(entries: list[Entry], undisturbed: list[Entry]) -> None:
    for ours, theirs in zip(logical(entries), logical(undisturbed), strict=True):
        assert ours == theirs
    assert started_after_they_were_finished(entries) == []


@pytest.mark.realtime
def test_a_campaign_that_loses_a_node_ends_where_an_undisturbed_one_ends(cluster, places):
    cluster.start_node(cpus=1, bench=True)
    cluster.start_node(cpus=1)
    place = places(LONGER, True)
    process = place.start(*RUN)
    with ended(process):
        until(lambda: finished_in("calibration", place.entries()) >= 12, process)
        cluster.kill_node(1)
        third = cluster.start_node(cpus=1)
        until(lambda: cluster.workers(third), process)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    assert "ended in the midst" not in errors
    told = notes(place.entries())
    assert "2 node(s), 2 core(s); the bench is on" in told
    assert "1 simulator(s) lost on" in told
    assert "(127.0.0.4) has joined with 1 core(s)" in told
    assert "simulator(s) lost on" in errors, "the person at the terminal is told, too"
    undisturbed = places(LONGER, False)
    undisturbed.finish(*RUN)
    assert_same_run(place.entries(), undisturbed.entries())
    assert cluster.is_alive()


@pytest.mark.realtime
def test_a_bench_lost_before_it_tilts_has_poured_nothing_and_a_resumed_run_ends_as_if_it_had_not_been(cluster, places):
    cluster.start_node(cpus=1)
    cluster.start_node(cpus=1, bench=True)
    place = places(SLOW_ARM, True)
    process = place.start(*RUN)
    with ended(process):
        until(lambda: finished_in("pours", place.entries()) == 1 and pour_under_way(place.entries()), process)
        assert {title(worker) for worker in cluster.workers(1)} >= {"ray::SimulatedArm", "ray::VirtualBalance"}
        time.sleep(1.0)  # its operator is still at work, for four seconds
        cluster.kill_node(1)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 3, errors  # a person has to see to it
    assert "machine" in errors
    assert "lost" in errors
    assert "; see to it, then resume the run" in errors
    entries = place.entries()
    assert [e.kind for e in entries].count(Kind.POUR_WITHDRAWN) == 1

    refused = place.start(*RESUME)
    with ended(refused):
        _, errors = refused.communicate(timeout=PATIENCE)
    assert refused.returncode == 2, "without the bench there is nothing to resume on"
    assert "no node offers 'decant_bench'" in errors
    assert len(place.entries()) == len(entries), "the run was not touched"

    cluster.start_node(cpus=1, bench=True)
    place.finish(*RESUME)
    undisturbed = places(SLOW_ARM, False)
    undisturbed.finish(*RUN)
    assert_same_run(place.entries(), undisturbed.entries())


@pytest.mark.realtime
def test_a_killed_program_leaves_no_actor_in_the_cluster_and_gives_the_bench_back(cluster, places):
    cluster.start_node(cpus=1, bench=True)
    cluster.start_node(cpus=1)
    place = places(LONGER, True)
    process = place.start(*RUN)
    with ended(process):
        until(lambda: finished_in("pours", place.entries()) >= 1, process)
        assert cluster.workers(0)
        assert cluster.workers(1)
        second = places(LONGER, True).start(*RUN)
        with ended(second):
            _, errors = second.communicate(timeout=PATIENCE)
        assert second.returncode == 2
        assert "'decant_bench' is in use; another program has the bench" in errors
        process.send_signal(signal.SIGKILL)
        process.communicate()
    until(lambda: not cluster.workers(0) and not cluster.workers(1), seconds=30.0)
    assert cluster.is_alive()
    place.finish(*RESUME)
    assert started_after_they_were_finished(place.entries()) == []
    assert cluster.is_alive()
    assert cluster.workers(0) == cluster.workers(1) == []


@pytest.mark.realtime
def test_a_program_that_loses_its_own_node_ends_with_a_word_whether_ray_lets_it_or_not(cluster, places):
    cluster.start_node(cpus=1)
    cluster.start_node(cpus=1, bench=True)
    place = places(LONGER, True)
    process = place.start(*RUN)
    with ended(process):
        until(lambda: finished_in("calibration", place.entries()) >= 3, process)
        cluster.kill_node(0)
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    killed = f"Ray on this machine or at {cluster.address} died and ended it" in errors
    assert killed or "Ray on this machine, " in errors
    assert "what is done so far is kept" in errors


CHECK = """
import sys
from actors.runtime.ray_cluster import check_cluster
from actors.interfaces import LaboratoryError, RaySettings
try:
    check_cluster(RaySettings(address=sys.argv[1]), pours=False)
except LaboratoryError as error:
    print(error)
"""

PRETEND = """
import json, sys
import ray
from ray.experimental.internal_kv import _internal_kv_get, _internal_kv_put
ray.init(address=sys.argv[1])
facts = json.loads(_internal_kv_get("CLUSTER_METADATA", namespace="cluster"))
_internal_kv_put("CLUSTER_METADATA", json.dumps({**facts, "ray_version": "2.9.0"}), overwrite=True, namespace="cluster")
"""


def program(text: str, cluster: LocalCluster, cwd: Path = ROOT, **environment: str) -> str:
    """What a program says of the cluster."""
    done = subprocess.run(
        [sys.executable, "-c", text, cluster.address],
        env={**cluster.environment, "PYTHONPATH": str(ROOT), **environment},
        cwd=cwd,
        capture_output=True,
        text=True,
        timeout=PATIENCE,
    )
    assert done.returncode == 0, done.stderr
    return done.stdout.strip()


MUG_POURS = """
import asyncio, sys
from pathlib import Path
from actors.laboratory import open_laboratory
from actors.interfaces import RaySettings
from actors.laboratory_settings import LaboratorySettings
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselSpec, cylinder

address, mesh = sys.argv[1], Path("mug.stl").absolute()
mug = VesselSpec(name="mug", shape=MeshShape(path=mesh, unit="mm"))
scene = Scene("mug", cylinder("beaker", inner_radius=0.035, inner_height=0.1), mug, Liquid(mass=0.15))
action = Action(angular_velocity=90 * DEG, x_offset=0.13, height=0.05, max_angle=110 * DEG, hold_time=0.2)

async def main():
    far = LaboratorySettings(name="far", ray=RaySettings(address=address))
    async with open_laboratory(far, pours=False) as laboratory:
        theta = SimulationParameters(particles=300)
        tasks = [PourTask(scene, action, theta, seed) for seed in range(4)]
        for result in await asyncio.gather(*map(laboratory.simulators.simulate, tasks)):
            assert result.outcome.invalid is None, result
        for cache in map(Path, ("cache-0", "cache-1")):
            kernels = sum(1 for _ in (cache / "kernels").glob("*.tic"))
            print(kernels >= 3, [path.name for path in (cache / "meshes").glob("*/*")], flush=True)

asyncio.run(main())
"""


@pytest.mark.realtime
def test_nodes_that_share_no_files_get_the_mesh_and_have_warm_kernels_after_their_first_pour(cluster, tmp_path):
    shutil.copy(ROOT / "configs" / "vessels" / "meshes" / "mug.stl", tmp_path)
    for number in range(2):
        cluster.start_node(cpus=1, cache=tmp_path / f"cache-{number}")
    said = program(MUG_POURS, cluster, cwd=tmp_path)
    assert said.splitlines() == ["True ['mug.stl']"] * 2


@pytest.mark.realtime
def test_clusters_that_can_t_be_joined_say_why(cluster, tmp_path):
    cluster.start_node(cpus=1)
    assert program(CHECK, cluster) == ""
    wrong = tmp_path / "token"
    wrong.write_text("0" * 64)
    assert "asks for a token that this program does not have" in program(CHECK, cluster, RAY_AUTH_TOKEN_PATH=str(wrong))
    program(PRETEND, cluster)
    differs = program(CHECK, cluster)
    assert "Version mismatch" in differs
    assert "Ray: 2.9.0" in differs


@pytest.mark.realtime
def test_a_machine_without_a_node_of_the_cluster_can_t_use_it(cluster):
    cluster.start_node(cpus=1)
    cluster.kill_node(0)  # the head goes on, and takes a while to see that
    time.sleep(30.0)
    assert "this machine is not a node of it" in program(CHECK, cluster)
