"""A process is killed after its second pour, then the journal is lost or changed: no pour is repeated."""

from __future__ import annotations

import json
import re
import shutil
import signal
import sqlite3
import subprocess
from collections.abc import Callable, Iterator
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import Result
from typer.testing import CliRunner

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.records.journal import JOURNAL_NAME, Entry, Kind
from orchestrator.records.journal_check import LEDGER_NAME, JournalDamagedError, read_ledger
from orchestrator.runs.run_folder import find_run
from tests.support import small_campaign
from tests.support.command_process import Workplace, ended, started_after_they_were_finished
from tests.support.waiting import PATIENCE

CAMPAIGN = small_campaign.CAMPAIGN.replace("directory: runs,", "directory: runs, figures: false, recording: false,")

pytestmark = pytest.mark.slow  # the same losses of a toy run: tests/orchestrator/records/test_journal.py

RUN = ("run", "small.yaml", "--in-process")
RESUME = (*RUN, "--resume", "--run")
WAL = f"{JOURNAL_NAME}-wal"


def two_poured(place: Workplace) -> Callable[[list[Entry]], bool]:
    """Two pours are in the journal's own file, not only in its log: a kill before that moment loses the second one."""

    def reached(entries: list[Entry]) -> bool:
        if sum(entry.kind == Kind.POUR_FINISHED for entry in entries) < 2:
            return False
        address = f"file:{place.run_directory() / JOURNAL_NAME}?immutable=1"  # without its log
        with closing(sqlite3.connect(address, uri=True)) as connection:
            try:
                (count,) = connection.execute("select count(*) from event where kind = 'pour.finished'").fetchone()
            except sqlite3.DatabaseError:  # the log is being copied
                return False
        return int(count) >= 2

    return reached


@pytest.fixture(scope="module")
def killed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a campaign that was killed after its second pour."""
    folder = tmp_path_factory.mktemp("killed")
    small_campaign.write_campaign(folder, CAMPAIGN)
    place = Workplace(folder)
    try:
        process, _ = place.interrupt(two_poured(place), signal.SIGKILL, *RUN)
        assert process.returncode == -signal.SIGKILL
    finally:
        place.close()
    return folder


@pytest.fixture
def place(killed: Path, tmp_path: Path) -> Iterator[Workplace]:
    """A copy of it, to be damaged."""
    shutil.copytree(killed, tmp_path / "copy")
    place = Workplace(tmp_path / "copy")
    yield place
    place.close()


def decant(place: Workplace, *arguments: str) -> tuple[int, str, str]:
    process: subprocess.Popen[str]
    with ended(process := place.start(*arguments)):
        output, errors = process.communicate(timeout=PATIENCE)
    return process.returncode, output, errors


def check(run: Path, *options: str) -> Result:
    return CliRunner().invoke(app, ["runs", "check", str(run), *options])


def pours_begun(run: Path) -> list[int]:
    """Ids of the pours that have begun, as the ledger has them: the journal may be gone."""
    return [line.body["id"] for line in read_ledger(run / LEDGER_NAME) if line.kind == Kind.POUR_STARTED]


def without_journal(run: Path) -> None:
    for name in (JOURNAL_NAME, WAL, f"{JOURNAL_NAME}-shm"):
        (run / name).unlink(missing_ok=True)


def truncated(run: Path) -> None:
    (run / JOURNAL_NAME).write_bytes(b"")


def with_another_weight(run: Path) -> None:
    """One bit of the first recorded weight, changed where it stands in the file."""
    with closing(sqlite3.connect(run / JOURNAL_NAME)) as connection:
        connection.execute("pragma wal_checkpoint(truncate)")
    path = run / JOURNAL_NAME
    content = bytearray(path.read_bytes())
    place = content.index(b'"spilled":', content.index(b'"measurement":')) + len(b'"spilled":0.0')
    content[place + 1] ^= 1  # a digit becomes its neighbour: still valid JSON, and valid SQLite
    path.write_bytes(content)


def without_its_last_entries(run: Path) -> None:
    """As it was before its second pour: valid, with everything after it lost."""
    with closing(sqlite3.connect(run / JOURNAL_NAME)) as connection:
        (second,) = connection.execute(
            "select seq from event where kind = 'pour.started' order by seq limit 1 offset 1",
        ).fetchone()
        for trigger in ("event_is_never_deleted", "chain_is_never_deleted"):
            connection.execute(f"drop trigger {trigger}")
        connection.execute("delete from event where seq >= ?", [second])
        connection.execute("delete from chain where seq >= ?", [second])
        connection.commit()


def without_ledger(run: Path) -> None:
    (run / LEDGER_NAME).unlink()


@pytest.mark.parametrize(
    ("damage", "problem"),
    [
        pytest.param(without_journal, "journal.sqlite is missing, but the folder has resolved.json"),
        pytest.param(truncated, "journal.sqlite is empty, but the folder has resolved.json"),
        (with_another_weight, "(pour.finished) was changed after it was written"),
        pytest.param(without_its_last_entries, "entries were lost"),
        pytest.param(without_ledger, "pours.jsonl, the ledger of pours, is missing"),
    ],
)
def test_a_run_with_a_damaged_journal_is_refused_with_the_pours_that_were_made(
    place: Workplace, damage: Callable[[Path], None], problem: str
) -> None:
    run = place.run_directory()
    before = pours_begun(run)
    damage(run)
    kept = {path.name: path.read_bytes() for path in run.iterdir() if not path.name.startswith(f"{JOURNAL_NAME}-")}

    code, _, errors = decant(place, *RESUME, run.name)
    assert code == 2, errors
    assert problem in errors
    assert "Nothing was poured now" in errors
    assert "what to do: restore journal.sqlite" in errors
    if damage is not without_ledger:
        assert "pour 1 of stage pours (weighed: " in errors
        assert "pour 2 of stage pours (weighed: " in errors
        assert pours_begun(run) == before
    left = {path.name: path.read_bytes() for path in run.iterdir() if not path.name.startswith(f"{JOURNAL_NAME}-")}
    assert left == kept, "a refusal changes nothing in the run's folder"

    checked = check(run, "--json")
    assert checked.exit_code == 1, checked.output
    assert any(problem in text for text in json.loads(checked.stdout)["problems"])

    plan = load_campaign(place.folder / "small.yaml")
    plan = replace(plan, outputs=plan.outputs.model_copy(update={"directory": str(run.parent)}))
    with pytest.raises(JournalDamagedError, match=re.escape(problem)):
        find_run(plan)  # without a name it is found by its journal, or by its ledger


@pytest.mark.parametrize("lost", ["deleted", "damaged"])
def test_a_lost_write_ahead_log_repeats_no_pour(place: Workplace, lost: str) -> None:
    run = place.run_directory()
    before = pours_begun(run)
    assert len(before) >= 2
    wal = run / WAL
    if lost == "deleted":
        wal.unlink(missing_ok=True)
    elif wal.exists():
        content = bytearray(wal.read_bytes())
        for place_ in range(0, len(content), 512):
            content[place_] ^= 1
        wal.write_bytes(content)
    checked = check(run)
    if len(before) > 2 and checked.exit_code == 1:  # killed between ledger and checkpoint of the third
        assert "entries were lost" in checked.output
        assert "pour 2 of stage pours (weighed: " in checked.output
        return
    assert checked.exit_code == 0, checked.output
    place.finish(*RESUME, run.name)
    assert started_after_they_were_finished(place.entries()) == []
    begun = pours_begun(run)
    assert begun[: len(before)] == before
    assert len(begun) - len(set(begun)) <= 1, "only a pour that was under way when it was killed may be repeated"


def test_an_undamaged_run_passes_the_check(place: Workplace) -> None:
    run = place.run_directory()
    checked = check(run)
    assert checked.exit_code == 0, checked.output
    assert "complete and unchanged (" in checked.output
    assert "pour 2 of stage pours (weighed: " in checked.output
