"""Golden files are the same in any time zone, terminal, language and home directory."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from orchestrator.records.run_registry import VARIABLE
from sim_engine.resources import cache_directory
from tests.golden.golden import Golden

REGENERATE = "--regenerate"

CACHE = str(cache_directory())


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(REGENERATE, action="store_true", default=False, help="write the golden files anew")


@pytest.fixture
def golden(request: pytest.FixtureRequest) -> Golden:
    # The option is known only where this folder is named on the command line.
    return Golden(bool(request.config.getoption(REGENERATE, default=False)))


@pytest.fixture(autouse=True)
def neutral(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    """An environment of its own for every test."""
    for name in [name for name in os.environ if name.startswith(("DECANT_", "LC_", "TYPER_", "_TYPER", "GITHUB_"))]:
        monkeypatch.delenv(name)
    home = tmp_path / "home"
    home.mkdir()
    values = {
        "TZ": "UTC",
        "LC_ALL": "C.UTF-8",
        "LANG": "C.UTF-8",
        "HOME": str(home),
        VARIABLE: str(tmp_path / "state"),
        "NO_COLOR": "1",
        "TERM": "dumb",
    }
    values |= {"DECANT_CACHE_DIR": CACHE}  # with the home directory's own, a simulator would compile its kernels again
    values |= {"COLUMNS": "120", "LINES": "40", "TERMINAL_WIDTH": "120", "MPLBACKEND": "agg"}
    for name in ("FORCE_COLOR", "PY_COLORS", "XDG_DATA_HOME", "XDG_STATE_HOME", "XDG_CONFIG_HOME", "XDG_CACHE_HOME"):
        monkeypatch.delenv(name, raising=False)
    for name, value in values.items():
        monkeypatch.setenv(name, value)
    # Both are read from the environment when typer is imported.
    monkeypatch.setattr("typer.rich_utils.MAX_WIDTH", 120)
    monkeypatch.setattr("typer.rich_utils.FORCE_TERMINAL", None)
    time.tzset()
    yield
    monkeypatch.undo()
    time.tzset()
