"""What every kind of bad input is answered with: files and command lines in `data/bad_input`, and their errors.

`files/` has the good files and those that are wrong on the command line. `cases.json` has one case on each line: its
folder of files, the command, and further files, each as a text or as an edit of another file.
"""

from __future__ import annotations

import base64
import json
import os
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.records.run_registry import VARIABLE
from tests.golden.golden import DATA, ROOT, Golden, normalised

INPUTS = DATA / "bad_input"

SHIPPED = "configs/"
"""What edits of shipped files begin with."""

pytestmark = pytest.mark.timeout(120)  # should a command no longer refuse its input, it may begin to work


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    """The folders that commands are given in."""
    root = tmp_path_factory.mktemp("bad")
    found = {name: root / name for name in ("good", "small", "shipped", "empty")}
    shutil.copytree(ROOT / "configs", found["shipped"])
    for name, folder in found.items():
        folder.mkdir(exist_ok=True)
        if name != "empty":
            shutil.copytree(INPUTS / "files" / name, folder, dirs_exist_ok=True)
    (found["small"] / "folder").mkdir()
    return found


def cases() -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((INPUTS / "cases.json").read_text(encoding="utf-8"))
    return found


def content(file: Mapping[str, Any]) -> bytes:
    """The bytes of a case's file."""
    if "base64" in file:
        return base64.b64decode(file["base64"])
    if "text" in file:
        return "".join(file["text"]).encode()
    name = str(file["of"])
    source = ROOT / name if name.startswith(SHIPPED) else INPUTS / "files" / name
    text = source.read_text(encoding="utf-8")
    if "old" in file:
        assert text.count(file["old"]) == 1, f"{name} no longer has the text that a case replaces: {file['old']!r}"
        text = text.replace(file["old"], file["new"])
    return text.encode()


def answered(case: Mapping[str, Any], folder: Path, monkeypatch: pytest.MonkeyPatch) -> str:
    """What the command prints, and its exit code; the folder is as it was."""
    monkeypatch.chdir(folder)
    before = sorted(folder.rglob("*"))
    restored = {name: (folder / name).read_bytes() for name in case["files"] if (folder / name).is_file()}
    for name, file in case["files"].items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_bytes(content(file))
    try:
        result = CliRunner().invoke(app, case["command"])
        if result.exception is not None and not isinstance(result.exception, SystemExit):
            raise result.exception
    finally:
        for name in case["files"]:
            if name in restored:
                (folder / name).write_bytes(restored[name])
            else:
                (folder / name).unlink()
    made = {path for path in folder.rglob("*") if path not in before and path.is_file()}
    assert not made, f"{case['command']} left {sorted(map(str, made))}"
    places = [(str(folder), "<here>"), (str(folder.parent), "<there>"), (os.environ[VARIABLE], "<state>")]
    printed = normalised(result.stdout + result.stderr, places)
    return f"{printed}exit {result.exit_code}\n"


@pytest.mark.parametrize("where", ["good", "small", "shipped", "empty"])
def test_bad_input_gets_the_same_error(
    where: str, folders: dict[str, Path], golden: Golden, monkeypatch: pytest.MonkeyPatch
) -> None:
    sections = []
    for case in cases():
        if case["in"] == where:
            sections.append(f"=== {case['name']}\n$ decant {' '.join(case['command'])}\n")
            sections.append(answered(case, folders[where], monkeypatch) + "\n")
    golden.check(f"bad_input/errors-{where}.txt", "".join(sections))
