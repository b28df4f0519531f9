"""Measure the quickstart: benefit of its calibration, losses of its pours, and number of pours until it stops.

    python benchmarks/quickstart.py [--seeds 10] [--first 401] [--strategies shipped ...] [--calibration-only]
                                    [--fits 10] [--laboratory FILE] [--into build/quickstart] [--write]

The benchmark runs the shipped campaign unchanged, on a simulated bench with the ground truth of its own laboratory. It
only skips the scores of random θ, on which the deployment does not depend. Each seed runs in its own process, which
ends with this one. Every simulated pour of a seed is stored under `--into`, keyed by request and solver. The strategies
of a seed thus share their calibration and all other identical pours. Finished runs are stored there too, so an
interrupted comparison continues.

- `--calibration-only` skips the deployment, and scores only the test pours.
- `--strategies "all pours"` makes 15 pours per seed and does not stop before, for the coverage of the prediction
  intervals.
- `--calibration-only --strategies shipped mirrored` calibrates with whole pours of 600 particles and with mirrored ones
  of 1,100, which take as long. Decant itself mirrors pours of 2,000 particles and more only.
- `--fits` compares calibrations only, for this number of seeds from `--first` on, on two benches: that of the
  laboratory file, and one whose receiver stands 14 mm farther away. θ* of `simulations: auto` is compared with θ* of 30
  simulations, with the uncalibrated θ, and with the best θ of a 10 × 10 grid, which has the same seeds as the first.
  Further pours with new actions test all of them, and the prediction intervals.
- `--write` makes no runs; it writes the tables of stored runs to docs/data/results.json, for docs/make_tables.py.

Questions, fixed before the first run on seeds from 401 on; seeds below 400 are for tuning or were used before:

1. Does calibration halve the mean error on the test pours, on at least 9 of 10 seeds?
2. Is no pour above 10 % after the first below 1 %? Is the median number of pours until it stops four or fewer?
3. (`all pours`.) Are 85 to 95 % of at least 300 pours in their 90 % intervals? Is the mean interval score better than
   that of intervals that are not scaled by a campaign's earlier pours?
4. (`mirrored`.) Is the mean error on the test pours with mirrored pours at least a quarter lower?
5. (`--fits`.) Is θ* on the training pours in the mean at most 0.3 points above the best of the grid, and never above
   the uncalibrated θ? Is its mean error on 12 further pours at most 2 points? Do 85 to 95 % of these lie in their 90 %
   intervals?
"""

from __future__ import annotations

import argparse
import asyncio
import itertools
import json
import math
import tempfile
import time
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from statistics import median
from typing import Any
from unittest.mock import patch

import numpy as np
from machine import ROOT, KeptRows, run_self, say, write_table
from players import by_turn, coverage, interval

from actors.bench.ground_truth import draw_pose_error
from actors.interfaces import InvalidActionError
from actors.simulators.job_runner import Simulator, pour_simulator
from actors.simulators.local_worker import ThreadWorker
from actors.simulators.pool import WorkerPool
from orchestrator.campaigns import campaign_file
from orchestrator.learning.calibration.action_prior import Contexts
from orchestrator.learning.calibration.calibration_base import Calibrated
from orchestrator.learning.calibration.calibration_scores import CalibrationEvaluation, calibration_residual
from orchestrator.learning.calibration.pour_design import stratified
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, MeasuredPour
from orchestrator.learning.deployment import deployment_base
from orchestrator.learning.deployment.real_pours import DeploymentTrial, scaled_interval
from orchestrator.learning.requests import Prediction
from orchestrator.records.codec import digest, from_json, result_of, to_json
from orchestrator.runs.stages import (
    CALIBRATION,
    EVALUATION,
    StageDefinition,
    calibrated_theta,
    calibration_stages,
    measured_pours,
    posterior_draws,
)
from sim_engine import simulator
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import PourOutcome, SimulatedPour
from sim_engine.prediction_band import LEVEL, CalibrationResidual, band
from sim_engine.scene import MIRRORED_FROM, PoseError, PourTask, Scene

GOOD, BAD = 0.01, 0.10
TRUTH = ("liquid", "pose_error", "pose_noise")
"""Settings of a bench that are unknown to the simulator."""

CAMPAIGN = ROOT / "configs" / "campaigns" / "quickstart.yaml"


def _with_all_pours(content: dict[str, Any]) -> None:
    rules = ("stop", "good_enough")
    kept = {key: value for key, value in content["deployment"].items() if key not in rules}
    content["deployment"] = kept | {"pours": ALL_POURS}


ALL_POURS = 15
"""Number of pours per seed of the arm `all pours`."""


def _mirrored(content: dict[str, Any]) -> None:
    content["simulator"]["parameters"] = content["simulator"]["parameters"] | {"particles": 1_100}


ARMS: dict[str, Callable[[dict[str, Any]], None]] = {
    "shipped": lambda content: None,
    "all pours": _with_all_pours,
    "mirrored": _mirrored,
}
"""What each arm changes in the content of the campaign."""


class KeptPours(WorkerPool):
    """A pool that returns stored outcomes of repeated simulations; the file's name has the solver's fingerprint."""

    def __init__(self, file: Path, *, make: Callable[[], Simulator] = pour_simulator) -> None:
        super().__init__(1, partial(ThreadWorker, make), separate=False)
        self._file, self.simulated = KeptRows(file), 0
        self._known: dict[str, Any] = {row["task"]: row["outcome"] for row in self._file.rows}

    async def simulate(self, task: PourTask, user: object = None) -> SimulatedPour:
        """See `SimulatorPool.simulate`; without frames."""
        key = digest(to_json(task, PourTask))
        if key not in self._known:
            found = await super().simulate(task, user)
            self._known[key] = to_json(found.outcome, PourOutcome)
            self.simulated += 1
            self._file.add({"task": key, "outcome": self._known[key]})
        return SimulatedPour(from_json(self._known[key], PourOutcome))


def one(seed: int, arm: str, laboratory: Path, into: Path, *, calibration_only: bool = False) -> dict[str, Any]:
    """Run one campaign; return its calibration's error on the test pours, and every pour with its prediction."""
    from decant.running import build_campaign
    from orchestrator.reports.stage_views import deployments_of, evaluation_of, theta_of
    from orchestrator.runs.run_service import RunRequest, RunResources, RunService
    from orchestrator.runs.run_tasks import run_task

    pool = kept_pours(seed, into)
    unscaled: list[tuple[float, float]] = []

    def scale(prediction: Prediction, earlier: Sequence[DeploymentTrial], worst: float) -> tuple[float, float]:
        unscaled.append(prediction.of_a_pour())
        return scaled_interval(prediction, earlier, worst)

    with (
        tempfile.TemporaryDirectory(prefix="decant-quickstart-") as folder,
        patch.object(deployment_base, "scaled_interval", scale),
        patch.multiple(campaign_file, MIRRORED_FROM=0 if arm == "mirrored" else MIRRORED_FROM),
        patch.multiple(simulator, MIRRORED_FROM=0 if arm == "mirrored" else MIRRORED_FROM),
    ):
        content = on_numbers(seed, laboratory, folder)
        ARMS[arm](content)
        campaign = build_campaign(content, folder)
        assert campaign.deployment is not None
        assert campaign.calibration is not None
        request = run_task(campaign)
        if calibration_only:
            request = RunRequest(replace(campaign, deployment=None), calibration_and_test(campaign.calibration))
        handle = RunService().start(request, RunResources(in_process=True, simulators=pool))
        results = asyncio.run(handle.wait()).results
        asyncio.run(pool.close())
    scores, theta = evaluation_of(results), theta_of(results)
    assert scores is not None
    assert theta is not None
    run: dict[str, Any] = {
        "seed": seed,
        "arm": arm,
        "test": {name: scores.discrepancy[name]["test"] for name in ("theta", "uncalibrated")},
        "theta": {name: theta.theta.model_dump()[name] for name in theta.searched},
    }
    actions = campaign.deployment.actions
    for found in deployments_of(results).values():
        known = found.recommended
        run |= {
            "pours": [
                {
                    "at": [round(u, 4) for u in actions.encode(pour.action_si)],
                    "loss": pour.loss,
                    "predicted": pour.predicted,
                    "band": pour.predicted_interval,
                    "unscaled": band,
                }
                for pour, band in zip(found.pours, unscaled, strict=False)
                if pour.status == "weighed" and pour.loss is not None
            ],
            "recommended": None if known is None else [round(u, 4) for u in actions.encode(known.action_si)],
            "ended": found.ended,
        }
    return {**run, "cpu_s": round(time.process_time(), 1), "simulated": pool.simulated}


PROGRAMS: dict[str, int | str] = {"auto": "auto", "30 simulations": 30}
"""Numbers of simulations that are compared."""

BENCHES = {"twin": None, "14 mm": "14 mm"}
"""Benches of the comparison, with the offset of the receiver if it is not that of the laboratory file."""

FURTHER, DRAWN, CELLS = 12, 6, 10
"""Number of further pours, of posterior draws that predict each, and of the grid's values per axis."""


def fitted(seed: int, bench: str, laboratory: Path, into: Path) -> list[dict[str, Any]]:
    """Calibrate with each program; return errors on the training, test and further pours, one row per program."""
    from decant.running import build_campaign, load_campaign
    from orchestrator.reports.stage_views import evaluation_of
    from orchestrator.runs.run_service import RunRequest, RunResources, RunService

    pool, rows = kept_pours(f"fit-{seed}", into), []
    for program, simulations in PROGRAMS.items():
        with tempfile.TemporaryDirectory(prefix="decant-quickstart-") as folder:
            content = {**load_campaign(CAMPAIGN, laboratory).resolved, "seed": seed}
            content["outputs"] = {"directory": folder, "recording": False, "figures": False}
            content["laboratory"]["bench"]["time_scale"] = 3000
            if (offset := BENCHES[bench]) is not None:
                content["laboratory"]["bench"]["pose_error"]["x"] = offset
            content["calibration"] |= {"random_baseline": 0, "simulations": simulations}
            campaign = build_campaign(content, folder)
            plan = campaign.calibration
            assert plan is not None
            request = RunRequest(replace(campaign, deployment=None), tuple(calibration_stages(plan)))
            begun = time.process_time()
            handle = RunService().start(request, RunResources(in_process=True, simulators=pool))
            results = asyncio.run(handle.wait()).results
        scores, calibrated = evaluation_of(results), result_of(results, CALIBRATION, Calibrated)
        assert scores is not None
        assert calibrated.found is not None
        assert calibrated.found.posterior is not None
        row: dict[str, Any] = {
            "seed": seed,
            "bench": bench,
            "program": program,
            "simulations": calibrated.simulations,
            "cpu_s": round(time.process_time() - begun, 1),
            "ended": calibrated.ended,
            "errors": scores.discrepancy,
            "recommended": None if scores.gain is None else scores.gain.recommended,
            "theta": {name: getattr(calibrated.found.theta, name) for name in calibrated.found.searched},
            "region": calibrated.found.posterior.region,
            "correlation": calibrated.found.posterior.correlation,
        }
        if calibrated.pour_seeds:
            train = [one.pour for one in measured_pours(plan, results) if one.pour.split == "train"]
            row["grid"] = asyncio.run(best_of_grid(plan, train, calibrated.pour_seeds, pool, row["errors"]))
        thetas = {"theta": calibrated.found.theta, "uncalibrated": plan.uncalibrated}
        drawn = posterior_draws(calibrated.found, DRAWN)
        left = calibration_residual(plan, scores, len(calibrated.found.searched))
        left = None if left is None else left.at(plan.scene)
        row["further"] = asyncio.run(further(campaign, seed, thetas, drawn, left, pool))
        rows.append(row)
    asyncio.run(pool.close())
    return rows


async def best_of_grid(
    plan: CalibrationPlan,
    train: Sequence[MeasuredPour],
    seeds: Sequence[int],
    pool: KeptPours,
    known: dict[str, dict[str, float | None]],
) -> float:
    """Return the lowest mean error of a grid of θ on the training pours.

    A θ is left as soon as its errors add up to those of the best one so far. Initially this is θ* with one point more,
    so a grid whose best is worse than that yields this number.
    """
    best = (known["theta"]["train"] or 0.0) + 0.01
    pours = [(pour, seed) for pour, seed in zip([p for p in train if p.spillage is not None], seeds, strict=True)]
    middles = [(i + 0.5) / CELLS for i in range(CELLS)]
    for point in itertools.product(middles, repeat=plan.parameters.dimension):
        theta = SimulationParameters.from_values({**plan.fixed_parameters, **plan.parameters.decode(point)})
        total = 0.0
        for pour, seed in pours:
            assert pour.spillage is not None
            found = await spilled(pool, plan.scene, pour.action, theta, seed)
            total += abs(pour.spillage - found)
            if total >= best * len(pours):
                break
        best = min(best, total / len(pours))
    return best


async def spilled(
    pool: KeptPours,
    scene: Scene,
    action: Action,
    theta: SimulationParameters,
    seed: int,
    error: PoseError | None = None,
) -> float:
    """Return the simulated spillage; 1 if it is undefined, or if the cups touch with this θ."""
    try:
        outcome = (await pool.simulate(PourTask(scene, action, theta, seed, pose_error=error))).outcome
    except InvalidActionError:
        return 1.0
    found = outcome.fractions.spillage
    return 1.0 if found is None else found


async def further(
    campaign: CampaignPlan,
    seed: int,
    thetas: dict[str, SimulationParameters],
    drawn: Sequence[SimulationParameters],
    left: CalibrationResidual | None,
    pool: KeptPours,
) -> dict[str, Any]:
    """Return mean errors on further pours of new actions, and the number of pours in their 90 % intervals."""
    plan, bench, rng = campaign.calibration, campaign.laboratory.bench, np.random.default_rng([seed, FURTHER])
    assert plan is not None
    assert bench is not None
    errors: dict[str, list[float]] = {name: [] for name in (*thetas, "posterior")}
    inside = 0
    for stratum in stratified(FURTHER, plan.actions.dimension, rng):
        action = plan.scene.action(plan.actions.decode(stratum.draw(rng)))
        own = int(rng.integers(2**31))
        truth = await spilled(pool, plan.scene, action, bench.theta, own, draw_pose_error(bench, own))
        for name, theta in thetas.items():
            errors[name].append(abs(truth - await spilled(pool, plan.scene, action, theta, own + 1)))
        values = [await spilled(pool, plan.scene, action, theta, own + 2 + k) for k, theta in enumerate(drawn)]
        errors["posterior"].append(abs(truth - sum(values) / len(values)))
        inside += band(values, drawn[0].particles, left).holds(truth)
    return {**{name: sum(values) / len(values) for name, values in errors.items()}, "inside": inside, "of": FURTHER}


def fits_table(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return head and rows of the comparison: one row per bench, seed and program, and the means."""

    def cells(row: dict[str, Any]) -> list[float]:
        train, unseen = row["errors"], row["further"]
        grid = row.get("grid", math.nan)
        return [train["theta"]["train"], train.get("uncalibrated", train["theta"])["train"], grid,
                unseen["theta"], unseen["posterior"], unseen["uncalibrated"]]  # fmt: skip

    def shown(values: Sequence[float]) -> list[str]:
        return ["" if math.isnan(value) else f"{100 * value:.2f}" for value in values]

    lines = []
    for bench, program in itertools.product(BENCHES, PROGRAMS):
        chosen = [row for row in rows if (row["bench"], row["program"]) == (bench, program)]
        for row in chosen:
            held = f"{row['further']['inside']} of {row['further']['of']}"
            lines.append([bench, program, str(row["seed"]), str(row["simulations"]), *shown(cells(row)), held])
        if chosen:
            inside, of = (sum(row["further"][key] for row in chosen) for key in ("inside", "of"))
            means = np.array([cells(row) for row in chosen]).mean(axis=0)
            made = f"{np.mean([row['simulations'] for row in chosen]):.0f}"
            lines.append([bench, program, "mean", made, *shown(means), f"{100 * inside / of:.0f} %"])
    head = ["bench", "program", "seed", "simulations", "training pours: θ\\*", "uncalibrated", "best of the grid"]
    return {"head": [*head, "further pours: θ\\*", "posterior", "uncalibrated", "in 90 % intervals"], "rows": lines}


def calibration_and_test(plan: CalibrationPlan) -> tuple[StageDefinition, ...]:
    """Return the calibration's stages, with an evaluation on the test pours only."""
    *stages, _ = calibration_stages(plan)

    def evaluation(results: Any, seed: int) -> CalibrationEvaluation:
        test = [scored for scored in measured_pours(plan, results) if scored.pour.split == "test"]
        plain = SimulationParameters.from_values(plan.fixed_parameters)
        theta = calibrated_theta(results).theta
        return CalibrationEvaluation(theta, {}, test, Contexts.of(plan), seed, uncalibrated=plain)

    return (*stages, StageDefinition(EVALUATION, evaluation))


def kept_pours(seed: int | str, into: Path) -> KeptPours:
    """Return the pool of a seed."""
    from sim_engine.solver_fingerprint import solver_fingerprint

    return KeptPours(into / f"pours-{solver_fingerprint()}-{seed}.jsonl")


def on_numbers(seed: int, laboratory: Path, folder: str, name: str | None = None) -> dict[str, Any]:
    """Return the shipped campaign on a simulated laboratory, with the ground truth of the campaign's own laboratory, or
    of a bench of `BENCHES`."""
    from decant.running import load_campaign

    truth = load_campaign(CAMPAIGN).resolved["laboratory"]["bench"]
    content: dict[str, Any] = {
        **load_campaign(CAMPAIGN, laboratory).resolved,
        "seed": seed,
        "outputs": {"directory": folder, "recording": False, "figures": False},
    }
    bench = content["laboratory"]["bench"]
    if name is None:
        bench = {key: value for key, value in bench.items() if key not in TRUTH}
        bench |= {key: truth[key] for key in TRUTH if key in truth}
    elif BENCHES[name] is not None:
        bench["pose_error"]["x"] = BENCHES[name]
    content["laboratory"]["bench"] = bench | {"time_scale": 3000}  # only speeds the bench up; the results are the same
    content["calibration"]["random_baseline"] = 0
    return content


def figures(run: dict[str, Any]) -> dict[str, float]:
    """Return the summary figures of a run; shares of a load.

    'final' is the mean of the pours of the recommended action. 'good' is the number of pours until one is below 1 %;
    if no pour is, it is the number of pours plus one.
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
    """Return whether a pour lies in its 90 % interval."""
    low, high = pour["band"]
    return bool(low <= pour["loss"] <= high)


def coverage_table(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return head and rows: share of the pours in their 90 % intervals, and the mean interval score."""
    rows = []
    for name, pours in by_turn([run["pours"] for run in runs]).items():
        cells = []
        for key in ("band", "unscaled"):
            inside, score = coverage([(*pour[key], pour["loss"]) for pour in pours], LEVEL)
            cells += [f"{100 * inside:.0f} %", f"{score:.4f}"]
        rows.append([name, str(len(pours)), *cells])
    head = ["pours", "number", "in their 90 % intervals", "interval score", "not scaled by earlier pours"]
    return {"head": [*head, "interval score"], "rows": rows}


def summary(runs: list[dict[str, Any]]) -> str:
    """Return the summary over all seeds."""
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


def calibration_table(runs: list[dict[str, Any]]) -> dict[str, Any]:
    """Return head and rows: errors on the test pours, and the parameters found."""
    rows = []
    for run in runs:
        calibrated, plain, theta = run["test"]["theta"], run["test"]["uncalibrated"], run["theta"]
        rows.append(
            [
                str(run["seed"]),
                f"{100 * plain:.1f}",
                f"{100 * calibrated:.1f}",
                "yes" if calibrated <= 0.5 * plain else "no",
                f"{theta['friction']:.2f}",
                f"{1e3 * theta['receiver_x']:.1f} mm",
            ]
        )
    head = ["seed", "uncalibrated, error on the test pours [points]", "θ\\*", "halved", "friction found"]
    return {"head": [*head, "receiver found at"], "rows": rows}


def _run_missing(asked: argparse.Namespace, kept: KeptRows) -> None:
    """Make the missing runs, one process each."""
    places = [f"--{name}={path.resolve()}" for name, path in vars(asked).items() if isinstance(path, Path)]
    places += ["--calibration-only"] if asked.calibration_only else []
    for seed in range(asked.first, asked.first + asked.seeds):
        for arm in asked.strategies:
            known = [run for run in kept.rows if (run["seed"], run["arm"]) == (seed, arm)]
            if any("pours" in run or asked.calibration_only for run in known):
                continue
            run = run_self(__file__, f"--one={seed}", "--strategies", arm, *places)
            kept.add(run)
            losses = [round(100 * pour["loss"], 2) for pour in run.get("pours", ())]
            say(f"seed {seed}, {arm}: test {run['test']}, lost {losses} %; {run['cpu_s']} CPU s")


def _compare_fits(asked: argparse.Namespace) -> None:
    """Make the missing comparisons, one process for each seed and bench, and print or write their table."""
    kept = KeptRows(asked.into / "fits.jsonl")
    places = [f"--{name}={getattr(asked, name).resolve()}" for name in ("laboratory", "into")]
    wanted = range(asked.first, asked.first + asked.fits)
    for seed, bench in itertools.product(wanted, () if asked.write else BENCHES):
        if any((row["seed"], row["bench"]) == (seed, bench) for row in kept.rows):
            continue
        new = run_self(__file__, f"--one={seed}", f"--bench={bench}", *places)["rows"]
        kept.add(*new)
        say(f"seed {seed}, {bench}: {[(row['program'], row['simulations'], row['cpu_s']) for row in new]}")
    shown = fits_table(sorted((row for row in kept.rows if row["seed"] in wanted), key=lambda row: row["seed"]))
    print(
        "\n".join(f"| {' | '.join(cells)} |" for cells in (shown["head"], ["---"] * len(shown["head"]), *shown["rows"]))
    )
    if asked.write:
        command = f"python benchmarks/quickstart.py --fits {asked.fits} --first {asked.first}"
        settings = "calibration of quickstart.yaml on the bench of twin.yaml; mean errors in points"
        write_table("quickstart-fits", **shown, command=command, settings=settings)


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=10)
    parser.add_argument("--first", type=int, default=401)
    parser.add_argument("--strategies", nargs="+", choices=list(ARMS), default=["shipped"])
    parser.add_argument("--calibration-only", action="store_true", help="skip the deployment")
    parser.add_argument("--fits", type=int, default=0, help="number of seeds to compare calibrations on")
    parser.add_argument("--bench", choices=list(BENCHES), help=argparse.SUPPRESS)
    parser.add_argument("--laboratory", type=Path, default=ROOT / "configs" / "laboratories" / "twin.yaml")
    parser.add_argument("--into", type=Path, default=ROOT / "build" / "quickstart")
    parser.add_argument("--write", action="store_true", help="write the tables into docs/data/results.json")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # runs one seed in this process
    asked = parser.parse_args()
    asked.into.mkdir(parents=True, exist_ok=True)
    if asked.one is not None:
        if asked.bench is not None:
            print(json.dumps({"rows": fitted(asked.one, asked.bench, asked.laboratory, asked.into)}))
            return
        only = asked.calibration_only
        print(json.dumps(one(asked.one, asked.strategies[0], asked.laboratory, asked.into, calibration_only=only)))
        return
    if asked.fits:
        _compare_fits(asked)
        return
    kept = KeptRows(asked.into / "runs.jsonl")
    if not asked.write:
        _run_missing(asked, kept)
    runs = {(run["seed"], run["arm"]): run for run in kept.rows}.values()  # the latest of each
    wanted = range(asked.first, asked.first + asked.seeds)
    for arm in asked.strategies:
        chosen = sorted(
            (run for run in runs if run["seed"] in wanted and run["arm"] == arm), key=lambda run: run["seed"]
        )
        poured = [run for run in chosen if "pours" in run]
        if poured:
            print(f"{arm}: {summary(poured)}")
        seeds = f"--seeds {asked.seeds} --first {asked.first}"
        bench = "quickstart.yaml on a simulated bench with the ground truth of virtual.yaml"
        command = f"python benchmarks/quickstart.py {seeds}"
        if asked.write and poured and arm == "all pours":
            settings = f"{bench}; {ALL_POURS} pours per seed"
            write_table(
                "quickstart-coverage",
                **coverage_table(poured),
                command=f"{command} --strategies '{arm}'",
                settings=settings,
            )
        if asked.write and arm == "shipped":
            shown = f"{command} --calibration-only"
            write_table("quickstart-calibration", **calibration_table(chosen), command=shown, settings=bench)


if __name__ == "__main__":
    main()
