"""Runs of the toy campaign that die where a test wants them to."""

from __future__ import annotations

import asyncio
import os
import signal
from collections import Counter
from pathlib import Path
from typing import Any

from orchestrator.records.journal import JOURNAL_NAME, Journal, JournalReader, Kind
from tests.support.toy_campaign import ToyLaboratory, run_toy, toy_plan, toy_stages

SMALL = toy_stages(simulations=3, pours=2, beside=2)


def run(directory: Path, laboratory: ToyLaboratory | None = None, **arguments: Any) -> Any:
    arguments.setdefault("stages", SMALL)
    arguments.setdefault("plan", toy_plan(directory, on_unknown="repeat"))
    return asyncio.run(run_toy(directory, laboratory, **arguments))


def killed_at(point: int, *, after_commit: bool, directory: Path, resume: bool = False) -> bool:
    """Run in a child process that SIGKILLs itself at its `point`-th write; True if it got that far.

    The child is forked, because starting a hundred interpreters would take minutes.
    """
    child = os.fork()
    if child == 0:
        try:
            die_at(point, after_commit)
            run(directory, resume=resume)
            os._exit(0)
        except BaseException:
            import traceback

            traceback.print_exc()
            os._exit(1)
    _, status = os.waitpid(child, 0)
    assert os.WIFSIGNALED(status) or os.WEXITSTATUS(status) == 0, "the child failed in another way than planned"
    return os.WIFSIGNALED(status)


def die_at(point: int, after_commit: bool) -> None:
    write, count = Journal._write, 0

    def dying(self: Journal, events: Any) -> None:
        nonlocal count
        count += 1
        if count == point and not after_commit:
            os.kill(os.getpid(), signal.SIGKILL)
        write(self, events)
        if count == point:
            os.kill(os.getpid(), signal.SIGKILL)

    Journal._write = dying  # type: ignore[method-assign]


def killed_when_last(kind: Kind, parent: Path, earliest: int = 10) -> Path:
    """Directory of a run that died right after an entry of that kind was written."""
    for point in range(earliest, 100):
        directory = parent / f"point-{point}"
        assert killed_at(point, after_commit=True, directory=directory)
        with JournalReader(directory / JOURNAL_NAME) as journal:
            *_, last = journal.entries()
        simulated = kind is not Kind.FINISHED or last.body.get("outcome", {}).get("type") == "Simulated"
        if last.kind == kind and simulated:
            return directory
    raise AssertionError(f"no run ended in {kind}")


def finished_times(directory: Path) -> Counter[int]:
    with JournalReader(directory / JOURNAL_NAME) as journal:
        kinds = [Kind.FINISHED, Kind.POUR_FINISHED]
        return Counter(entry.body["id"] for entry in journal.entries(kinds=kinds))
