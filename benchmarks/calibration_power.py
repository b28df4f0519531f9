"""Measure the benefit of calibration: per parameter on recorded pours, and by cross-validation over all of them.

    python benchmarks/calibration_power.py [CAMPAIGN] [--seeds 11 12] [--simulations 108] [--particles 1000]
                                           [--known wall_distance=1.5 rim_correction=0] [--folds 8]
                                           [--fold-simulations 72] [--workers 1] [--fresh] [--json]
    python benchmarks/calibration_power.py --as-it-is --seeds 11 12 13 --folds 0

Sets: the campaign's own calibration (C4) runs repeatedly, with one more searched parameter each time and the same
budget. A parameter that is not searched has the campaign's fixed value or Decant's default; if the campaign does not
fix the number of particles, `--particles` does. θ* is then simulated on each recorded pour. The score is the mean
|measured − simulated| of the normalised spillage on training, test and transfer pours, for θ* and for the mean over
draws from θ's posterior. The first row has no calibration. `--known` adds a last row that searches all other
parameters, with these fixed at the given values (for example, known wall properties). With `--as-it-is` the only row
searches what the campaign searches.

Folds: all pours of the campaign's scene are sorted by angular velocity and assigned to the folds in turn, so each fold
has slow and fast pours. θ*, over the parameters that the campaign searches, is calibrated on all other folds and scored
on this fold's pours. Two baselines without a simulator use the same folds and leave-one-out: the mean of the other
pours and a Gaussian process fitted to them.

Each calibration runs in its own process, up to `--workers` at a time, and is stored in the cache directory, so an
interrupted benchmark continues. `--fresh` discards stored results.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, cast

from machine import ROOT, describe, run_self, say, show
from standard_pour import check_particles

from orchestrator.config.file_loading import load_campaign
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.journal.codec import digest
from orchestrator.requests import Failed, Outcome, Request, Simulate, Simulated, Suggest, Suggested
from orchestrator.runs.fingerprint import fingerprint
from orchestrator.runs.stage_scheduler import PendingRequest, free_slots, next_to_tell
from orchestrator.runs.stages import (
    CALIBRATION,
    calibrated_theta,
    calibration_stages,
    measured_pours,
    posterior_draws,
    scenes_of,
    stage_seed,
)
from orchestrator.strategies.calibration.action_prior import Contexts
from orchestrator.strategies.calibration.calibration_scores import (
    DRAWS,
    Evaluation,
    ScoredPour,
    mean_predictor_discrepancy,
    regression_discrepancy,
)
from orchestrator.strategies.campaign_plan import CalibrationPlan, CampaignPlan, MeasuredPour, RecordedPour
from orchestrator.strategies.strategy import Strategy
from sim_engine.errors import InvalidSceneError
from sim_engine.liquids import SimulationParameters
from sim_engine.resources import cache_directory
from sim_engine.scene import PourTask
from sim_engine.search_space import Axis, Space

CAMPAIGN = ROOT / "configs" / "campaigns" / "recorded.yaml"
STEPS = (("xsph_rate",), ("cohesion",), ("friction",), ("wall_distance", "rim_correction"), ("smagorinsky_constant",))
"""Parameters that each step adds to the search."""

RANGES = {
    axis.name: axis
    for axis in (
        Axis("cohesion", 0.0, 0.1),
        Axis("xsph_rate", 0.0, 10.0),
        Axis("friction", 0.0, 0.3),
        Axis("smagorinsky_constant", 0.0, 0.2),
    )
}
"""Ranges of parameters that the campaign does not search."""

SPLITS = ("train", "test", "transfer")


def growing_sets() -> list[tuple[str, ...]]:
    """Return the parameter names searched in each row of the first table, from none to all."""
    return [tuple(name for step in STEPS[:k] for name in step) for k in range(len(STEPS) + 1)]


def searching(
    plan: CalibrationPlan, names: Sequence[str], particles: int, known: Mapping[str, float] | None = None
) -> CalibrationPlan:
    """Return the calibration that searches only these parameters.

    Args:
        names: parameter names, not empty.
        particles: N if it is neither searched nor fixed by the campaign.
        known: values of parameters that are not searched, overriding the campaign's.
    """
    axes = {**RANGES, **{axis.name: axis for axis in plan.parameters.axes}}
    fixed = {"particles": float(particles), **plan.fixed_parameters, **(known or {})}
    return replace(
        plan,
        parameters=Space(tuple(axes[name] for name in names)),
        fixed_parameters={name: value for name, value in fixed.items() if name not in names},
    )


def dealt(pours: Sequence[RecordedPour], folds: int) -> list[list[int]]:
    """Return the indices of each fold's pours, assigned in turn in the order of their angular velocities."""
    order = sorted(range(len(pours)), key=lambda i: (pours[i].action.angular_velocity, pours[i].action.max_angle))
    return [order[k::folds] for k in range(folds)]


def without(plan: CalibrationPlan, fold: Sequence[int]) -> CalibrationPlan:
    """Return the calibration on all recorded pours except a fold, whose pours become its test split."""
    assert plan.records is not None
    pours = tuple(
        replace(pour, split="test" if i in set(fold) else "train") for i, pour in enumerate(plan.records.pours)
    )
    return replace(plan, records=replace(plan.records, pours=pours), transfer=None)


def play(strategy: Strategy, answer: Callable[[Request], Outcome], slots: int, label: str) -> None:
    """Run the ask–tell loop until the strategy has finished, in the order of a campaign run."""
    flights: dict[int, PendingRequest] = {}
    asked, begun, told = 0, time.monotonic(), 0
    while not strategy.finished:
        for request in strategy.ask(free_slots(list(flights.values()), slots)):
            flights[asked] = PendingRequest(asked, request)
            asked += 1
        for flight in flights.values():
            if flight.outcome is None:
                flight.outcome = answer(flight.request)
        flight = cast("PendingRequest", next_to_tell(list(flights.values()), "logical"))
        assert flight.outcome is not None
        del flights[flight.id]
        strategy.tell(flight.request, flight.outcome)
        progress = strategy.progress()
        done, total = progress.done, progress.total
        if done >= told + 20 or done == total > told:
            told = done
            say(f"{label}: {done}/{total} simulations, {time.monotonic() - begun:.0f} s")


class Answers:
    """Evaluates suggestion queries and simulates pours in this process."""

    def __init__(self, plan: CampaignPlan) -> None:
        from sim_engine.simulator import PourSimulator

        self._simulator = PourSimulator()
        self._scenes = scenes_of(plan)

    def __call__(self, request: Request) -> Outcome:
        """Return the outcome of a request."""
        from actors.optimizer.suggest import propose

        if isinstance(request, Suggest):
            return Suggested(propose(request.query))
        assert isinstance(request, Simulate)
        task = PourTask(self._scenes[request.scene], request.action, request.parameters, request.seed)
        try:
            outcome = self._simulator.simulate(task).outcome
        except InvalidSceneError as error:
            return Failed("invalid_action", str(error))
        return Simulated(outcome) if outcome.invalid is None else Failed("simulation", outcome.invalid)

    def close(self) -> None:
        """Close the simulator; compiled kernels remain cached for the next process."""
        self._simulator.close()


def calibrate(plan: CampaignPlan, seed: int, label: str, splits: Sequence[str]) -> dict[str, Any]:
    """Calibrate as the campaign would, and simulate θ* on the recorded pours of some splits.

    Args:
        plan: the campaign; it is not calibrated if its budget is 0.
        seed: replaces the campaign's seed.
    """
    calibration = plan.calibration
    assert calibration is not None
    answers, begun = Answers(plan), time.process_time()
    theta = SimulationParameters.from_values(calibration.fixed_parameters)
    drawn: Sequence[SimulationParameters] = ()
    if calibration.simulations > 0:
        (stage,) = (stage for stage in calibration_stages(calibration) if stage.name == CALIBRATION)
        strategy = stage.build({}, stage_seed(seed, stage.name))
        play(strategy, answers, plan.parallel_simulations, label)
        found = calibrated_theta({CALIBRATION: strategy.result()})
        theta, drawn = found.theta, posterior_draws(found, DRAWS)
    pours = [scored for scored in recorded(calibration) if scored.pour.split in splits]
    judge = Evaluation({"theta": theta}, pours, stage_seed(seed, "evaluation"))
    play(judge, answers, plan.parallel_simulations, f"{label}, θ*")
    draws = {f"posterior {k}": one for k, one in enumerate(drawn, 1)}
    among = Evaluation(draws, pours, stage_seed(seed, "evaluation") + 1)
    play(among, answers, plan.parallel_simulations, f"{label}, posterior")
    answers.close()
    return {
        "theta": theta.model_dump(),
        "discrepancy": {split: judge.discrepancy("theta", split) for split in splits},
        "posterior": {split: among.posterior_mean(split) for split in splits},
        "errors": [
            abs(pair.measured - pair.simulated)
            for pair in judge.result().pairs
            if pair.measured is not None and pair.simulated is not None
        ],
        "cpu_s": round(time.process_time() - begun, 1),
    }


def recorded(plan: CalibrationPlan) -> list[ScoredPour]:
    """Return all recorded pours, with those of the other receiver last."""
    transfer = () if plan.transfer is None else plan.transfer.pours
    others = [ScoredPour(plan.transfer.scene.name, MeasuredPour.from_record(p)) for p in transfer if plan.transfer]
    return [*measured_pours(plan, {}), *others]


def without_simulator(plan: CalibrationPlan, folds: Sequence[Sequence[int]]) -> dict[str, float]:
    """Return the mean |Δ| over all pours, predicted by the mean and by a regression of the other pours."""
    totals, count = {"mean": 0.0, "regression": 0.0}, 0
    for fold in folds:
        pours = [scored.pour for scored in measured_pours(without(plan, fold), {})]
        train, test = ([pour for pour in pours if pour.split == split] for split in ("train", "test"))
        known = sum(pour.spillage is not None for pour in test)
        if known == 0:
            continue
        count += known
        totals["mean"] += known * (mean_predictor_discrepancy(train, test) or 0.0)
        totals["regression"] += known * (regression_discrepancy(Contexts.of(plan), train, test) or 0.0)
    return {name: round(total / count, 4) for name, total in totals.items()}


def wanted_sets(options: argparse.Namespace) -> list[tuple[tuple[str, ...], dict[str, float]]]:
    """Return the searched parameters and the known values of each row.

    Raises:
        SystemExit: `--known` has an unknown parameter or an invalid value.
    """
    if options.as_it_is:
        return [(tuple(options.searched), {})]
    sets: list[tuple[tuple[str, ...], dict[str, float]]] = [(names, {}) for names in growing_sets()]
    known = known_values(options.known)
    if known:
        sets.append((tuple(name for name in sets[-1][0] if name not in known), known))
    return sets


def known_values(texts: Sequence[str]) -> dict[str, float]:
    """Parse `--known`: values of parameters by name.

    Raises:
        SystemExit: an unknown parameter or an invalid value.
    """
    known: dict[str, float] = {}
    for text in texts:
        name, _, value = text.partition("=")
        try:
            known[name] = float(value)
            SimulationParameters.from_values({name: known[name]})
        except KeyError:
            there_are = ", ".join(SimulationParameters.info())
            raise SystemExit(f"--known {text}: no such parameter; there are {there_are}") from None
        except ValueError as error:
            raise SystemExit(f"--known {text}: {error}") from None
    return known


def set_name(names: Sequence[str], known: Mapping[str, float]) -> str:
    """Return a readable name of a set."""
    told = ", ".join(f"{name} {value:g}" for name, value in known.items())
    return (" + ".join(names) or "nothing") + (f" (known: {told})" if told else "")


def set_row(name: str, found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return a row of the first table: means over the seeds, and the value of each seed."""
    row: dict[str, Any] = {"searched": name}
    for split in SPLITS:
        values = [one["discrepancy"][split] for one in found if one["discrepancy"].get(split) is not None]
        row[split] = round(statistics.mean(values), 4) if values else None
        row[f"{split}_seeds"] = [round(value, 4) for value in values]
        means = [mean for one in found if (mean := one.get("posterior", {}).get(split)) is not None]
        row[f"{split}_posterior_seeds"] = [round(value, 4) for value in means]
    row["thetas"] = [_rounded(one["theta"]) for one in found]
    row["cpu_s"] = round(sum(one["cpu_s"] for one in found), 1)
    return row


def fold_summary(found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return mean |Δ| over all pours, each scored by a θ* not trained on it, with its standard error."""
    errors = [error for one in found for error in one["errors"]]
    spread = statistics.stdev(errors) / len(errors) ** 0.5 if len(errors) > 1 else None
    return {
        "discrepancy": round(statistics.mean(errors), 4),
        "standard_error": None if spread is None else round(spread, 4),
        "largest": round(max(errors), 4),
        "pours": len(errors),
        "cpu_s": round(sum(one["cpu_s"] for one in found), 1),
    }


def _rounded(theta: Mapping[str, float]) -> dict[str, float]:
    return {name: float(f"{value:.4g}") for name, value in theta.items()}


class Kept:
    """Store of finished calibrations, keyed by everything that determines them; one file each."""

    def __init__(self, folder: str = "calibration-power", *, fresh: bool) -> None:
        self._folder = cache_directory() / folder
        self._folder.mkdir(exist_ok=True)
        if fresh:
            for path in self._folder.glob("*.json"):
                path.unlink()

    def find(self, key: Any) -> dict[str, Any] | None:
        """Return the stored result, or None."""
        path = self._path(key)
        return cast("dict[str, Any]", json.loads(path.read_text(encoding="utf-8"))) if path.exists() else None

    def get(self, key: Any, make: Callable[[], dict[str, Any]]) -> dict[str, Any]:
        """Return the stored result, or compute and store it."""
        found = self.find(key)
        if found is not None:
            return found
        path, result = self._path(key), make()
        unfinished = path.with_suffix(".tmp")
        unfinished.write_text(json.dumps(result), encoding="utf-8")
        unfinished.replace(path)
        return result

    def _path(self, key: Any) -> Path:
        return self._folder / f"{digest(key)[:24]}.json"


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path, nargs="?", default=CAMPAIGN, help="campaign with recorded pours")
    parser.add_argument("--seeds", type=int, nargs="*", default=(11, 12), help="seeds of the sets; none skips the sets")
    parser.add_argument("--simulations", type=int, help="budget per set; default: the campaign's")
    parser.add_argument("--particles", type=int, default=1_000, metavar="N", help="if the campaign does not fix it")
    parser.add_argument(
        "--known", nargs="*", default=[], metavar="NAME=VALUE", help="add a last row that searches the others"
    )
    parser.add_argument("--as-it-is", action="store_true", help="only the campaign's own search")
    parser.add_argument("--folds", type=int, default=8, help="0 skips the cross-validation")
    parser.add_argument("--fold-simulations", type=int, default=72, help="budget per fold")
    parser.add_argument("--workers", type=int, default=1, help="calibrations at a time")
    parser.add_argument("--fresh", action="store_true", help="discard stored results")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # runs one calibration in this process
    return parser.parse_args()


@dataclass(frozen=True)
class Job:
    """One calibration, its seed and the splits that score it."""

    calibration: CalibrationPlan
    seed: int
    label: str
    splits: tuple[str, ...]


def job(calibration: CalibrationPlan, options: argparse.Namespace, which: str) -> Job:
    """Parse a job name: 'set 3 11' is row 3 of the sets with seed 11, 'fold 3 11' the fourth fold."""
    kind, number, seed = which.split()
    if kind == "fold":
        fold = dealt(calibration.records.pours if calibration.records else (), options.folds)[int(number)]
        changed = without(calibration, fold).with_settings(simulations=options.fold_simulations)
        return Job(changed, int(seed), f"fold {int(number) + 1} of {options.folds}", ("test",))
    names, known = wanted_sets(options)[int(number)]
    if names:
        changed = searching(calibration, names, options.particles, known)
        changed = changed.with_settings(simulations=options.simulations)
    else:
        fixed = {"particles": float(options.particles), **calibration.fixed_parameters}
        changed = replace(calibration, fixed_parameters=fixed).with_settings(simulations=0)
    return Job(changed, int(seed), f"{set_name(names, known)}, seed {seed}", SPLITS)


def main() -> None:
    """Measure and print."""
    options = _options()
    try:
        plan = load_campaign(options.campaign)
    except ConfigError as error:
        raise SystemExit(str(error)) from None
    calibration = plan.calibration
    if calibration is None or calibration.records is None:
        raise SystemExit(f"{options.campaign}: a campaign with recorded pours is needed (calibration.pours.from)")
    check_particles(options.particles)
    count = len(calibration.records.pours)
    if options.folds and not 2 <= options.folds <= count:
        raise SystemExit(f"--folds {options.folds}: 2 to {count} are possible with {count} recorded pours")
    options.simulations = options.simulations or calibration.simulations
    options.searched = calibration.parameters.names
    if options.one is not None:
        one = job(calibration, options, options.one)
        print(json.dumps(calibrate(replace(plan, calibration=one.calibration), one.seed, one.label, one.splits)))
        return
    sets = wanted_sets(options)
    wanted = [f"set {k} {seed}" for seed in options.seeds for k in range(len(sets))]
    wanted += [f"fold {k} {plan.seed}" for k in range(options.folds)]
    same = [str(options.campaign.resolve()), f"--simulations={options.simulations}", f"--particles={options.particles}"]
    same += ["--known", *options.known] if options.known else []
    same += ["--as-it-is"] if options.as_it_is else []
    same += [f"--folds={options.folds}", f"--fold-simulations={options.fold_simulations}"]
    machine, kept, begun = describe(), Kept(fresh=options.fresh), time.monotonic()

    def make(which: str) -> dict[str, Any]:
        one = job(calibration, options, which)
        decides = fingerprint(replace(plan, calibration=one.calibration, deployment=None))
        key = [machine["fingerprint"], decides, one.seed, one.splits]
        return kept.get(key, lambda: run_self(__file__, *same, f"--one={which}"))

    with ThreadPoolExecutor(max(options.workers, 1)) as pool:
        found = dict(zip(wanted, pool.map(make, wanted), strict=True))
    say(f"all made, {time.monotonic() - begun:.0f} s")
    result: dict[str, Any] = {"campaign": options.campaign.stem}
    if options.seeds:
        rows = [[found[f"set {k} {seed}"] for seed in options.seeds] for k in range(len(sets))]
        result["sets"] = [set_row(set_name(*one), row) for one, row in zip(sets, rows, strict=True)]
        result |= {"seeds": list(options.seeds), "simulations": options.simulations, "particles": options.particles}
    if options.folds:
        folds = dealt(calibration.records.pours, options.folds)
        judged = [found[f"fold {k} {plan.seed}"] for k in range(options.folds)]
        result["cross_validation"] = {
            "folds": options.folds,
            "simulations": options.fold_simulations,
            "searched": " + ".join(calibration.parameters.names),
            **fold_summary(judged),
            "by_fold": [round(one["discrepancy"]["test"], 4) for one in judged],
            "thetas": [_rounded(one["theta"]) for one in judged],
            "without_simulator": without_simulator(calibration, folds),
            "without_simulator_leaving_one_out": without_simulator(calibration, [[i] for i in range(count)]),
        }
    show({**result, "machine": machine}, options.json)


if __name__ == "__main__":
    main()
