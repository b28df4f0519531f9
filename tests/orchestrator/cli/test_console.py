"""`console`: people who wait are told what for: soon at a terminal, now and then in a file, never if they want it
quiet.
"""

from __future__ import annotations

import io
import threading
import time
from functools import partial

import pytest

from orchestrator.cli import console as speaking
from orchestrator.cli import console as waiting
from orchestrator.cli import simulate_command
from orchestrator.cli.console import WaitingIndicator


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def waited(out: io.StringIO, at: list[float]) -> str:
    """What is shown if something is told at these times [s]."""
    now = 0.0
    with WaitingIndicator(out, lambda: now) as doing:
        for now in at:
            doing(f"at {now:g} s")
    return out.getvalue()


def test_a_terminal_shows_one_line_after_two_seconds_and_cleans_up() -> None:
    assert waited(Terminal(), [0.5, 1.9]) == ""
    assert waited(Terminal(), [1.0, 2.5, 3.0]) == "\r\x1b[Kat 2.5 s …\r\x1b[Kat 3 s …\r\x1b[K"


def test_a_file_gets_a_line_now_and_then() -> None:
    assert waited(io.StringIO(), [2.5, 9.0]) == ""
    assert waited(io.StringIO(), [11.0, 12.0, 22.0]) == "at 11 s …\nat 22 s …\n"


def test_nobody_is_told_who_wants_it_quiet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(speaking, "_quiet", True)
    assert waited(Terminal(), [5.0]) == ""


class Slow:
    """A simulator that takes its time, and never comes back in between."""

    def simulate(self, task: object) -> object:
        time.sleep(0.4)  # longer than the console waits before it shows progress
        return task

    def close(self) -> None:
        pass


def test_simulate_says_which_seed_it_is_at_while_it_simulates(
    monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(waiting, "EVERY", 0.1)
    monkeypatch.setattr(simulate_command, "waiting_for", partial(waiting.waiting_for, beat=0.05))
    assert simulate_command._simulated_pour(Slow(), [1, 2]) == [1, 2]  # type: ignore[arg-type, list-item, comparison-overlap]
    lines = capfd.readouterr().err.splitlines()
    assert lines[0].startswith("simulating seed 1 of 2, 0 s so far; the first pour ever also compiles kernels")
    assert lines[-1].startswith("simulating seed 2 of 2, ")
    assert all(t.name != "waiting" for t in threading.enumerate())
