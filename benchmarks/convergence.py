"""Measure how the outcome depends on the number of particles.

    python benchmarks/convergence.py --store FILE [--particles 500 1000 2000] [--seeds 3]
                                     [--finest 5000 10000 20000 40000] [--table | --write]

Nineteen pours (`sim_engine.validation.convergence`) are simulated at each number of particles: the coarse ones with
several seeds, the finest once. Finished simulations are in the store, so an interrupted measurement continues.
`--write` makes no runs; it writes the table to docs/data/results.json.

A pour counts as converged if its spillage changes by at most 0.02 from the third finest number to the finest. The two
last rows are the distances of the converged pours from the finest.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

import numpy as np
from machine import KeptRows, write_table

from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator
from sim_engine.validation.convergence import POURS, spillage

CONVERGED = 0.02


def table(made: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows: the spillage of each pour by number of particles, and the distances from the finest."""
    numbers = sorted({one["particles"] for one in made})
    found: dict[tuple[str, int], list[float]] = {}
    for one in made:
        found.setdefault((one["pour"], one["particles"]), []).append(one["spillage"])
    spilled = {pour.name: np.array([np.mean(found[pour.name, n]) for n in numbers]) for pour in POURS}
    converged = {name: bool(abs(row[-1] - row[-3]) <= CONVERGED) for name, row in spilled.items()}
    rows = [[name, *(f"{r:.3f}" for r in row), "yes" if converged[name] else "no"] for name, row in spilled.items()]
    off = np.abs(np.array([row - row[-1] for name, row in spilled.items() if converged[name]]))
    words = "distance of the converged from the finest"
    rows += [[f"{words}, mean", *(f"{d:.3f}" for d in off.mean(axis=0)), ""]]
    rows += [[f"{words}, largest", *(f"{d:.3f}" for d in off.max(axis=0)), ""]]
    return ["pour", *(f"{n:,}" for n in numbers), "converged"], rows


def main() -> None:
    """Run the missing simulations, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--particles", type=int, nargs="*", default=[500, 1_000, 2_000])
    parser.add_argument("--seeds", type=int, default=3, help="seeds of the coarse simulations")
    parser.add_argument("--finest", type=int, nargs="*", default=[5_000, 10_000, 20_000, 40_000])
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    options = parser.parse_args()
    kept = KeptRows(options.store)
    if not (options.table or options.write):
        simulator = PourSimulator()
        wanted = [(n, seed) for n in options.particles for seed in range(1, options.seeds + 1)]
        wanted += [(n, 1) for n in options.finest]
        for n, seed in wanted:
            theta = SimulationParameters(particles=n, cohesion=0.0, xsph_rate=1.0)
            for pour in POURS:
                key = {"pour": pour.name, "particles": n, "seed": seed}
                if all(row | key != row for row in kept.rows):
                    spilled, cpu_s = spillage(simulator, pour, theta, seed)
                    kept.add({**key, "spillage": round(spilled, 5), "cpu_s": round(cpu_s, 5)})
    head, rows = table(kept.rows)
    for row in (head, *rows):
        print(" | ".join(row))
    if options.write:
        settings = (
            "spilled over poured by number of particles; 200 mL of water, no surface tension, uncalibrated; three "
            "seeds up to 2,000 particles, one beyond; converged: at most 0.02 from 10,000 to 40,000 particles"
        )
        shown = [row for row in rows if row[-1] != "yes"]
        write_table("convergence", head, shown, "python benchmarks/convergence.py --store FILE", settings)


if __name__ == "__main__":
    main()
