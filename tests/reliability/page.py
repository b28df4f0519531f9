"""Runs the kill matrix, or as much of it as time allows, and writes docs/reliability.md's table.

python -m tests.reliability.page --jobs 2                    # all cases: minutes on two idle cores
python -m tests.reliability.page --jobs 2 --minutes 5        # as many as that, drawn by a fixed seed
"""

from __future__ import annotations

import argparse
import json
import random
import subprocess
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

from tests.reliability.matrix import FAULTS, LOST, Case, Matrix, can_mount

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reliability.md"
BEGIN, END = "<!-- table: kill matrix -->\n", "<!-- end of table -->"
SEED = 13


def work(number: int, jobs: int, minutes: float, file: Path) -> None:
    """One process' share of the cases, each written down as soon as it has ended."""
    end = time.monotonic() + 60.0 * minutes
    with tempfile.TemporaryDirectory() as folder, file.open("a", encoding="utf-8") as out:
        matrix = Matrix(Path(folder))
        mounting = can_mount(Path(folder))
        cases = [case for case in matrix.cases() if case.fault != "full disk" or mounting]
        random.Random(SEED).shuffle(cases)
        out.write(json.dumps({"cases": len(cases)}) + "\n")
        for case in cases[number::jobs]:
            if time.monotonic() > end:
                break
            out.write(json.dumps(asdict(matrix.play(case))) + "\n")
            out.flush()


def table(rows: Sequence[dict[str, Any]], cases: int) -> str:
    """Cases by fault and stage: how many, how they ended, what was asked, what was wrong."""
    groups: dict[tuple[str, str], list[dict[str, Any]]] = defaultdict(list)
    for row in rows:
        stage = "all stages" if row["case"]["fault"] == LOST else row["at"].partition(": ")[0].partition(":")[0]
        groups[row["case"]["fault"], stage].append(row)
    wrong = sum(bool(row["wrong"]) for row in rows)
    lines = [
        f"{len(rows)} of {cases} cases were run, {wrong} ended otherwise than they should.",
        "",
        "| fault | while writing in | cases | the struck process | a person was asked | as undisturbed |",
        "|---|---|---|---|---|---|",
    ]
    order = {name: i for i, name in enumerate((*FAULTS, LOST))}
    for (fault, stage), some in sorted(groups.items(), key=lambda item: (order[item[0][0]], item[0][1])):
        ended = defaultdict(int)
        for row in some:
            ended[row["said"]] += 1
        said = ", ".join(f"{text} ({count})" for text, count in sorted(ended.items()))
        good = sum(not row["wrong"] for row in some)
        lines.append(
            f"| {fault} | {stage} | {len(some)} | {said} | {sum(r['asked'] for r in some)} | {good} of {len(some)} |"
        )
    return "\n".join(lines) + "\n"


def write(file: Path) -> int:
    """The table of what is in a file of results; returns how many cases went wrong."""
    found = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
    rows = [row for row in found if "case" in row]
    before, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    page = before + BEGIN + table(rows, max(row["cases"] for row in found if "cases" in row)) + END
    PAGE.write_text(page + rest.partition(END)[2], encoding="utf-8")
    for row in rows:
        if row["wrong"]:
            print(Case(**row["case"]), row["at"], row["wrong"])
    return sum(bool(row["wrong"]) for row in rows)


def main() -> None:
    """Run and write."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--minutes", type=float, default=600.0)
    parser.add_argument("--results", type=Path, default=ROOT / "build" / "kill-matrix.jsonl")
    parser.add_argument("--number", type=int, default=None, help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.number is not None:
        work(options.number, options.jobs, options.minutes, options.results)
        return
    options.results.parent.mkdir(exist_ok=True)
    options.results.unlink(missing_ok=True)
    shared = ["--jobs", str(options.jobs), "--minutes", str(options.minutes), "--results", str(options.results)]
    program = [sys.executable, "-m", "tests.reliability.page", *shared, "--number"]
    workers = [subprocess.Popen([*program, str(number)], cwd=ROOT) for number in range(options.jobs)]
    failed = [worker.wait() for worker in workers]
    sys.exit(1 if any(failed) or write(options.results) else 0)


if __name__ == "__main__":
    main()
