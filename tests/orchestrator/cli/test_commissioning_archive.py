"""`commissioning_archive`: the recordings of a commissioning day in one file, and their replay. Nothing here was
recorded on a real rig.
"""

from __future__ import annotations

import json
import zipfile
from pathlib import Path

import pytest
from typer.testing import CliRunner, Result

from orchestrator.cli.app import app
from orchestrator.cli.commissioning_archive import CommissioningArchive

ROOT = Path(__file__).parents[3]
ARCHIVES = sorted((ROOT / "tests" / "data" / "commissioning").glob("*.zip"))


def archive(*words: Path | str) -> Result:
    return CliRunner().invoke(app, ["robot", "archive", *map(str, words)])


@pytest.mark.parametrize("path", ARCHIVES, ids=lambda path: path.stem)
def test_archives_of_first_days_are_read_as_on_the_day(path: Path) -> None:
    checks = list(CommissioningArchive(path).replay())
    assert checks
    assert [check for check in checks if check.state != "ok"] == []


@pytest.fixture
def day(tmp_path: Path) -> Path:
    """The archive that the guide produced on virtual devices, unpacked."""
    with zipfile.ZipFile(ROOT / "tests" / "data" / "commissioning" / "virtual.zip") as kept:
        kept.extractall(tmp_path / "day")
    (tmp_path / "day" / "index.json").unlink()
    return tmp_path / "day"


def test_recordings_are_added_one_after_another_and_replayed(day: Path, tmp_path: Path) -> None:
    kept, (first, *others) = tmp_path / "kept.zip", sorted(day.iterdir())
    assert archive(kept, first).exit_code == 0
    done = archive(kept, *others, "--json")
    assert done.exit_code == 0, done.stderr
    told = json.loads(done.stdout)
    assert told["ready"]
    assert [check["name"] for check in told["checks"]] == [path.name for path in (first, *others)]
    again = archive(kept, first)
    assert again.exit_code == 2
    assert "is in the archive already" in again.stderr


def test_a_recording_that_is_read_differently_fails_with_its_place(day: Path, tmp_path: Path) -> None:
    kept = CommissioningArchive(tmp_path / "kept.zip")
    kept.add([day / "robot.json"])
    changed = json.loads((day / "robot.json").read_text())
    changed["readout"]["exchange"]["payload"] += 1.0
    (day / "robot.json").write_text(json.dumps(changed))
    with zipfile.ZipFile(tmp_path / "kept.zip") as old:
        index = old.read("index.json")
    with zipfile.ZipFile(tmp_path / "kept.zip", "w") as fresh:
        fresh.write(day / "robot.json", "robot.json")
        fresh.writestr("index.json", index)
    done = archive(tmp_path / "kept.zip")
    assert done.exit_code == 1
    assert 'state was "ok", is "fail"' in done.stdout or "found was" in done.stdout


@pytest.mark.parametrize(
    ("name", "text"), [("notes.json", "{}"), ("notes.jsonl", "{}\n"), ("notes.txt", "200 g put on")]
)
def test_what_is_no_recording_is_refused_and_leaves_the_archive_as_it_is(tmp_path: Path, name: str, text: str) -> None:
    (tmp_path / name).write_text(text)
    done = archive(tmp_path / "kept.zip", tmp_path / name)
    assert done.exit_code == 2
    assert f"{name}: not a recording" in done.stderr
    assert not (tmp_path / "kept.zip").exists()
    absent = archive(tmp_path / "kept.zip", tmp_path / "absent.json")
    assert absent.exit_code == 2
    assert "absent.json: there is no such file" in absent.stderr
    missing = archive(tmp_path / "kept.zip")
    assert missing.exit_code == 2
    assert "there is no such archive" in missing.stderr
