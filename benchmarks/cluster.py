"""Measure simulations on several machines: speed-up, a lost node, memory of the driver, scheduler limits.

    python benchmarks/cluster.py scheduler      1,000 workers that answer after a drawn time; needs no Ray
    python benchmarks/cluster.py nodes          Ray clusters of 1 to 3 nodes of one core, on loopback addresses
    python benchmarks/cluster.py page           the tables of docs/laboratory/cluster.md from the figures

Scheduler: the real pool, and a complete run with its journal, execute on an event loop whose time is the CPU time of
its thread plus skipped waits (`skipping_clock`). The figures therefore hold for an otherwise idle core. A worker
prefetches one job, as a Ray actor does. 'Idle' is the time that a worker waits for its next job while jobs are queued.

Nodes: jobs that wait for a second and use no core show the cost of scheduling. Real simulations share the cores of this
machine. For a lost node, the node and all its processes are killed (SIGKILL) in mid-run.

Figures are stored in docs/data/cluster.json.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import os
import pickle
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any, cast

import numpy as np
import psutil
from daemon_page import MARKED, markdown_table
from machine import ROOT, describe, say
from skipping_clock import SkippingLoop
from standard_pour import standard_task

from actors.laboratory import open_laboratory
from actors.laboratory_settings import LaboratorySettings, RaySettings
from actors.simulators.job_runner import Simulator, pour_simulator
from actors.simulators.pool import Greeting, WorkerPool, WorkerReply
from orchestrator.run_service import RunRequest, RunResources, RunService
from orchestrator.study.study_campaigns import campaign_of
from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import GRID, cells_of
from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.scene import PourTask

DATA, PAGE = ROOT / "docs" / "data" / "cluster.json", ROOT / "docs" / "laboratory" / "cluster.md"

WORKERS = (10, 100, 1000)
SIMULATION = 10.0
"""Mean time of a simulation [s]; drawn from a log-normal distribution with σ = 0.5."""

SHORTER = (3.0, 1.0, 0.3)
QUEUED = 10_000

RUNS = ((16, 16), (16, 32), (16, 64), (64, 256), (128, 256), (256, 256))
"""Workers and `parallel_simulations` of complete runs; 256 is the largest."""

WAIT = 1.0
"""Duration of a waiting job [s]."""

PARTICLES, POURS = 500, 12
"""Particles of the real simulations, and their number."""


def outcome(seed: int = 0) -> SimulatedPour:
    """Return an outcome of typical size."""
    curve = tuple(0.02 * k for k in range(200))
    return SimulatedPour(
        PourOutcome(
            1.0, 0.0, 0.0, 0.0, 0.0, 1, 0.01, 0.0, 4.0, 1, 0.0, seed, curve_times=curve, curve_poured=curve,
            curve_spilled=curve,
        )
    )  # fmt: skip


# ---- the scheduler with virtual workers


class VirtualWorker:
    """A `Worker` that answers after a drawn time, one job at a time.

    Args:
        mean: mean time of a job [s].
        seed: seed of the drawn times.
        idle: list that receives the times between two jobs [s].
    """

    def __init__(self, mean: float, seed: int, idle: list[float]) -> None:
        self._rng, self._mean, self._idle = np.random.default_rng(seed), mean, idle
        self._alone, self._ended = asyncio.Lock(), -1.0
        self._begun, self._busy, self._works = 0.0, 0.0, False
        self._answer = outcome()

    def busy(self, now: float) -> float:
        """Return the time spent on jobs until now [s]."""
        return self._busy + (now - self._begun if self._works else 0.0)

    async def start(self) -> Greeting:
        """See `Worker.start`."""
        return Greeting(1)

    async def run(self, number: int, task: PourTask) -> WorkerReply:
        """See `Worker.run`."""
        clock = asyncio.get_running_loop().time
        async with self._alone:
            if self._ended >= 0.0:
                self._idle.append(clock() - self._ended)
            seconds = self._mean * float(self._rng.lognormal(-0.125, 0.5))
            self._begun, self._works = clock(), True
            await asyncio.sleep(seconds)
            self._ended, self._works = clock(), False
            self._busy += self._ended - self._begun
        return WorkerReply(self._answer, seconds)

    def cancel(self, number: int) -> None:
        """See `Worker.cancel`."""

    async def close(self, patience: float) -> None:
        """See `Worker.close`."""


def virtual_pool(workers: int, mean: float, idle: list[float]) -> tuple[WorkerPool, list[VirtualWorker]]:
    """Return a pool of virtual workers, and the workers."""
    made: list[VirtualWorker] = []

    def make() -> VirtualWorker:
        made.append(VirtualWorker(mean, len(made), idle))
        return made[-1]

    return WorkerPool(workers, make, ahead=1, deadline=1e9), made


def skipping(work: Callable[[], Any]) -> Any:
    """Run a coroutine on an event loop that skips waits."""
    with asyncio.Runner(loop_factory=SkippingLoop) as runner:
        return runner.run(work())


async def queue_of(workers: int, mean: float, jobs: int) -> dict[str, Any]:
    """Queue all jobs at once; measure worker efficiency while jobs wait, and scheduling cost."""
    idle: list[float] = []
    pool, made = virtual_pool(workers, mean, idle)
    await pool.pids()
    task = standard_task(2000, 1)
    before = psutil.Process().memory_info().rss
    clock, begun, cpu = asyncio.get_running_loop().time, 0.0, time.thread_time()
    begun = clock()
    waiting = [asyncio.ensure_future(pool.simulate(task)) for _ in range(jobs)]
    await asyncio.sleep(0.0)
    queued = psutil.Process().memory_info().rss
    for answered, _ in enumerate(asyncio.as_completed(waiting), start=1):
        await _
        if answered == jobs - 2 * workers:
            stretch, busy, part = clock() - begun, sum(one.busy(clock()) for one in made), len(idle)
            spent = time.thread_time() - cpu
    await pool.close()
    return {
        "workers": workers,
        "simulation_s": mean,
        "jobs": jobs,
        "answers_per_s": round((jobs - 2 * workers) / stretch, 1),
        "cpu_ms_per_job": round(1e3 * spent / (jobs - 2 * workers), 3),
        "decisions_per_cpu_s": round((jobs - 2 * workers) / spent),
        "idle_ms_median": round(1e3 * statistics.median(idle[:part]), 2),
        "idle_ms_p99": round(1e3 * float(np.quantile(idle[:part], 0.99)), 2),
        "efficiency": round(busy / (stretch * workers), 3),
        "driver_kb_per_queued_job": round((queued - before) / jobs / 1e3, 2),
    }


async def fairness(workers: int, mean: float) -> dict[str, Any]:
    """Time the smaller of two users of a pool until it has all its answers; the other queues ten times as many jobs."""
    pool, _ = virtual_pool(workers, mean, [])
    many, few = pool.share(), pool.share()
    task = standard_task(2000, 1)
    clock = asyncio.get_running_loop().time
    await pool.pids()
    begun = clock()
    large = [asyncio.ensure_future(many.simulate(task)) for _ in range(10 * workers)]
    await asyncio.sleep(0.0)
    await asyncio.gather(*(few.simulate(task) for _ in range(workers)))
    took = clock() - begun
    await asyncio.gather(*large)
    whole = clock() - begun
    await pool.close()
    return {"workers": workers, "few_s": round(took, 1), "all_s": round(whole, 1)}


class VirtualLaboratory:
    """A laboratory with a virtual pool."""

    bench = optimizer = None

    def __init__(self, pool: WorkerPool, spec: LaboratorySettings, need_bench: bool) -> None:
        self.simulators = pool.share()

    async def __aenter__(self) -> VirtualLaboratory:
        return self

    async def __aexit__(self, *exc: object) -> None:
        pass


async def whole_run(workers: int, slots: int, mean: float) -> dict[str, Any]:
    """Run the grid of the paper's study: strategy, stage scheduler, journal, pool.

    Args:
        workers: workers in the pool.
        slots: parallel simulations in the campaign.
        mean: mean time of a simulation [s].
    """
    idle: list[float] = []
    study = load_study(ROOT / "configs" / "studies" / "paper.yaml")
    cell = next(one for one in cells_of(study) if one.id == GRID)
    with tempfile.TemporaryDirectory() as place:
        plan, stages = campaign_of(study, cell, lambda key: {}, Path(place))
        pool, _ = virtual_pool(workers, mean, idle)
        await pool.pids()
        request = RunRequest(replace(plan, parallel_simulations=slots), stages, Path(place))
        handle = RunService().start(request, RunResources(laboratory=partial(VirtualLaboratory, pool)))  # type: ignore[arg-type]
        clock = asyncio.get_running_loop().time
        begun, cpu = clock(), time.thread_time()
        result = await handle.wait()
        took, spent = clock() - begun, time.thread_time() - cpu
        size = sum(path.stat().st_size for path in Path(place).glob("journal*"))
        await pool.close()
        await asyncio.to_thread(handle.close)
    return {
        "workers": workers,
        "slots": slots,
        "simulation_s": mean,
        "simulations": result.simulations,
        "cpu_ms_per_simulation": round(1e3 * spent / result.simulations, 2),
        "simulations_per_cpu_s": round(result.simulations / spent),
        "idle_ms_median": round(1e3 * statistics.median(idle), 2),
        "wall_s_scaled": round(took, 1),
        "ideal_s": round(result.simulations * mean / workers, 1),
        "efficiency": round(result.simulations * mean / workers / took, 3),
        "journal_kb_per_simulation": round(size / result.simulations / 1e3, 2),
    }


def scheduler() -> dict[str, Any]:
    """Run all measurements without Ray."""
    pools, runs = [], []
    for workers in WORKERS:
        say(f"pool of {workers}")
        pools.append(skipping(partial(queue_of, workers, SIMULATION, max(10 * workers, 1000))))
    for mean in SHORTER:
        say(f"pool of {WORKERS[-1]}, simulations of {mean:g} s")
        pools.append(skipping(partial(queue_of, WORKERS[-1], mean, QUEUED)))
    for workers, slots in RUNS:
        say(f"run on {workers} workers")
        runs.append(skipping(partial(whole_run, workers, slots, SIMULATION)))
    return {
        "pool": pools,
        "run": runs,
        "fair": skipping(partial(fairness, 100, SIMULATION)),
        "task_kb": round(len(pickle.dumps(standard_task(2000, 1))) / 1e3, 2),
        "outcome_kb": round(len(pickle.dumps(outcome())) / 1e3, 2),
    }


# ---- Ray clusters


class Waiting:
    """A simulator that only waits.

    Args:
        seconds: duration [s].
    """

    def __init__(self, seconds: float) -> None:
        self._seconds = seconds

    def simulate(self, task: PourTask, *, cancelled: Any = None) -> SimulatedPour:
        """Wait, then return an outcome."""
        time.sleep(self._seconds)
        return outcome(task.seed)

    def close(self) -> None:
        """Do nothing; there is nothing to close."""


async def drive(address: str, kind: str, jobs: int) -> None:
    """Use a cluster as a client program; print one line of JSON per event."""
    import ray

    ray.cloudpickle.register_pickle_by_value(sys.modules[__name__])
    seconds = {"wait": WAIT, "nothing": 0.0, "queue": WAIT}.get(kind)
    make: Callable[[], Simulator] = pour_simulator if seconds is None else partial(Waiting, seconds)
    spec = LaboratorySettings(name="benchmark", ray=RaySettings(address=address))
    laboratory: Any = open_laboratory(spec, need_bench=False, make=make)
    async with laboratory:
        laboratory.listen(lambda notice: print(json.dumps({"notice": notice.text, "at": time.time()}), flush=True))
        pool = cast(WorkerPool, laboratory.simulators)
        size = len(await pool.pids())
        tasks = [standard_task(PARTICLES, 1)] * jobs
        first = [asyncio.ensure_future(pool.simulate(task)) for task in tasks[: 2 * size]]
        await asyncio.gather(*first)  # kernels, first calls
        process = psutil.Process()
        before, cpu = process.memory_info().rss, sum(process.cpu_times()[:2])
        busy, begun = pool.statistics().busy_s, time.time()
        print(json.dumps({"begun": begun, "workers": size}), flush=True)
        waiting = [asyncio.ensure_future(pool.simulate(task)) for task in tasks]
        if kind == "queue":
            await asyncio.sleep(3.0)
            memory = process.memory_info().rss - before
            for one in waiting:
                one.cancel()
            await asyncio.wait(waiting)
            print(json.dumps({"memory_mb": memory / 1e6, "rss_mb": process.memory_info().rss / 1e6}), flush=True)
            return
        answers = []
        for answer in asyncio.as_completed(waiting):
            await answer
            answers.append(time.time() - begun)
        spent = sum(process.cpu_times()[:2]) - cpu
        found = {"wall_s": answers[-1], "answers": answers, "busy_s": pool.statistics().busy_s - busy}
        print(json.dumps({**found, "driver_cpu_s": spent, "workers": size}), flush=True)


def driven(cluster: Any, kind: str, jobs: int, *, kill: int | None = None, after: float = 0.0) -> dict[str, Any]:
    """Run `drive` on a cluster; return its last line and, for a killed node, the time until the loss was reported.

    Args:
        cluster: `tests.support.local_cluster.LocalCluster`.
        kill: node to kill.
        after: time from the first job to the kill [s].
    """
    process = subprocess.Popen(
        [sys.executable, __file__, "--drive", cluster.address, kind, str(jobs)],
        env={**cluster.environment, "PYTHONPATH": f"{ROOT}{os.pathsep}{ROOT / 'benchmarks'}"},
        stdout=subprocess.PIPE,
        text=True,
    )
    lines: list[dict[str, Any]] = []
    killed = 0.0
    assert process.stdout is not None
    try:
        for line in process.stdout:
            if not line.startswith("{"):
                continue
            lines.append(json.loads(line))
            if "begun" in lines[-1] and kill is not None:
                time.sleep(after)
                cluster.kill_node(kill)
                killed = time.time()
        if process.wait(120.0) != 0 or not lines:
            raise SystemExit(f"{kind}: ended with {process.returncode}")
    finally:
        with contextlib.suppress(ProcessLookupError):
            process.kill()
    lost = next((one["at"] - killed for one in lines if killed and "is lost" in one.get("notice", "")), None)
    return {**lines[-1], **({} if lost is None else {"noticed_s": round(lost, 1)})}


def nodes(real: bool) -> dict[str, Any]:
    """Run all measurements on Ray clusters of this machine."""
    sys.path.insert(0, str(ROOT))
    from tests.support.local_cluster import LocalCluster

    rows: list[dict[str, Any]] = []
    found: dict[str, Any] = {"load before": [round(one, 1) for one in psutil.getloadavg()]}
    with LocalCluster() as cluster:
        cluster.start_node(cpus=0)
        for count in (1, 2, 3):
            say(f"{count} node(s)")
            cluster.start_node(cpus=1)
            jobs = 40
            waited = driven(cluster, "wait", jobs)
            rows.append(row("waiting", count, jobs, waited, WAIT))
            if real and count < 3:
                pours = driven(cluster, "real", POURS)
                rows.append(row("simulation", count, POURS, pours, pours["busy_s"] / POURS))
            if count == 1:
                queue = driven(cluster, "queue", QUEUED)
                found["queue"] = {"jobs": QUEUED, "memory_mb": round(queue["memory_mb"], 1)}
        say("calls")
        calls = driven(cluster, "nothing", 1500)
        found["calls"] = {
            "per_s": round(1500 / calls["wall_s"]),
            "driver_cpu_ms": round(1e3 * calls["driver_cpu_s"] / 1500, 3),
            "per_driver_cpu_s": round(1500 / calls["driver_cpu_s"]),
        }
        say("a lost node")
        jobs, after = 60, 8.0
        lost = driven(cluster, "wait", jobs, kill=3, after=after)
        # the node's work until it was killed, plus that of the two others
        ideal = after + (jobs * WAIT - 3 * after) / 2.0
        found["lost"] = {
            "jobs": jobs,
            "wall_s": round(lost["wall_s"], 1),
            "ideal_s": round(ideal, 1),
            "lost_s": round(lost["wall_s"] - ideal, 1),
            "noticed_s": lost.get("noticed_s"),
        }
    first = {one["kind"]: one for one in reversed(rows)}
    for one in rows:
        one["speed_up"] = round(first[one["kind"]]["wall_s"] / one["wall_s"], 2)
        one["efficiency"] = round(one["speed_up"] / one["nodes"], 3)
    return {**found, "nodes": rows}


def row(kind: str, count: int, jobs: int, found: dict[str, Any], each: float) -> dict[str, Any]:
    """Return one row of speed-ups."""
    return {
        "kind": kind,
        "nodes": count,
        "jobs": jobs,
        "each_s": round(each, 2),
        "wall_s": round(found["wall_s"], 2),
        "busy": round(found["busy_s"] / (count * found["wall_s"]), 3),
    }


# ---- the page


def keep(name: str, found: dict[str, Any]) -> None:
    """Store the measured figures."""
    figures = json.loads(DATA.read_text(encoding="utf-8")) if DATA.is_file() else {}
    figures[name] = {**found, "machine": describe(), "command": f"python benchmarks/cluster.py {name}"}
    DATA.write_text(json.dumps(figures, indent=1) + "\n", encoding="utf-8")


def render(page: str, figures: dict[str, Any]) -> str:
    """Return the page with updated tables; tables without figures stay unchanged."""

    def shown(match: Any) -> str:
        found = figures.get(match[2].removeprefix("cluster-"))
        return str(match[0]) if found is None else f"{match[1]}{TABLES[match[2]](found)}{match[3]}"

    return MARKED.sub(shown, page)


def nodes_table(found: dict[str, Any]) -> str:
    """Return the table of speed-up and efficiency by number of nodes."""
    rows = [
        (
            *(one[key] for key in ("kind", "nodes", "jobs", "each_s", "wall_s", "speed_up")),
            f"{100 * one['efficiency']:.0f} %",
            f"{100 * one['busy']:.0f} %",
        )
        for one in sorted(found["nodes"], key=lambda one: (one["kind"] != "waiting", one["nodes"]))
    ]
    head = (
        "job",
        "nodes of one core",
        "jobs",
        "each [s]",
        "wall time [s]",
        "speed-up",
        "efficiency",
        "simulators busy",
    )
    calls, lost, queue = found["calls"], found["lost"], found["queue"]
    return (
        markdown_table(head, rows)
        + f"\n- A node killed in the middle of {lost['jobs']} waiting jobs on three nodes: {lost['wall_s']} s, where "
        f"{lost['ideal_s']} s are possible: {lost['lost_s']} s lost. The program reported the loss after "
        f"{lost['noticed_s']} s.\n"
        f"- {queue['jobs']:,} queued simulations need {queue['memory_mb']} MB in the program.\n"
        f"- A call through Ray takes {calls['driver_cpu_ms']} ms of the program's core, so at most "
        f"{calls['per_driver_cpu_s']} answers per second; {calls['per_s']} per second were reached here.\n"
        f"\n<sub>{found['machine']['processor']}, {found['machine']['cores']} cores shared by all nodes and other "
        f"work, load {found['load before'][0]} beforehand: `{found['command']}`, {found['machine']['date']}</sub>\n"
    )


def scheduler_table(found: dict[str, Any]) -> str:
    """Return the tables of scheduler speed, by workers and duration."""
    rows = [
        (
            f"{one['workers']:,}",
            one["simulation_s"],
            one["answers_per_s"],
            one["cpu_ms_per_job"],
            one["idle_ms_median"],
            one["idle_ms_p99"],
            f"{100 * one['efficiency']:.1f} %",
        )
        for one in found["pool"]
    ]
    head = (
        "workers", "simulation [s]", "answers per s", "core time per answer [ms]", "idle, median [ms]",
        "idle, 99 % below [ms]", "efficiency",
    )  # fmt: skip
    runs = [
        (one["workers"], one["slots"], one["cpu_ms_per_simulation"], one["journal_kb_per_simulation"],
         one["wall_s_scaled"], f"{100 * one['efficiency']:.0f} %")
        for one in found["run"]
    ]  # fmt: skip
    head_run = (
        "workers", "parallel_simulations", "core time each [ms]", "journal each [kB]", "scaled time [s]", "efficiency",
    )  # fmt: skip
    fair = found["fair"]
    return (
        "The pool alone:\n\n"
        + markdown_table(head, rows)
        + f"\nA whole run with strategy and journal, {found['run'][0]['simulations']:,} simulations of "
        f"{found['run'][0]['simulation_s']:g} s (the grid of the paper's study):\n\n"
        + markdown_table(head_run, runs)
        + f"\n- A task is {found['task_kb']} kB, an outcome {found['outcome_kb']} kB.\n"
        f"- Two runs share {fair['workers']} workers, and one of them has queued ten times as much: the other one has "
        f"its answers after {fair['few_s']} s of {fair['all_s']} s.\n"
        f"\n<sub>{found['machine']['processor']}: `{found['command']}`, {found['machine']['date']}</sub>\n"
    )


TABLES: dict[str, Callable[[dict[str, Any]], str]] = {
    "cluster-nodes": nodes_table,
    "cluster-scheduler": scheduler_table,
}


def write_page() -> None:
    """Update the tables of the page."""
    figures = json.loads(DATA.read_text(encoding="utf-8"))
    PAGE.write_text(render(PAGE.read_text(encoding="utf-8"), figures), encoding="utf-8")


def main(arguments: Sequence[str] | None = None) -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("scheduler", "nodes", "page"), nargs="?", default="scheduler")
    parser.add_argument("--no-simulations", action="store_true", help="only jobs that wait")
    parser.add_argument("--drive", nargs=3, metavar=("ADDRESS", "KIND", "JOBS"), help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.drive is not None:
        address, kind, jobs = options.drive
        asyncio.run(drive(address, kind, int(jobs)))
        return
    if options.what != "page":
        found = scheduler() if options.what == "scheduler" else nodes(not options.no_simulations)
        print(json.dumps(found, indent=1))
        keep(options.what, found)
    write_page()


if __name__ == "__main__":
    main()
