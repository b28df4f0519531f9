"""Compare C1, C2, C3, C4 and no calibration: discrepancy of θ* on unseen recorded pours, and cost.

    python benchmarks/calibration_strategies.py [CAMPAIGN] [--search wall_distance rim_correction]
                                                [--rows C1=2800 C2=504 C3=1652 C4=108] [--seeds 11 12 13]
                                                [--known cohesion=0 xsph_rate=0]
                                                [--random 8] [--once C1 random] [--workers 1] [--fresh] [--kept]
                                                [--json]

Each row is a strategy with a budget of single simulated pours; the default budgets are the paper's. `--rows C1=504
C2=504 C3=504 C4=504` compares the strategies at equal cost. All rows search the same parameters, two as in the paper.
A parameter that is not searched has the value given with `--known`, the campaign's fixed value, or Decant's default.

θ* is then simulated on each recorded pour. The score is the mean |measured − simulated| of the normalised spillage on
training, test and transfer pours, each with a 95 % interval, and the quartiles over all pours outside the training set
(test and transfer, all seeds). An interval is a bootstrap over the pours, each averaged over the seeds; it shows the
effect of the choice of pours. Seeds change the random choices and the initial positions. C1 and rows without a search
have no random choices. Rows named in `--once` run with the first seed only.

Rows without calibration:

- 'uncalibrated' has the known values, and Decant's defaults for the searched parameters.
- 'defaults', present if `--known` is given, has only defaults.
- 'random' is the median over θ drawn from the search space, on pours outside the training set.

Each calibration runs in its own process, up to `--workers` at a time, and is stored in the cache directory, so an
interrupted benchmark continues. `--kept` computes nothing and shows the stored results. `--fresh` discards them.
"""

from __future__ import annotations

import argparse
import json
import statistics
import time
from collections.abc import Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from calibration_power import CAMPAIGN, SPLITS, Answers, Kept, known_values, play, recorded, searching
from machine import describe, run_self, say, show
from optimisers import interval

from orchestrator.config.file_loading import load_campaign
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.journal.codec import result_of
from orchestrator.runs.fingerprint import fingerprint
from orchestrator.runs.stages import CALIBRATION, calibrated_theta, calibration_stages, stage_seed
from orchestrator.strategies.calibration.calibration_base import Calibrated, DesignSettings
from orchestrator.strategies.calibration.calibration_scores import Evaluation, random_parameters
from orchestrator.strategies.campaign_plan import CalibrationPlan, CampaignPlan
from orchestrator.strategies.strategy_registry import calibrations
from sim_engine.liquids import SimulationParameters
from sim_engine.settings.model import Problems

PAPER = ("C1=2800", "C2=504", "C3=1652", "C4=108")
DEFAULTS, UNCALIBRATED, RANDOM = "defaults", "uncalibrated", "random"
NOT_CALIBRATED = (DEFAULTS, UNCALIBRATED, RANDOM)
TRAINED_ON = "train"


@dataclass(frozen=True)
class Row:
    """A strategy and its budget.

    Attributes:
        name: 'C1' to 'C4', or one of `NOT_CALIBRATED`.
        budget: single simulated pours; for 'random', the number of θ.
    """

    name: str
    budget: int = 0


class Complaints:
    """Records whether the settings have a problem."""

    any = False

    def add(self, text: str, *at: str | int, key: bool = False, of: str = "", more: bool = False) -> None:
        """Record a problem."""
        self.any = True

    def valid(self, *keys: str) -> bool:
        """Return True: all keys are valid."""
        return True

    def within(self, *at: str | int) -> Problems:
        """Return this object."""
        return self


def at_price(plan: CalibrationPlan, row: Row) -> CalibrationPlan:
    """Return the calibration by another strategy, with as many θ as the budget allows.

    Raises:
        SystemExit: the budget is too small.
    """
    pours = sum(scored.pour.split == TRAINED_ON and scored.pour.spillage is not None for scored in recorded(plan))
    kind, names = calibrations()[row.name], plan.parameters.names
    settings = kind.like(plan.settings, simulations=row.budget)
    if (initial := getattr(settings, "initial_samples", None)) is not None:
        trials = row.budget if row.name == "C4" else max(row.budget // pours, 1)
        settings = settings.model_copy(update={"initial_samples": min(initial, trials)})
    complaints = Complaints()
    settled = settings.settled(names, pours, complaints)
    if settled is None or complaints.any:
        raise SystemExit(f"--rows {row.name}={row.budget}: too few for {len(names)} parameters and {pours} pours")
    return replace(plan, settings=settled)


def measure(plan: CampaignPlan, row: Row, seed: int) -> dict[str, Any]:
    """Calibrate as a campaign would, and simulate the found θ on all recorded pours.

    Args:
        plan: campaign whose calibration comes from `at_price`.
        seed: replaces the campaign's seed.
    """
    calibration = plan.calibration
    assert calibration is not None
    answers, begun, label = Answers(plan), time.process_time(), f"{row.name}, seed {seed}"
    found: Calibrated | None = None
    if row.name == DEFAULTS:
        thetas = {"theta": SimulationParameters()}
    elif row.name == UNCALIBRATED:
        # fixed values apply to every user; searched parameters have their defaults
        thetas = {"theta": SimulationParameters.from_values(calibration.fixed_parameters)}
    elif row.name == RANDOM:
        thetas = random_parameters(calibration.parameters, calibration.fixed_parameters, row.budget, seed)
    else:
        (stage,) = (stage for stage in calibration_stages(calibration) if stage.name == CALIBRATION)
        strategy = stage.build({}, stage_seed(seed, stage.name))
        play(strategy, answers, plan.parallel_simulations, label)
        found = result_of({CALIBRATION: strategy.result()}, CALIBRATION, Calibrated)
        thetas = {"theta": calibrated_theta({CALIBRATION: found}).theta}
    pours = recorded(calibration)
    unseen = [scored for scored in pours if scored.pour.split != TRAINED_ON]
    # unseen pours come first, so that all θ have the same initial positions there
    trained = [] if row.name == RANDOM else [scored for scored in pours if scored.pour.split == TRAINED_ON]
    judge = Evaluation(thetas, [*unseen, *trained], stage_seed(seed, "evaluation"))
    play(judge, answers, plan.parallel_simulations, f"{label}, judged")
    answers.close()
    errors: dict[str, list[float | None]] = {split: [] for split in SPLITS}
    for pair in judge.result().pairs:
        known = pair.measured is not None and pair.simulated is not None
        errors[pair.split].append(abs(pair.measured - pair.simulated) if known else None)  # type: ignore[operator]
    return {
        "theta": None if row.name == RANDOM else thetas["theta"].model_dump(),
        "discrepancy": {
            split: judge.random_median(split) if row.name == RANDOM else judge.discrepancy("theta", split)
            for split in SPLITS
        },
        "errors": {} if row.name == RANDOM else errors,
        "simulations": 0 if found is None else found.simulations,
        "lost": 0 if found is None else found.lost,
        "expected": None if found is None or found.found is None else found.found.predicted_discrepancy,
        "cpu_s": round(time.process_time() - begun, 1),
    }


def table_row(row: Row, calibration: CalibrationPlan | None, found: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return means over the seeds, intervals over the pours, each seed's value, and quartiles of unseen pours."""
    shown: dict[str, Any] = {"strategy": row.name, "simulations": max(one["simulations"] for one in found)}
    if calibration is not None and row.name in ("C1", "C2", "C3"):
        assert isinstance(calibration.settings, DesignSettings)
        shown["thetas"] = calibration.settings.thetas
    for split in SPLITS:
        values = [one["discrepancy"][split] for one in found if one["discrepancy"][split] is not None]
        shown[split] = round(statistics.mean(values), 4) if values else None
        shown[f"{split}_seeds"] = [round(value, 4) for value in values]
        of_pours = over_seeds([one["errors"].get(split, ()) for one in found])
        if of_pours:
            shown[f"{split}_interval"] = [round(bound, 4) for bound in interval(of_pours)[1:]]
    unseen = [
        error
        for one in found
        for split, errors in one["errors"].items()
        for error in errors
        if split != TRAINED_ON and error is not None
    ]
    if len(unseen) > 1:
        shown["unseen_quartiles"] = [round(value, 4) for value in statistics.quantiles(unseen, n=4)]
    shown["expected"] = [round(one["expected"], 4) for one in found if one["expected"] is not None]
    shown["thetas_found"] = [
        {name: float(f"{value:.4g}") for name, value in one["theta"].items()} for one in found if one["theta"]
    ]
    shown["lost"] = sum(one["lost"] for one in found)
    shown["cpu_s"] = round(sum(one["cpu_s"] for one in found), 1)
    return shown


def over_seeds(found: Sequence[Sequence[float | None]]) -> list[float]:
    """Return each pour's mean error over the seeds that have one; empty if there are none."""
    known = [[error for error in errors if error is not None] for errors in zip(*found, strict=True)]
    return [statistics.mean(errors) for errors in known if errors]


def rows_of(options: argparse.Namespace) -> list[Row]:
    """Return the rows of the table, with the uncalibrated ones first.

    Raises:
        SystemExit: `--rows` has an unknown strategy or no budget.
    """
    rows = [Row(DEFAULTS)] if options.known else []
    rows += [Row(UNCALIBRATED), *([Row(RANDOM, options.random)] if options.random > 0 else [])]
    for text in options.rows:
        name, _, budget = text.partition("=")
        if name not in ("C1", "C2", "C3", "C4") or not budget.isdigit() or int(budget) < 1:
            raise SystemExit(f"--rows {text}: should be a strategy and its simulations, for example C3=1652")
        rows.append(Row(name, int(budget)))
    return rows


def _options() -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path, nargs="?", default=CAMPAIGN, help="campaign with recorded pours")
    parser.add_argument("--search", nargs="+", default=("wall_distance", "rim_correction"), metavar="PARAMETER")
    parser.add_argument("--known", nargs="*", default=[], metavar="NAME=VALUE", help="values of other parameters")
    parser.add_argument("--rows", nargs="+", default=PAPER, metavar="STRATEGY=SIMULATIONS")
    parser.add_argument("--seeds", type=int, nargs="+", default=(11, 12, 13))
    parser.add_argument("--random", type=int, default=8, help="random θ per seed to compare with; 0 for none")
    parser.add_argument("--once", nargs="*", default=[], metavar="ROW", help="rows that run with the first seed only")
    parser.add_argument("--workers", type=int, default=1, help="calibrations at a time")
    parser.add_argument("--fresh", action="store_true", help="discard stored results")
    parser.add_argument("--kept", action="store_true", help="compute nothing, show stored results")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # runs one calibration in this process
    return parser.parse_args()


def searched(plan: CampaignPlan, names: Sequence[str], known: Mapping[str, float]) -> CampaignPlan:
    """Return the campaign with only these parameters searched, and with calibration only.

    Raises:
        SystemExit: the campaign has no recorded pours, or does not search these parameters.
    """
    calibration = plan.calibration
    if calibration is None or calibration.records is None:
        raise SystemExit(f"{plan.source}: a campaign with recorded pours is needed (calibration.pours.from)")
    unknown = sorted(set(names) - set(calibration.parameters.names))
    if unknown:
        there_are = ", ".join(calibration.parameters.names)
        raise SystemExit(f"--search {' '.join(unknown)}: not searched by {plan.source.name}; it searches {there_are}")
    default = SimulationParameters().particles
    both = sorted(set(known) & set(names))
    if both:
        raise SystemExit(f"--known {' '.join(both)}: searched as well; say one of them")
    return replace(plan, calibration=searching(calibration, names, default, known), deployment=None)


def main() -> None:
    """Measure and print."""
    options = _options()
    try:
        plan = searched(load_campaign(options.campaign), options.search, known_values(options.known))
    except ConfigError as error:
        raise SystemExit(str(error)) from None
    calibration = plan.calibration
    assert calibration is not None
    rows = rows_of(options)
    plans = [
        plan if row.name in NOT_CALIBRATED else replace(plan, calibration=at_price(calibration, row)) for row in rows
    ]
    if options.one is not None:
        number, seed = map(int, options.one.split())
        print(json.dumps(measure(plans[number], rows[number], seed)))
        return
    same = [str(options.campaign.resolve()), "--search", *options.search, "--rows", *options.rows]
    same += ["--known", *options.known] if options.known else []
    same += [f"--random={options.random}"]
    machine, kept, begun = describe(), Kept("calibration-strategies", fresh=options.fresh), time.monotonic()

    def make(job: tuple[int, int]) -> dict[str, Any] | None:
        number, seed = job
        row = rows[number]
        key = ["strategies", machine["fingerprint"], fingerprint(plans[number]), row.name, row.budget, seed]
        if options.kept:
            return kept.find(key)
        found = kept.get(key, lambda: run_self(__file__, *same, f"--one={number} {seed}"))
        say(f"{row.name}, seed {seed}: {found['discrepancy']}, {found['cpu_s']} CPU s")
        return found

    jobs = [
        (number, seed)
        for seed in options.seeds
        for number, row in enumerate(rows)
        if row.name not in options.once or seed == options.seeds[0]
    ]
    with ThreadPoolExecutor(max(options.workers, 1)) as pool:
        made = dict(zip(jobs, pool.map(make, jobs), strict=True))
    say(f"{sum(one is not None for one in made.values())} of {len(jobs)} made, {time.monotonic() - begun:.0f} s")
    found = [[one for job, one in made.items() if job[0] == number and one is not None] for number in range(len(rows))]
    table = [
        {"seeds": len(of_row), **table_row(row, plans[number].calibration, of_row)}
        for number, (row, of_row) in enumerate(zip(rows, found, strict=True))
        if of_row
    ]
    result = {"campaign": options.campaign.stem, "searched": list(options.search), "seeds": list(options.seeds)}
    show({**result, "rows": table, "machine": machine}, options.json)


if __name__ == "__main__":
    main()
