"""A daemon whose simulators' Ray dies under it: it lives on, says so, and has new ones for whatever comes next."""

from __future__ import annotations

import contextlib
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path

import psutil
import pytest

from orchestrator.journal import Kind
from tests.end_to_end.command import started_after_they_were_finished
from tests.end_to_end.small import CAMPAIGN, write_campaign
from tests.end_to_end.test_daemon_killed import Laboratory, opened

pytestmark = [pytest.mark.slow, pytest.mark.ray]


@pytest.fixture
def laboratory(tmp_path: Path) -> Iterator[Laboratory]:
    write_campaign(tmp_path, CAMPAIGN.replace("directory: runs, recorded_simulations: 1", "rrd: false, figures: false"))
    temporary = tempfile.mkdtemp(prefix="y", dir="/tmp")  # short, since Ray puts sockets in it
    with opened(tmp_path) as found:
        found.in_process, found.environment = False, {"TMPDIR": temporary}
        found.start()
        yield found
        assert found.end() == 0
    shutil.rmtree(temporary, ignore_errors=True)


def kill(laboratory: Laboratory, name: str) -> None:
    """End one of Ray's own processes, as an out-of-memory killer would."""
    found = []
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            ours = any(laboratory.environment["TMPDIR"] in word for word in process.cmdline())
            if ours and Path(process.cmdline()[0]).name == name:
                found.append(process.pid)
    assert found, f"no {name}"
    for pid in found:
        os.kill(pid, signal.SIGKILL)


@pytest.mark.parametrize("name", ["raylet", "gcs_server"])
def test_a_part_of_ray_dies_and_what_was_running_is_gone_on_with_by_new_simulators(
    laboratory: Laboratory, name: str
) -> None:
    first = laboratory.decant("submit", "small.yaml").stdout.strip()
    laboratory.until(lambda: any(e.kind == Kind.FINISHED for e in laboratory.entries()))
    kill(laboratory, name)
    laboratory.until(lambda: laboratory.told("show", first)["state"] == "finished")
    assert "goes on with new simulators" in laboratory.said()
    assert started_after_they_were_finished(laboratory.entries()) == []
    second = laboratory.decant("submit", "small.yaml").stdout.strip()
    laboratory.until(lambda: laboratory.told("show", second)["state"] in ("finished", "failed"))
    assert laboratory.told("show", second)["state"] == "finished"
