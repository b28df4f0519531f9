"""The daemon on a Ray cluster of two nodes, of which one is lost."""

from __future__ import annotations

import json
import re
import signal
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from orchestrator.daemon.api.daemon_client import Client
from orchestrator.daemon.rigs.submissions import pack_unresolved
from orchestrator.records.journal import JournalReader
from tests.support import small_campaign
from tests.support.command_process import PATIENCE, Workplace, ended, finished_in, logical
from tests.support.local_cluster import LocalCluster

pytestmark = [pytest.mark.ray, pytest.mark.slow, pytest.mark.realtime]

LABORATORY = "{name: NAME, bench: {liquid: {particles: 400, cohesion: 0.05 N/m}, time_scale: 0}}\n"
CAMPAIGN = small_campaign.CAMPAIGN.replace("  simulations: 6\n", "  simulations: 20\n")


@pytest.fixture
def cluster() -> Iterator[LocalCluster]:
    with LocalCluster() as cluster:
        cluster.start_node(cpus=1)
        cluster.start_node(cpus=1)
        yield cluster


def until(what: Callable[[], Any], process: subprocess.Popen[str]) -> Any:
    end = time.monotonic() + PATIENCE
    while not (found := what()):
        assert process.poll() is None, process.communicate()
        assert time.monotonic() < end, "waited in vain"
        time.sleep(0.1)
    return found


def entries(run: Path) -> list[Any]:
    if not (run / "journal.sqlite").is_file():
        return []
    with JournalReader(run / "journal.sqlite") as journal:
        return list(journal.entries())


def test_two_rigs_of_a_daemon_share_the_simulators_of_a_cluster_that_loses_a_node(
    cluster: LocalCluster, tmp_path: Path
) -> None:
    rigs = ("left", "right")
    for rig in rigs:
        (tmp_path / f"{rig}.yaml").write_text(LABORATORY.replace("NAME", rig))
    settings = {"rigs": {rig: f"{rig}.yaml" for rig in rigs}, "ray": {"address": cluster.address}}
    (tmp_path / "daemon.yaml").write_text(json.dumps(settings))
    anywhere = re.sub(r"laboratory:\n(  .*\n)+", "", CAMPAIGN)  # it runs on each rig as it is
    text, files = pack_unresolved(small_campaign.write_campaign(tmp_path, anywhere))
    place = Workplace(tmp_path, cluster.environment)
    state = tmp_path / "state"
    process = place.start("server", "start", "daemon.yaml", "--state", str(state), "--port", "0")
    try:
        with ended(process):
            until((state / "url").is_file, process)
            with Client((state / "url").read_text().strip(), state) as client:
                until(lambda: client.get("/status")["simulators"] == 2, process)
                sent = [
                    client.post("/campaigns", {"text": text, "files": files, "task": "run", "rig": rig})["id"]
                    for rig in rigs
                ]

                def at_work(key: str) -> bool:
                    run = client.get(f"/campaigns/{key}")["run"]
                    return run is not None and finished_in("calibration", entries(state / "runs" / run)) >= 3

                until(lambda: all(map(at_work, sent)), process)
                assert cluster.workers(1), "simulators are on both nodes"
                cluster.kill_node(1)

                def ends() -> bool:
                    found = [client.get(f"/campaigns/{key}")["state"] for key in sent]
                    assert "failed" not in found
                    return found == ["finished"] * 2

                until(ends, process)
                runs = [state / "runs" / client.get(f"/campaigns/{key}")["run"] for key in sent]
            process.send_signal(signal.SIGTERM)
            process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
        left, right = (logical(entries(run)) for run in runs)
        assert left == right, "the same seed gives the same outcomes, on whichever node they are simulated"
        assert cluster.is_alive(), "the cluster is others'"
        assert cluster.workers(0) == []
    finally:
        place.close()
