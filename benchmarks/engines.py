"""Compare the packages that can compile the solver: CPU seconds of the standard pour, start, memory and size.

    python benchmarks/engines.py [--repeats 3] [--core 1] [--json]

Each engine starts once with an empty cache and then `--repeats` times with its cache; processes of the engines
alternate. Every process pours the standard pour with 500 and 2,000 particles.
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import statistics
import tempfile
import time
from pathlib import Path
from typing import Any

PARTICLES = 500, 2000


def measured(core: int | None) -> dict[str, Any]:
    """Pour with the engine of this process; CPU seconds from the start of the process to the first answer."""
    from standard_pour import measure, short_task

    from sim_engine.simulator import PourSimulator

    simulator = PourSimulator()
    simulator.simulate(short_task(PARTICLES[0]))
    start = time.process_time()
    pours = {n: measure(simulator, n, seed=1) for n in PARTICLES}
    simulator.close()
    return {
        "start_cpu_s": start,
        "cpu_s": [pours[n].cpu_s for n in PARTICLES],
        "left": list(pours[PARTICLES[-1]].left),
        "memory_mb": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3,
    }


def size_mb(package: str) -> float:
    """Installed size of a package's files [MB]."""
    from importlib.metadata import files

    paths = [Path(str(file.locate())) for file in files(package) or []]
    return sum(path.stat().st_size for path in paths if path.is_file()) / 1e6


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--repeats", type=int, default=3, help="number of processes of each engine with a warm cache")
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--measured", action="store_true", help=argparse.SUPPRESS)
    options = parser.parse_args()
    if options.measured:
        print(json.dumps(measured(options.core)))
        return

    from importlib.metadata import version

    from machine import describe, pin, run_self, say, show

    from sim_engine.engine_package import ENGINES, VARIABLE
    from sim_engine.resources import installed

    core = pin(options.core)
    runs: dict[str, list[dict[str, Any]]] = {name: [] for name in ENGINES if installed(name)}
    with tempfile.TemporaryDirectory() as cache:
        for _ in range(options.repeats + 1):
            for name, made in runs.items():
                os.environ[VARIABLE] = name
                made.append(run_self(__file__, "--measured", cache=Path(cache)))
                say(f"{name}: {made[-1]['cpu_s'][-1]:.2f} CPU s")
    rows = [
        {
            "engine": f"{name} {version(name)}",
            "cold_cpu_s": round(made[0]["start_cpu_s"], 2),
            "warm_cpu_s": round(statistics.median(run["start_cpu_s"] for run in made[1:]), 2),
            "cpu_s": [round(statistics.median(run["cpu_s"][k] for run in made), 3) for k in range(len(PARTICLES))],
            "left": [round(value, 3) for value in made[0]["left"]],
            "memory_mb": round(statistics.median(run["memory_mb"] for run in made[1:])),
            "size_mb": round(size_mb(name)),
        }
        for name, made in runs.items()
    ]
    del os.environ[VARIABLE]
    show({"particles": list(PARTICLES), "engines": rows, "core": core, "machine": describe()}, options.json)


if __name__ == "__main__":
    main()
