"""A state folder that version 0.2.1 wrote, as docs/laboratory/upgrade.md describes: read, converted, continued."""

from __future__ import annotations

import shutil
import sqlite3
from pathlib import Path

import pytest

from orchestrator.daemon.state.access_tokens import Role
from orchestrator.daemon.state.daemon_store import FORMAT, Store, StoreFormatError
from tests.support.toy_daemon import serving

WRITTEN = Path(__file__).parents[3] / "data" / "daemon" / "state-0.2.1"
TOKENS = "".join(f"{role.name.lower()} {role.name.lower()} {role.name.lower() * 6}\n" for role in Role)


def state_of_0_2_1(folder: Path) -> Path:
    """Write the state folder of version 0.2.1: one campaign finished, one in the paused queue."""
    state = folder / "state"
    shutil.copytree(WRITTEN / "campaigns", state / "campaigns")
    directory = state / "runs" / "cup-20261127-1"
    directory.mkdir(parents=True)
    shutil.copy(WRITTEN / "run" / "summary.json", directory)
    scripts = {state / "daemon": "daemon", state / "events": "events", directory / "journal": "run/journal"}
    for path, name in scripts.items():
        database = sqlite3.connect(path.with_suffix(".sqlite"))
        database.executescript((WRITTEN / f"{name}.sql").read_text(encoding="utf-8"))
        database.close()
    (state / "tokens").write_text(TOKENS, encoding="utf-8")
    (state / "tokens").chmod(0o600)
    return state


async def test_the_queue_of_version_0_2_1_goes_on(tmp_path: Path) -> None:
    state = state_of_0_2_1(tmp_path)
    async with serving(tmp_path) as served:
        assert served.tokens[Role.OPERATOR] == "operator" * 6
        first, second = await served.get("/campaigns/first"), await served.get("/campaigns/second")
        assert (first["state"], second["state"]) == ("finished", "queued")
        assert len(first["pours_made"]) == 3
        assert first["after"] is None
        assert [entry["what"] for entry in second["audit"]] == ["submit"]
        assert (await served.get("/materials"))["liquids"][0]["id"] == "water"
        await served.post("/queue/resume")
        ended = await served.until(second["id"], "finished")
        assert ended["verdict"]["word"] == ended["summary"]["verdict"]["word"]
    database = sqlite3.connect(state / "daemon.sqlite")
    assert database.execute("pragma user_version").fetchone() == (FORMAT,)
    database.close()


def test_a_format_that_is_not_read_is_refused_and_left_as_it_is(tmp_path: Path) -> None:
    state = state_of_0_2_1(tmp_path)
    for version in (4, FORMAT + 1):
        database = sqlite3.connect(state / "daemon.sqlite")
        database.execute(f"pragma user_version = {version}")
        database.close()
        before = (state / "daemon.sqlite").read_bytes()
        with pytest.raises(StoreFormatError, match=f"written in format {version}, .* reads formats 5 to {FORMAT}"):
            Store(state / "daemon.sqlite")
        assert (state / "daemon.sqlite").read_bytes() == before
