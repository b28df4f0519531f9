"""`state_backup`: a backup of a working daemon, restored: nothing that was in it is lost, and nothing starts by
itself.
"""

from __future__ import annotations

import asyncio
import shutil
from pathlib import Path

import pytest

from orchestrator.daemon.state.state_backup import BackupError, back_up, restore
from tests.support.station import content, order, rigs_in, set_up, until_pour
from tests.support.toy_daemon import held, serving


@pytest.mark.slow
async def test_a_restored_daemon_has_results_and_account_and_waits_for_an_operator(tmp_path: Path) -> None:
    here, there, archive = tmp_path / "here", tmp_path / "there", tmp_path / "backup.zip"
    here.mkdir()
    there.mkdir()
    async with serving(here, held, rigs=rigs_in(here)) as served:
        await set_up(served)
        await served.post("/pours", order("done", amount="30 g"))
        (await served.pouring()).bench.go.set()
        done = await until_pour(served, "done", "weighed")
        await served.post("/materials/vessels/beaker/weighed", {"mass": "100 g"})
        before = await content(served, "vial-1")
        await served.post("/pours", order("begun", receiver="vial-2"))
        while len(served.laboratories) < 2:
            await asyncio.sleep(0.01)
        await served.laboratories[-1].bench.begun.wait()
        await served.post("/pours", order("queued", amount="5 g"))
        found = await asyncio.to_thread(back_up, here / "state", archive)
        assert found["runs"] == 2
        await served.post("/queue/pause")
        served.laboratories[-1].bench.go.set()
        await until_pour(served, "begun", "weighed")
    restore(archive, there / "state")
    async with serving(there, rigs=rigs_in(there)) as served:
        assert (await served.get("/status"))["queue_paused"]
        assert (await served.get("/pours/done"))["result"] == done["result"]
        assert await content(served, "vial-1") == before
        assert (await served.get("/pours/begun"))["state"] == "unknown"  # the backup can't know its outcome
        assert (await served.get("/pours/queued"))["state"] == "queued"
        assert not served.laboratories


def test_a_backup_is_refused_where_it_would_overwrite_or_is_none(tmp_path: Path) -> None:
    with pytest.raises(BackupError, match=r"has no daemon\.sqlite"):
        back_up(tmp_path, tmp_path / "x.zip")
    bad = tmp_path / "bad.zip"
    bad.write_bytes(b"PK no archive")
    with pytest.raises(BackupError, match="is no backup"):
        restore(bad, tmp_path / "new")
    with pytest.raises(BackupError, match="is not empty"):
        restore(bad, tmp_path)
    shutil.rmtree(tmp_path / "new", ignore_errors=True)
