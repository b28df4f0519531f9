"""`catalogue`: the catalogue of runs: what is found in it, and that it is right whatever happened to the runs or to
itself.
"""

from __future__ import annotations

import json
import logging
import os
import shlex
import shutil
import signal
import sqlite3
from dataclasses import replace
from datetime import datetime
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.catalogue import catalogue as index
from orchestrator.catalogue.catalogue import INDEX_NAME, Catalogue
from orchestrator.catalogue.queries import moment
from orchestrator.catalogue.run_reading import RunRows, read_run
from orchestrator.cli import console
from orchestrator.cli.app import app
from orchestrator.records import run_registry as registry
from orchestrator.records.journal import JOURNAL_NAME, JournalReader, Kind
from orchestrator.records.run_registry import VARIABLE, state_directory
from orchestrator.runs.run_folder import create_run
from tests.support.killed_runs import die_at, run
from tests.support.toy_campaign import ToyLaboratory, ToySimulators, toy_plan


@pytest.fixture
def state(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A state directory of its own; runs are made beside it."""
    monkeypatch.setenv(VARIABLE, str(tmp_path / "state"))
    monkeypatch.setattr(registry, "_reported", False)
    monkeypatch.setattr(console, "_quiet", False)  # of a command that a test ran before in this process
    return tmp_path / "state"


def made(tmp_path: Path, **changes: Any) -> Path:
    """A run of the toy campaign, from beginning to end."""
    plan = toy_plan(tmp_path / "runs", **changes)
    directory = create_run(plan)
    run(directory, plan=plan)
    return directory


def killed(tmp_path: Path, at: Kind) -> Path:
    """A run whose process died right after an entry of that kind was written."""
    for point in range(10, 60):
        directory = create_run(toy_plan(tmp_path / "runs"))
        if (child := os.fork()) == 0:
            die_at(point, after_commit=True)
            run(directory)
            os._exit(0)
        _, status = os.waitpid(child, 0)
        assert os.WTERMSIG(status) == signal.SIGKILL
        with JournalReader(directory / JOURNAL_NAME) as journal:
            *_, last = journal.entries()
        if last.kind == at:
            return directory
        shutil.rmtree(directory)
    raise AssertionError(f"no run ended in {at}")


def asked(table: str = "run", **conditions: Any) -> list[dict[str, Any]]:
    with Catalogue() as catalogue:
        catalogue.refresh()
        return catalogue.runs(conditions) if table == "run" else catalogue.pours(conditions)


def invoke(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command), env={"COLUMNS": "200"})


def test_a_run_and_its_pours_are_found_as_they_were_weighed(tmp_path: Path, state: Path) -> None:
    directory = made(tmp_path)
    (found,) = asked(receiver="CUP", liquid="water", strategy="D3", mode="virtual")
    assert (found["run"], found["state"], found["pours"]) == (directory.name, "finished", 4)
    with JournalReader(directory / JOURNAL_NAME) as journal:
        weighed = [e.body["outcome"]["measurement"]["spilled"] for e in journal.entries(kinds=[Kind.POUR_FINISHED])]
    pours = asked("pour", receiver="c?p", pourer="beaker")
    assert [pour["spilled_g"] for pour in pours] == pytest.approx([1e3 * mass for mass in weighed])
    assert all(15 <= pour["angular_velocity_deg_s"] <= 120 and pour["height_mm"] == 30 for pour in pours)
    assert pours[0]["loss"] == pytest.approx((weighed[0] + 0.001) / 0.2)  # (spilled + retained) / loaded
    assert not asked("pour", receiver="bowl")


def test_runs_are_found_by_when_they_were_made(tmp_path: Path, state: Path) -> None:
    made(tmp_path)
    assert asked(since="1h", until="2999")
    assert not asked(until="1h")
    assert not asked("pour", since="2999")


@pytest.mark.parametrize(
    ("text", "end", "means"),
    [
        ("2030-03-01", False, datetime(2030, 3, 1)),
        ("2030-03-01", True, datetime(2030, 3, 2)),
        ("2030-12", True, datetime(2031, 1, 1)),
        ("2030", True, datetime(2031, 1, 1)),
        ("2030-03-01 14:30", True, datetime(2030, 3, 1, 14, 31)),
        ("2d", False, datetime(2030, 3, 8, 12)),
    ],
)
def test_dates_are_read_as_people_mean_them(text: str, end: bool, means: datetime) -> None:
    assert moment(text, end=end, now=datetime(2030, 3, 10, 12)) == means.timestamp()


def test_an_index_that_is_lost_damaged_or_of_another_version_is_made_anew(tmp_path: Path, state: Path) -> None:
    made(tmp_path)
    before = asked()
    index = state / INDEX_NAME
    for harm in (index.unlink, lambda: index.write_bytes(b"not a database" * 400)):
        harm()
        assert asked() == before
    with Catalogue() as catalogue:
        catalogue._connection.execute("pragma user_version = 77")
        catalogue._connection.execute("drop view runs")
    assert asked() == before


def test_a_query_does_not_wait_for_another_process_that_reads_runs(
    tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = {made(tmp_path).name, made(tmp_path).name}
    found: list[set[str]] = []

    def read_slowly(directory: Path) -> RunRows:
        monkeypatch.setattr(index, "read_run", read_run)
        found.append({run["run"] for run in asked()})  # another process, while this one reads a journal
        return read_run(directory)

    monkeypatch.setattr(index, "read_run", read_slowly)
    assert {run["run"] for run in asked()} == names
    assert found == [names]


def test_a_run_that_goes_on_is_read_again(tmp_path: Path, state: Path) -> None:
    directory = killed(tmp_path, Kind.FINISHED)
    before = asked()[0]
    assert before["state"] == "interrupted"
    run(directory, plan=toy_plan(tmp_path / "runs"), resume=True)
    after = asked()[0]
    assert (after["state"], after["pours"]) == ("finished", 4)
    assert asked(state="finished")
    assert not asked(state="interrupted")


def test_a_pour_without_outcome_is_in_the_catalogue_too(tmp_path: Path, state: Path) -> None:
    killed(tmp_path, Kind.POUR_STARTED)
    *_, last = asked("pour")
    assert (last["outcome"], last["spilled_g"]) == ("open", None)
    assert asked()[0]["open_pours"] == 1


def test_a_run_is_running_while_its_process_lives(tmp_path: Path, state: Path) -> None:
    seen: list[str] = []

    def pause() -> float:
        seen.append(asked()[0]["state"])
        return 0.0

    plan = toy_plan(tmp_path / "runs")
    run(create_run(plan), ToyLaboratory(ToySimulators(pause)), plan=plan)
    assert set(seen) == {"running"}


def test_a_state_directory_that_cannot_be_written_is_said_once_and_stops_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, state: Path
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv(VARIABLE, str(tmp_path / "file" / "state"))
    with caplog.at_level(logging.WARNING):
        first, second = made(tmp_path), made(tmp_path)
    assert (first / JOURNAL_NAME).is_file()
    assert (second / JOURNAL_NAME).is_file()
    (line,) = [record.getMessage() for record in caplog.records if "catalogue" in record.getMessage()]
    assert f"decant runs add {first}" in line
    result = invoke("runs")
    assert (result.exit_code, "the runs are read again each time" in result.stderr) == (0, True)
    assert invoke(f"runs add {first}").exit_code == 2


def test_runs_of_elsewhere_are_entered_and_a_moved_one_is_known_once_with_its_remarks(
    tmp_path: Path, state: Path
) -> None:
    directory = made(tmp_path)
    assert "1 note" in invoke(f"runs note {directory.name} 'the tray was wet'").stdout
    shutil.move(tmp_path / "runs", tmp_path / "elsewhere")
    gone = invoke("runs list")
    assert directory.name not in gone.stdout
    assert "no longer listed; after a move: `decant runs add`" in gone.stderr
    assert "gone" not in invoke("runs list").stderr, "it is said once"
    result = invoke(f"runs add {tmp_path / 'elsewhere'}")
    assert (result.exit_code, result.stdout) == (0, "1 run entered, or known already\n")
    (found,) = asked(words=("WET",))
    assert found["path"] == str(tmp_path / "elsewhere" / directory.name)


def test_what_cannot_be_read_is_said_and_hides_nothing_else(tmp_path: Path, state: Path) -> None:
    bad, good = made(tmp_path), made(tmp_path)
    for file in bad.glob("journal.sqlite*"):
        file.write_bytes(b"rubbish" * 1000)
    result = invoke("runs list")
    assert good.name in result.stdout
    assert f"{bad / JOURNAL_NAME}: not a journal of Decant" in result.stderr
    shutil.rmtree(bad)
    assert bad.name not in invoke("runs list").stdout


def test_tags_of_an_earlier_version_are_words_of_a_note(tmp_path: Path, state: Path) -> None:
    directory = made(tmp_path)
    note = {"time": 1.9e9, "by": "ann", "text": "the tray was wet"}
    (directory / "remarks.json").write_text(json.dumps({"tags": ["good", "paper"], "notes": [note]}))
    assert "2 notes" not in invoke(f"runs note {directory.name} 'wiped'").stdout
    (found,) = asked(words=("paper", "wiped"))
    assert found["notes"] == ["tags: good, paper", "the tray was wet", "wiped"]


def posterior_rows(catalogue: Catalogue) -> list[str]:
    return [row[0] for row in catalogue._connection.execute("select content from posterior")]


def test_an_index_of_another_version_is_made_again_from_the_runs(
    tmp_path: Path, state: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A new version may read more from the same journals, as the keys of a posterior."""
    made(tmp_path)
    with monkeypatch.context() as earlier:
        earlier.setattr(index, "version", lambda name: "0.0.1")
        earlier.setattr(index, "read_run", lambda path: replace(read_run(path), posterior='{"old": 1}'))
        with Catalogue() as catalogue:
            catalogue.refresh()
            catalogue.refresh()  # reading a journal has changed its files
            assert posterior_rows(catalogue) == ['{"old": 1}']
    with Catalogue() as catalogue:
        catalogue.refresh()
        assert posterior_rows(catalogue) == [], "the run has no calibration, and therefore no posterior"
        catalogue._connection.execute("update run set campaign = 'kept'")
    with Catalogue() as catalogue:
        catalogue.refresh()
        assert [run["campaign"] for run in catalogue.runs({})] == ["kept"], "the same version reads a run once"


def test_one_command_says_which_action_was_used_for_a_vessel_and_what_it_spilled(tmp_path: Path, state: Path) -> None:
    directory = made(tmp_path)
    today = datetime.now().strftime("%Y-%m-%d")
    shown = invoke(f"runs pours --receiver cup --since {today} --until {today}").stdout
    for pour in asked("pour"):
        (line,) = [
            x for x in shown.splitlines() if f"{pour['angular_velocity_deg_s']:.4g} " in x and directory.name in x
        ]
        assert f"{pour['x_offset_mm']:.4g} " in line
        assert f"{pour['spilled_g']:.1f} " in line
        assert "VIRTUAL" in line
    told = json.loads(invoke("runs pours --receiver cup --json").stdout)
    assert [pour["spilled_g"] for pour in told["pours"]] == [pour["spilled_g"] for pour in asked("pour")]


def test_the_command_draws_charts_of_a_laboratory_and_a_note_begins_new_limits(
    tmp_path: Path,
    state: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.chdir(tmp_path)
    directory = made(tmp_path)
    table = invoke("runs chart").stdout
    with Catalogue(state) as catalogue:
        (chart,) = catalogue.charts({})
    assert (chart.laboratory, chart.quantity) == ("toy", "seconds")
    assert sum(point.pours for point in chart.points) == 4
    assert "time of a pour [s]" in table
    assert "too few days" in table
    assert not list(tmp_path.glob("*.png"))  # nothing is written unless it is asked for
    assert invoke("runs chart --png toy.png").exit_code == 0
    assert (tmp_path / "toy.png").stat().st_size > 5_000
    refused = invoke("runs chart elsewhere")
    assert refused.exit_code == 2
    assert "elsewhere: no weighed pour of this laboratory; known: toy" in refused.stderr
    assert invoke(f"runs note {directory.name} 'new limits: another balance'").exit_code == 0
    assert "no weighed pour that this holds for" in invoke("runs chart").stderr


@pytest.mark.parametrize(
    ("command", "says"),
    [
        ("runs list --since yesterday", "'yesterday' is not a date: write 2030-03-01"),
        ("runs list --mode maybe", "mode 'maybe' is not one of virtual, real, hardware"),
        ("runs show nothing", "nothing: no such run in the catalogue"),
        ("runs add nowhere", "nowhere: is not a folder"),
    ],
)
def test_bad_input_is_one_clear_error(command: str, says: str, state: Path) -> None:
    result = invoke(command)
    assert result.exit_code == 2
    assert says in result.stderr
    assert "Traceback" not in result.stderr


def test_a_run_is_named_by_as_much_as_makes_it_clear(tmp_path: Path, state: Path) -> None:
    one, other = made(tmp_path), made(tmp_path)
    unclear = invoke("runs show toy")
    assert unclear.exit_code == 2
    assert str(one) in unclear.stderr
    assert str(other) in unclear.stderr
    assert str(one) in invoke(f"runs show {one}").stdout


def test_the_state_directory_is_where_its_variables_say(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in (VARIABLE, "STATE_DIRECTORY", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    assert state_directory() == tmp_path / ".local/state/decant"
    monkeypatch.setenv("XDG_STATE_HOME", "/xdg")
    assert state_directory() == Path("/xdg/decant")
    monkeypatch.setenv("STATE_DIRECTORY", "/var/lib/decant:/other")
    assert state_directory() == Path("/var/lib/decant")
    monkeypatch.setenv(VARIABLE, "/mine")
    assert state_directory() == Path("/mine")


def damaged(directory: Path, statement: str) -> None:
    """Valid SQLite, with content that no run has written."""
    connection = sqlite3.connect(directory / JOURNAL_NAME)
    for (name,) in connection.execute("select name from sqlite_master where type = 'trigger'").fetchall():
        connection.execute(f"drop trigger {name}")
    connection.execute(statement)
    connection.commit()
    connection.close()


@pytest.mark.parametrize(
    "statement",
    [
        f"update header set fingerprint = json_set(fingerprint, '$.seed', json('{2**63}'))",
        "update header set fingerprint = json_set(fingerprint, '$.seed', json('[1]'))",
        "update header set fingerprint = '[]'",
        "update event set body = json_set(body, '$.after', json('{}')) where kind = 'campaign.state'",
        "update event set body = '7' where kind = 'pour.finished'",
        "update event set body = json_set(body, '$.id', 999) where kind = 'pour.started'",
        "update event set kind = 'told' where kind = 'requested'",
        "drop table event",
    ],
)
def test_a_bad_run_is_listed_as_unreadable_and_hides_no_other(tmp_path: Path, state: Path, statement: str) -> None:
    good, bad = made(tmp_path), made(tmp_path)
    damaged(bad, statement)
    shown = invoke("runs")
    assert shown.exit_code == 0, shown.output
    (line,) = (line for line in shown.stdout.splitlines() if good.name in line)
    assert "finished" in line
    (line,) = (line for line in shown.stdout.splitlines() if bad.name in line)
    assert "unreadable" in line
    assert f"note: {bad}" in shown.stderr  # its path, with the reason
    found = {run["run"]: run for run in json.loads(invoke("runs list --json").stdout)["runs"]}
    assert found[bad.name]["path"] == str(bad)
    assert {run["run"] for run in asked("pour")} == {good.name}


@pytest.mark.parametrize("lost", ["deleted", "empty", "garbage"])
def test_a_run_that_lost_its_journal_is_listed_as_unreadable(tmp_path: Path, state: Path, lost: str) -> None:
    good, bad = made(tmp_path), made(tmp_path)
    if lost == "deleted":
        (bad / JOURNAL_NAME).unlink()
    else:
        (bad / JOURNAL_NAME).write_bytes(b"" if lost == "empty" else b"coffee " * 1000)
    assert {run["run"]: run["state"] for run in asked()} == {good.name: "finished", bad.name: "unreadable"}
    checked = invoke(f"runs check {bad.name}")
    assert checked.exit_code == 1
    assert checked.output.count("(weighed: ") == 4  # the ledger has the pours
