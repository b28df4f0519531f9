"""`archive_routes`: former runs over the API, by role."""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.daemon.state.access_tokens import Role
from orchestrator.records.run_registry import VARIABLE, use_state_directory
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


def test_runs_of_the_daemon_are_found_and_noted_by_operators_only(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path) as served:
            name = await finished(served)
            (found,) = await served.get("/runs", receiver="NARR*", strategy="D2")
            assert (found["run"], found["pours"], found["mode"]) == (name, 3, "virtual")
            assert await served.get("/runs", since="2031") == []
            await served.post(f"/runs/{name}/notes", {"text": "good"}, role=Role.VIEWER, status=403)
            await served.post(f"/runs/{name}/notes", {"text": "the tray was wet"})
            (found,) = await served.get("/runs", words=["tray"])
            assert found["run"] == name

    run(work())


def test_what_can_not_be_found_or_asked_says_why(tmp_path: Path) -> None:
    async def work() -> None:
        async with serving(tmp_path) as served:
            for path, status, words in (
                ("/runs/nothing/report", 404, "no such run"),
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
