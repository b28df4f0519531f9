"""What the quickstart loses on its way, and after how many pours it stops, on the bench of numbers, seed after seed.

    python benchmarks/quickstart.py [--seeds 20] [--first 101] [--arms shipped ...] [--laboratory FILE]
                                    [--into build/quickstart] [--write]

The shipped campaign as it is; only random θ are not scored, which the deployment does not depend on. A seed is
a process of its own that ends with this one. Every simulated pour of a seed is kept under `--into`, by what was asked
and the solver that answered, so that the arms of a seed share their calibration and whatever else they both ask for,
pour for pour the same; finished runs are kept there, too, and an interrupted comparison goes on. `--write` makes no
runs, and puts the table of those that are there into docs/evidence/results.md.

The other arms change the program, for this benchmark only: there are no such settings.

Questions, written before it was run: no pour above 10 % after the first below 1 %? Four pours or fewer until it stops,
in the median? Seeds below 100 are for tuning, those from 101 on for answers.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import os
import tempfile
import threading
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any

from machine import ROOT, run_self, say
from players import interval

from actors.optimizer.questions import ModelDiscrepancy
from actors.simulators.job_runner import Simulator, pour_simulator
from actors.simulators.local_worker import ThreadWorker
from actors.simulators.pool import WorkerPool
from orchestrator.journal.codec import digest, from_json, to_json
from orchestrator.strategies.deployment import d3
from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.scene import PourTask

GOOD, BAD = 0.01, 0.10
PAGE = ROOT / "docs" / "evidence" / "results.md"
BEGIN, END = "<!-- measured: quickstart -->\n", "<!-- end of measured -->"
CAMPAIGN = ROOT / "configs" / "campaigns" / "quickstart.yaml"


def _with_lookahead() -> None:
    def discrepancy(*args: Any, **changes: Any) -> ModelDiscrepancy:
        return ModelDiscrepancy(*args, **{**changes, "lookahead": True})

    vars(d3).update(ModelDiscrepancy=discrepancy)


ARMS: dict[str, Callable[[], None]] = {
    "shipped": lambda: None,
    "look-ahead": _with_lookahead,
}


class KeptPours(WorkerPool):
    """A pool that answers from a file what it has simulated before; the file's name tells the solver."""

    def __init__(self, file: Path, *, make: Callable[[], Simulator] = pour_simulator) -> None:
        super().__init__(1, partial(ThreadWorker, make), separate=False)
        self._file, self._known = file, dict[str, Any]()
        self.simulated = 0
        if file.exists():
            rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()]
            self._known = {row["task"]: row["outcome"] for row in rows}

    async def simulate(self, task: PourTask, user: object = None) -> SimulatedPour:
        """See `SimulatorPool.simulate`; without frames."""
        key = digest(to_json(task, PourTask))
        if key not in self._known:
            found = await super().simulate(task, user)
            self._known[key] = to_json(found.outcome, PourOutcome)
            self.simulated += 1
            with self._file.open("a", encoding="utf-8") as file:
                file.write(json.dumps({"task": key, "outcome": self._known[key]}) + "\n")
        return SimulatedPour(from_json(self._known[key], PourOutcome))


def one(seed: int, arm: str, laboratory: Path, into: Path) -> dict[str, Any]:
    """One campaign: every pour with what was expected of it, what it recommends, and why it ended."""
    from decant.running import build_campaign, load_campaign
    from orchestrator.results.stage_views import deployments_of
    from orchestrator.run_service import RunResources, RunService, task_request
    from sim_engine.solver_fingerprint import solver_fingerprint

    ARMS[arm]()
    shipped = load_campaign(CAMPAIGN, laboratory)
    pool = KeptPours(into / f"pours-{solver_fingerprint()}-{seed}.jsonl")
    with tempfile.TemporaryDirectory(prefix="decant-quickstart-") as folder:
        content: dict[str, Any] = {
            **shipped.resolved,
            "seed": seed,
            "outputs": {"directory": folder, "recording": False},
        }
        content["laboratory"]["bench"]["time_scale"] = 3000  # nobody watches; the numbers are the same
        content["calibration"]["random_baseline"] = 0
        campaign = build_campaign(content, folder)
        handle = RunService().start(task_request(campaign), RunResources(in_process=True, simulators=pool))
        result = asyncio.run(handle.wait())
        asyncio.run(pool.close())
    (found,) = deployments_of(result.results).values()
    assert campaign.deployment is not None
    pours = [
        {
            "at": [round(u, 4) for u in campaign.deployment.actions.encode(pour.action_si)],
            "loss": pour.loss,
            "predicted": pour.predicted,
            "band": pour.predicted_interval,
        }
        for pour in found.pours
        if pour.status == "weighed" and pour.loss is not None
    ]
    known = found.recommended
    recommended = None if known is None else [round(u, 4) for u in campaign.deployment.actions.encode(known.action_si)]
    cpu = time.process_time()
    return {
        "seed": seed,
        "arm": arm,
        "pours": pours,
        "recommended": recommended,
        "ended": found.ended,
        "cpu_s": round(cpu, 1),
        "simulated": pool.simulated,
    }


def figures(run: dict[str, Any]) -> dict[str, float]:
    """What is asked of a run; shares of a load.

    'final' is the mean of the pours of the recommended action; where no pour goes below 1 %, 'good' is the number of
    pours and one more.
    """
    losses = [pour["loss"] for pour in run["pours"]]
    good = next((i for i, loss in enumerate(losses) if loss < GOOD), len(losses))
    final = [pour["loss"] for pour in run["pours"] if pour["at"] == run["recommended"]]
    return {
        "pours": len(losses),
        "good": good + 1,
        "mean": sum(losses) / len(losses),
        "first": losses[0],
        "worst": max(losses),
        "after": max(losses[good + 1 :], default=math.nan),
        "bad": sum(loss > BAD for loss in losses[good + 1 :]),
        "best": min(losses),
        "final": sum(final) / len(final) if final else math.nan,
    }


def held(pour: dict[str, Any]) -> bool:
    """Whether a pour lies in its 90 % band."""
    low, high = pour["band"]
    return bool(low <= pour["loss"] <= high)


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: a row for every seed, and what was asked."""
    lines = [
        "| seed | lost, pour by pour | pours | first below 1 % | worst after it | best | recommended | why it ended |",
        "|---:|---|---:|---:|---:|---:|---:|---|",
    ]
    found = [figures(run) for run in runs]
    for run, one in zip(runs, found, strict=True):
        shown = ", ".join(f"{100 * pour['loss']:.1f}" for pour in run["pours"])
        good = "none" if one["good"] > one["pours"] else f"{one['good']:g}"
        why = "all pours made" if run["ended"] is None else run["ended"].split(":")[0]
        cells = [str(run["seed"]), f"{shown} %", f"{one['pours']:g}", good]
        cells += ["" if math.isnan(one[key]) else f"{100 * one[key]:.1f} %" for key in ("after", "best", "final")]
        lines.append(f"| {' | '.join([*cells, why])} |")
    return "\n".join([*lines, "", summary(runs)])


def summary(runs: list[dict[str, Any]]) -> str:
    """What was asked, over all seeds."""
    found = [figures(run) for run in runs]
    pours = [pour for run in runs for pour in run["pours"]]
    inside = sum(map(held, pours))
    none = sum(one["bad"] == 0 for one in found)
    stopped = [one["pours"] for one in found]
    reached = [one["good"] for one in found if one["good"] <= one["pours"]]

    def mean(key: str) -> str:
        values = [one[key] for one in found if not math.isnan(one[key])]
        middle, low, high = (100 * value for value in interval(values))
        return f"{middle:.2f} % ({low:.2f} … {high:.2f}; median {100 * median(values):.2f} %)"

    at = f", in the median at pour {median(reached):g}" if reached else ""
    return (
        f"{len(runs)} seeds: no pour above 10 % after the first below 1 % in {none} of them; {median(stopped):g} pours "
        f"in the median until it stops ({min(stopped):g} to {max(stopped):g}); below 1 % in {len(reached)} of them{at}."
        f" In the mean a pour loses {mean('mean')}, the first one {mean('first')}, a run's worst {mean('worst')}, "
        f"its best {mean('best')}, the recommended action {mean('final')}. "
        f"{inside} of {len(pours)} pours ({100 * inside / max(len(pours), 1):.0f} %) lie in their 90 % bands."
    )


def write(text: str) -> None:
    """Put the table into the page."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}{text}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


def _end_with_parent() -> None:
    """End this process when the one that started it is gone, whatever ended that."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(1.0)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=101)
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=["shipped"])
    parser.add_argument("--laboratory", type=Path, default=ROOT / "configs" / "laboratories" / "twin.yaml")
    parser.add_argument("--into", type=Path, default=ROOT / "build" / "quickstart")
    parser.add_argument("--write", action="store_true", help="write the table into docs/evidence/results.md")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # this is a process that makes one seed
    asked = parser.parse_args()
    if asked.one is not None:
        _end_with_parent()
        print(json.dumps(one(asked.one, asked.arms[0], asked.laboratory, asked.into)))
        return
    asked.into.mkdir(parents=True, exist_ok=True)
    file = asked.into / "runs.jsonl"
    runs = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []
    wanted = range(asked.first, asked.first + asked.seeds)
    for seed in () if asked.write else wanted:
        for arm in asked.arms:
            if any((run["seed"], run["arm"]) == (seed, arm) for run in runs):
                continue
            places = [f"--{name}={path.resolve()}" for name, path in vars(asked).items() if isinstance(path, Path)]
            runs.append(run_self(__file__, f"--one={seed}", "--arms", arm, *places))
            with file.open("a", encoding="utf-8") as kept:
                kept.write(json.dumps(runs[-1]) + "\n")
            losses = ", ".join(
                f"{100 * pour['loss']:.2f} % ({100 * pour['band'][0]:.1f} … {100 * pour['band'][1]:.1f})"
                for pour in runs[-1]["pours"]
            )
            say(f"seed {seed}, {arm}: {losses} ({runs[-1]['cpu_s']:.0f} CPU s, {runs[-1]['simulated']} simulated)")
    for arm in asked.arms:
        chosen = [run for run in runs if run["seed"] in wanted and run["arm"] == arm]
        if chosen:
            text = table(sorted(chosen, key=lambda run: int(run["seed"])))
            print(f"{arm}\n\n{text}\n")
            if asked.write and arm == "shipped":
                write(text)


if __name__ == "__main__":
    main()
