"""`archive_routes`: former runs over the API, by role."""

from __future__ import annotations

import asyncio
import json
from pathlib import Path
from typing import Any

import pytest

from orchestrator.daemon.rigs import supervisor
from orchestrator.daemon.state.access_tokens import Role
from orchestrator.records.run_registry import VARIABLE, use_state_directory
from tests.support.toy_daemon import Served, serving
from tests.support.waiting import wait_async


@pytest.fixture(autouse=True)
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The daemon's state directory is its process's, as `decant server start` has it."""
    monkeypatch.setenv(VARIABLE, "")
    use_state_directory(tmp_path / "state")
    return tmp_path / "state"


async def finished(served: Served) -> str:
    """The name of a run that a campaign of the daemon has made."""
    return str((await served.until(await served.submit(), "finished"))["run"])


async def test_runs_of_the_daemon_are_found_and_noted_by_operators_only(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        name = await finished(served)
        (found,) = await served.get("/runs", words=["narr", "D2"])
        assert (found["run"], found["pours"], found["mode"]) == (name, 3, "virtual")
        assert await served.get("/runs", words=["2031"]) == []
        await served.post(f"/runs/{name}/notes", {"text": "good"}, role=Role.VIEWER, status=403)
        await served.post(f"/runs/{name}/notes", {"text": "the tray was wet"})
        (found,) = await served.get("/runs", words=["tray"])
        assert found["run"] == name


async def test_a_chart_out_of_control_is_reported_once_and_again_after_another_violation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.syspath_prepend(str(Path(__file__).parents[4] / "benchmarks"))
    import laboratory_months as months

    def days(first: int, last: int, film: float) -> None:
        """Runs of some days, the last of them with a film that is thicker by so much [kg]."""
        for day in range(first, last):
            bench = months.Bench(months.np.random.default_rng(day), film=film if day == last - 1 else 0.0)
            months.enter([months.write_day(tmp_path / "days", day, bench)])

    async with serving(tmp_path) as served:

        def reported() -> list[dict[str, Any]]:
            return [json.loads(event.data) for event in served.daemon.feed._ring if event.type == "ChartViolated"]

        await asyncio.to_thread(days, 0, 9, 0.005)
        await finished(served)
        async for _ in served.daemon.feed.read(0, beat=0.05):
            if reported():
                break
        (event,) = reported()
        assert (event["laboratory"], event["quantity"]) == ("months", "film_g")
        assert "film in the receiver: " in event["text"]
        charts = {c["quantity"]: c for c in await served.get("/runs/charts") if c["laboratory"] == "months"}
        assert (charts["film_g"]["text"], charts["zero_g"]["text"]) == (event["text"], "")
        await asyncio.to_thread(days, 9, 11, 0.0)  # it is in control again
        await served.supervisor.report_charts()
        await served.supervisor.report_charts()
        assert len(reported()) == 1
        await asyncio.to_thread(days, 11, 12, 0.005)
        await served.supervisor.report_charts()
        await served.supervisor.report_charts()
        assert len(reported()) == 2


async def test_charts_are_read_again_after_an_error(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reads: list[Path] = []

    def violated(state: Path) -> list[Any]:
        reads.append(state)
        if len(reads) == 1:
            raise ValueError("a value that no chart can have")
        return []

    monkeypatch.setattr(supervisor, "violated_charts", violated)
    async with serving(tmp_path) as served:
        for count in (1, 2):
            served.supervisor.shared.rested.set()
            await wait_async(lambda: len(reads) == count, f"charts read {count} times")  # noqa: B023


async def test_what_can_not_be_found_or_asked_says_why(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        for path, status, words in (
            ("/runs/nothing/report", 404, "no such run"),
            ("/runs?limit=0", 422, "greater than or equal to 1"),
            ("/runs/%2e%2e%2f%2e%2e%2fetc%2fpasswd", 404, ""),
        ):
            answer = await served.http.get(f"/api/v1{path}", headers=served.headers(Role.VIEWER))
            assert answer.status_code == status, (path, answer.text)
            assert words in answer.text


async def test_reports_of_earlier_runs_are_read(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        first = await finished(served)
        report = await served.http.get(f"/api/v1/runs/{first}/report", headers=served.headers(Role.VIEWER))
        assert report.status_code == 200
        assert "<html" in report.text
