"""What several tests of this floor need."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest

from orchestrator.cli import console
from tests.support.campaign_files import write_good


@pytest.fixture(autouse=True)
def not_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    """A command that runs in this process with --quiet or --json leaves the next test talking."""
    monkeypatch.setattr(console, "_quiet", False)


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The working directory, with what good campaigns refer to."""
    monkeypatch.chdir(tmp_path)
    return write_good(tmp_path)


@pytest.fixture(scope="session")
def results() -> dict[str, Any]:
    """Results of the real strategies, in a world whose spillage is a formula."""
    from tests.support.example_results import played_results

    return played_results()
