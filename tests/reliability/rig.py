"""A campaign that is struck, goes on as often as it has to, and is compared with an undisturbed one.

Each life of the program is a process of its own, forked from one that has imported everything, since starting
interpreters would take hours. The undisturbed run says which writes its journal has.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import re
import shutil
import signal
import tempfile
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any, NoReturn

import psutil

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.records.events import Event, PourProgressed, Subscriber
from orchestrator.records.journal import Journal, Kind
from orchestrator.records.states import State
from orchestrator.runs.run_engine import run_campaign
from tests.reliability import strikes
from tests.reliability.afterwards import entries, first_difference, kinds, record, state, unknown_pours, weights
from tests.reliability.case import (
    AHEAD,
    BACK,
    CUT,
    FULL,
    KILLED,
    KILLED_AFTER,
    STOPPED,
    Case,
    Outcome,
    Point,
    points_of,
)
from tests.reliability.formula import LOG
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.toy_campaign import ToyLaboratory

PATIENCE = 240.0
"""Longest that one life may take [s]: Ray alone may wait for a simulator for two minutes."""

LIVES = 4
"""A program that isn't done after so many of them never will be."""

LEAVING = 20.0
"""Within so long nothing is left of a program that was killed [s]."""

NOTHING_STRUCK = "there was nothing to be struck"

POUR_ASKED_ABOUT = re.compile(r"pour (\d+) of stage (\S+)")


@dataclass
class Life:
    """What one life of the program has to work with.

    Attributes:
        place: folder of the case.
        case: the fault that it is to meet; None for none.
    """

    place: Path
    case: Case | None = None

    @property
    def directory(self) -> Path:
        """Of the run."""
        return self.place / "run"

    def note(self, what: str, text: str) -> None:
        """Written down, whoever dies afterwards."""
        with (self.place / what).open("a", encoding="utf-8") as file:
            file.write(json.dumps(text) + "\n")

    def noted(self, what: str) -> list[str]:
        """All of that."""
        path = self.place / what
        return [json.loads(line) for line in path.read_text("utf-8").splitlines()] if path.exists() else []


class Rig:
    """Plays cases of one target. Subclasses say what laboratory and what watchers there are, and how it is struck.

    Args:
        folder: to work in.
    """

    target = "program"
    tilts = False
    """Whether the middle of its pours is a moment too."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.plan: CampaignPlan = load_campaign(self.write_campaign(folder))
        self.weights: dict[str, str] = {}
        warm_up(self.plan)
        place = self._place()
        life = self.life(place)
        with self._room(place):
            said = self._live(life)
            assert said == "went on", (said, life.noted("told"))
            self.points: list[Point] = points_of(life.noted("writes"))
            self.up = [point for point, up in zip(self.points, life.noted("up"), strict=True) if up == "yes"]
            self.expected = record(life.directory)
            self.weights = weights(life.directory)

    # ---- what subclasses say

    def write_campaign(self, folder: Path) -> Path:
        """The campaign that is run."""
        return write_campaign(folder, CAMPAIGN.replace("on_unknown: repeat", "on_unknown: ask"))

    def cases(self) -> list[Case]:
        """All that there are."""
        raise NotImplementedError

    @contextlib.asynccontextmanager
    async def laboratory(self, life: Life) -> AsyncIterator[Any]:
        """As `run_campaign` takes it."""
        raise NotImplementedError
        yield

    @contextlib.contextmanager
    def subscribers(self, life: Life, plan: CampaignPlan) -> Iterator[list[Subscriber]]:
        """Who watches."""
        yield []

    def life(self, place: Path, case: Case | None = None) -> Life:
        """Of a case, or undisturbed."""
        return Life(place, case)

    def pids(self) -> list[int]:
        """In the program's process: of what is struck."""
        return [os.getpid()]

    def full(self, life: Life) -> Path:
        """Where the disk is, that is filled up."""
        return life.place / "disk"

    def questions(self, life: Life) -> int:
        """Number of questions about pours that had begun."""
        return len(life.noted("asked"))

    def check(self, life: Life) -> Iterator[str]:
        """What else should not be."""
        yield from ()

    def close(self) -> None:
        """Nothing is left of it."""

    # ---- a case

    def play(self, case: Case) -> Outcome:
        """Strike, go on, compare."""
        place, begun = self._place(), cpu()
        life = self.life(place, case)
        disk = self.full(life) if case.fault == FULL else None
        with self._room(place, disk):
            ended = self._live(life)
            told, unknown = (life.noted("told") or [""])[-1], unknown_pours(life.directory)
            lives = 1
            if disk is not None:
                strikes.tidy(disk)
            while state(life.directory) is not State.FINISHED and lives < LIVES:
                lives += 1
                self._live(replace(life, case=None))
                unknown |= unknown_pours(life.directory)
            wrong = (*self._wrong(life, unknown), *self._left(place))
            asked, heard = len(life.noted("asked")), tuple(life.noted("heard"))
        return Outcome(case, ended, told, lives, asked, heard, wrong, round(cpu() - begun, 2))

    def _place(self) -> Path:
        return Path(tempfile.mkdtemp(prefix="k", dir="/tmp"))  # short, since Ray puts sockets below it

    @contextlib.contextmanager
    def _room(self, place: Path, disk: Path | None = None) -> Iterator[None]:
        try:
            with contextlib.nullcontext() if disk is None else strikes.disk(disk):
                (place / "tmp").mkdir(exist_ok=True)
                if disk is not None and disk == place / "disk" and self.target == "program":
                    (disk / "run").mkdir()
                    (place / "run").symlink_to(disk / "run")
                yield
        finally:
            shutil.rmtree(place, ignore_errors=True)

    def _live(self, life: Life) -> str:
        """One life, in a process of its own; how it ended."""
        there = bool(kinds(life.directory))
        if not there:  # it died before there was a journal: nothing had begun
            for path in life.directory.glob("*"):
                path.unlink()
        child = os.fork()
        if child == 0:
            self._in_child(life, resume=there)
        if (status := wait(child)) is None:
            life.note("hung", f"a life of the program did not end within {PATIENCE:g} s")
            return "hung"
        if os.WIFSIGNALED(status):
            return f"ended by {signal.Signals(os.WTERMSIG(status)).name}"
        return "went on" if os.WEXITSTATUS(status) == 0 else f"came to rest: {state(life.directory)}"

    def _in_child(self, life: Life, *, resume: bool) -> NoReturn:
        """The program's process, from its beginning to its end."""
        code = 1
        try:
            os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
            os.dup2(os.open(life.place / "errors", os.O_WRONLY | os.O_CREAT | os.O_APPEND), 2)
            os.environ |= {"TMPDIR": str(life.place / "tmp"), LOG: str(life.place / "poured")}
            tempfile.tempdir = None
            self.run(life, resume=resume)
            code = 0
        except Exception as error:
            with contextlib.suppress(OSError):
                life.note("told", f"{type(error).__name__}: {error}")
        finally:
            os._exit(code)

    def run(self, life: Life, *, resume: bool) -> None:
        """In the program's process: run the campaign, or go on with it."""
        asyncio.run(self.campaign(life, resume=resume))

    async def campaign(self, life: Life, *, resume: bool) -> None:
        """The same, awaited."""
        plan = replace(self.plan, outputs=self.plan.outputs.model_copy(update={"directory": str(life.place)}))
        life.directory.mkdir(parents=True, exist_ok=True)

        def answer(question: str, options: Sequence[str], facts: Any) -> str:
            life.note("asked", question)
            return self.answer(question)

        moments = self.moments(life)
        async with self.laboratory(life) as laboratory:
            with self.subscribers(life, plan) as subscribers, moments.noted():
                everybody = [*subscribers, self._tilting(moments)]
                await run_campaign(
                    plan, laboratory, life.directory, resume=resume, ask_operator=answer, subscribers=everybody
                )

    def moments(self, life: Life) -> Moments:
        """What happens in a life, which is struck at."""
        return Moments(life, self._strike(life), self.pids)

    def _tilting(self, moments: Moments) -> Subscriber:
        """The middle of a pour is a moment like a write."""

        def watch(event: Event) -> None:
            if self.tilts and isinstance(event, PourProgressed) and event.progress.checkpoint == "tilt":
                moments.tilting(f"{event.stage}: tilting", event.number)

        return watch

    def answer(self, question: str) -> str:
        """The operator has weighed what the undisturbed pour weighed."""
        found = POUR_ASKED_ABOUT.search(question)
        assert found is not None, question
        return self.weights[f"{found[2]} {found[1]}"]

    def _strike(self, life: Life) -> Callable[[bool], None]:
        case = life.case

        def strike(after: bool) -> None:
            assert case is not None
            if after != (case.fault == KILLED_AFTER):
                return
            life.note("struck", case.fault)
            self.strike(case.fault, life)

        return strike

    def strike(self, fault: str, life: Life) -> None:
        """In the program's process: make it happen."""
        if fault == FULL:
            strikes.fill(self.full(life))
            return
        if fault in (AHEAD, BACK):
            strikes.shift_clock(strikes.DAY if fault == AHEAD else -strikes.HOUR)
            return
        pids = self.pids()
        if not pids:
            life.note("missed", fault)
        match fault:
            case _ if fault in (KILLED, KILLED_AFTER):
                strikes.kill(pids)
            case _ if fault == STOPPED and pids == [os.getpid()]:
                os.kill(os.getpid(), signal.SIGSTOP)
            case _ if fault == STOPPED:
                strikes.stop(pids)
            case _ if fault == CUT and not strikes.cut(pids):
                life.note("missed", fault)

    # ---- what should not be

    def _wrong(self, life: Life, unknown: set[tuple[str, int]]) -> Iterator[str]:
        if life.case is not None and not life.noted("struck"):
            yield "it was never struck"
        yield from life.noted("hung")
        if life.noted("missed"):
            yield NOTHING_STRUCK
        if (found := state(life.directory)) is not State.FINISHED:
            yield f"the campaign is not finished but {found}: {life.noted('told')[-1:]}"
            return
        if (difference := first_difference(record(life.directory), self.expected)) is not None:
            yield f"other requests, decisions or results than undisturbed: {difference}"
        finished = Counter(
            e.body["id"] for e in entries(life.directory) if e.kind in (Kind.FINISHED, Kind.POUR_FINISHED)
        )
        if set(finished.values()) != {1}:
            yield "something was done again although it was finished"
        poured = Counter((life.place / "poured").read_text("utf-8").split())
        if again := [seed for seed, count in poured.items() if count > 1]:
            yield f"{len(again)} pour(s) were made twice"
        weighed = set(weights(life.directory))
        if weighed != set(self.weights) or len(poured) > len(weighed):
            yield f"{len(poured)} pours were made, {len(weighed)} weights are in the journal"
        if (asked := self.questions(life)) != len(unknown):
            yield f"{len(unknown)} pours had begun and had no outcome, and a person was asked {asked} times"
        yield from self.check(life)

    def _left(self, place: Path) -> list[str]:
        """Processes and folders that are left of it."""
        end = time.monotonic() + LEAVING
        while (left := leftovers(place)) and time.monotonic() < end:
            time.sleep(0.1)
        for process in left:
            with contextlib.suppress(psutil.Error):
                process.kill()
        files = [path for path in (place / "tmp").glob("*/*") if path.name != "lock"]
        return ([f"left running: {[p.pid for p in left]}"] if left else []) + (
            [f"left lying: {[str(f.relative_to(place)) for f in files]}"] if files else []
        )


@cache
def _warm() -> list[bool]:
    return []


def warm_up(plan: CampaignPlan) -> None:
    """Run a campaign on numbers in this process, once: what is forked from it then has imported everything."""
    from tests.reliability.program import Optimizer

    if not _warm():
        _warm().append(True)
        with tempfile.TemporaryDirectory() as folder:
            laboratory: Any = ToyLaboratory(optimizer=Optimizer())  # type: ignore[arg-type]
            asyncio.run(run_campaign(plan, laboratory, Path(folder) / "run", ask_operator=None))


# ---- in the program's process


class Moments:
    """What happens, moment by moment; it is written down, and struck at where it is to be.

    Args:
        strike: makes the fault happen; told whether what happens has happened.
        pids: processes of what is struck.
    """

    def __init__(self, life: Life, strike: Callable[[bool], None], pids: Callable[[], list[int]]) -> None:
        self._life, self._strike, self._pids = life, strike, pids
        self._seen: Counter[str] = Counter()

    def comes(self, label: str) -> bool:
        """It is about to happen; whether it is struck at."""
        life = self._life
        self._seen[label] += 1
        if life.case is None:
            life.note("writes", label)
            life.note("up", "yes" if self._pids() else "no")
            return False
        hit = (label, self._seen[label]) == (life.case.at, life.case.number)
        if hit:
            self._strike(False)
        return hit

    def tilting(self, label: str, number: int) -> None:
        """A pour tilts: the first word of it counts."""
        if self._seen[label] < number:
            self.comes(label)

    @contextlib.contextmanager
    def noted(self) -> Iterator[None]:
        """Every write of a journal is such a moment."""
        write = Journal._write

        def noted(journal: Journal, events: Any) -> None:
            hit = self.comes(label_of(events))
            write(journal, events)
            if hit:
                self._strike(True)

        Journal._write = noted  # type: ignore[method-assign]
        try:
            yield
        finally:
            Journal._write = write  # type: ignore[method-assign]


def label_of(events: Any) -> str:
    """Stage and kind of a write's first entry; a note's first words."""
    first = events[0]
    words = f": {first.text.partition(':')[0]}" if first.kind == Kind.NOTE else ""
    return f"{first.stage or 'campaign'}: {first.kind}{words}"


# ---- from outside


def wait(child: int) -> int | None:
    """The child's status; None if it doesn't end. Where it stopped it goes on a moment later."""
    end = time.monotonic() + PATIENCE
    while time.monotonic() < end:
        pid, status = os.waitpid(child, os.WUNTRACED | os.WNOHANG)
        if pid and os.WIFSTOPPED(status):
            time.sleep(0.05)
            os.kill(child, signal.SIGCONT)
        elif pid:
            return status
        time.sleep(0.01)
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    return None


def leftovers(place: Path) -> list[psutil.Process]:
    """Processes whose environment or command line names a case's folder."""
    found, folder = [], str(place)
    for process in psutil.process_iter():
        with contextlib.suppress(psutil.Error, OSError):
            if process.status() == psutil.STATUS_ZOMBIE or process.pid == os.getpid():
                continue
            if process.environ().get("TMPDIR", "").startswith(folder) or any(folder in w for w in process.cmdline()):
                found.append(process)
    return found


def cpu() -> float:
    """Seconds of a core that this process and everything that it has started have taken."""
    total = sum(os.times()[:4])
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):
            total += sum(process.cpu_times()[:4])
    return total
