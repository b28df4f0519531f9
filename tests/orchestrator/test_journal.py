"""The journal keeps what was written, refuses what it should, and is held by one process at a time."""

from __future__ import annotations

import os
import signal
import sqlite3
import subprocess
import sys
import textwrap
from pathlib import Path

import pytest

from actors.child_process import child_environment
from orchestrator.journal import JOURNAL_NAME, Draft, Journal, JournalReader, Kind
from orchestrator.journal_file import FORMAT, Header, JournalError, JournalLockedError
from orchestrator.states import State

HEADER = Header("toy", {"seed": 7, "deployment": {"pours": 3}})


def bodies(path: Path) -> list[dict[str, object]]:
    with JournalReader(path) as reader:
        return [entry.body for entry in reader.entries()]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / JOURNAL_NAME


def test_entries_come_back_in_order_with_their_stage(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    journal.append(Kind.NOTE, {"text": "größer"}, stage="pours")
    journal.append_all([Draft(Kind.TOLD, {"id": 1}, "calibration"), Draft(Kind.TOLD, {"id": 2}, "calibration")])
    journal.close()
    with JournalReader(path) as reader:
        entries = list(reader.entries())
        assert [(e.seq, e.stage, e.kind, e.body) for e in entries] == [
            (1, "pours", "note", {"text": "größer"}),
            (2, "calibration", "told", {"id": 1}),
            (3, "calibration", "told", {"id": 2}),
        ]
        assert [e.seq for e in reader.entries(stage="calibration", after=2)] == [3]
        assert reader.header.name == "toy"


def test_a_reader_sees_entries_while_the_run_writes_them(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    with JournalReader(path) as reader:
        assert reader.state() is State.QUEUED
        journal.append(Kind.CAMPAIGN_STATE, {"before": "queued", "after": "preparing", "reason": "", "pid": 1})
        assert reader.state() is State.PREPARING
    journal.close()


@pytest.mark.parametrize("statement", ["delete from event", "update event set body = '{}'"])
def test_nothing_written_can_be_changed_or_deleted(path: Path, statement: str) -> None:
    journal = Journal.create(path, HEADER)
    journal.append(Kind.NOTE, {"text": "it happened"})
    journal.close()
    connection = sqlite3.connect(path)
    with pytest.raises(sqlite3.DatabaseError, match="append-only"):
        connection.execute(statement)
    connection.close()
    assert bodies(path) == [{"text": "it happened"}]


def test_entries_written_together_are_there_together_or_not_at_all(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    with pytest.raises(ValueError, match="not JSON compliant"):
        journal.append_all([Draft(Kind.TOLD, {"id": 1}), Draft(Kind.TOLD, {"id": float("nan")})])
    connection = sqlite3.connect(path)
    connection.execute(
        "create trigger no_seven before insert on event when json_extract(new.body, '$.id') = 7 "
        "begin select raise(abort, 'disk full'); end"
    )
    connection.close()
    with pytest.raises(sqlite3.DatabaseError, match="disk full"):
        journal.append_all([Draft(Kind.ASKED, {"ids": [7]}), Draft(Kind.REQUESTED, {"id": 7})])
    journal.append(Kind.NOTE, {"text": "still usable"})
    journal.close()
    assert bodies(path) == [{"text": "still usable"}]


def test_pours_are_flushed_to_the_disk_and_simulations_need_not_be(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    level = {}
    for kind in (Kind.STARTED, Kind.POUR_STARTED, Kind.POUR_FINISHED, Kind.FINISHED):
        journal.append(kind, {"id": 1})
        level[kind] = journal._connection.execute("pragma synchronous").fetchone()[0]
    journal.close()
    assert level == {Kind.STARTED: 1, Kind.POUR_STARTED: 2, Kind.POUR_FINISHED: 2, Kind.FINISHED: 1}


def test_everything_acknowledged_survives_the_death_of_the_writer(path: Path) -> None:
    code = f"""
        from pathlib import Path
        from orchestrator.journal import Journal, Kind
        from orchestrator.journal_file import Header
        journal = Journal.create(Path({str(path)!r}), Header("toy", {HEADER.fingerprint!r}))
        for number in range(10**6):
            journal.append(Kind.NOTE, {{"number": number}})
            print(number, flush=True)
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)], stdout=subprocess.PIPE, text=True, env=child_environment()
    )
    assert process.stdout is not None
    for line in process.stdout:
        if int(line) >= 300:
            break
    process.send_signal(signal.SIGKILL)
    acknowledged = int((process.stdout.read().split() or [line])[-1])
    process.wait()
    numbers = [body["number"] for body in bodies(path)]
    assert numbers[: acknowledged + 1] == list(range(acknowledged + 1))
    journal = Journal.resume(path, HEADER)  # the lock went with the process
    journal.close()


def test_a_second_process_is_refused_and_told_who_is_first(path: Path) -> None:
    code = f"""
        from pathlib import Path
        from orchestrator.journal import Journal
        from orchestrator.journal_file import Header
        journal = Journal.create(Path({str(path)!r}), Header("toy", {HEADER.fingerprint!r}))
        print("open", flush=True)
        input()
    """
    process = subprocess.Popen(
        [sys.executable, "-c", textwrap.dedent(code)],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        text=True,
        env=child_environment(),
    )
    assert process.stdout is not None
    assert process.stdout.readline() == "open\n"
    try:
        with pytest.raises(JournalLockedError, match=f"process {process.pid} is running this campaign"):
            Journal.resume(path, HEADER)
        with JournalReader(path) as reader:  # but anyone may read
            assert reader.header.name == "toy"
    finally:
        process.communicate("\n")
    Journal.resume(path, HEADER).close()


def test_one_process_can_not_open_it_twice_either(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    with pytest.raises(JournalLockedError, match=f"process {os.getpid()}"):
        Journal.resume(path, HEADER)
    journal.close()


def test_a_run_can_not_be_begun_over_another(path: Path) -> None:
    Journal.create(path, HEADER).close()
    with pytest.raises(JournalError, match="holds a run already"):
        Journal.create(path, HEADER)


def test_other_settings_are_refused_by_name(path: Path) -> None:
    Journal.create(path, HEADER).close()
    with pytest.raises(JournalError, match=r"deployment\.pours: 3 became 5"):
        Journal.resume(path, Header("toy", {"seed": 7, "deployment": {"pours": 5}}))
    Journal.resume(path, HEADER).close()  # and the refusal left no lock behind


def test_another_format_is_refused(path: Path) -> None:
    Journal.create(path, HEADER).close()
    connection = sqlite3.connect(path)
    connection.execute("update header set format = ?", [FORMAT + 1])
    connection.commit()
    connection.close()
    with pytest.raises(JournalError, match=f"written in format {FORMAT + 1}"):
        Journal.resume(path, HEADER)
    with pytest.raises(JournalError, match=f"reads format {FORMAT}"):
        JournalReader(path)


def test_what_is_not_a_journal_is_refused(path: Path) -> None:
    path.parent.mkdir()
    with pytest.raises(JournalError, match="no journal to resume"):
        Journal.resume(path, HEADER)
    with pytest.raises(JournalError, match="no journal here"):
        JournalReader(path)
    path.write_bytes(b"spilled coffee " * 1000)
    with pytest.raises(JournalError, match="not a journal of Decant"):
        Journal.resume(path, HEADER)
    with pytest.raises(JournalError, match="not a journal of Decant"):
        JournalReader(path)


def test_a_run_that_died_before_its_first_word_can_be_resumed(path: Path) -> None:
    path.parent.mkdir()
    path.touch()  # the file exists, nothing was committed
    journal = Journal.resume(path, HEADER)
    assert list(journal.entries()) == []
    assert journal.state() is State.QUEUED
    journal.close()


def test_a_refused_journal_is_not_kept_open(path: Path) -> None:
    Journal.create(path, HEADER).close()
    with pytest.raises(JournalError):
        Journal.create(path, HEADER)
    with pytest.raises(JournalError) as refused:
        Journal.resume(path, Header("toy", {"seed": 8}))
    # the error still holds the frames that it passed through, and with them whatever they had left open
    held = [target for fd in Path("/proc/self/fd").iterdir() if (target := os.path.realpath(fd)).startswith(str(path))]
    assert (held, refused.type) == ([], JournalError)


def test_a_full_disk_is_named_and_nothing_written_is_lost(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    journal.append(Kind.NOTE, {"text": "before"})
    pages = journal._connection.execute("pragma page_count").fetchone()[0]
    journal._connection.execute(f"pragma max_page_count = {pages}")
    with pytest.raises(JournalError, match=r"can't be written \(database or disk is full;.*resume the run"):
        journal.append(Kind.NOTE, {"text": "x" * 100_000})
    journal.append(Kind.NOTE, {"text": "after"})  # there is room for little things
    assert [entry.body["text"] for entry in journal.entries()] == ["before", "after"]
    journal.close()
