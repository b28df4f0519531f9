"""`archive_routes`: former runs over the API: the same answers as `decant runs` gives on the machine itself, by
role.
"""

from __future__ import annotations

import json
import shlex
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.daemon.state.access_tokens import Role
from orchestrator.records.run_registry import VARIABLE, use_state_directory
from tests.orchestrator.catalogue.test_catalogue import made
from tests.support.daemon_thread import Real
from tests.support.toy_daemon import Served, run, serving


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The daemon's state directory is its process's, as `decant server start` has it."""
    monkeypatch.setenv(VARIABLE, "")
    use_state_directory(tmp_path / "state")
    return tmp_path / "state"


async def finished(served: Served) -> str:
    """The name of a run that a campaign of the daemon has made."""
    return str((await served.until(await served.submit(), "finished"))["run"])


def test_runs_and_pours_of_the_daemon_are_found_and_noted_by_operators_only(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path) as served:
            name = await finished(served)
            (found,) = await served.get("/runs", receiver="NARR*", strategy="D2")
            assert (found["run"], found["pours"], found["mode"]) == (name, 3, "virtual")
            assert await served.get("/runs", since="2031") == []
            pours = await served.get("/runs/pours", run=name)
            assert [pour["number"] for pour in pours] == [1, 2, 3]
            assert all(60 <= pour["angular_velocity_deg_s"] <= 180 for pour in pours)

            await served.post(f"/runs/{name}/notes", {"text": "good"}, role=Role.VIEWER, status=403)
            await served.post(f"/runs/{name}/notes", {"text": "the tray was wet"})
            (found,) = await served.get("/runs", words=["tray"])
            shown = await served.get(f"/runs/{name[:-1]}")
            assert [(note["by"], note["text"]) for note in shown["notes"]] == [("operator", "the tray was wet")]
            assert [pour["id"] for pour in shown["list_of_pours"]] == [pour["id"] for pour in pours]

    run(work())


def test_what_can_not_be_found_or_asked_says_why(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path) as served:
            for path, status, words in (
                ("/runs/nothing", 404, "no such run"),
                ("/runs?since=yesterday", 422, "is not a date"),
                ("/runs?since=999999999d", 422, "is not a date"),
                ("/runs?mode=dream", 422, "is not one of"),
                ("/runs?reciever=cup", 422, "reciever"),
                ("/runs/%2e%2e%2f%2e%2e%2fetc%2fpasswd", 404, ""),
            ):
                answer = await served.http.get(f"/api/v1{path}", headers=served.headers(Role.VIEWER))
                assert answer.status_code == status, (path, answer.text)
                assert words in answer.text

    run(work())


def test_reports_of_earlier_runs_are_read(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path) as served:
            first = await finished(served)
            report = await served.http.get(f"/api/v1/runs/{first}/report", headers=served.headers(Role.VIEWER))
            assert report.status_code == 200
            assert "<html" in report.text

    run(work())


@pytest.mark.slow
def test_the_command_line_answers_the_same_through_the_daemon(tmp_path: Path, state: Path) -> None:
    directory = made(tmp_path)
    real = Real(state)

    def say(command: str) -> Any:
        environment = {"COLUMNS": "200", "DECANT_URL": real.url, "DECANT_TOKEN": real.token(Role.OPERATOR)}
        return CliRunner().invoke(app, shlex.split(command), env=environment)

    try:
        for command in ("list", "pours", f"show {directory.name}"):
            here, there = say(f"runs {command}"), say(f"runs {command} --daemon")
            assert there.exit_code == here.exit_code == 0, there.stderr
            assert there.stdout == here.stdout != ""
        assert "1 note" in say(f"runs note {directory.name} 'the tray was wet' --daemon").stdout
        assert json.loads(say("runs list tray --json").stdout)["runs"][0]["run"] == directory.name
        refused = say("runs show nothing --daemon")
        assert refused.exit_code == 2
        assert "no such run" in refused.stderr
    finally:
        real.close()
