"""Measure how the outcome depends on the number of particles.

    python benchmarks/convergence.py --store FILE [--particles 500 1000 2000] [--seeds 3]
                                     [--finest 5000 10000 20000 40000] [--table | --write]
    python benchmarks/convergence.py --store FILE --halves [--particles 1000 2000 5000 10000] [--seeds 30]
    python benchmarks/convergence.py --store FILE --fine [--finest 10000 20000 40000 80000] [--seeds 3]

Nineteen pours (`validation.convergence`) are simulated at each number of particles: the coarse ones with
several seeds, the finest once. Finished simulations are in the store, so an interrupted measurement continues.
`--write` makes no runs; it writes the table to docs/data/results.json.

`--halves` compares eight of them as whole and as mirrored pours, in turns, with the mean of whole pours of 10,000
particles: what does a simulation cost, and how near is it? `--fine` is for those that do not converge, mirrored.

A pour counts as converged if its spillage changes by at most 0.02 from the third finest number to the finest. The two
last rows are the distances of the converged pours from the finest.
"""

from __future__ import annotations

import argparse
import itertools
from collections import Counter
from collections.abc import Sequence
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from machine import KeptRows, write_table
from validation.convergence import POURS, ConvergencePour, has_converged, spillage

from orchestrator.learning import single_action
from sim_engine.fluid import engine
from sim_engine.liquids import SimulationParameters
from sim_engine.prediction_band import band, shift_of
from sim_engine.scene import MIRRORED_FROM
from sim_engine.simulator import PourSimulator

CONVERGED = 0.02
FINE = 10_000
"""Number of particles whose whole pours are the reference of `--halves`."""
PLANNED, SEEDS, FINE_ONE = 2_000, 5, single_action.FINE
"""Of a plan: particles and number of its simulations, and particles of the finer one."""


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


def halves(made: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows: cost of whole and mirrored pours, and their distance from whole ones of `FINE` particles.

    The last column is the distance of a whole pour that takes as long, between two measured numbers of particles.
    """
    spilled: dict[tuple[int, bool], dict[str, list[float]]] = {}
    seconds: dict[tuple[int, bool], list[float]] = {}
    for row in made:
        key = row["particles"], row.get("mirrored", False)
        spilled.setdefault(key, {}).setdefault(row["pour"], []).append(100 * row["spillage"])
        seconds.setdefault(key, []).append(row["cpu_s"])
    cost = {key: float(np.mean(values)) for key, values in seconds.items()}
    fine = {name: float(np.mean(values)) for name, values in spilled[FINE, False].items()}
    errors: dict[tuple[int, bool], tuple[float, float, float]] = {}
    for key, pours in sorted(spilled.items()):
        bias = np.array([np.mean(values) - fine[name] for name, values in pours.items()])
        scatter = np.array([np.std(values, ddof=1) for values in pours.values()])
        parts = float(np.sqrt(np.mean(bias**2))), float(np.sqrt(np.mean(scatter**2)))
        errors[key] = (*parts, float(np.hypot(*parts)))
    whole = sorted(key for key in errors if not key[1])
    logs = np.log([cost[key] for key in whole]), np.log([errors[key][2] for key in whole])
    rows = []
    for key, values in errors.items():
        as_long = f"{np.exp(np.interp(np.log(cost[key]), *logs)):.2f}" if key[1] else ""
        cells = [f"{key[0]:,}", "mirrored" if key[1] else "whole", f"{cost[key]:.2f}"]
        rows.append([*cells, *(f"{value:.2f}" for value in values), as_long])
    head = ["particles", "liquid", "CPU s", f"means from {FINE:,}, points", "scatter between seeds"]
    return [*head, "error of one pour", "a whole pour that takes as long"], rows


def differences(made: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows: mean spillage of each pour, mirrored less whole, with its standard error, in points."""
    spilled: dict[tuple[str, int, bool], list[float]] = {}
    for row in made:
        key = row["pour"], row["particles"], row.get("mirrored", False)
        spilled.setdefault(key, []).append(100 * row["spillage"])
    numbers = sorted({n for _, n, half in spilled if half})
    rows = []
    for name in dict.fromkeys(name for name, _, _ in spilled):
        cells = []
        for n in numbers:
            half, whole = spilled[name, n, True], spilled[name, n, False]
            error = np.sqrt(np.var(half, ddof=1) / len(half) + np.var(whole, ddof=1) / len(whole))
            cells.append(f"{np.mean(half) - np.mean(whole):+.2f} ± {error:.2f}")
        rows.append([name, f"{np.mean(spilled[name, FINE, False]):.1f} %", *cells])
    return ["pour", f"whole, {FINE:,}", *(f"{n:,}" for n in numbers)], rows


def finest(made: list[dict[str, Any]]) -> tuple[list[str], list[list[str]]]:
    """Return head and rows: mean spillage of the pours that do not converge, by number of particles, mirrored.

    The last column is the 90 % interval of a plan with `PLANNED` particles and one simulation of `FINE_ONE`.
    """
    numbers = sorted({row["particles"] for row in made if row.get("mirrored")} - {PLANNED})
    rows = []
    for pour in POURS:
        cells = []
        for n in numbers:
            values = [
                r["spillage"] for r in made if r.get("mirrored") and (r["pour"], r["particles"]) == (pour.name, n)
            ]
            cells.append(f"{np.mean(values):.3f} ({min(values):.3f} … {max(values):.3f})" if values else "")
        if any(cells):
            first, fine = (
                {r["seed"]: r["spillage"] for r in made if (r["pour"], r["particles"]) == (pour.name, n)}
                for n in (PLANNED, FINE_ONE)
            )
            finer = shift_of(fine[min(fine)], PLANNED) - shift_of(first[min(first)], PLANNED)
            rows.append([pour.name, *cells, band(list(first.values()), PLANNED, finer=finer).percent()])
    return ["pour", *(f"{n:,}" for n in numbers), f"interval of a plan with {PLANNED:,}"], rows


def simulate(
    kept: KeptRows, pours: Sequence[ConvergencePour], particles: int, seed: int, mirrored: bool = False
) -> None:
    """Simulate the pours that the store lacks."""
    plain = SimulationParameters(cohesion=0.0, xsph_rate=1.0)
    theta = plain.model_copy(update={"particles": particles})  # beyond the largest number that is allowed, too
    for pour in pours:
        key = {"pour": pour.name, "particles": particles, "seed": seed} | ({"mirrored": True} if mirrored else {})
        if all(row | key != row or row.get("mirrored", False) != mirrored for row in kept.rows):
            spilled, cpu_s = spillage(simulator(), pour, theta, seed, mirrored)
            kept.add({**key, "spillage": round(spilled, 5), "cpu_s": round(cpu_s, 5)})


@cache
def simulator() -> PourSimulator:
    """The simulator of this process, with room for 80,000 particles and their images."""
    engine.POOL = 80_000
    return PourSimulator()


def main() -> None:
    """Run the missing simulations, and print the table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--store", type=Path, required=True)
    parser.add_argument("--halves", action="store_true", help="compare whole and mirrored pours")
    parser.add_argument("--fine", action="store_true", help="the pours that do not converge, mirrored")
    parser.add_argument("--particles", type=int, nargs="*")
    parser.add_argument("--seeds", type=int, help="seeds of the coarse simulations")
    parser.add_argument("--first", type=int, default=1, help="first seed")
    parser.add_argument("--finest", type=int, nargs="*")
    parser.add_argument("--table", action="store_true", help="only print the table")
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    options = parser.parse_args()
    kept = KeptRows(options.store)
    seeds = range(options.first, options.first + (options.seeds or (30 if options.halves else 3)))
    numbers = options.particles or ([1_000, 2_000, 5_000, FINE] if options.halves else [500, 1_000, 2_000])
    fine = options.finest or [
        *([] if options.fine else [5_000]),
        10_000,
        20_000,
        40_000,
        *([80_000] if options.fine else []),
    ]
    if not (options.table or options.write):
        if options.halves:
            for n, seed, half in itertools.product(numbers, seeds, (False, True)):
                if n >= MIRRORED_FROM or not half:
                    simulate(kept, POURS[:8], n, seed, half)
        elif options.fine:
            planned = [(PLANNED, seed) for seed in range(seeds[0], seeds[0] + SEEDS)]
            for n, seed in [*planned, *itertools.product(fine, seeds)]:
                simulate(kept, [pour for pour in POURS if not has_converged(pour)], n, seed, True)
        else:
            for n, seed in [*itertools.product(numbers, seeds), *((n, seeds[0]) for n in fine)]:
                simulate(kept, POURS, n, seed)
    settings = "200 mL of water, no surface tension, uncalibrated; "
    if options.halves:
        counts = Counter((row["pour"], row["particles"], row.get("mirrored", False)) for row in kept.rows).values()
        settings += f"{min(counts)} to {max(counts)} seeds; root mean squares over eight pours; CPU seconds of one core"
        tables = {"halves": halves(kept.rows), "halves-pours": differences(kept.rows)}
    elif options.fine:
        tables = {"convergence-fine": finest(kept.rows)}
        settings += f"spilled over poured of mirrored pours: mean (range) of {len(seeds)} seeds"
    else:
        head, rows = table(kept.rows)
        tables = {"convergence": (head, rows)}
        settings += (
            "spilled over poured by number of particles; three seeds up to 2,000 particles, one beyond; converged: at "
            "most 0.02 from 10,000 to 40,000 particles"
        )
    for name, (head, rows) in tables.items():
        print("\n".join(" | ".join(row) for row in (head, *rows)))
        if options.write:
            kind = " --halves" if options.halves else " --fine" if options.fine else ""
            shown = [row for row in rows if row[-1] != "yes"]
            write_table(name, head, shown, f"python benchmarks/convergence.py --store FILE{kind}", settings)


if __name__ == "__main__":
    main()
