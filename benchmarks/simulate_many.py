"""Measure `decant.simulate_many` against `decant.simulate`, one action after the other.

    python benchmarks/simulate_many.py [--workers 2] [--actions 24] [--rounds 3] [--json]

Both make the same simulations of the shipped quickstart in alternation; medians over the rounds. `set_up_s` is the time
of the first call of a program less that of the second one: the processes start in the first one only.

`speed_up` compares wall times, so that the machine must be idle. `cpu_speed_up` does not need that: it is the CPU time
of the serial calls over the shortest time of the batch on as many cores as it has workers. That is the CPU time of its
busiest process, or of all its processes divided by the cores, whichever is longer.
"""

from __future__ import annotations

import argparse
import statistics
import time
from collections.abc import Callable
from typing import Any

import psutil
from machine import describe, show

import decant


def actions(count: int) -> list[dict[str, str | float]]:
    """Actions all over the quickstart's range."""
    return [
        {"angular_velocity": 50 + 90 * (7 * k % count) / count, "x_offset": 97 + 50 * k / count} for k in range(count)
    ]


def cpu_times() -> tuple[float, dict[int, float]]:
    """CPU time of this process, and of each of its children [s]."""
    children = psutil.Process().children(recursive=True)
    return time.process_time(), {child.pid: sum(child.cpu_times()[:2]) for child in children}


def measured(work: Callable[[], object]) -> tuple[float, float, list[float]]:
    """Wall time, CPU time of this process, and of its children [s]."""
    own, workers = cpu_times()
    begun = time.perf_counter()
    work()
    wall = time.perf_counter() - begun
    own_after, workers_after = cpu_times()
    return wall, own_after - own, [cpu - workers.get(pid, 0.0) for pid, cpu in workers_after.items()]


def measure(options: argparse.Namespace) -> dict[str, Any]:
    """Return the medians of all rounds."""
    campaign, chosen = decant.load_campaign(decant.shipped("campaigns/quickstart.yaml")), actions(options.actions)
    first, _, _ = measured(lambda: decant.simulate(campaign, chosen[0]))
    second, _, _ = measured(lambda: decant.simulate(campaign, chosen[0]))
    decant.simulate_many(campaign, chosen[: 2 * options.workers], workers=options.workers)
    speed_ups, cpu_speed_ups = [], []
    for _ in range(options.rounds):
        wall, own, workers = measured(lambda: [decant.simulate(campaign, action) for action in chosen])
        wall_many, own_many, workers_many = measured(
            lambda: decant.simulate_many(campaign, chosen, workers=options.workers)
        )
        speed_ups.append(wall / wall_many)
        shortest = max(own_many, *workers_many, (own_many + sum(workers_many)) / options.workers)
        cpu_speed_ups.append((own + sum(workers)) / shortest)
    return {
        "workers": options.workers,
        "actions": options.actions,
        "set_up_s": first - second,
        "second_call_s": second,
        "speed_up": statistics.median(speed_ups),
        "cpu_speed_up": statistics.median(cpu_speed_ups),
    }


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--actions", type=int, default=24)
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--json", action="store_true")
    options = parser.parse_args()
    results = measure(options)
    show(results | {"machine": describe()}, as_json=options.json)


if __name__ == "__main__":
    main()
