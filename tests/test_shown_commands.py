"""Every command that README and the pages show is executed here, or is marked with what it needs."""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from orchestrator.cli import console as speaking
from orchestrator.cli.app import app
from tests.shown_commands import PAGES, REASONS, ROOT, TESTED, Block, arguments_of, blocks_of, write_scratch

QUICKSTART = ROOT / "configs" / "campaigns" / "quickstart.yaml"

BLOCKS = [block for page in PAGES for block in blocks_of(page)]

QUICK = frozenset({"validate", "schema", "plugins", "init", "runs"})
"""Verbs that simulate nothing: run with every test, in this process. The others take seconds to a minute each."""

HOW = """
Every command of README.md and docs/ is executed by tests/test_shown_commands.py, as it stands, in a folder with small
forms of the shipped campaigns (tests/shown_commands.py). One that can't be has to say why, above its block:

    <!-- needs: REASON -->                      or <!-- needs: REASON, see tests/…/test_….py -->

REASON is one of:
""" + "\n".join(f"    {reason:10}{meaning}" for reason, meaning in REASONS.items())


def shown() -> dict[str, str]:
    """Commands that are to be executed, each once, and where they stand first."""
    places: dict[str, str] = {}
    for block in BLOCKS:
        for command in block.commands if not block.needs else ():
            if command.startswith("decant "):
                places.setdefault(shlex.join(shlex.split(command, comments=True)), block.place)
    return places


def is_quick(command: str) -> bool:
    words = command.split()
    return words[1] in QUICK or ("--dry-run" in words and words[1] == "study")


COMMANDS = [pytest.param(command, id=f"{place} {command}") for command, place in shown().items() if is_quick(command)]
LONG = [pytest.param(command, id=f"{place} {command}") for command, place in shown().items() if not is_quick(command)]


@pytest.fixture(scope="module")
def scratch(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, str]:
    folder = tmp_path_factory.mktemp("shown")
    return folder, write_scratch(folder)


@pytest.mark.parametrize("block", BLOCKS, ids=[block.place for block in BLOCKS])
def test_a_block_is_executed_or_says_what_it_needs(block: Block) -> None:
    if not block.needs:
        others = [command for command in block.commands if not command.startswith("decant ")]
        assert not others, f"{block.place}: not a command of Decant's, so that nothing executes it: {others}\n{HOW}"
        return
    reasons = block.needs.split(" and ")
    assert set(reasons) <= set(REASONS), f"{block.place}: '{block.needs}' is not a known need\n{HOW}"
    assert block.test or not TESTED & set(reasons), f"{block.place}: name the test that runs it instead\n{HOW}"
    assert not block.test or (ROOT / block.test).is_file(), f"{block.place}: {block.test} is not there\n{HOW}"


def test_the_campaign_that_is_told_is_the_shipped_one() -> None:
    told = (ROOT / "docs" / "tutorials" / "first-pour.md").read_text(encoding="utf-8")
    shipped = [line.partition(" #")[0].rstrip() for line in QUICKSTART.read_text(encoding="utf-8").splitlines()]
    lines = [line for block in re.findall(r"```yaml\n(.*?)```", told, re.DOTALL) for line in block.splitlines()]
    assert len(lines) > 12
    assert [line for line in lines if line not in shipped] == []


def test_the_downloads_are_reports_that_need_nothing_beside_them() -> None:
    pages = [path.read_text(encoding="utf-8") for path in sorted((ROOT / "docs" / "reports").glob("*.html"))]
    assert len(pages) == 2
    for page in pages:
        assert not re.search(r'(?:src|href)="(?!data:)', page)
        assert "VIRTUAL" in page
        assert not re.search(r"/(?:home|root|work)/|/tmp/(?!decant-)", page), "a folder of one machine"


def test_pages_show_commands_of_both_kinds() -> None:
    assert len(COMMANDS) >= 5
    assert len(LONG) >= 8


@pytest.mark.parametrize("command", COMMANDS)
def test_a_quick_command_does_what_the_page_says(
    command: str, scratch: tuple[Path, str], monkeypatch: pytest.MonkeyPatch
) -> None:
    folder, run = scratch
    monkeypatch.chdir(folder)
    monkeypatch.setattr(speaking, "_quiet", False)
    done = CliRunner().invoke(app, arguments_of(command, run), env={"COLUMNS": "120"})
    assert done.exit_code == 0, f"{command}\n{done.output}\n{HOW}"


@pytest.mark.realtime  # some move an emulated arm in real time, which stops on a starved machine, as it should
@pytest.mark.slow
@pytest.mark.parametrize("command", LONG)
def test_a_long_command_does_what_the_page_says(command: str, scratch: tuple[Path, str]) -> None:
    folder, run = scratch
    done = decant(arguments_of(command, run), folder)
    assert done.returncode == 0, f"{command}\n{done.stderr[-3000:]}\n{HOW}"


def decant(arguments: list[str], folder: Path) -> Any:
    """The program, as from a terminal that nobody types in."""
    program = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    return subprocess.run(
        program, cwd=folder, env=environment, stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=800
    )
