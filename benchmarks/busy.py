"""Run the shipped campaigns next to busy processes: nothing that is emulated may fail because the host is slow.

    python benchmarks/busy.py [quickstart night series] [--busy 16] [--runs 10] [--one-core] [--seed 7]

- `quickstart`: the README's campaign.
- `night`: mixtures.yaml on rack.yaml, where an arm carries the vessels of six cups.
- `series`: the doses of dispense.yaml on virtual-dosing.yaml, in real time.

The busy processes have normal priority, run on the same cores, and end with this process. `--one-core` keeps
everything on the first permitted core. Each run's exit code and time are printed; the time is not judged. The exit
code is 1 if a run ended with another code than 0.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from machine import ROOT, say, started

COMMANDS = {
    "quickstart": ["campaigns/quickstart.yaml"],
    "night": ["campaigns/mixtures.yaml", "--laboratory", "laboratories/rack.yaml"],
    "series": ["campaigns/dispense.yaml", "--laboratory", "laboratories/virtual-dosing.yaml"],
}

LONGEST = 3 * 3600.0
"""Time after which a run counts as stuck [s]; its processes are ended."""


@contextlib.contextmanager
def busy_processes(count: int) -> Iterator[None]:
    """Keep processes busy while the body runs; they end with this process, also when it is killed."""
    children = [started([sys.executable, "-c", "while True: pass"]) for _ in range(count)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def run_once(name: str, seed: int, folder: Path) -> tuple[int, float, str]:
    """Run one campaign. Returns its exit code, its time [s] and its messages."""
    shutil.copytree(ROOT / "configs", folder / "configs")
    words = [str(folder / "configs" / word) if word.endswith(".yaml") else word for word in COMMANDS[name]]
    command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "run", *words]
    environment = {**os.environ, "DECANT_STATE": str(folder / "state")}  # an account of vessels of its own
    output, begin = folder / "output.txt", time.monotonic()
    with output.open("wb") as file:
        child = started([*command, "--seed", str(seed), "--quiet"], env=environment, stdout=file, stderr=file)
        try:
            status = child.wait(LONGEST)
        except subprocess.TimeoutExpired:
            status = 124
        finally:
            child.terminate()
            child.wait()
    return status, time.monotonic() - begin, output.read_text(encoding="utf-8").strip()


def main() -> int:
    """Run all campaigns, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "campaigns", nargs="*", choices=[*COMMANDS, []], metavar="campaign", help="quickstart by default"
    )
    parser.add_argument("--busy", type=int, default=16, help="number of busy processes")
    parser.add_argument("--runs", type=int, default=10, help="of each campaign")
    parser.add_argument("--one-core", action="store_true", help="everything on one core")
    parser.add_argument("--seed", type=int, default=7, help="of the first run; each further run has the next one")
    chosen = parser.parse_args()
    if chosen.one_core:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cores, failures = len(os.sched_getaffinity(0)), 0
    with busy_processes(chosen.busy):
        for name in chosen.campaigns or ["quickstart"]:
            for number in range(chosen.runs):
                with tempfile.TemporaryDirectory(prefix="decant-busy-") as folder:
                    status, seconds, words = run_once(name, chosen.seed + number, Path(folder))
                failures += status != 0
                load = os.getloadavg()[0]
                say(
                    f"{name} {number + 1}/{chosen.runs}: exit {status} after {seconds:.0f} s ({chosen.busy} busy, "
                    f"{cores} cores, load {load:.0f}){f': {words}' if status else ''}"
                )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
