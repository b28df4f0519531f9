"""Run the shipped campaigns next to busy processes: nothing that is emulated may fail because the host is slow.

    python benchmarks/busy.py [quickstart night series] [--busy 16] [--runs 10] [--at-once 1]
                              [--one-core] [--seed 7]

- `quickstart`: the README's campaign.
- `night`: mixtures.yaml on rack.yaml, where an arm carries the vessels of six cups.
- `series`: the doses of dispense.yaml on virtual-dosing.yaml, of particles; a dose that misses its tolerance makes it
  end with 4.

The busy processes have normal priority, run on the same cores, and end with this process. Linux may divide the
processor among sessions (`sched_autogroup_enabled`); one busy process then gets as much as one emulated device, or as
all simulators of a run together. Each line says how it is divided. `--one-core` keeps everything on the first permitted
core. Each run's exit code and time are printed; the time is not judged. The exit code is 1 if a run ended with another
code than 0; the folder of such a run is kept.
"""

from __future__ import annotations

import argparse
import contextlib
import os
import shutil
import sys
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
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
    """Keep processes busy while the body runs; they end with this process, also when it is killed.

    Each has a session of its own: Linux may give all processes of a session together the share of one (`autogroup`).
    """
    command = [sys.executable, "-c", "while True: pass"]
    children = [started(command, start_new_session=True) for _ in range(count)]
    try:
        yield
    finally:
        for child in children:
            child.kill()
            child.wait()


def divided_among() -> str:
    """What Linux divides the processor among: processes, or sessions."""
    setting = Path("/proc/sys/kernel/sched_autogroup_enabled")
    return "sessions" if setting.exists() and setting.read_text().strip() == "1" else "processes"


@dataclass
class Run:
    """A campaign that is under way, in a folder and with an account of vessels of its own."""

    name: str
    seed: int

    def __post_init__(self) -> None:
        """Start it."""
        self._folder = folder = Path(tempfile.mkdtemp(prefix="decant-busy-"))
        shutil.copytree(ROOT / "configs", folder / "configs")
        words = [str(folder / "configs" / word) if word.endswith(".yaml") else word for word in COMMANDS[self.name]]
        command = [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "run", *words]
        environment = {**os.environ, "DECANT_STATE": str(folder / "state")}
        self._output, self._begin = folder / "output.txt", time.monotonic()
        with self._output.open("wb") as file:
            child = started([*command, "--seed", str(self.seed), "--quiet"], env=environment, stdout=file, stderr=file)
        self._child = child

    def ended(self) -> bool:
        """Whether it has ended; one that has taken `LONGEST` is ended here."""
        if time.monotonic() - self._begin > LONGEST:
            self._child.terminate()
            self._child.wait()
        return self._child.poll() is not None

    def result(self) -> tuple[int, float, str]:
        """Exit code, time [s] and messages of a run that has ended; its folder is removed unless it failed."""
        seconds, text = time.monotonic() - self._begin, self._output.read_text(encoding="utf-8").strip()
        if self._child.returncode == 0:
            shutil.rmtree(self._folder, ignore_errors=True)
        return self._child.returncode, seconds, text


def main() -> int:
    """Run all campaigns, and print a line for each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument(
        "campaigns", nargs="*", choices=[*COMMANDS, []], metavar="campaign", help="quickstart by default"
    )
    parser.add_argument("--busy", type=int, default=16, help="number of busy processes")
    parser.add_argument("--runs", type=int, default=10, help="of each campaign")
    parser.add_argument("--at-once", type=int, default=1, help="runs beside each other: each makes the others slower")
    parser.add_argument("--one-core", action="store_true", help="everything on one core")
    parser.add_argument("--seed", type=int, default=7, help="of the first run; each further run has the next one")
    chosen = parser.parse_args()
    if chosen.one_core:
        os.sched_setaffinity(0, {min(os.sched_getaffinity(0))})
    cores, failures, count = len(os.sched_getaffinity(0)), 0, 0
    waiting = [(name, chosen.seed + n) for name in chosen.campaigns or ["quickstart"] for n in range(chosen.runs)]
    total = len(waiting)
    running: list[Run] = []
    with busy_processes(chosen.busy):
        while waiting or running:
            while waiting and len(running) < chosen.at_once:
                running.append(Run(*waiting.pop(0)))
            time.sleep(0.2)
            for run in [run for run in running if run.ended()]:
                running.remove(run)
                status, seconds, text = run.result()
                failures, count = failures + (status != 0), count + 1
                say(
                    f"{count}/{total}: {run.name} with seed {run.seed}: exit {status} after {seconds:.0f} s "
                    f"({chosen.busy} busy, {chosen.at_once} at once, {cores} cores divided among {divided_among()}, "
                    f"load {os.getloadavg()[0]:.0f})"
                    f"{f': {text}' if status else ''}"
                )
    return 1 if failures else 0


if __name__ == "__main__":
    sys.exit(main())
