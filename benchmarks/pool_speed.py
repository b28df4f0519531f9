"""Measure the worker pool's overhead against plain processes, its load, and the time to the first outcome.

    python benchmarks/pool_speed.py [--workers 2] [--particles 2000] [--pours 8] [--rounds 3] [--json]

Throughput: the pool and an equal number of plain processes without Ray make the same pours alternately in one session;
medians over the rounds. Overhead per simulation: (wall time × workers − time reported by the workers) / simulations,
with very small pours and with a simulator that does nothing. Busy fraction: time reported by the workers / (wall time ×
workers). Both end when the first worker runs out of work. Start: new processes with a warm kernel cache, from opening
the laboratory to the first outcome.

Run it on an idle machine: plain processes and pool alternate, but other load does not.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import statistics
import subprocess
import sys
import time
from dataclasses import dataclass
from typing import Any, cast

import psutil
from machine import describe, run_self, say, show, single_threaded
from standard_pour import check_particles, short_task, standard_task

from actors.laboratory import RayLaboratory
from actors.laboratory_settings import LaboratorySettings
from actors.simulators.pool import WorkerPool
from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.scene import PourTask

TINY = 200
"""Particles of a very small pour."""

THROUGHPUT_LIMIT, OVERHEAD_LIMIT_MS = 0.95, 10.0
"""Required throughput of the pool relative to plain processes, and largest overhead per simulation."""


@dataclass(frozen=True)
class Block:
    """A set of pours made together.

    Attributes:
        wall_s: time from the first task to the last outcome.
        cpu_s: CPU seconds of the workers.
        beside_s: CPU seconds of all other processes involved.
        busy: busy fraction of the workers, while there was work for all of them.
        between_s: the remaining time per simulation.
    """

    wall_s: float
    cpu_s: float
    beside_s: float = 0.0
    busy: float = 1.0
    between_s: float = 0.0


class Nothing:
    """A simulator that returns at once."""

    def simulate(self, task: PourTask, *, cancelled: Any = None) -> SimulatedPour:
        """Return an outcome of typical size."""
        curve = tuple(0.02 * k for k in range(200))
        outcome = PourOutcome(
            1.0, 0.0, 0.0, 0.0, 0.0, 1, 0.01, 0.0, 4.0, 1, 0.0, task.seed, curve_times=curve, curve_poured=curve,
            curve_spilled=curve,
        )  # fmt: skip
        return SimulatedPour(outcome)

    def close(self) -> None:
        """Do nothing; there is nothing to close."""


class Plain:
    """Processes without Ray that share the requested pours."""

    def __init__(self, workers: int) -> None:
        command = [sys.executable, __file__, "--plain"]
        self._processes = [
            subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=single_threaded())
            for _ in range(workers)
        ]
        self.pour(TINY, workers)

    def pour(self, particles: int, pours: int) -> Block:
        """Make this number of pours, distributed evenly."""
        begun = time.perf_counter()
        cpu = 0.0
        try:
            for k, process in enumerate(self._processes):
                seeds = list(range(k, pours, len(self._processes)))
                assert process.stdin is not None
                process.stdin.write(json.dumps({"particles": particles, "seeds": seeds}) + "\n")
                process.stdin.flush()
            for process in self._processes:
                assert process.stdout is not None
                cpu += float(process.stdout.readline())
        except (OSError, ValueError):
            ends = [process.wait(timeout=10.0) for process in self._processes if process.poll() is not None]
            raise SystemExit(f"a plain process has ended with {ends}; nothing to compare the pool with") from None
        return Block(time.perf_counter() - begun, cpu)

    def close(self) -> None:
        """End the processes."""
        for process in self._processes:
            process.communicate(timeout=60)


def plain_worker() -> None:
    """Run in a plain process: read orders line by line, return CPU seconds."""
    from sim_engine.simulator import PourSimulator

    simulator = PourSimulator()
    simulator.simulate(short_task(TINY))
    for line in sys.stdin:
        order = json.loads(line)
        begun = time.process_time()
        for seed in order["seeds"]:
            simulator.simulate(standard_task(order["particles"], seed))
        print(time.process_time() - begun, flush=True)
    simulator.close()


async def pour_in_pool(pool: WorkerPool, particles: int, pours: int) -> Block:
    """Make this number of pours, all queued at once."""
    workers, others = await _processes(pool)
    before = [_cpu(workers), _cpu(others) + time.process_time()]
    worked, begun = pool.statistics().busy_s, time.perf_counter()
    jobs = [asyncio.ensure_future(pool.simulate(standard_task(particles, seed))) for seed in range(pours)]
    full = pours - pool.size + 1  # after this outcome the first worker runs out of work
    for answered, job in enumerate(asyncio.as_completed(jobs), start=1):
        await job
        if answered == full:
            stretch = (time.perf_counter() - begun) * pool.size
            worked = pool.statistics().busy_s - worked
    wall = time.perf_counter() - begun
    after = [_cpu(workers), _cpu(others) + time.process_time()]
    idle = max(stretch - worked, 0.0)
    return Block(wall, after[0] - before[0], after[1] - before[1], 1.0 - idle / stretch, idle / full)


async def _processes(pool: WorkerPool) -> tuple[list[psutil.Process], list[psutil.Process]]:
    """Return the pool's worker processes and Ray's other processes."""
    members = [psutil.Process(pid) for pid in await pool.pids()]
    others = []
    for process in psutil.Process().children(recursive=True):
        with contextlib.suppress(psutil.Error):  # ended meanwhile
            if process not in members and "pool_speed" not in " ".join(process.cmdline()):
                others.append(process)
    return members, others


def _cpu(processes: list[psutil.Process]) -> float:
    total = 0.0
    for process in processes:
        with contextlib.suppress(psutil.Error):
            times = process.cpu_times()
            total += times.user + times.system
    return total


async def throughput(options: argparse.Namespace) -> dict[str, Any]:
    """Measure pool and plain processes alternately, and the pool's overhead with very small pours."""
    plain = Plain(options.workers)
    spec = LaboratorySettings(name="benchmark", simulators=options.workers)
    async with RayLaboratory(spec) as laboratory:
        pool = cast(WorkerPool, laboratory.simulators)
        await pour_in_pool(pool, TINY, 2 * options.workers)
        rounds: list[tuple[Block, Block]] = []
        for number in range(options.rounds):
            say(f"round {number + 1} of {options.rounds}")
            if number % 2 == 0:
                ours = await pour_in_pool(pool, options.particles, options.pours)
                theirs = await asyncio.to_thread(plain.pour, options.particles, options.pours)
            else:
                theirs = await asyncio.to_thread(plain.pour, options.particles, options.pours)
                ours = await pour_in_pool(pool, options.particles, options.pours)
            rounds.append((ours, theirs))
        say("tiny pours")
        tiny = [await pour_in_pool(pool, TINY, options.tiny) for _ in range(options.rounds)]
    plain.close()
    ratio = statistics.median(theirs.wall_s / ours.wall_s for ours, theirs in rounds)
    overheads = [1e3 * block.between_s for block in tiny]
    return {
        "throughput_ratio": round(ratio, 3),
        "throughput_met": ratio >= THROUGHPUT_LIMIT,
        "throughput_ratio_by_cpu": round(statistics.median(b.cpu_s / a.cpu_s for a, b in rounds), 3),
        "pours_per_minute_pool": round(60 * statistics.median(options.pours / a.wall_s for a, _ in rounds), 1),
        "pours_per_minute_plain": round(60 * statistics.median(options.pours / b.wall_s for _, b in rounds), 1),
        "busy_fraction": round(statistics.median(a.busy for a, _ in rounds), 4),
        "cpu_beside_the_workers": round(statistics.median(a.beside_s / a.cpu_s for a, _ in rounds), 4),
        "tiny_pour_ms": round(1e3 * statistics.median(block.cpu_s for block in tiny) / options.tiny, 1),
        "overhead_ms": round(statistics.median(overheads), 2),
        "overhead_met": statistics.median(overheads) <= OVERHEAD_LIMIT_MS,
        "rounds": [
            {"pool_wall_s": round(a.wall_s, 2), "plain_wall_s": round(b.wall_s, 2),
             "pool_cpu_s": round(a.cpu_s, 2), "plain_cpu_s": round(b.cpu_s, 2), "busy": round(a.busy, 4)}
            for a, b in rounds
        ],
    }  # fmt: skip


async def nothing(options: argparse.Namespace) -> dict[str, Any]:
    """Measure the pool with a simulator that does nothing: many jobs at once, and one after the other."""
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    spec = LaboratorySettings(name="benchmark", simulators=options.workers)
    async with RayLaboratory(spec, make=Nothing) as laboratory:
        pool = cast(WorkerPool, laboratory.simulators)
        await pour_in_pool(pool, TINY, 10 * options.workers)
        many = await pour_in_pool(pool, TINY, 1000)
        latencies = []
        for seed in range(100):
            begun = time.perf_counter()
            await pool.simulate(standard_task(TINY, seed))
            latencies.append(time.perf_counter() - begun)
    return {
        "empty_simulations_per_s": round(1000 / many.wall_s),
        "empty_overhead_ms": round(1e3 * many.between_s, 2),
        "empty_round_trip_ms": round(1e3 * statistics.median(latencies), 2),
    }


async def first_answer(particles: int, begun: float) -> dict[str, float]:
    """Return the time of each phase of a new process up to a laboratory's first outcome [s].

    Args:
        particles: N.
        begun: `time.monotonic()` at the process's start, by its parent's clock.
    """
    marks = {"program": time.monotonic()}
    async with RayLaboratory(LaboratorySettings(name="benchmark", simulators=1)) as laboratory:
        marks["ray"] = time.monotonic()
        pool = cast(WorkerPool, laboratory.simulators)
        await pool.pids()
        marks["process"] = time.monotonic()
        await pool.simulate(standard_task(particles, 1))
        marks["answer"] = time.monotonic()
        await pool.simulate(standard_task(particles, 1))
        pour = time.monotonic() - marks["answer"]
    return {
        "imports of the program": marks["program"] - begun,
        "Ray": marks["ray"] - marks["program"],
        "simulator's process": marks["process"] - marks["ray"],
        "imports, engine, vessels, kernels": marks["answer"] - marks["process"] - pour,
        "pour": pour,
        "first answer after opening": marks["answer"] - marks["program"],
    }


def start(options: argparse.Namespace) -> dict[str, Any]:
    """Run new processes one after the other; return medians. The previous pools have filled the kernel cache."""
    runs = []
    for number in range(options.rounds):
        say(f"start {number + 1} of {options.rounds}")
        arguments = ("--first-answer", str(time.monotonic()), "--particles", str(options.particles))
        runs.append(run_self(__file__, *arguments))
    return {name: round(statistics.median(run[name] for run in runs), 2) for name in runs[0]}


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--particles", type=int, default=2000)
    parser.add_argument("--pours", type=int, default=8, help="pours per round, on each side")
    parser.add_argument("--rounds", type=int, default=3)
    parser.add_argument("--tiny", type=int, default=60, help="very small pours per round")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--plain", action="store_true", help=argparse.SUPPRESS)
    parser.add_argument("--first-answer", type=float, help=argparse.SUPPRESS)
    options = parser.parse_args()
    check_particles(options.particles)
    if min(options.workers, options.rounds, options.tiny) < 1 or options.pours % options.workers:
        raise SystemExit("--workers, --rounds and --tiny need at least 1, and --pours a multiple of --workers")
    if options.plain:
        plain_worker()
        return
    if options.first_answer is not None:
        print(json.dumps(asyncio.run(first_answer(options.particles, options.first_answer))))
        return
    settings = {"workers": options.workers, "particles": options.particles, "pours": options.pours}
    measured = {**asyncio.run(throughput(options)), **asyncio.run(nothing(options))}
    show({**settings, **measured, "start_s": start(options), "machine": describe()}, options.json)


if __name__ == "__main__":
    main()
