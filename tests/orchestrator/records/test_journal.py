"""`journal`: the journal keeps what was written, refuses what it should, and is held by one process at a time."""

from __future__ import annotations

import errno
import fcntl
import os
import signal
import sqlite3
import subprocess
import sys
import textwrap
from collections.abc import Callable
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import pytest
from typer.testing import CliRunner

from actors.runtime.child_process import child_environment
from orchestrator.cli.app import app
from orchestrator.daemon.state.daemon_store import FORMAT as STORE_FORMAT
from orchestrator.daemon.state.daemon_store import Store, StoreError
from orchestrator.learning.requests import Failed, Pour, Poured, Simulate
from orchestrator.records.codec import CodecError
from orchestrator.records.events import (
    CampaignStateChanged,
    LogLine,
    Requested,
    RequestFinished,
    RequestStarted,
    Told,
)
from orchestrator.records.journal import JOURNAL_NAME, Journal, JournalReader, Kind
from orchestrator.records.journal_check import BEGUN, LEDGER_NAME, JournalDamagedError, check_journal, read_ledger
from orchestrator.records.journal_file import FORMAT, Header, JournalError
from orchestrator.records.states import State
from orchestrator.study.study_folder import StudyError, opened
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourMeasurement
from tests.support.study_files import small

HEADER = Header("toy", {"seed": 7, "deployment": {"pours": 3}})
POUR = Pour("narrow cup", Action(angular_velocity=0.7, x_offset=0.09, height=0.05), 1, 1)


class SlowPour:
    """Nothing that a strategy may request."""


def note(text: str, stage: str = "") -> LogLine:
    return LogLine(text=text, stage=stage, kept=True)


def bodies(path: Path) -> list[dict[str, object]]:
    with JournalReader(path) as reader:
        return [entry.body for entry in reader.entries()]


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "run" / JOURNAL_NAME


def test_entries_come_back_in_order_with_their_stage(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    journal.append(note("größer", "pours"))
    journal.append(Told(stage="calibration", id=1), Told(stage="calibration", id=2))
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
        journal.append(CampaignStateChanged(before=State.QUEUED, after=State.PREPARING, pid=1))
        assert reader.state() is State.PREPARING
    journal.close()


@pytest.mark.parametrize("statement", ["delete from event", "update event set body = '{}'"])
def test_nothing_written_can_be_changed_or_deleted(path: Path, statement: str) -> None:
    journal = Journal.create(path, HEADER)
    journal.append(note("it happened"))
    journal.close()
    connection = sqlite3.connect(path)
    with pytest.raises(sqlite3.DatabaseError, match="append-only"):
        connection.execute(statement)
    connection.close()
    assert bodies(path) == [{"text": "it happened"}]


def test_entries_written_together_are_there_together_or_not_at_all(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    with pytest.raises(CodecError, match="got SlowPour"):
        journal.append(Told(id=1), Requested(id=2, request=SlowPour()))  # type: ignore[arg-type]
    connection = sqlite3.connect(path)
    connection.execute(
        "create trigger no_seven before insert on event when json_extract(new.body, '$.id') = 7 "
        "begin select raise(abort, 'disk full'); end"
    )
    connection.close()
    with pytest.raises(sqlite3.DatabaseError, match="disk full"):
        journal.append(Told(id=6), Told(id=7))
    journal.append(note("still usable"))
    journal.close()
    assert bodies(path) == [{"text": "still usable"}]


def test_pours_are_flushed_to_the_disk_and_simulations_need_not_be(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    level = {}
    simulation = Simulate("narrow cup", POUR.action, SimulationParameters(), 1)
    failed = Failed("simulation", "diverged")
    for request in (simulation, POUR):
        started, finished = (
            RequestStarted(id=1, request=request),
            RequestFinished(id=1, request=request, outcome=failed),
        )
        for event in (started, finished):
            journal.append(event)
            level[event.kind] = journal._connection.execute("pragma synchronous").fetchone()[0]
    journal.close()
    assert level == {Kind.STARTED: 1, Kind.POUR_STARTED: 2, Kind.POUR_FINISHED: 2, Kind.FINISHED: 1}


def test_everything_acknowledged_survives_the_death_of_the_writer(path: Path) -> None:
    code = f"""
        from pathlib import Path
        from orchestrator.records.events import LogLine
        from orchestrator.records.journal import Journal
        from orchestrator.records.journal_file import Header
        journal = Journal.create(Path({str(path)!r}), Header("toy", {HEADER.fingerprint!r}))
        for number in range(10**6):
            journal.append(LogLine(text=str(number), kept=True))
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
    numbers = [int(str(body["text"])) for body in bodies(path)]
    assert numbers[: acknowledged + 1] == list(range(acknowledged + 1))
    journal = Journal.resume(path, HEADER)  # the lock went with the process
    journal.close()


def test_a_second_process_is_refused_and_told_who_is_first(path: Path) -> None:
    code = f"""
        from pathlib import Path
        from orchestrator.records.journal import Journal
        from orchestrator.records.journal_file import Header
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
        with pytest.raises(JournalError, match=f"process {process.pid} is running this campaign"):
            Journal.resume(path, HEADER)
        with JournalReader(path) as reader:  # but anyone may read
            assert reader.header.name == "toy"
    finally:
        process.communicate("\n")
    Journal.resume(path, HEADER).close()


def test_one_process_can_not_open_it_twice_either(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    with pytest.raises(JournalError, match=f"process {os.getpid()}"):
        Journal.resume(path, HEADER)
    journal.close()


def test_a_run_can_not_be_begun_over_another(path: Path) -> None:
    Journal.create(path, HEADER).close()
    with pytest.raises(JournalError, match="holds a run already"):
        Journal.create(path, HEADER)


def test_other_settings_are_refused_by_name(path: Path) -> None:
    Journal.create(path, HEADER).close()
    with pytest.raises(JournalError, match=r"deployment\.pours: 3 became 5.* versions\.json next to it"):
        Journal.resume(path, Header("toy", {"seed": 7, "deployment": {"pours": 5}}))
    Journal.resume(path, HEADER).close()  # and the refusal left no lock behind


def test_a_run_of_whole_pours_says_how_it_is_resumed(path: Path) -> None:
    Journal.create(path, Header("toy", {"scene": {"name": "cup"}})).close()
    with pytest.raises(JournalError, match=r"simulated whole pours.* Write 'symmetry: off' under 'simulator'"):
        Journal.resume(path, Header("toy", {"scene": {"name": "cup", "mirrored": True}}))
    with pytest.raises(JournalError, match=r"begun with other settings.* scene\.not_mirrored: nothing became true"):
        Journal.resume(path, Header("toy", {"scene": {"name": "cup", "not_mirrored": True}}))


@pytest.mark.parametrize("other", [FORMAT - 1, FORMAT + 1])
def test_a_journal_of_another_format_is_refused_and_stays_as_it_is(path: Path, other: int) -> None:
    journal = Journal.create(path, HEADER)
    pour(journal, 1)
    journal.close()
    with closing(sqlite3.connect(path)) as connection:
        connection.execute("update header set format = ?", [other])
        connection.commit()
    before = {file.name: file.read_bytes() for file in (path, path.with_name(LEDGER_NAME))}
    told = f"{path}: written in format {other}, this version of Decant reads format {FORMAT}; use the version that "
    told += "began the run (see versions.json next to it), or begin a new run"
    for use in (JournalReader, check_journal, lambda path: Journal.resume(path, HEADER)):
        with pytest.raises(JournalError) as refused:
            use(path)
        assert (str(refused.value), refused.value.exit_code) == (told, 2)
    for command in (["report", str(path.parent)], ["runs", "check", str(path.parent)]):
        result = CliRunner().invoke(app, command)
        assert (result.exit_code, result.stdout, result.stderr) == (2, "", f"{told}\n")
    assert {file.name: file.read_bytes() for file in (path, path.with_name(LEDGER_NAME))} == before
    assert not (path.parent / "report.html").exists()


@pytest.mark.parametrize("other", [2, STORE_FORMAT + 1])
def test_a_queue_of_another_format_is_refused_and_stays_as_it_is(tmp_path: Path, other: int) -> None:
    path = tmp_path / "daemon.sqlite"
    with closing(sqlite3.connect(path)) as connection:
        connection.executescript(f"create table campaign (id text primary key); pragma user_version = {other};")
    before = path.read_bytes()
    for _ in range(2):  # the refusal leaves no lock behind
        with pytest.raises(StoreError) as refused:
            Store(path)
        assert str(refused.value) == (
            f"{path}: written in format {other}, this version of Decant reads formats 5 to {STORE_FORMAT}; "
            "use the version that wrote it, or name another folder with --state"
        )
    assert CliRunner().invoke(app, ["server", "start", "--state", str(tmp_path), "--port", "0"]).exit_code == 2
    assert path.read_bytes() == before


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
    journal.append(note("before"))
    pages = journal._connection.execute("pragma page_count").fetchone()[0]
    journal._connection.execute(f"pragma max_page_count = {pages}")
    with pytest.raises(JournalError, match=r"can't be written \(database or disk is full;.*resume the run"):
        journal.append(note("x" * 100_000))
    journal.append(note("after"))  # there is room for little things
    assert [entry.body["text"] for entry in journal.entries()] == ["before", "after"]
    journal.close()


# -- lost and changed entries ------------------------------------------------------------------------------------------


def pour(journal: Journal, number: int) -> None:
    """One pour, from its intent to its outcome."""
    journal.append(RequestStarted(stage="pours", id=number, request=replace(POUR, number=number)))
    outcome = Poured(PourMeasurement(0.2, 0.003, 0.001))
    journal.append(RequestFinished(stage="pours", id=number, request=POUR, outcome=outcome))


def poured(path: Path, *, between: Callable[[Journal], object] = lambda _: None) -> None:
    """Two pours by a process that is killed right after them; `between` the two it does something more."""
    child = os.fork()
    if child == 0:
        try:
            journal = Journal.create(path, HEADER)
            pour(journal, 1)
            between(journal)
            pour(journal, 2)
        finally:
            os.kill(os.getpid(), signal.SIGKILL)
    _, status = os.waitpid(child, 0)
    assert os.WTERMSIG(status) == signal.SIGKILL


def kill_before_the_ledger(journal: Journal) -> None:
    """Its process is killed as soon as it writes to its ledger."""
    journal._ledger.append = lambda lines: os.kill(os.getpid(), signal.SIGKILL)  # type: ignore[method-assign]


def test_at_a_pour_the_entries_leave_the_write_ahead_log(path: Path) -> None:
    poured(path)
    for suffix in ("-wal", "-shm"):
        path.with_name(path.name + suffix).unlink(missing_ok=True)
    with JournalReader(path) as reader:
        assert [entry.kind for entry in reader.entries()] == [Kind.POUR_STARTED, Kind.POUR_FINISHED] * 2


def test_a_log_that_a_reader_kept_from_being_copied_and_that_is_lost_is_detected(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    reading = sqlite3.connect(path)
    reading.execute("begin")
    reading.execute("select count(*) from event").fetchone()  # pages that it reads stay in the file until it ends
    pour(journal, 1)
    copied = path.with_name("copied") / JOURNAL_NAME
    copied.parent.mkdir()
    for name in (JOURNAL_NAME, LEDGER_NAME):  # the folder as it is on the disk, without the log
        (copied.parent / name).write_bytes((path.parent / name).read_bytes())
    reading.close()
    journal.close()
    with pytest.raises(JournalDamagedError, match=r"entries were lost\n.*made: pour 1 of stage pours \(weighed: 3.0 g"):
        Journal.resume(copied, HEADER)
    Journal.resume(path, HEADER).close()


def test_a_process_killed_between_journal_and_ledger_is_resumed_and_the_ledger_completed(path: Path) -> None:
    poured(path, between=kill_before_the_ledger)
    kinds = [line.kind for line in read_ledger(path.with_name(LEDGER_NAME))]
    assert kinds == [BEGUN, Kind.POUR_STARTED, Kind.POUR_FINISHED]
    Journal.resume(path, HEADER).close()
    found = check_journal(path)
    assert found.problems == ()
    assert found.pours[0] == "pour 1 of stage pours (weighed: 3.0 g spilled, 1.0 g retained)"
    assert found.pours[1].startswith("pour 2 of stage pours (began ")


def test_a_half_written_last_line_of_the_ledger_is_no_damage(path: Path) -> None:
    poured(path)
    ledger = path.with_name(LEDGER_NAME)
    whole = ledger.read_bytes()
    ledger.write_bytes(whole[:-10])
    assert check_journal(path).problems == ()
    Journal.resume(path, HEADER).close()
    assert ledger.read_bytes() == whole


@pytest.mark.parametrize("edit", [(b'"spilled":0.003', b'"spilled":0.002'), (b'"pour.started"', b'"pour.withdrawn"')])
def test_a_changed_ledger_is_detected(path: Path, edit: tuple[bytes, bytes]) -> None:
    poured(path)
    ledger = path.with_name(LEDGER_NAME)
    ledger.write_bytes(ledger.read_bytes().replace(*edit, 1))
    with pytest.raises(JournalDamagedError, match=r"pours.jsonl, line [23]: was changed after it was written"):
        Journal.resume(path, HEADER)


@pytest.mark.parametrize(
    "change",
    [
        "update event set body = replace(body, '0.003', '0.004') where seq = 2",
        "update event set t = t + 1 where seq = 3",
        "update header set name = 'other'",
        "delete from event where seq = 2",
        "delete from event where seq = 4",
        "delete from chain where seq = 4",
        "insert into event values (5, 'pours', 0.0, 'note', '{}')",
    ],
)
def test_a_changed_removed_or_inserted_entry_is_detected(path: Path, change: str) -> None:
    journal = Journal.create(path, HEADER)
    pour(journal, 1)
    journal.append(note("one"))
    journal.append(note("two"))
    journal.close()
    assert check_journal(path).verdict == "complete and unchanged (4 entries)"
    with closing(sqlite3.connect(path)) as connection:
        for name in ("event_is_never_changed", "event_is_never_deleted", "chain_is_never_deleted"):
            connection.execute(f"drop trigger {name}")
        connection.execute(change)
        connection.commit()
    assert check_journal(path).problems
    with pytest.raises(JournalDamagedError, match="Nothing was poured now"):
        Journal.resume(path, HEADER)


def test_every_flipped_byte_of_an_entry_is_detected(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    pour(journal, 1)
    journal.close()
    content = path.read_bytes()
    begin = content.index(b'{"id":1,"outcome"')
    for place in range(begin, content.index(b'"Poured"', begin)):
        changed = bytearray(content)
        changed[place] ^= 1
        path.write_bytes(changed)
        assert check_journal(path).problems, f"byte {place - begin}"


@pytest.mark.parametrize("trace", ["resolved.json", "journal.reserve", "journal.lock", LEDGER_NAME])
def test_a_folder_with_traces_of_a_run_gets_no_new_journal(path: Path, trace: str) -> None:
    path.parent.mkdir()
    (path.parent / trace).touch()
    with pytest.raises(JournalError, match=f"a run was begun here .*{trace}"):
        Journal.create(path, HEADER)
    with pytest.raises(JournalDamagedError, match="missing"):
        Journal.resume(path, HEADER)
    assert not path.exists()


def test_an_empty_journal_next_to_a_recording_is_not_begun_again(path: Path) -> None:
    path.parent.mkdir()
    path.touch()
    (path.parent / "campaign.rrd").touch()
    with pytest.raises(JournalDamagedError, match=r"is empty, but the folder has campaign.rrd"):
        Journal.resume(path, HEADER)


def test_a_run_can_be_checked_while_it_is_written(path: Path) -> None:
    journal = Journal.create(path, HEADER)
    for number in range(1, 20):
        pour(journal, number)
        journal.append(note("between"))
        assert check_journal(path).problems == ()
    journal.close()


def test_a_file_system_without_locks_is_reported_as_that(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as another process that runs the campaign, the study or the daemon: NFS without its lock service."""

    def unsupported(*_: object) -> None:
        raise OSError(errno.ENOLCK, os.strerror(errno.ENOLCK))

    monkeypatch.setattr(fcntl, "flock", unsupported)
    cause = rf"can't be locked \({os.strerror(errno.ENOLCK)}\); name a folder on a local disk"
    with pytest.raises(JournalError, match=rf"journal\.lock: {cause}"):
        Journal.create(tmp_path / "journal.sqlite", HEADER)
    with pytest.raises(StoreError, match=cause):
        Store(tmp_path / "daemon.sqlite")
    with pytest.raises(StudyError, match=cause), opened(small(tmp_path)):
        pass
