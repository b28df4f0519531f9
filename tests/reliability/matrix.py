"""The kill matrix: a campaign is struck at every write of its journal, goes on, and ends as if nothing had happened.

The campaign is a whole one: C4 on weighed pours and D3, with the real strategies, optimiser, scheduler and journal, on
a bench of numbers whose spillage is a formula. Each case runs in a process of its own, which the fault strikes:

- killed: SIGKILL before or after the write;
- stopped: SIGSTOP, and SIGCONT a moment later;
- full disk: a real one, a small file system in memory, filled to the brim (needs root);
- clock: it jumps a day ahead, or an hour back;
- optimiser lost: its process is gone in the middle of a question, as its device reports it.
"""

from __future__ import annotations

import asyncio
import contextlib
import os
import shutil
import signal
import subprocess
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from actors.device import DeviceLostError
from actors.optimizer.actor import Proposer
from orchestrator.campaign import run_campaign
from orchestrator.config.load import load_campaign
from orchestrator.journal import JOURNAL_NAME, Journal, JournalReader, Kind
from orchestrator.plan import CampaignPlan
from orchestrator.states import RESTING, State
from tests.end_to_end.small import CAMPAIGN, write_campaign
from tests.orchestrator.toy import ToyBench, ToyLaboratory, logical_record

FAULTS = ("killed before", "killed after", "stopped", "full disk", "clock a day ahead", "clock an hour back")
"""What strikes at a write of the journal."""

LOST = "optimiser lost"
"""What strikes at a question to the optimiser."""

DISK_MB = 60
PATIENCE = 300.0


@dataclass(frozen=True)
class Case:
    """One fault at one moment.

    Attributes:
        point: the how manieth write of the journal, or question to the optimiser.
    """

    fault: str
    point: int


@dataclass(frozen=True)
class Outcome:
    """How a case ended.

    Attributes:
        at: what was being written: stage and kind of the entry.
        said: how the struck process ended, in words.
        asked: questions to the operator.
        wrong: what should not be: empty.
    """

    case: Case
    at: str
    said: str
    asked: int
    wrong: tuple[str, ...]


class LoggingBench(ToyBench):
    """Writes down every pour that it makes, whoever dies afterwards."""

    log: Path

    async def pour(self, *arguments: Any, **named: Any) -> Any:
        measured = await super().pour(*arguments, **named)
        with self.log.open("a", encoding="utf-8") as file:
            file.write(f"{named['seed']}\n")
        return measured


class Optimizer:
    """The optimiser itself; at one question its process is lost."""

    def __init__(self, lost_at: int = 0) -> None:
        self.lost_at, self.asked = lost_at, 0

    async def suggest(self, problem: Any) -> Any:
        self.asked += 1
        if self.asked == self.lost_at:
            raise DeviceLostError("optimiser: its process died")
        return Proposer().suggest(problem)


class Matrix:
    """Cases of one campaign."""

    def __init__(self, folder: Path) -> None:
        """Run it undisturbed first.

        Args:
            folder: to work in.
        """
        self.folder = folder
        text = CAMPAIGN.replace("on_unknown: repeat", "on_unknown: ask")
        self.plan: CampaignPlan = load_campaign(write_campaign(folder, text))
        self.entries: list[str] = []
        undisturbed = folder / "undisturbed"
        optimizer = Optimizer()
        with counting(self.entries):
            self.run(undisturbed, optimizer=optimizer)
        self.expected = logical_record(undisturbed)
        self.questions = optimizer.asked

    def cases(self) -> list[Case]:
        """All of them: every fault at every write, and a lost optimiser at every question."""
        writes = [Case(fault, point) for point in range(1, len(self.entries) + 1) for fault in FAULTS]
        return writes + [Case(LOST, point) for point in range(1, self.questions + 1)]

    def run(
        self,
        directory: Path,
        *,
        resume: bool = False,
        optimizer: Optimizer | None = None,
        asked: list[str] | None = None,
    ) -> None:
        """Run the campaign or go on with it; a person answers that a pour may be repeated."""
        bench = LoggingBench()
        bench.log = directory.parent / f"{directory.name}.poured"
        laboratory: Any = ToyLaboratory(bench=bench, optimizer=optimizer or Optimizer())  # type: ignore[arg-type]

        def answer(question: str, options: Sequence[str]) -> str:
            if asked is not None:
                asked.append(question)
            return "repeat"

        plan = replace(self.plan, outputs=replace(self.plan.outputs, directory=directory.parent))
        directory.mkdir(parents=True, exist_ok=True)
        asyncio.run(run_campaign(plan, laboratory, directory, resume=resume, ask_operator=answer))

    def play(self, case: Case) -> Outcome:
        """Strike, go on, compare."""
        place = self.folder / f"{case.fault.replace(' ', '-')}-{case.point}"
        with disk(place) if case.fault == "full disk" else made(place):
            directory, asked = place / "run", list[str]()
            said = self._struck(case, directory)
            (place / "filler").unlink(missing_ok=True)
            if self._state(directory) is not State.FINISHED:
                there = (directory / JOURNAL_NAME).is_file() and bool(self._kinds(directory))
                if not there:  # it died before there was a journal: nothing had begun
                    shutil.rmtree(directory, ignore_errors=True)
                self.run(directory, resume=there, asked=asked)
            wrong = tuple(self._wrong(directory, asked))
        at = f"question {case.point}" if case.fault == LOST else self.entries[case.point - 1]
        return Outcome(case, at, said, len(asked), wrong)

    def _struck(self, case: Case, directory: Path) -> str:
        """Run in a child that the fault strikes; how it ended."""
        child = os.fork()
        if child == 0:
            code = 1
            with contextlib.suppress(BaseException):
                os.dup2(os.open(os.devnull, os.O_WRONLY), 2)
                if case.fault != LOST:
                    strike_at(case, directory.parent)
                self.run(directory, optimizer=Optimizer(case.point if case.fault == LOST else 0))
                code = 0
            os._exit(code)
        status = wait(child)
        if os.WIFSIGNALED(status):
            return f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
        return "went on" if os.WEXITSTATUS(status) == 0 else f"came to rest: {self._state(directory)}"

    @staticmethod
    def _state(directory: Path) -> State | None:
        if not (directory / JOURNAL_NAME).is_file():
            return None
        with contextlib.suppress(Exception), JournalReader(directory / JOURNAL_NAME) as journal:
            return journal.state()
        return None

    @staticmethod
    def _kinds(directory: Path) -> list[str]:
        with contextlib.suppress(Exception), JournalReader(directory / JOURNAL_NAME) as journal:
            return [entry.kind for entry in journal.entries()] or [str(journal.header.name)]
        return []

    def _wrong(self, directory: Path, asked: list[str]) -> Iterator[str]:
        if self._state(directory) not in RESTING:
            yield "the run is not at rest"
        if logical_record(directory) != self.expected:
            yield "other requests, decisions or results than undisturbed"
        with JournalReader(directory / JOURNAL_NAME) as journal:
            entries = list(journal.entries())
        finished = Counter(e.body["id"] for e in entries if e.kind in (Kind.FINISHED, Kind.POUR_FINISHED))
        if set(finished.values()) != {1}:
            yield "something was done again although it was finished"
        poured = Counter((directory.parent / f"{directory.name}.poured").read_text("utf-8").split())
        repeated = sum(count - 1 for count in poured.values())
        if repeated > len(asked):
            yield f"{repeated} pours were made again, and a person was asked about {len(asked)}"
        weighed = sum(e.kind == Kind.POUR_FINISHED for e in entries)
        if len(poured) != weighed:
            yield f"{len(poured)} pours were made, {weighed} weights are in the journal"


@contextlib.contextmanager
def counting(entries: list[str]) -> Iterator[None]:
    """Every write of a journal is noted: stage and kind of its first entry."""
    write = Journal.append_all

    def noting(self: Journal, drafts: Any) -> None:
        entries.append(f"{drafts[0].stage or 'campaign'}: {drafts[0].kind}")
        write(self, drafts)

    Journal.append_all = noting  # type: ignore[method-assign]
    try:
        yield
    finally:
        Journal.append_all = write  # type: ignore[method-assign]


def strike_at(case: Case, place: Path) -> None:
    """In the child: make the fault happen at that write."""
    write, now, count = Journal.append_all, time.time, 0
    strikes: dict[str, Callable[[], Any]] = {
        "killed before": lambda: os.kill(os.getpid(), signal.SIGKILL),
        "stopped": lambda: os.kill(os.getpid(), signal.SIGSTOP),
        "full disk": lambda: fill(place),
        "clock a day ahead": lambda: setattr(time, "time", lambda: now() + 86_400.0),
        "clock an hour back": lambda: setattr(time, "time", lambda: now() - 3_600.0),
    }

    def struck(self: Journal, drafts: Any) -> None:
        nonlocal count
        count += 1
        if count == case.point and case.fault in strikes:
            strikes[case.fault]()
        write(self, drafts)
        if count == case.point and case.fault == "killed after":
            os.kill(os.getpid(), signal.SIGKILL)

    Journal.append_all = struck  # type: ignore[method-assign]


def wait(child: int) -> int:
    """The child's status; where it stopped it goes on a moment later."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WUNTRACED | os.WNOHANG)
        if pid and os.WIFSTOPPED(status):
            time.sleep(0.05)
            os.kill(child, signal.SIGCONT)
        elif pid:
            return status
        time.sleep(0.005)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    raise AssertionError("the struck process hangs")


@contextlib.contextmanager
def made(place: Path) -> Iterator[None]:
    """A folder that is removed again."""
    place.mkdir()
    try:
        yield
    finally:
        shutil.rmtree(place, ignore_errors=True)


@contextlib.contextmanager
def disk(place: Path) -> Iterator[None]:
    """A small disk of its own."""
    place.mkdir()
    subprocess.run(["mount", "-t", "tmpfs", "-o", f"size={DISK_MB}m", "tmpfs", str(place)], check=True)
    try:
        yield
    finally:
        subprocess.run(["umount", "--lazy", str(place)], check=True)
        place.rmdir()


def can_mount(folder: Path) -> bool:
    """Whether a small disk can be had here."""
    with contextlib.suppress(subprocess.CalledProcessError, OSError), disk(folder / "probe"):
        return True
    return False


def fill(place: Path) -> None:
    """Until nothing more goes onto the disk."""
    with (place / "filler").open("ab", buffering=0) as file:
        for size in (1 << 20, 4096, 1):
            with contextlib.suppress(OSError):
                while True:
                    file.write(bytes(size))
