"""A test that is tried again repeats what it judges: fixtures of its module are made again for it."""

from __future__ import annotations

import sys
from pathlib import Path

import pytest

from actors.runtime.child_process import run
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[1]

CONFTEST = "from tests.conftest import pytest_collection_modifyitems, pytest_runtest_setup\n"

TESTS = """
import pytest

seen = []

@pytest.fixture(scope="session")
def once():
    seen.append("session")
    return len(seen)

@pytest.fixture(scope="module")
def controller(once):
    seen.append("start")
    yield seen.count("start")
    seen.append("end")

@pytest.fixture(scope="module")
def outcome(controller):
    return controller

@pytest.mark.realtime
def test_good_at_the_second_try(outcome):
    assert outcome == 2

@pytest.mark.realtime
def test_after_it(outcome):
    assert outcome == 2
    assert seen == ["session", "start", "end", "start"]
"""


@pytest.mark.slow
def test_a_rerun_renews_the_fixtures_of_its_module(tmp_path: Path) -> None:
    (tmp_path / "conftest.py").write_text(CONFTEST, encoding="utf-8")
    (tmp_path / "test_inner.py").write_text(TESTS, encoding="utf-8")
    (tmp_path / "pytest.ini").write_text("[pytest]\nmarkers = realtime\n", encoding="utf-8")
    command = [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "-p", "no:schemathesis", str(tmp_path)]
    done = run(command, timeout=PATIENCE, environment={"PYTHONPATH": str(ROOT), "DECANT_TESTS_PART": ""})
    assert "2 passed, 1 rerun" in done.stdout, done.stdout
