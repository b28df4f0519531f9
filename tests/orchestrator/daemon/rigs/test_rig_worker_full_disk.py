"""`rig_worker`: a disk that fills: nothing is begun, what is kept is limited, and nothing is lost."""

from __future__ import annotations

import asyncio
import os
from pathlib import Path

import pytest
from fastapi.testclient import TestClient

from orchestrator.daemon.http_api import create_app
from orchestrator.daemon.rigs import rig_worker as lane
from orchestrator.daemon.state.daemon_settings import DaemonSettings
from orchestrator.daemon.state.daemon_store import StoreError
from orchestrator.daemon.state.run_readout import prune_recordings
from tests.support.toy_daemon import serving


async def test_without_room_nothing_is_begun_and_it_is_said_until_there_is_room(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    free = [700_000_000]
    monkeypatch.setattr(lane, "free_space", lambda path: free[0])
    async with serving(tmp_path) as served:
        served.daemon.settings.__dict__["keep_free"] = 800_000_000
        key = await served.submit()
        while not (await served.get("/status"))["problems"]:
            await asyncio.sleep(0.01)
        status = await served.get("/status")
        assert "700 MB are free" in status["problems"][0]
        assert "keep_free" in status["problems"][0]
        assert (await served.get(f"/campaigns/{key}"))["state"] == "queued"
        assert (await served.http.get("/readyz")).status_code == 503
        free[0] = 900_000_000
        served.daemon.wake()
        await served.until(key, "finished")
        assert (await served.get("/status"))["problems"] == []


async def test_a_command_that_a_full_disk_can_not_keep_is_refused_with_the_reason(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def full(*arguments: object) -> None:
        raise StoreError(f"{tmp_path}/daemon.sqlite: can't be written (database or disk is full)")

    async with serving(tmp_path) as served:
        with monkeypatch.context() as disk:
            disk.setattr(served.daemon.store, "write", full)
            refused = await served.post("/queue/pause", status=507)
        assert "is it full? Make room, then repeat the call" in refused["detail"]
        assert str(tmp_path) not in refused["detail"]
        assert not (await served.get("/status"))["queue_paused"]
        await served.post("/queue/pause")


def recorded(settings: DaemonSettings, name: str, age: float) -> Path:
    path = settings.runs / name / "campaign.rrd"
    path.parent.mkdir(parents=True)
    for one in (path, path.with_name("journal.sqlite")):
        one.write_bytes(b"x")
    os.utime(path, (1e9 - age, 1e9 - age))
    return path


def test_recordings_are_kept_as_long_as_they_are_to_be_and_journals_always(tmp_path: Path) -> None:
    settings = DaemonSettings(tmp_path, keep_recordings=2)
    new, newer, many, old = (recorded(settings, n, a) for n, a in (("a", 10), ("b", 5), ("c", 50), ("d", 200)))
    assert prune_recordings(settings, busy={"d"}) == [many]
    assert prune_recordings(settings) == [old]
    assert new.exists()
    assert newer.exists()
    assert len(list(settings.runs.glob("*/journal.sqlite"))) == 4


def test_all_recordings_are_kept_unless_somebody_says_otherwise(tmp_path: Path) -> None:
    settings = DaemonSettings(tmp_path)
    recorded(settings, "a", 1e8)
    assert prune_recordings(settings) == []


async def test_a_snapshot_that_nobody_was_told_of_is_forgotten(tmp_path: Path) -> None:
    async with serving(tmp_path) as served:
        await served.post("/queue/pause")
        key = await served.submit()
    (tmp_path / "state/campaigns/abc123/files").mkdir(parents=True)
    async with serving(tmp_path):
        assert [path.name for path in (tmp_path / "state/campaigns").iterdir()] == [key]


@pytest.mark.parametrize(
    ("error", "status"), [(TimeoutError("the arm did not answer"), 500), (OSError(28, "full"), 507)]
)
def test_only_a_disk_that_is_full_is_called_so(error: OSError, status: int) -> None:
    async def fails() -> None:
        raise error

    app = create_app()
    app.add_api_route("/fails", fails)
    assert TestClient(app, raise_server_exceptions=False).get("/fails").status_code == status
