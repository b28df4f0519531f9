"""Measure a pour's CPU seconds and memory against the number of particles.

    python benchmarks/scaling.py [--particles 1000 2000 5000 10000 20000] [--memory 1000 2000 5000 10000 20000 50000]
                                 [--repeats 3] [--core 1] [--json]

Each number has its own process, so that memory is measured separately. Memory is the resident set early in the pour,
and its growth with each step before that: packages, Taichi, the solver's arrays, kernels and vessels (by a pour of 200
particles), the pour of N itself. The exponent is that of a power law fitted to all CPU seconds.
"""

from __future__ import annotations

import argparse
import json
import statistics
from typing import Any

import numpy as np
import psutil
from machine import describe, pin, run_self, say, show
from standard_pour import FEWEST, check_particles, measure, short_task, standard_task

from sim_engine.errors import SimulationCancelled
from sim_engine.simulator import SETTLING, SLICE, PourSimulator

PARTICLES = (1_000, 2_000, 5_000, 10_000, 20_000)
MEMORY = (1_000, 2_000, 5_000, 10_000, 20_000, 50_000)
EARLY = round((0.1 + SETTLING) / SLICE)
"""Slices after which a pour uses all its memory."""


def resident() -> int:
    """Return the memory of this process that is in RAM [bytes]."""
    return int(psutil.Process().memory_info().rss)


def cost(particles: int, repeats: int) -> dict[str, Any]:
    """Return CPU seconds by phase, median over seeds."""
    simulator = PourSimulator()
    simulator.simulate(short_task(FEWEST))
    runs = [measure(simulator, particles, seed) for seed in range(1, repeats + 1)]
    simulator.close()
    middle = sorted(runs, key=lambda run: run.cpu_s)[repeats // 2]
    return {
        "particles": particles,
        "cpu_s": round(statistics.median(run.cpu_s for run in runs), 3),
        "steps": middle.outcome.steps,
        "iterations": middle.iterations,
        "particle_iterations_per_s": round(particles * middle.iterations / middle.cpu_s),
        "simulated_time_s": round(middle.outcome.simulated_time, 3),
        "delivered": round(statistics.mean(run.outcome.received for run in runs), 4),
    }


def memory(particles: int) -> dict[str, Any]:
    """Return the resident memory of a process during a pour, by use."""
    imports = resident()
    from sim_engine.fluid.engine import engine

    taichi = resident()
    engine()
    started = resident()
    simulator = PourSimulator()
    simulator.simulate(short_task(FEWEST))
    ready = resident()
    slices = 0

    def enough() -> bool:
        nonlocal slices
        slices += 1
        return slices > EARLY

    try:
        simulator.simulate(standard_task(particles, 1), cancelled=enough)
    except SimulationCancelled:
        pouring = resident()
    else:
        raise SystemExit(f"the standard pour with {particles} particles was over at once")
    simulator.close()
    return {
        "particles": particles,
        "imports_mb": round(imports / 1e6, 1),
        "taichi_mb": round((taichi - imports) / 1e6, 1),
        "arrays_mb": round((started - taichi) / 1e6, 1),
        "kernels_and_vessels_mb": round((ready - started) / 1e6, 1),
        "pour_mb": round((pouring - ready) / 1e6, 1),
        "process_mb": round(pouring / 1e6, 1),
    }


def exponent(rows: list[dict[str, Any]]) -> float | None:
    """Return p of cpu_s ∝ N^p by least squares of the logarithms; None for fewer than two numbers."""
    if len(rows) < 2:
        return None
    n, cpu = (np.log([row[key] for row in rows]) for key in ("particles", "cpu_s"))
    return round(float(np.polyfit(n, cpu, 1)[0]), 2)


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, nargs="*", default=PARTICLES, metavar="N", help="N for CPU seconds")
    parser.add_argument("--memory", type=int, nargs="*", default=MEMORY, metavar="N", help="N for memory")
    parser.add_argument("--repeats", type=int, default=3, help="pours per N, each with another seed")
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--one", choices=("cost", "memory"), help=argparse.SUPPRESS)  # measures in this process
    options = parser.parse_args()
    numbers = [check_particles(n) for n in options.particles]
    if options.one is not None:
        row = cost(numbers[0], options.repeats) if options.one == "cost" else memory(numbers[0])
        print(json.dumps(row))
        return
    for_memory = [check_particles(n) for n in options.memory]
    if options.repeats < 1:
        raise SystemExit(f"--repeats {options.repeats}: at least one pour is needed")
    core = pin(options.core)
    costs, memories = [], []
    for n in sorted(set(numbers)):
        costs.append(run_self(__file__, f"--particles={n}", "--one=cost", f"--repeats={options.repeats}"))
        say(f"{n} particles: {costs[-1]['cpu_s']:.2f} CPU s")
    for n in sorted(set(for_memory)):
        memories.append(run_self(__file__, f"--particles={n}", "--one=memory"))
        say(f"{n} particles: {memories[-1]['process_mb']:.0f} MB")
    result = {
        "cost": costs,
        "exponent": exponent(costs),
        "memory": memories,
        "repeats": options.repeats,
        "core": core,
        "machine": describe(),
    }
    show(result, options.json)


if __name__ == "__main__":
    main()
