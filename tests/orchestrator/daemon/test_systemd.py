"""The unit file that Decant comes with, as systemd itself reads it."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from actors.runtime.child_process import child_environment

UNIT = Path(__file__).parents[3] / "configs" / "systemd" / "decant.service"


@pytest.mark.skipif(shutil.which("systemd-analyze") is None, reason="systemd is not installed (apt install systemd)")
def test_systemd_has_nothing_against_the_unit(tmp_path: Path) -> None:
    unit = tmp_path / "decant.service"
    # The program is looked for; on this machine it is elsewhere.
    unit.write_text(UNIT.read_text().replace("/opt/decant/bin/decant", sys.executable))
    done = subprocess.run(
        ["systemd-analyze", "verify", str(unit)], capture_output=True, text=True, timeout=120, env=child_environment()
    )
    complaints = [line for line in done.stderr.splitlines() if "decant.service" in line]
    assert (done.returncode, complaints) == (0, []), done.stderr


def test_the_unit_gives_a_pour_the_time_to_be_weighed() -> None:
    text = UNIT.read_text()
    assert "KillMode=mixed" in text, "simulators would be told to end before the pour they compute has landed"
    assert "TimeoutStopSec=10min" in text
    assert "Restart=on-failure" in text
