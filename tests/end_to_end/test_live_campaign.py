"""A campaign watched while it runs, by somebody who comes late."""

from __future__ import annotations

import re
import time
from pathlib import Path

import pytest

from tests.support.command_process import Workplace
from tests.support.rerun_recordings import Contents, seen, viewer
from tests.support.small_campaign import write_campaign
from tests.support.waiting import PATIENCE

FIRST = ("/cell/receiver/mesh", "/cell/liquid", "/balance/shown", "/learning/calibration/loss/measured", "/status")
"""What is there long before the campaign ends."""

ALL = (
    *FIRST,
    "/simulation/liquid",
    "/learning/deployment-narrow/surrogate",
    "/learning/calibration/theta",
    "/learning/deployment-narrow/loss/predicted",
    "/learning/deployment-narrow/loss/best",
    "/balance/expected/high",
    "/balance/pour/middle",
    "/machine/activity/simulator_1",
    "/machine/activity/arm",
    "/machine/seconds",
)


@pytest.mark.slow
def test_late_viewer_of_a_running_campaign_sees_what_happened_and_what_happens(tmp_path: Path) -> None:
    write_campaign(tmp_path)
    process = Workplace(tmp_path).start("run", "small.yaml", "--live", "--in-process")
    try:
        assert process.stderr is not None
        found, end = None, time.monotonic() + PATIENCE
        while found is None and time.monotonic() < end and (line := process.stderr.readline()):
            found = re.search(r"live view: \S+127.0.0.1%3A(\d+)%2Fproxy", line)
        assert found
        time.sleep(3.0)  # late
        with viewer(f"rerun+http://127.0.0.1:{found[1]}/proxy", tmp_path / "seen.rrd"):
            seen(tmp_path / "seen.rrd", lambda contents: all(entity in contents.columns for entity in FIRST))
            process.communicate(timeout=PATIENCE)
        assert process.returncode == 0
    finally:
        process.kill()
        process.wait()
    kept = Contents(next((tmp_path / "runs").glob("*/campaign.rrd")))
    for entity in ALL:
        assert kept.rows(entity) > 0, entity
    assert kept.rows("/learning/calibration/loss/measured") == 3
    # 400 particles of the running pour, coloured by fate
    assert all(len(row) == 400 for row in kept.values("/cell/liquid", "Points3D:class_ids") if row)  # type: ignore[arg-type]
