"""What all tests need."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

# A shell that starts something in the background has it ignore Ctrl-C, and its children with it: those that are
# interrupted here would go on.
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

IN_REAL_TIME = (
    "actors/arm_ur/",
    "actors/balance/",
    "actors/bench/",
    "actors/test_arm",
    "actors/test_cluster",
    "actors/test_laboratory",
    "actors/test_ray",
    "actors/test_simulator_pools",
    "actors/test_virtual_bench",
    "actors/virtual_ur/",
    "end_to_end/",
    "orchestrator/commands/test_arming",
    "orchestrator/commands/test_doctor",
    "orchestrator/commands/test_jog",
    "orchestrator/commands/test_pour_command",
    "orchestrator/study/test_study.py",
)
"""Tests with processes that keep deadlines of milliseconds, such as an arm's watchdog."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """A starved machine misses deadlines, and no arm should move on then: what fails in real time is tried thrice.

    Reruns are counted in the last line. A test that needs one on an idle machine has a fault.
    """
    for item in items:
        if item.path.relative_to(Path(__file__).parent).as_posix().startswith(IN_REAL_TIME):
            item.add_marker(pytest.mark.flaky(reruns=2))
