"""A store of the released format 2: a daemon starts on it, loses nothing, and takes orders."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest

from orchestrator.daemon.daemon_store import FORMAT, Store, StoreError
from tests.support.station import content, order, rigs_in, set_up, until_pour
from tests.support.toy_daemon import run, serving

OLD = Path(__file__).parent / "data" / "store_format2.sql"
"""Written by the last code of format 2: a finished campaign with an answered question, a queued one, a paused queue."""


def old_store(folder: Path) -> Path:
    path = folder / "daemon.sqlite"
    folder.mkdir(exist_ok=True)
    with sqlite3.connect(path) as database:
        database.executescript(OLD.read_text(encoding="utf-8"))
    return path


def test_a_daemon_starts_on_a_store_of_format_2_and_pours_an_order(tmp_path: Path) -> None:
    path = old_store(tmp_path / "state")

    async def work() -> None:
        async with serving(tmp_path, rigs=rigs_in(tmp_path)) as served:
            found = {one["id"]: one for one in await served.get("/campaigns")}
            assert {key: one["state"] for key, one in found.items()} == {
                "narrow-1a2b3c": "finished",
                "wide-4d5e6f": "queued",
            }
            assert (found["wide-4d5e6f"]["priority"], found["wide-4d5e6f"]["by"]) == (3, "ada")
            assert (await served.get("/status"))["queue_paused"]
            assert (await served.get("/questions", answered=True))[0]["answer"] == "lost"
            # its snapshot is not part of this test
            await served.post("/campaigns/wide-4d5e6f/stop")
            await served.post("/queue/resume")
            await set_up(served)
            await served.post("/pours", order("first"))
            assert (await until_pour(served, "first", "weighed"))["result"]["received_g"] > 0.0
            assert (await content(served, "vial-1"))["pour"] == "first"
            with pytest.raises(sqlite3.IntegrityError, match="append-only"):
                served.daemon.store.write("delete from audit")

    run(work())
    with sqlite3.connect(path) as database:
        assert database.execute("pragma user_version").fetchone()[0] == FORMAT
        assert database.execute("select by from audit order by id").fetchone()[0] == "ada"


def test_an_upgrade_that_is_interrupted_leaves_the_old_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = old_store(tmp_path)
    copy = shutil.copy(path, tmp_path / "copy.sqlite")
    monkeypatch.setattr("orchestrator.daemon.daemon_store._STATION", "create table batch (id text); nonsense;")
    with pytest.raises(StoreError):
        Store(path)
    monkeypatch.undo()
    with sqlite3.connect(path) as there, sqlite3.connect(copy) as before:
        assert list(there.iterdump()) == list(before.iterdump())
    Store(path).close()
