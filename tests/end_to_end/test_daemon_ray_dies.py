"""Ray's own processes die under a daemon, or are cut off: it begins anew by itself, and what ran goes on."""

from __future__ import annotations

import os
import signal
import time
from pathlib import Path

import psutil
import pytest

from orchestrator.records.journal import Kind
from tests.end_to_end.test_daemon_killed import SLOW_POURS, Laboratory, opened
from tests.reliability import strikes
from tests.support.command_process import pour_under_way, started_after_they_were_finished
from tests.support.small_campaign import write_campaign
from tests.support.waiting import PATIENCE

pytestmark = pytest.mark.slow


def of_ray(laboratory: Laboratory, name: str) -> list[int]:
    """Living processes of that name that the daemon has started."""
    assert laboratory.process is not None
    children = psutil.Process(laboratory.process.pid).children(recursive=True)
    return [child.pid for child in children if child.is_running() and child.name() == name]


@pytest.mark.parametrize(("name", "fault"), [("raylet", "killed"), ("gcs_server", "killed"), ("raylet", "cut")])
def test_a_campaign_goes_on_by_itself_and_the_next_one_runs(tmp_path: Path, name: str, fault: str) -> None:
    write_campaign(tmp_path, SLOW_POURS)
    with opened(tmp_path) as laboratory:
        laboratory.in_process = False
        laboratory.start()
        assert laboratory.process is not None
        url = (laboratory.state / "url").read_text()
        key = laboratory.decant("queue", "submit", "small.yaml").stdout.strip()
        laboratory.until(lambda: pour_under_way(laboratory.entries()))
        (former,) = of_ray(laboratory, name)
        if fault == "killed":
            os.kill(former, signal.SIGKILL)
        else:
            assert strikes.cut([former]) > 2
        laboratory.until(lambda: of_ray(laboratory, name) not in ([former], []))
        assert (laboratory.state / "url").read_text() == url

        end = time.monotonic() + PATIENCE
        while (
            laboratory.told("queue", "list", key)["state"] != "finished"
        ):  # asked about the pour, unless it could be weighed
            for question in laboratory.told("queue", "list")["questions"]:
                assert question["kind"] == "unknown"
                laboratory.decant("queue", "answer", str(question["id"]), "weighed", "3.2", "0.4")
            assert time.monotonic() < end, laboratory.said()
            time.sleep(0.2)
        entries = laboratory.entries()
        assert started_after_they_were_finished(entries) == []
        begun, withdrawn = (
            [entry.body["id"] for entry in entries if entry.kind == kind]
            for kind in (Kind.POUR_STARTED, Kind.POUR_WITHDRAWN)
        )
        assert len(set(begun)) == 5
        assert sorted(begun) == sorted([*set(begun), *withdrawn])

        second = laboratory.decant("queue", "submit", "small.yaml").stdout.strip()
        laboratory.until(lambda: laboratory.told("queue", "list", second)["state"] == "finished")
        children = psutil.Process(laboratory.process.pid).children()
        assert not [child for child in children if child.status() == psutil.STATUS_ZOMBIE]
        assert laboratory.end() == 0
