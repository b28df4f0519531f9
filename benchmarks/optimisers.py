"""Compare Decant's optimiser with others on the same problems: regret of the reported result.

    python benchmarks/optimisers.py [--problems spill2 narrow2 ...] [--optimisers Decant "BoTorch UCB" ...] [--seeds 30]
                                    [--budget SECONDS] [--fresh NAME ...] [--speed] [--json]

All optimisers have the same initial points, noise and number of evaluations (`optimiser_problems.py`). 'Reported' is
the result an optimiser returns to its user, evaluated without noise: the best posterior mean for Decant and BoTorch,
otherwise the lowest observation. 'Visited' is the best evaluated point. Means have 95 % bootstrap intervals over seeds.

The other optimisers are not dependencies of Decant. They run in their own environment in the cache directory, created
on first use (about 1 GB). Each run of (problem, optimiser, seed) is stored there too, so an interrupted comparison
continues. `--budget` limits each optimiser's CPU seconds; `--fresh` discards stored runs of the named optimisers.
`--speed` measures the cost of a fit and a suggestion instead.
"""

from __future__ import annotations

import argparse
import json
import shutil
import statistics
import subprocess
import sys
import time
import venv
from collections.abc import Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe, pin, say, show, single_threaded
from optimiser_problems import BY_NAME, PROBLEMS, Instance
from optimiser_rivals import RIVALS, luckiest, play

from actors.optimizer.feasible_region import Region
from actors.optimizer.questions import Data, MinimumQuery, PourQuery, SpaceFillingQuery, SuggestionQuery
from actors.optimizer.suggest import propose
from actors.runtime.child_process import child_environment
from sim_engine.resources import cache_directory
from sim_engine.search_space import Axis, Space

REQUIREMENTS = ("scikit-optimize==0.10.2", "bayesian-optimization==3.4.0", "torch==2.13.0", "botorch==0.18.0")
RIVALS_FILE = Path(__file__).with_name("optimiser_rivals.py")
OURS = ("Decant", "random search", "Sobol")
RESAMPLES = 4000


def environment() -> Path:
    """Return the Python of the other optimisers' environment, creating it if needed.

    Raises:
        SystemExit: the environment cannot be created; the message has pip's output.
    """
    folder = cache_directory() / f"rivals-1-py{sys.version_info[0]}.{sys.version_info[1]}"
    python = folder / ("Scripts/python.exe" if sys.platform == "win32" else "bin/python")
    ready = folder / "ready"
    if ready.exists():
        return python
    say(f"making an environment for {', '.join(REQUIREMENTS)} in {folder} (once)")
    shutil.rmtree(folder, ignore_errors=True)
    venv.create(folder, with_pip=True)
    command = [str(python), "-m", "pip", "install", "--quiet", "--disable-pip-version-check", *REQUIREMENTS]
    done = subprocess.run(command, check=False, capture_output=True, text=True, env=child_environment())
    if done.returncode != 0:
        raise SystemExit(f"the others can't be installed; pip says:\n{done.stderr.strip()}")
    ready.touch()
    return python


class Kept:
    """Results in the cache, one line of JSON each, appended when they arrive."""

    def __init__(self) -> None:
        self._path = cache_directory() / "optimisers.jsonl"
        lines = self._path.read_text(encoding="utf-8").splitlines() if self._path.exists() else []
        self.rows: dict[tuple[str, str, int], dict[str, Any]] = {}
        for line in lines:
            row = json.loads(line)
            self.rows[row["optimiser"], row["problem"], row["seed"]] = row

    def add(self, optimiser: str, row: dict[str, Any]) -> None:
        """Store one more result."""
        row = {"optimiser": optimiser, **row}
        self.rows[optimiser, row["problem"], row["seed"]] = row
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(row) + "\n")

    def forget(self, optimisers: Sequence[str]) -> None:
        """Discard the stored results of some optimisers."""
        self.rows = {key: row for key, row in self.rows.items() if key[0] not in optimisers}
        lines = [json.dumps(row) + "\n" for row in self.rows.values()]
        beside = self._path.with_suffix(".new")
        beside.write_text("".join(lines), encoding="utf-8")
        beside.replace(self._path)


def ours(name: str, world: Instance) -> dict[str, Any]:
    """Run Decant's optimiser as a campaign uses it, or random search, once."""
    axes = [
        Axis(f"x{i}", c.lower, c.upper, "log" if c.log else "linear", c.integer)
        for i, c in enumerate(world.problem.coordinates)
    ]
    space = Space(tuple(axes))

    def query(points: list[Any], costs: list[float]) -> SuggestionQuery:
        seed, tried = 1000 * world.seed + len(points), tuple(tuple(map(float, point)) for point in points)
        if name == "Sobol":
            return SpaceFillingQuery(space, tried, seed=seed)
        return MinimumQuery(space, Data(tried, tuple(costs)), seed=seed)

    def ask(points: list[Any], costs: list[float]) -> Any:
        if name == "random search":
            return Region(space, ()).draw(1, np.random.default_rng(1000 * world.seed + len(points)), even=False)[0]
        return np.array(propose(query(points, costs)).points[0])

    def report(points: list[Any], costs: list[float]) -> Any:
        if name in ("random search", "Sobol"):
            return luckiest(points, costs)
        return np.array(propose(query(points, costs)).best_point)

    return play(world, ask, report)


def rival(name: str, jobs: Sequence[tuple[str, int]], seconds: float) -> Iterator[dict[str, Any]]:
    """Yield results of another optimiser as they arrive from a child process, which ends when no jobs can follow.

    Raises:
        SystemExit: it failed; the message has the end of its output.
    """
    command = [str(environment()), str(RIVALS_FILE), name]
    pipes = {"stdin": subprocess.PIPE, "stdout": subprocess.PIPE, "stderr": subprocess.PIPE}
    child = subprocess.Popen(command, **pipes, text=True, env=single_threaded())  # type: ignore[call-overload]
    try:
        spent = 0.0
        for problem, seed in jobs:
            child.stdin.write(json.dumps({"problem": problem, "seed": seed}) + "\n")
            child.stdin.flush()
            line = child.stdout.readline()
            if not line:
                raise SystemExit(f"{name} ended with {child.wait()}:\n{child.stderr.read()[-2000:]}")
            row = json.loads(line)
            yield row
            spent += row["total_s"]
            if spent > seconds:
                break
    finally:
        child.kill()
        child.wait()


def run(optimisers: Sequence[str], problems: Sequence[str], seeds: int, seconds: float, kept: Kept) -> None:
    """Run missing jobs; seeds are the outer loop, so that a limited budget covers all problems."""
    for name in optimisers:
        jobs = [(p, seed) for seed in range(seeds) for p in problems if (name, p, seed) not in kept.rows]
        if not jobs:
            continue
        say(f"{name}: {len(jobs)} runs")
        if name in RIVALS:
            for row in rival(name, jobs, seconds):
                kept.add(name, row)
            continue
        started = time.process_time()
        for problem, seed in jobs:
            kept.add(name, ours(name, Instance(BY_NAME[problem], seed)))
            if time.process_time() - started > seconds:
                break


def interval(values: Sequence[float]) -> tuple[float, float, float]:
    """Return the mean and its 95 % bootstrap interval (percentiles)."""
    array = np.array(values)
    means = array[np.random.default_rng(0).integers(0, len(array), (RESAMPLES, len(array)))].mean(axis=1)
    low, high = np.percentile(means, (2.5, 97.5))
    return float(array.mean()), float(low), float(high)


def table(optimisers: Sequence[str], problems: Sequence[str], seeds: int, kept: Kept) -> list[dict[str, Any]]:
    """Return one row per problem and optimiser."""
    rows = []
    for problem in problems:
        for name in optimisers:
            runs = [kept.rows[name, problem, seed] for seed in range(seeds) if (name, problem, seed) in kept.rows]
            if not runs:
                continue
            mean, low, high = interval([run["reported"] for run in runs])
            rows.append(
                {
                    "problem": problem,
                    "optimiser": name,
                    "reported": round(mean, 4),
                    "interval": [round(low, 4), round(high, 4)],
                    "median": round(statistics.median(run["reported"] for run in runs), 4),
                    "visited": round(statistics.fmean(run["visited"] for run in runs), 4),
                    "per_evaluation": round(statistics.fmean(run["poured"] for run in runs), 3),
                    "seeds": len(runs),
                    "ms": round(1e3 * statistics.median(run["cpu_s"] for run in runs), 1),
                }
            )
    return rows


def speed() -> list[dict[str, Any]]:
    """Return the CPU time of a fit, and of a fit with a proposal, at 100 observations: the fastest of five."""
    rows = []
    for dimension in (2, 4, 6):
        space = Space(tuple(Axis(f"x{i}", 0.0, 1.0) for i in range(dimension)))
        rng = np.random.default_rng(dimension)
        points = rng.random((100, dimension))
        costs = 1.0 - np.exp(-((4.0 * np.maximum(np.linalg.norm(points - 0.4, axis=1) - 0.2, 0.0)) ** 1.5))
        costs += (0.01 + 0.1 * costs) * rng.standard_normal(100)

        def data(part: slice, points: Any = points, costs: Any = costs) -> Data:
            return Data(tuple(map(tuple, points[part].tolist())), tuple(costs[part].tolist()))

        everything, pours, simulations = data(slice(None)), data(slice(15)), data(slice(15, None))
        queries: tuple[tuple[str, str, MinimumQuery | PourQuery], ...] = (
            ("constant", "constant", MinimumQuery(space=space, data=everything)),
            ("constant", "varying", MinimumQuery(space=space, data=everything, noise="varying")),
            ("residual", "constant", PourQuery(space=space, data=pours, simulated=simulations)),
        )
        for mean, noise, question in queries:
            fit = min(propose(replace(question, count=0)).seconds for _ in range(5))
            both = min(propose(question).seconds for _ in range(5))
            row = {"dimension": dimension, "mean": mean, "noise": noise}
            rows.append({**row, "fit_ms": round(1e3 * fit, 1), "suggestion_ms": round(1e3 * both, 1)})
    return rows


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    names = [*OURS, *RIVALS]
    parser.add_argument("--problems", nargs="+", choices=list(BY_NAME), default=[p.name for p in PROBLEMS])
    parser.add_argument("--optimisers", nargs="+", choices=names, default=names)
    parser.add_argument("--seeds", type=int, default=30)
    parser.add_argument("--budget", type=float, default=600.0)
    parser.add_argument("--fresh", nargs="+", choices=names, default=[])
    parser.add_argument("--speed", action="store_true")
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    core = pin(None)
    if asked.speed:
        show({"core": core, "rows": speed(), "machine": describe()}, asked.json)
        return
    kept = Kept()
    kept.forget(asked.fresh)
    run(asked.optimisers, asked.problems, asked.seeds, asked.budget, kept)
    rows = table(asked.optimisers, asked.problems, asked.seeds, kept)
    show({"core": core, "seeds": asked.seeds, "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
