"""Measure how long a new process takes to finish its first pour, by phase.

    python benchmarks/start_up.py [--particles 2000] [--repeats 3] [--core 1] [--json]

The first process starts with an empty cache: it builds the vessels' grids and compiles the kernels. The others use its
cache. Figures are wall time in seconds from the start of the process to the outcome, and CPU seconds, which other load
does not affect. Kernels: the first pour's time minus that of the same pour repeated.
"""

from __future__ import annotations

import argparse
import itertools
import json
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

PHASES = ("interpreter", "imports", "engine", "vessels", "kernels", "pour")
"""Phases in order of time: Python itself, packages, Taichi's start and the arrays, geometry and its checks, compiling
or loading kernels, the pour."""

LIMIT, COLD_LIMIT = 3.0, 12.0
"""Required time to the first outcome with a warm cache and with an empty one [s]."""


def answer(particles: int, begun: float) -> dict[str, Any]:
    """Make the first pour of this process.

    Args:
        particles: N.
        begun: `time.monotonic()` at the process's start, by its parent's clock [s].
    """
    marks = [begun, time.monotonic()]
    from standard_pour import standard_task

    from sim_engine.fluid.engine import engine
    from sim_engine.simulator import PourSimulator

    marks.append(time.monotonic())
    engine()
    marks.append(time.monotonic())
    simulator, task = PourSimulator(), standard_task(particles, seed=1, mirrored=True)
    simulator.prepare(task)
    marks.append(time.monotonic())
    simulator.simulate(task)
    marks.append(time.monotonic())
    cpu = time.process_time()
    simulator.simulate(task)
    again = time.monotonic() - marks[-1]
    simulator.close()
    parts = [after - before for before, after in itertools.pairwise(marks)]
    first = parts.pop()
    parts += [max(first - again, 0.0), min(again, first)]
    return {
        "answered_s": marks[-1] - begun,
        "cpu_s": cpu,
        "phases": dict(zip(PHASES, parts, strict=True)),
    }


def summary(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return medians over some processes."""
    return {
        "answered_s": round(statistics.median(run["answered_s"] for run in runs), 2),
        "cpu_s": round(statistics.median(run["cpu_s"] for run in runs), 2),
        "phases": {name: round(statistics.median(run["phases"][name] for run in runs), 3) for name in PHASES},
        "processes": len(runs),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--repeats", type=int, default=3, help="number of processes with a warm cache")
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--begun", type=float, help=argparse.SUPPRESS)  # measured process
    options = parser.parse_args()
    if options.begun is not None:
        print(json.dumps(answer(options.particles, options.begun)))
        return

    from machine import describe, pin, run_self, say, show
    from standard_pour import check_particles

    particles = check_particles(options.particles)
    if options.repeats < 1:
        raise SystemExit(f"--repeats {options.repeats}: at least one process is needed")
    core = pin(options.core)
    runs = []
    with tempfile.TemporaryDirectory() as cache:
        for k in range(options.repeats + 1):
            begun = time.monotonic()
            run = run_self(__file__, f"--particles={particles}", f"--begun={begun!r}", cache=Path(cache))
            say(f"{'cold' if k == 0 else 'warm'} cache: answered after {run['answered_s']:.2f} s")
            runs.append(run)
        size = sum(file.stat().st_size for file in Path(cache).rglob("*") if file.is_file())
    warm = summary(runs[1:])
    result = {
        "particles": particles,
        "warm": warm,
        "cold": summary(runs[:1]),
        "limit_s": LIMIT,
        "within_limit": warm["answered_s"] <= LIMIT,
        "cold_limit_s": COLD_LIMIT,
        "cold_within_limit": summary(runs[:1])["answered_s"] <= COLD_LIMIT,
        "cache_mb": round(size / 1e6, 1),
        "core": core,
        "machine": describe(),
    }
    show(result, options.json)


if __name__ == "__main__":
    main()
