"""Sequences of two to four random faults: the program is struck again while it continues after the last one.

python -m tests.reliability.fault_sequences --count 1000 --jobs 2        # simulated bench; about a quarter of an hour
python -m tests.reliability.fault_sequences --count 50 --bench protocols # arm and balance over their protocols
python -m tests.reliability.fault_sequences --count 50 --bench daemon    # two clients at once
python -m tests.reliability.fault_sequences --seed 417                   # one sequence; if it fails, its shortest form
python -m tests.reliability.fault_sequences --write                      # the table of docs/evidence/reliability.md

A sequence follows from its seed. A fault comes at the n-th write of the journal since the fault before it, or since the
program was started again, or while a person is asked about a pour that began. The first writes of a later life are
those of its restart. The account of right and wrong is that of the kill matrix; a person may be asked again about a
pour if the program was killed before the answer. A failing sequence is shortened: faults are left out and moved to
earlier writes as long as it still fails. Each that was found is a test in `test_fault_sequences.py`.
"""

from __future__ import annotations

import argparse
import contextlib
import json
import os
import random
import subprocess
import sys
import tempfile
import threading
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.api.daemon_client import Client, DaemonError
from orchestrator.daemon.rigs.submissions import pack
from orchestrator.records.journal import Kind
from orchestrator.records.states import State
from tests.reliability import strikes
from tests.reliability.afterwards import state, unknown_pours
from tests.reliability.case import AHEAD, BACK, CUT, FULL, KILLED, KILLED_AFTER, STOPPED
from tests.reliability.page import BEGIN, END, PAGE, ROOT, commit
from tests.reliability.program import ProgramRig
from tests.reliability.rig import NOTHING_STRUCK, POUR_ASKED_ABOUT, Life, Moments, Rig, cpu
from tests.reliability.served import SUBMITTED, DaemonRig, ServedLife
from tests.reliability.wired import BalanceRig, ControllerRig, WiredRig, WorkerRig

RESULTS = ROOT / "build" / "fault-sequences.jsonl"

PROGRAM = "program"

RESTART, LATER = 8, 60
"""Half of the later faults come within so many writes, during a restart if there is one; the others within so many."""

LIVES = 6
"""Lives after the last fault in which the campaign must finish."""

DEVICES: dict[str, type[WiredRig]] = {"worker": WorkerRig, "controller": ControllerRig, "balance": BalanceRig}


@dataclass(frozen=True)
class Fault:
    """One fault of a sequence.

    Attributes:
        target: the struck process: 'program', 'worker', 'controller' or 'balance'.
        fault: as in `case.FAULTS`.
        write: number of the write of the journal since the last fault, or in this life, from 1; 0: while a person is
            asked about a pour.
    """

    target: str
    fault: str
    write: int


def sequence(seed: int, writes: int, pours: Sequence[int], *, protocols: bool) -> tuple[Fault, ...]:
    """Draw the faults of a seed.

    Args:
        seed: of the sequence.
        writes: number of writes of an undisturbed life.
        pours: numbers of the writes that begin a pour.
        protocols: whether devices are struck, too.
    """
    rng = random.Random(seed)
    faults: list[Fault] = []
    for number in range(rng.randint(2, 4)):
        if number == 1 and faults[0] in [Fault(PROGRAM, KILLED_AFTER, write) for write in pours] and rng.random() < 0.5:
            faults.append(Fault(PROGRAM, rng.choice((KILLED, STOPPED)), 0))
        elif number == 0 and rng.random() < 0.4:
            faults.append(Fault(PROGRAM, KILLED_AFTER, rng.choice(pours)))
        else:
            last = writes if number == 0 else RESTART if rng.random() < 0.5 else LATER
            write = rng.randint(1, last)
            target = rng.choice((PROGRAM, *DEVICES)) if protocols else PROGRAM
            known = (KILLED, STOPPED, CUT) if target != PROGRAM else (KILLED, KILLED_AFTER, STOPPED, FULL, AHEAD, BACK)
            faults.append(Fault(target, rng.choice([f for f in known if not (protocols and f == FULL)]), write))
    return tuple(faults)


@dataclass
class StruckLife(Life):
    """A life that meets the remaining faults of a sequence, until one of them ends it."""

    faults: tuple[Fault, ...] = ()

    @property
    def next(self) -> Fault | None:
        """The next fault; None after the last one."""
        met = len(self.noted("met"))
        return self.faults[met] if met < len(self.faults) else None


class SequenceMoments(Moments):
    """Counts the writes since the last fault; the rig strikes at the one that the next fault names."""

    def __init__(self, life: Life, rig: SequenceRig) -> None:
        super().__init__(life, lambda after: None, rig.pids)
        self._life, self._rig, self._writes = life, rig, 0
        self._strike = self._after

    def comes(self, label: str) -> bool:
        """See `Moments.comes`."""
        if not isinstance(self._life, StruckLife):
            return super().comes(label)
        self._writes += 1
        fault = self._life.next
        hit = fault is not None and fault.write == self._writes
        if hit:
            self._writes = 0
            self._rig.meet(self._life, after=False)
        return hit and fault is not None and fault.fault == KILLED_AFTER

    def _after(self, after: bool) -> None:
        if after and isinstance(self._life, StruckLife):
            self._rig.meet(self._life, after=True)


class SequenceRig(Rig):
    """Plays sequences; mixed into a rig that has the laboratory."""

    _living: Life | None = None

    def moments(self, life: Life) -> Moments:
        self._living = life
        return SequenceMoments(life, self)

    def meet(self, life: StruckLife, *, after: bool) -> None:
        """In the program's process: make the next fault happen."""
        fault = life.next
        assert fault is not None
        if after != (fault.fault == KILLED_AFTER):
            return
        life.note("met", f"{fault.target} {fault.fault}")
        life.note("struck", fault.fault)
        if fault.target == PROGRAM:
            if fault.fault == FULL:
                strikes.fill(self.full(life))
            elif fault.fault in (AHEAD, BACK):
                strikes.shift_clock(strikes.DAY if fault.fault == AHEAD else -strikes.HOUR)
            elif fault.fault == STOPPED:
                strikes.stop([os.getpid()])
            else:
                strikes.kill([os.getpid()])
            return
        missed = len(life.noted("missed"))
        DEVICES[fault.target].strike(self._of(fault.target), fault.fault, life)
        if len(life.noted("missed")) > missed:
            life.note("not struck", f"{fault.target} {fault.fault}")

    def _of(self, target: str) -> Any:
        """This rig, which strikes the processes of a device instead of those of the program."""
        self.process = DEVICES[target].process
        return self

    def struck(self, place: Path, faults: tuple[Fault, ...]) -> StruckLife:
        """A life that meets a sequence."""
        return StruckLife(place, faults=faults)

    def answer(self, question: str) -> str:
        life = self._living
        if isinstance(life, StruckLife) and life.next is not None and life.next.write == 0:
            self.meet(life, after=False)
        return super().answer(question)

    def play_sequence(self, faults: Sequence[Fault]) -> dict[str, Any]:
        """Strike, continue until the campaign is finished, and compare with the undisturbed run.

        Returns:
            How the lives ended, the number of questions, the faults that were met, those of them that found no process
            or connection to strike, as between two pours, and `wrong`: what should not be.
        """
        place, begun = self._place(), cpu()
        life = self.struck(place, tuple(faults))
        disk = self.full(life) if any(fault.fault == FULL for fault in faults) else None
        ended: list[str] = []
        unknown: set[tuple[str, int]] = set()
        with self._room(place, disk):
            while len(ended) < len(faults) + LIVES and (not ended or state(life.directory) is not State.FINISHED):
                ended.append(self._live(life))
                unknown |= unknown_pours(life.directory)
                if disk is not None:
                    strikes.tidy(disk)
            wrong = [*self._wrong(life, unknown), *self._left(place)]
            outcome = {
                **{"ended": ended, "asked": len(life.noted("asked")), "met": life.noted("met")},
                **{"not_struck": life.noted("not struck"), "wrong": [text for text in wrong if text != NOTHING_STRUCK]},
            }
        return {**outcome, "cpu_s": round(cpu() - begun, 2)}

    def questions(self, life: Life) -> int:
        """Number of pours that a person was asked about."""
        about = [POUR_ASKED_ABOUT.search(question) for question in life.noted("asked")]
        return len({match.groups() for match in about if match is not None})

    def shortest(self, faults: Sequence[Fault]) -> tuple[Fault, ...]:
        """The shortest sequence that still fails: faults are left out, and moved to earlier writes."""
        failing = tuple(faults)
        tried = True
        while tried:
            tried = False
            shorter = [failing[:k] + failing[k + 1 :] for k in range(len(failing))]
            earlier = [
                (*failing[:k], replace(fault, write=fault.write // 2), *failing[k + 1 :])
                for k, fault in enumerate(failing)
                if fault.write > 1
            ]
            for candidate in (*shorter, *earlier):
                if candidate and self.play_sequence(candidate)["wrong"]:
                    failing, tried = candidate, True
                    break
        return failing


class ProgramSequences(SequenceRig, ProgramRig):
    """Over a simulated bench."""


class WiredSequences(SequenceRig, WiredRig):
    """Over the protocols of arm and balance."""

    tilts = False

    def pids(self) -> list[int]:
        return strikes.descendants(self.process) if self.process else [os.getpid()]


@dataclass
class StruckServedLife(StruckLife, ServedLife):
    """A daemon that meets a sequence."""


class ServedSequences(SequenceRig, DaemonRig):
    """A daemon; two clients submit, answer and resume at the same time, also while it starts again."""

    def struck(self, place: Path, faults: tuple[Fault, ...]) -> StruckLife:
        # the people who answer are not in the daemon's process
        return StruckServedLife(place, faults=tuple(fault for fault in faults if fault.write))

    def answer(self, question: str) -> str:
        return DaemonRig.answer(self, question)

    def _live(self, life: Life) -> str:
        assert isinstance(life, ServedLife)
        ended = threading.Event()
        second = threading.Thread(target=self._second_client, args=(life, ended))
        second.start()
        try:
            return super()._live(life)
        finally:
            ended.set()
            second.join(30.0)

    def _second_client(self, life: ServedLife, ended: threading.Event) -> None:
        text, files = pack(load_campaign(self.folder / "small.yaml"))
        while not ended.wait(0.05):
            if not (life.state / "url").exists():
                continue
            with contextlib.suppress(DaemonError, OSError), Client(state=life.state) as client:
                client.post("/campaigns", {"text": text, "files": files, "id": SUBMITTED})
                for question in client.get("/questions"):
                    life.note("asked", question["text"])
                    client.post(f"/questions/{question['id']}/answer", {"answer": self.answer(question["text"])})
                for item in client.get("/campaigns"):
                    if item["state"] == "paused":
                        client.post(f"/campaigns/{item['id']}/resume")

    def check(self, life: Life) -> Iterator[str]:
        assert isinstance(life, ServedLife)
        if (runs := len(list((life.state / "runs").glob("*")))) != 1:
            yield f"one submission of two clients became {runs} runs"


TITLES = {"simulated": "simulated", "protocols": "over the protocols", "daemon": "simulated, daemon with two clients"}

BENCHES: dict[str, type[SequenceRig]] = {
    "simulated": ProgramSequences,
    "protocols": WiredSequences,
    "daemon": ServedSequences,
}


def faults_of(rig: SequenceRig, seed: int) -> tuple[Fault, ...]:
    """The sequence of a seed for a rig."""
    labels = [label for label, _ in rig.points]
    pours = [number for number, label in enumerate(labels, start=1) if label.endswith(f": {Kind.POUR_STARTED}")]
    return sequence(seed, len(labels), pours, protocols=isinstance(rig, WiredRig))


def work(seeds: Sequence[int], results: Path, bench: str) -> int:
    """Play the sequences of some seeds; each is written down when it has ended. Returns how many failed."""
    failed = 0
    with tempfile.TemporaryDirectory() as folder, results.open("a", encoding="utf-8") as out:
        rig = BENCHES[bench](Path(folder))
        for seed in seeds:
            faults = faults_of(rig, seed)
            row = {"seed": seed, "bench": bench, "faults": [asdict(fault) for fault in faults]}
            row |= rig.play_sequence(faults)
            if row["wrong"]:
                failed += 1
                row["shortest"] = [asdict(fault) for fault in rig.shortest(faults)]
            out.write(json.dumps({**row, "code": commit()}) + "\n")
            out.flush()
            print(seed, *(f"{f.target} {f.fault} {f.write}" for f in faults), *row["wrong"], sep=" | ", flush=True)
        rig.close()
    return failed


def played(results: Path) -> dict[tuple[str, int], dict[str, Any]]:
    """The last outcome of each sequence, by kind and seed."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    return {(row["bench"], row["seed"]): row for row in map(json.loads, lines)}


def table(rows: Sequence[dict[str, Any]]) -> str:
    """How sequences ended, by bench."""
    lines = [
        "| bench | sequences | faults | lives | questions about pours | as undisturbed |",
        "|---|---|---|---|---|---|",
    ]
    for bench, title in TITLES.items():
        of_bench = [row for row in rows if row["bench"] == bench]
        if of_bench:
            met = Counter(text for row in of_bench for text in row["met"])
            met -= Counter(text for row in of_bench for text in row.get("not_struck", ()))
            good = sum(not row["wrong"] for row in of_bench)
            lives, asked = sum(len(row["ended"]) for row in of_bench), sum(row["asked"] for row in of_bench)
            lines.append(
                f"| {title} | {len(of_bench)} | {met.total()} | {lives} | {asked} | {good} of {len(of_bench)} |"
            )
    return "\n".join(lines) + "\n"


def write(results: Path) -> int:
    """Write the table; returns the number of sequences that ended wrongly."""
    rows = list(played(results).values())
    before, marker, after = PAGE.read_text(encoding="utf-8").partition(BEGIN.format("fault sequences"))
    assert marker, f"{PAGE} has no place for the table"
    PAGE.write_text(before + marker + table(rows) + END + after.partition(END)[2], encoding="utf-8")
    for row in rows:
        if row["wrong"]:
            print(row["seed"], row["wrong"], row.get("shortest"))
    return sum(bool(row["wrong"]) for row in rows)


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--count", type=int, default=1000)
    parser.add_argument("--first", type=int, default=0, help="first seed")
    parser.add_argument("--seed", type=int, default=None)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--bench", choices=list(BENCHES), default="simulated")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--share", nargs=2, type=int, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    options.results.parent.mkdir(exist_ok=True)
    if options.write:
        sys.exit(1 if write(options.results) else 0)
    if options.seed is not None:
        sys.exit(1 if work([options.seed], options.results, options.bench) else 0)
    seeds = range(options.first, options.first + options.count)
    done = {seed for bench, seed in played(options.results) if bench == options.bench}
    remaining = [seed for seed in seeds if seed not in done]
    if options.share is not None:
        number, shares = options.share
        sys.exit(1 if work(remaining[number::shares], options.results, options.bench) else 0)
    command = [sys.executable, "-m", "tests.reliability.fault_sequences", "--results", str(options.results)]
    command += ["--first", str(options.first), "--count", str(options.count), "--bench", options.bench]
    running = [
        subprocess.Popen([*command, "--share", str(n), str(options.jobs)], cwd=ROOT, env=child_environment())
        for n in range(options.jobs)
    ]
    sys.exit(max(process.wait() for process in running))


if __name__ == "__main__":
    main()
