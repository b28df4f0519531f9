"""`server_process`: the unit file that Decant comes with, as systemd itself reads it."""

from __future__ import annotations

import re
import shlex
import shutil
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.shipped import shipped
from orchestrator.cli.app import app
from orchestrator.daemon.state.access_tokens import Role
from tests.support.daemon_thread import Real

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


def test_the_unit_names_shipped_settings_and_a_folder_for_every_file_that_is_written() -> None:
    text = UNIT.read_text()
    (settings,) = re.findall(r"^ExecStart=\S+/decant server start /etc/decant/(\S+)$", text, re.MULTILINE)
    assert shipped(settings).is_file()
    assert "StateDirectory=decant\n" in text
    assert "CacheDirectory=decant\nEnvironment=XDG_CACHE_HOME=/var/cache\n" in text, "the service user has no home"


def test_other_users_submit_and_look_with_a_token_and_nothing_else(tmp_path: Path) -> None:
    real = Real(tmp_path / "service")

    def typed(command: str, role: Role) -> Any:
        environment = {"DECANT_URL": real.url, "DECANT_TOKEN": real.token(role), "DECANT_STATE": str(tmp_path / "own")}
        return CliRunner().invoke(app, shlex.split(command), env=environment)

    try:
        assert typed("queue pause", Role.OPERATOR).exit_code == 0
        quickstart = shlex.quote(str(shipped("campaigns/quickstart.yaml")))
        submitted = typed(f"queue submit {quickstart}", Role.OPERATOR)
        assert submitted.exit_code == 0, submitted.stderr
        assert submitted.stdout.strip() in typed("queue list", Role.VIEWER).stdout
        refused = typed(f"queue submit {quickstart}", Role.VIEWER)
        assert refused.exit_code != 0
        assert "this takes operator" in refused.stderr
    finally:
        real.close()
