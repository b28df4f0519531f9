"""Measure CPU seconds of the standard pour, alone or compared with the fastest peer.

    python benchmarks/pour_speed.py --particles 2000 [--repeats 3] [--core 1] [--json]
    python benchmarks/pour_speed.py --particles 2000 --peer [RUNS]

Both use one thread on one core and alternate. Set-up is excluded: a short pour compiles kernels (or loads them from the
cache) before the measurement, and the peer's first step, which samples its walls, is not counted. Decant's pour ends
when nothing can change any more, after at most 6 s. The peer always simulates 6 s, so the ratio is also given per
simulated second. Outflow, delivery and density are measured in the same way. The peer and the standard pour have no
surface tension; the cost of Decant's default cohesion is measured as well.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Iterator
from typing import Any

import peer
from machine import describe, pin, say, show
from peer import PeerRun
from standard_pour import END, TIMES, Measured, check_particles, measure, short_task

from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator


def turns(ours: int, theirs: int) -> Iterator[str]:
    """Yield 'ours' and 'theirs', alternating as evenly as possible."""
    done = {"ours": 0, "theirs": 0}
    total = {"ours": ours, "theirs": theirs}
    while done != total:
        name = min((k for k in total if done[k] < total[k]), key=lambda k: (done[k] + 0.5) / total[k])
        done[name] += 1
        yield name


def of_ours(particles: int, runs: list[Measured]) -> dict[str, Any]:
    """Return the figures of our runs: medians over the seeds."""
    middle = sorted(runs, key=lambda run: run.cpu_s)[len(runs) // 2]
    cpu_s = statistics.median(run.cpu_s for run in runs)
    simulated = particles // (1 + middle.outcome.mirrored)
    rates = [simulated * run.iterations / run.cpu_s for run in runs]
    left = [statistics.mean(values) for values in zip(*(run.left for run in runs), strict=True)]
    return {
        "mirrored": middle.outcome.mirrored,
        "cpu_s": round(cpu_s, 3),
        "cpu_s_of_each": [round(run.cpu_s, 3) for run in runs],
        "wall_s": round(statistics.median(run.wall_s for run in runs), 3),
        "steps": middle.outcome.steps,
        "iterations": middle.iterations,
        "iterations_per_step": round(middle.iterations / middle.outcome.steps, 2),
        "particle_iterations_per_s": round(statistics.median(rates)),
        "simulated_time_s": round(statistics.median(run.outcome.simulated_time for run in runs), 3),
        **_physics(left, [run.outcome.received for run in runs], [run.density for run in runs]),
        "density_error": round(statistics.mean(run.outcome.density_error for run in runs), 4),
        "repeats": len(runs),
    }


def of_theirs(particles: int, runs: list[PeerRun]) -> dict[str, Any]:
    """Return the figures of the peer's runs: medians over the seeds."""
    middle = sorted(runs, key=lambda run: run.cpu_s)[len(runs) // 2]
    left = [statistics.mean(values) for values in zip(*(run.left for run in runs), strict=True)]
    cpu_s = statistics.median(run.cpu_s for run in runs)
    return {
        "name": f"{peer.NAME} {peer.VERSION}, DFSPH with volume maps",
        "cpu_s": round(cpu_s, 3),
        "cpu_s_of_each": [round(run.cpu_s, 3) for run in runs],
        "steps": middle.steps,
        "iterations": middle.iterations,
        "iterations_per_step": round(middle.iterations / middle.steps, 2),
        "particle_iterations_per_s": round(particles * middle.iterations / middle.cpu_s),
        "simulated_time_s": END,
        **_physics(left, [run.delivered for run in runs], [run.density for run in runs]),
        "repeats": len(runs),
    }


def _physics(left: list[float], received: list[float], densities: list[float]) -> dict[str, Any]:
    return {
        "left": {f"{t:g} s": round(value, 3) for t, value in zip(TIMES, left, strict=True)},
        "delivered": round(statistics.mean(received), 4),
        "delivered_of_each": [round(value, 4) for value in received],
        "density_at_rest": round(statistics.mean(densities), 4),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--repeats", type=_at_least_one, default=3, help="number of our pours, each with another seed")
    parser.add_argument(
        "--peer",
        type=_at_least_one,
        nargs="?",
        const=1,
        default=0,
        metavar="RUNS",
        help=f"also run {peer.NAME} this number of times (once without a number)",
    )
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    particles = check_particles(options.particles)
    python = None
    if options.peer:
        peer.check_particles(particles)
        python = peer.environment()
    core = pin(options.core)

    simulator = PourSimulator()
    begun = time.perf_counter()
    simulator.simulate(short_task(particles))
    first = time.perf_counter() - begun
    ours: list[Measured] = []
    whole: list[Measured] = []
    tense: list[Measured] = []
    theirs: list[PeerRun] = []
    for turn in turns(options.repeats, options.peer):
        if turn == "ours":
            ours.append(measure(simulator, particles, seed=len(ours) + 1, mirrored=True))
            whole.append(measure(simulator, particles, seed=len(ours)))
            tense.append(measure(simulator, particles, len(ours), SimulationParameters().cohesion, mirrored=True))
            say(f"ours, seed {len(ours)}: {ours[-1].cpu_s:.2f} CPU s, whole {whole[-1].cpu_s:.2f} CPU s")
        elif python is not None:
            say(f"{peer.NAME}, seed {len(theirs) + 1}: running")
            theirs.append(peer.pour(python, particles, seed=len(theirs) + 1))
            say(f"{peer.NAME}, seed {len(theirs)}: {theirs[-1].cpu_s:.2f} CPU s")
    result: dict[str, Any] = {"particles": particles, **of_ours(particles, ours), "first_pour_s": round(first, 2)}
    result["with_cohesion"] = {
        "cohesion": SimulationParameters().cohesion,
        "cpu_s": round(statistics.median(run.cpu_s for run in tense), 3),
        "left": [round(statistics.mean(values), 3) for values in zip(*(run.left for run in tense), strict=True)],
    }
    result["whole"] = of_ours(particles, whole)
    if theirs:
        result["peer"] = of_theirs(particles, theirs)
        for figures in (result, result["whole"]):
            figures["ratio"] = round(result["peer"]["cpu_s"] / figures["cpu_s"], 2)
            per_second = figures["simulated_time_s"] / END
            figures["ratio_per_simulated_second"] = round(figures["ratio"] * per_second, 2)
    result["core"] = core
    result["machine"] = describe()
    simulator.close()
    show(result, options.json)


def _at_least_one(text: str) -> int:
    if not text.isdigit() or int(text) < 1:
        raise argparse.ArgumentTypeError(f"{text!r} is not a whole number of 1 or more")
    return int(text)


if __name__ == "__main__":
    main()
