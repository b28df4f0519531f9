"""What all tests need."""

from __future__ import annotations

import atexit
import functools
import gc
import importlib.util
import os
import re
import shutil
import signal
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
import typer.testing

from orchestrator.records.run_registry import VARIABLE
from tests.support.hypothesis_examples import load_profile

load_profile()

os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")  # for children, as `orchestrator.cli` has it

# Typer builds the whole tree of commands anew for each invocation, which takes longer than most commands do.
typer.testing._get_command = functools.cache(typer.testing._get_command)

# A shell that starts something in the background has it ignore Ctrl-C, and its children with it: those that are
# interrupted here would go on.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# Tests' runs don't belong into the catalogue of the person who runs them. Workers of xdist inherit the place.
if "PYTEST_XDIST_WORKER" not in os.environ:
    os.environ[VARIABLE] = tempfile.mkdtemp(prefix="decant-state-")
    atexit.register(shutil.rmtree, os.environ[VARIABLE], ignore_errors=True)


MANY = (Path(__file__).parent / "actors", Path(__file__).parent / "orchestrator")
"""Folders of many short files. They come last, so that no long one is alone at the end of a run on several workers.

Their files alternate: many tests of the first wait for devices, and those of the second compute meanwhile.
"""

REALTIME = (Path(__file__).parent / "end_to_end", Path(__file__).parent / "reliability")
"""Folders whose tests watch other processes: each is `realtime`."""


@pytest.fixture(autouse=True)
def not_quiet() -> None:
    """A command with `--quiet` in this process makes later ones quiet that a test calls without their options."""
    if (console := sys.modules.get("orchestrator.cli.console")) is not None:
        console.set_quiet(False)


PART = "DECANT_TESTS_PART"
"""Variable '2/4': of the files with tests that were chosen, each fourth one, from the second on."""


SLOW_FILE = re.compile(r"^pytestmark = .*\bmark\.slow\b", re.MULTILINE)


def pytest_ignore_collect(collection_path: Path, config: pytest.Config) -> bool | None:
    """A file of nothing but slow tests is not imported where none of them is wanted: some import much."""
    if "not slow" not in config.option.markexpr or collection_path.suffix != ".py":
        return None
    return True if SLOW_FILE.search(collection_path.read_text(encoding="utf-8")) else None


@pytest.hookimpl(wrapper=True)
def pytest_collection() -> Iterator[None]:
    """Collecting makes objects that stay: a search for garbage among them takes long and finds none, then and later."""
    gc.disable()
    try:
        return (yield)
    finally:
        gc.freeze()
        gc.enable()


@pytest.hookimpl(trylast=True)  # after those that were not chosen have gone
def pytest_collection_modifyitems(config: pytest.Config, items: list[pytest.Item]) -> None:
    """Sort and mark the tests, and leave out those of other parts. No test is tried again."""
    if twice := [name for name, count in Counter(item.nodeid for item in items).items() if count > 1]:
        raise pytest.UsageError(f"several tests have the name {twice[0]}, of which pytest-xdist would run one")
    rank: dict[Path, float] = {}
    for folder in MANY:
        files = list(dict.fromkeys(item.path for item in items if item.path.is_relative_to(folder)))
        rank |= {path: (index + 1) / len(files) for index, path in enumerate(files)}
    items.sort(key=lambda item: rank.get(item.path, 0.0))
    for item in items:
        if item.get_closest_marker("ur_rtde") is not None and importlib.util.find_spec("rtde_receive") is None:
            item.add_marker(pytest.mark.skip(reason="ur-rtde, of which Python 3.13 has no wheel, is not installed"))
        if any(item.path.is_relative_to(folder) for folder in REALTIME):
            item.add_marker("realtime")
    if part := os.environ.get(PART):
        number, parts = (int(word) for word in part.split("/"))
        files = sorted({item.path for item in items})[number - 1 :: parts]
        left_out = [item for item in items if item.path not in files]
        items[:] = [item for item in items if item.path in files]
        config.hook.pytest_deselected(items=left_out)
