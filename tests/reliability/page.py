"""Runs the kill matrix, and writes docs/evidence/reliability.md's tables and docs/data/kill-matrix.csv.

python -m tests.reliability.page --jobs 2                      # all cases: within an hour on two idle cores
python -m tests.reliability.page --only controller balance     # of these targets alone
python -m tests.reliability.page --write                       # no case: the tables of what was run

Each case's outcome is written into build/kill-matrix.jsonl as soon as it is known; cases that stand there are not run
again, unless they went wrong, until `--fresh` throws them away.
"""

from __future__ import annotations

import argparse
import csv
import importlib
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from actors.runtime.child_process import child_environment
from tests.reliability.case import FAULTS, TARGETS, Case
from tests.reliability.rig import Rig
from tests.reliability.strikes import can_mount

ROOT = Path(__file__).parents[2]
PAGE, LIST = ROOT / "docs" / "evidence" / "reliability.md", ROOT / "docs" / "data" / "kill-matrix.csv"
RESULTS = ROOT / "build" / "kill-matrix.jsonl"
BEGIN, END = "<!-- table: {} -->\n", "<!-- end of table -->"
SEED = 13

RIGS = {
    "ray": "own_ray:RayRig",
    "program": "program:ProgramRig",
    "daemon": "served:DaemonRig",
    "simulator": "pooled:SimulatorRig",
    "optimiser": "pooled:OptimiserRig",
    "worker": "wired:WorkerRig",
    "controller": "wired:ControllerRig",
    "balance": "wired:BalanceRig",
    "recording": "recorded:RecordingRig",
}
"""Where the rig of each target is; the one that waits longest comes first."""


def rig_of(target: str, folder: Path) -> Rig:
    """Ready to play."""
    module, _, name = RIGS[target].partition(":")
    rig: Rig = getattr(importlib.import_module(f"tests.reliability.{module}"), name)(folder)
    return rig


def found(results: Path) -> dict[str, dict[str, Any]]:
    """The last outcome of each case that was run, by name."""
    lines = results.read_text(encoding="utf-8").splitlines() if results.exists() else []
    rows = [json.loads(line) for line in lines]
    return {Case(**row["case"]).name: row for row in rows if "case" in row}


def work(target: str, number: int, shares: int, results: Path, limit: int | None = None) -> None:
    """One process' share of a target's cases, each written down as soon as it has ended."""
    with tempfile.TemporaryDirectory() as folder, results.open("a", encoding="utf-8") as out:
        rig = rig_of(target, Path(folder))
        mounting = can_mount(Path(folder))
        cases = [case for case in rig.cases() if case.fault != "full disk" or mounting]
        random.Random(SEED).shuffle(cases)
        out.write(json.dumps({"target": target, "cases": len(cases), "points": len(rig.points)}) + "\n")
        done = {name for name, row in found(results).items() if not row["wrong"]}
        for case in [case for case in cases[number::shares] if case.name not in done][:limit]:
            outcome = rig.play(case)
            out.write(json.dumps({**asdict(outcome), "t": time.time(), "code": commit()}) + "\n")
            out.flush()
            print(case.name, *outcome.wrong, sep=" | ", flush=True)
        rig.close()


def commit() -> str:
    """Of the program that was tried."""
    floors = ("HEAD:orchestrator", "HEAD:actors", "HEAD:sim_engine")
    command = ["git", "-C", str(ROOT), "rev-parse", *floors]
    said = subprocess.run(command, capture_output=True, text=True, check=False, env=child_environment()).stdout
    return " ".join(word[:10] for word in said.split())


def run(targets: Sequence[str], jobs: int, results: Path, limit: int | None = None) -> bool:
    """All cases of some targets, so many processes at a time; whether all of them came to their end."""
    shares = {"program": jobs}  # of those with many cases; a process of each of the others
    tasks = [(target, n, shares.get(target, 1)) for target in targets for n in range(shares.get(target, 1))]
    running: list[subprocess.Popen[bytes]] = []
    good = True
    while tasks or running:
        while tasks and len(running) < jobs:
            target, number, of = tasks.pop(0)
            arguments = ["--results", str(results), "--share", target, str(number), str(of)]
            arguments += [] if limit is None else ["--limit", str(limit)]
            running.append(
                subprocess.Popen(
                    [sys.executable, "-m", "tests.reliability.page", *arguments], cwd=ROOT, env=child_environment()
                )
            )
        time.sleep(0.2)  # polls the parts that run
        good &= all(process.returncode in (None, 0) for process in running)
        running = [process for process in running if process.poll() is None]
    return good


# ---- tables


def table(rows: Sequence[dict[str, Any]]) -> str:
    """By target: faults, ends of the first lives, and unknown pours. The list has each case."""
    groups: dict[str, list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        groups[row["case"]["target"]].append(row)
    wrong = sum(bool(row["wrong"]) for row in rows)
    lines = [
        f"{len(rows)} cases were run, {wrong} ended otherwise than they should.",
        "",
        "| struck | faults | the first life of the program | unknown pours | as undisturbed |",
        "|---|---|---|---|---|",
    ]
    for target in sorted(groups, key=TARGETS.index):
        cases = groups[target]
        faults = sorted({row["case"]["fault"] for row in cases}, key=FAULTS.index)
        ended = counted(row["ended"].partition(",")[0] for row in cases)
        undisturbed = sum(not row["wrong"] for row in cases)
        unknown = sum(row["asked"] for row in cases)
        lines.append(f"| {target} | {', '.join(faults)} | {ended} | {unknown} | {undisturbed} of {len(cases)} |")
    return "\n".join(lines) + "\n"


def counted(words: Any) -> str:
    """Each with how often it was said."""
    return ", ".join(f"{text} ({count})" for text, count in sorted(Counter(words).items()))


def write(results: Path) -> int:
    """The tables of what is in a file of results; returns how many cases went wrong."""
    rows = list(found(results).values())
    page = PAGE.read_text(encoding="utf-8")
    before, marker, rest = page.partition(BEGIN.format("kill matrix"))
    assert marker, f"{PAGE} has no place for the table of the kill matrix"
    PAGE.write_text(before + marker + table(rows) + END + rest.partition(END)[2], encoding="utf-8")
    order = {name: i for i, name in enumerate((*TARGETS, *FAULTS))}
    rows.sort(key=lambda row: (order[row["case"]["target"]], order[row["case"]["fault"]]))
    with LIST.open("w", encoding="utf-8", newline="") as file:
        out = csv.writer(file, lineterminator="\n")
        out.writerow(
            ["struck", "fault", "at", "number", "first life", "told", "lives", "asked", "bench asked", "wrong"]
        )
        for row in rows:
            case, told = row["case"], " ".join(row["told"].split())[:100]
            out.writerow([*case.values(), row["ended"], anonymous(told), row["lives"], row["asked"],
                          " ".join(row["heard"]), "; ".join(row["wrong"])])  # fmt: skip
    for row in rows:
        if row["wrong"]:
            print(Case(**row["case"]).name, row["wrong"])
    return sum(bool(row["wrong"]) for row in rows)


def anonymous(text: str) -> str:
    """Without the folders and numbers of processes that nobody will find again."""
    import re

    return re.sub(r"/tmp/\S+?(?=[:\s,]|$)", "…", text)


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", nargs="+", choices=list(RIGS), default=list(RIGS))
    parser.add_argument("--limit", type=int, default=None, help="as many cases of each share, and no more")
    parser.add_argument("--fresh", action="store_true")
    parser.add_argument("--write", action="store_true")
    parser.add_argument("--results", type=Path, default=RESULTS)
    parser.add_argument("--share", nargs=3, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.share is not None:
        target, number, shares = options.share
        work(target, int(number), int(shares), options.results, options.limit)
        return
    options.results.parent.mkdir(exist_ok=True)
    if options.fresh:
        options.results.unlink(missing_ok=True)
    good = options.write or run(options.only, options.jobs, options.results, options.limit)
    sys.exit(1 if write(options.results) or not good else 0)


if __name__ == "__main__":
    main()
