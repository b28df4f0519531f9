"""Measure pours per minute of one batched call against its number of scenes.

    python benchmarks/batches.py [--particles 1000] [--scenes 1 2 4 8 16] [--core 1] [--json]

Each batch has different actions and seeds. The same tasks also run one by one, half before and half after the batch.
The scenes of a batch run one after another, so the ratio should be 1.
"""

from __future__ import annotations

import argparse
import dataclasses
import time
from collections.abc import Callable
from typing import Any

import psutil
from machine import describe, pin, say, show
from standard_pour import check_particles, short_task, standard_task

from sim_engine.action import DEG
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator

SCENES = (1, 2, 4, 8, 16)


def tasks(particles: int, count: int) -> list[PourTask]:
    """Return different pours: speeds from 30 to 45 deg/s, one seed each."""
    pours = []
    for k in range(count):
        task = standard_task(particles, seed=k + 1)
        action = dataclasses.replace(task.action, angular_velocity=(30.0 + 15.0 * k / count) * DEG)
        pours.append(dataclasses.replace(task, action=action))
    return pours


def compare(simulator: PourSimulator, particles: int, count: int) -> dict[str, Any]:
    """Run one batch, and the same pours one by one: half before it, half after."""
    batch = tasks(particles, count)
    half = (count + 1) // 2
    before = clocked(lambda: [simulator.simulate(task) for task in batch[:half]])
    together = clocked(lambda: simulator.simulate_many(batch))
    after = clocked(lambda: [simulator.simulate(task) for task in batch[half:]])
    alone = before[0] + after[0], before[1] + after[1]
    return {
        "scenes": count,
        "cpu_s_per_pour": round(together[0] / count, 3),
        "pours_per_minute": round(60.0 * count / together[1], 1),
        "alone_cpu_s_per_pour": round(alone[0] / count, 3),
        "alone_pours_per_minute": round(60.0 * count / alone[1], 1),
        "cpu_over_alone": round(together[0] / alone[0], 3),
        "process_mb": round(psutil.Process().memory_info().rss / 1e6),
    }


def clocked(run: Callable[[], object]) -> tuple[float, float]:
    """Return the CPU and wall seconds of a call."""
    cpu, wall = time.process_time(), time.perf_counter()
    run()
    return time.process_time() - cpu, time.perf_counter() - wall


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--particles", type=int, default=1000)
    parser.add_argument("--scenes", type=int, nargs="+", help="sizes of the batches")
    parser.add_argument("--core", type=int, help="core to run on; default: the least busy one")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    particles = check_particles(options.particles)
    sizes = options.scenes or SCENES
    if min(sizes) < 1:
        raise SystemExit("--scenes: batches hold one pour or more")
    core = pin(options.core)
    simulator = PourSimulator()
    simulator.simulate(short_task(particles))
    rows = []
    for count in sizes:
        rows.append(compare(simulator, particles, count))
        say(f"{count} scenes: {rows[-1]['pours_per_minute']} pours/min, {rows[-1]['cpu_over_alone']} of one by one")
    simulator.close()
    result = {"particles": particles, "batches": rows, "core": core, "machine": describe()}
    show(result, options.json)


if __name__ == "__main__":
    main()
