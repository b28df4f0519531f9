"""Runs `decant` as people do, in a process of its own, watches its journal, and kills it at chosen moments."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import psutil

from orchestrator.records.journal import JOURNAL_NAME, Entry, JournalReader, Kind
from orchestrator.records.journal_file import JournalError
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[2]

NOT_LOGICAL = frozenset({"cpu_s", "seconds", "pid"})
"""What differs between two runs that are the same."""

FINISHED = (Kind.FINISHED, Kind.POUR_FINISHED)


class Workplace:
    """A folder with a campaign, and a temporary folder of its own, in which leftovers can be told from others'.

    Args:
        folder: of the campaign.
        environment: that programs get beside this one's.
    """

    def __init__(self, folder: Path, environment: dict[str, str] | None = None) -> None:
        self.folder = folder
        self.environment = environment or {}
        # Short, since Ray puts sockets in it.
        self.temporary = Path(tempfile.mkdtemp(prefix="e", dir="/tmp"))

    def start(self, *arguments: str) -> subprocess.Popen[str]:
        """`decant ARGUMENTS` as from another terminal."""
        return subprocess.Popen(
            [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *arguments],
            cwd=self.folder,
            env={**os.environ, **self.environment, "PYTHONPATH": str(ROOT), "TMPDIR": str(self.temporary)},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            start_new_session=True,
        )

    def succeed(self, *arguments: str) -> str:
        """Run to the end, which must be a good one; returns stdout."""
        process = self.start(*arguments)
        with ended(process):
            output, errors = process.communicate(timeout=PATIENCE)
            assert process.returncode == 0, errors
        return output

    def finish(self, *arguments: str) -> dict[str, Any]:
        """Run to a good end with --json; returns what its last line says."""
        (line,) = self.succeed(*arguments, "--json").splitlines()
        result: dict[str, Any] = json.loads(line)
        return result

    def interrupt(
        self, when: Callable[[list[Entry]], bool], number: int, *arguments: str
    ) -> tuple[subprocess.Popen[str], str]:
        """Send a signal as soon as the journal is in a certain state; returns the ended process and its stderr."""
        process = self.start(*arguments)
        with ended(process):
            self.await_journal(when, process)
            process.send_signal(number)
            process.send_signal(signal.SIGCONT)
            _, errors = process.communicate(timeout=PATIENCE)
        return process, errors

    def await_journal(self, when: Callable[[list[Entry]], bool], process: subprocess.Popen[str]) -> None:
        """Stop the process (SIGSTOP) with its journal in a certain state."""
        end = time.monotonic() + PATIENCE
        while time.monotonic() < end:
            if process.poll() is not None:
                raise AssertionError(f"it ended before the moment that was waited for:\n{process.communicate()[1]}")
            if when(self.entries()):
                # Nothing is written while it stands still: what is found now is what a kill leaves behind.
                process.send_signal(signal.SIGSTOP)
                if when(self.entries()):
                    return
                process.send_signal(signal.SIGCONT)
            time.sleep(0.02)
        raise AssertionError("the moment that was waited for never came")

    def run_directory(self) -> Path:
        """The only run."""
        (directory,) = (self.folder / "runs").iterdir()
        return directory

    def entries(self) -> list[Entry]:
        """The run's journal as far as it goes; empty before there is one."""
        try:
            with JournalReader(self.run_directory() / JOURNAL_NAME) as journal:
                return list(journal.entries())
        except (JournalError, OSError, ValueError):
            return []

    def leftovers(self) -> list[str]:
        """Processes and folders that Ray has left."""
        found = []
        for process in psutil.process_iter():
            with contextlib.suppress(psutil.Error, OSError):
                if process.environ().get("TMPDIR") == str(self.temporary) or any(
                    str(self.temporary) in word for word in process.cmdline()
                ):
                    found.append(f"{process.pid} {process.name()}")
        return found + [str(path) for path in self.temporary.glob("*/*") if path.name != "lock"]

    def assert_nothing_is_left(self) -> None:
        """Within the time that a killed program's warden needs."""
        end = time.monotonic() + 30.0
        while (left := self.leftovers()) and time.monotonic() < end:
            time.sleep(0.2)
        assert not left, f"left behind: {left}"

    def close(self) -> None:
        """Remove the temporary folder, with processes that a failed test has left."""
        for line in self.leftovers():
            with contextlib.suppress(ValueError, OSError):
                os.kill(int(line.split()[0]), signal.SIGKILL)
        shutil.rmtree(self.temporary, ignore_errors=True)


@contextlib.contextmanager
def ended(process: subprocess.Popen[str]) -> Iterator[None]:
    """No process outlives its test."""
    try:
        yield
    finally:
        if process.poll() is None:
            process.kill()
            process.communicate()


def logical(entries: list[Entry]) -> list[tuple[Any, ...]]:
    """What was asked for, decided, told and concluded, in order; times, process ids and attempts aside."""
    outcomes: dict[int, Any] = {}
    record: list[tuple[Any, ...]] = []
    for entry in entries:
        match entry.kind:
            case Kind.FINISHED | Kind.POUR_FINISHED:
                outcomes[entry.body["id"]] = timeless(entry.body["outcome"])
            case Kind.TOLD:
                record.append((entry.stage, entry.kind, entry.body["id"], outcomes[entry.body["id"]]))
            case Kind.STAGE_OPENED | Kind.ASKED | Kind.REQUESTED | Kind.DECISION | Kind.STAGE_CLOSED:
                record.append((entry.stage, entry.kind, timeless(entry.body)))
    return record


def timeless(data: Any) -> Any:
    """Without what differs between two runs that are the same."""
    if isinstance(data, dict):
        return {key: timeless(value) for key, value in data.items() if key not in NOT_LOGICAL}
    return [timeless(value) for value in data] if isinstance(data, list) else data


def started_after_they_were_finished(entries: list[Entry]) -> list[int]:
    """Requests that were done again although their outcome was in the journal."""
    done: set[int] = set()
    again = []
    for entry in entries:
        if entry.kind in FINISHED:
            if entry.body["id"] in done:
                again.append(entry.body["id"])
            done.add(entry.body["id"])
        elif entry.kind in (Kind.STARTED, Kind.POUR_STARTED) and entry.body["id"] in done:
            again.append(entry.body["id"])
    return again


def pour_under_way(entries: list[Entry]) -> bool:
    """Whether a pour has started and has no outcome."""
    finished = {e.body["id"] for e in entries if e.kind == Kind.POUR_FINISHED}
    return any(e.kind == Kind.POUR_STARTED and e.body["id"] not in finished for e in entries)


def finished_in(stage: str, entries: list[Entry]) -> int:
    """Outcomes of a stage, pours and simulations and suggestions."""
    return sum(e.stage == stage and e.kind in FINISHED for e in entries)
