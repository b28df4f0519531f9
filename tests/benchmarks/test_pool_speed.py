"""`benchmarks/pool_speed.py` refuses what it can't measure, and measures pool and plain processes beside each other."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment
from tests.support.waiting import PATIENCE

SCRIPT = Path(__file__).parents[2] / "benchmarks" / "pool_speed.py"


def run(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, str(SCRIPT), *arguments],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )


def test_pours_that_can_t_be_shared_out_evenly_are_refused() -> None:
    done = run("--workers", "2", "--pours", "3")
    assert done.returncode == 1
    assert "--pours a multiple of --workers" in done.stderr


@pytest.mark.ray
@pytest.mark.slow
def test_pool_and_plain_processes_are_measured_in_one_go() -> None:
    done = run("--particles", "300", "--pours", "4", "--rounds", "2", "--tiny", "20", "--json")
    assert done.returncode == 0, done.stderr
    found = json.loads(done.stdout)
    assert len(found["rounds"]) == 2
    assert found["throughput_ratio_by_cpu"] > 0.0
    assert 0.0 < found["busy_fraction"] <= 1.0
    assert found["overhead_ms"] >= 0.0
    assert found["start_s"]["first answer after opening"] > found["start_s"]["Ray"] > 0.0
