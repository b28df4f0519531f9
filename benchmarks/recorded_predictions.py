"""Test predictions of unseen recorded pours seed by seed, and after perturbations on the order of rounding errors.

    python benchmarks/recorded_predictions.py [--seeds 11 12 ...] [--perturbed 10] [--simulations 108] [--draws 5]
                                              [--write]

For each seed the shipped campaign configs/campaigns/recorded.yaml is calibrated. Each test pour and each pour into the
other receiver is then simulated with draws of the posterior, one seed each. The prediction is their mean and their 90 %
interval. Its error is the mean |recorded − predicted|; the goals are 0.02 on both.

`--perturbed` repeats the calibration with the first seed, each time with all recorded masses changed by a relative 1e-7
up or down. Rounding on another processor changes results by less. The output reports how much θ* and the predictions
differ, and how many predictions lie in each other's intervals.

Each calibration runs in its own process and is stored in the cache directory, so an interrupted comparison continues.
`--write` makes no calibrations; it writes the stored ones to docs/data. Seeds that are already there stay, if they were
measured with the same settings.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from itertools import permutations
from statistics import fmean
from typing import Any

import numpy as np
from calibration_power import CAMPAIGN, Answers, Kept, play, recorded
from machine import TABLES, describe, provenance, run_self, say, write_table

from orchestrator.config.file_loading import load_campaign
from orchestrator.requests import Simulate, Simulated
from orchestrator.runs.fingerprint import fingerprint
from orchestrator.runs.stages import CALIBRATION, calibrated_theta, calibration_stages, posterior_draws, stage_seed
from orchestrator.strategies.campaign_plan import CampaignPlan, RecordSet
from sim_engine.outcome import normalised_spillage
from sim_engine.prediction_band import band

PERTURBATION = 1e-7
"""Relative change of every recorded mass."""

PREDICTIONS = TABLES.with_name("recorded-predictions.json")
GOAL = 0.02


def perturbed(plan: CampaignPlan, number: int) -> CampaignPlan:
    """Return the campaign with all recorded masses changed by ± 1e-7; unchanged for 0."""
    calibration = plan.calibration
    assert calibration is not None
    assert calibration.records is not None
    if number == 0:
        return plan
    rng = np.random.default_rng(number)

    def changed(mass: float) -> float:
        return mass * (1.0 + PERTURBATION * float(rng.choice([-1.0, 1.0])))

    records: RecordSet = replace(
        calibration.records,
        pours=tuple(
            replace(pour, poured=changed(pour.poured), spilled=changed(pour.spilled))
            for pour in calibration.records.pours
        ),
    )
    return replace(plan, calibration=replace(calibration, records=records))


def predictions(plan: CampaignPlan, seed: int, draws: int, label: str) -> dict[str, Any]:
    """Calibrate, and predict the unseen pours.

    Returns:
        θ*, and for each pour its split, the recorded r, the mean of the simulated r and the ends of their interval.
    """
    calibration = plan.calibration
    assert calibration is not None
    answers, begun = Answers(plan), time.process_time()
    (stage,) = (stage for stage in calibration_stages(calibration) if stage.name == CALIBRATION)
    strategy = stage.build({}, stage_seed(seed, stage.name))
    play(strategy, answers, plan.parallel_simulations, label)
    found = calibrated_theta({CALIBRATION: strategy.result()})
    drawn = posterior_draws(found, draws)
    rows = []
    for one in recorded(calibration):
        if one.pour.split == "train" or one.pour.spillage is None:
            continue
        values = []
        for k, theta in enumerate(drawn):
            outcome = answers(Simulate(one.scene, one.pour.action, theta, stage_seed(seed, f"draw {k}"), "predict"))
            if isinstance(outcome, Simulated) and outcome.outcome.invalid is None:
                r = normalised_spillage(outcome.outcome.fractions)
                values += [] if r is None else [r]
        if values:
            interval = band(values, found.theta.particles)
            row = {"split": one.pour.split, "recorded": one.pour.spillage, "predicted": fmean(values)}
            rows.append({**row, "low": interval.low, "high": interval.high})
    answers.close()
    best = {name: found.theta.model_dump()[name] for name in found.searched}
    return {"theta": best, "pours": rows, "cpu_s": round(time.process_time() - begun, 1)}


def error(found: dict[str, Any], split: str) -> float:
    """Return the mean |recorded − predicted| over the pours of a split."""
    return fmean(abs(one["recorded"] - one["predicted"]) for one in found["pours"] if one["split"] == split)


def seed_rows(found: dict[int, dict[str, Any]]) -> list[list[str]]:
    """Return one row per seed: errors, and number of pours in their intervals."""
    rows = []
    for seed, one in sorted(found.items()):
        held = sum(pour["low"] <= pour["recorded"] <= pour["high"] for pour in one["pours"])
        errors = [f"{error(one, split):.3f}" for split in ("test", "transfer")]
        rows.append([str(seed), *errors, f"{held} of {len(one['pours'])}"])
    return rows


def rounding_rows(found: Sequence[dict[str, Any]]) -> list[list[str]]:
    """Return rows with the differences between calibrations of almost equal pours."""
    rows = []
    for name in found[0]["theta"]:
        values = [one["theta"][name] for one in found]
        rows.append([f"θ\\*, `{name}`", f"{min(values):.3g} … {max(values):.3g}"])
    for split in ("test", "transfer"):
        values = [error(one, split) for one in found]
        rows.append([f"error of the posterior mean, {split}", f"{min(values):.3f} … {max(values):.3f}"])
    pairs = [
        (a["predicted"], b)
        for one, other in permutations(found, 2)
        for a, b in zip(one["pours"], other["pours"], strict=True)
    ]
    held = sum(b["low"] <= value <= b["high"] for value, b in pairs)
    largest = max(abs(value - b["predicted"]) for value, b in pairs)
    rows.append(["largest difference of two predictions of a pour", f"{largest:.3f}"])
    return [*rows, ["predictions inside the 90 % intervals of the others", f"{held} of {len(pairs)}"]]


def write(options: argparse.Namespace, seeds: dict[int, dict[str, Any]], again: Sequence[dict[str, Any]]) -> None:
    """Write predictions and tables to docs/data."""
    settings = (
        f"recorded.yaml with the set of 5,000 particles, C4, {options.simulations} simulations of 1,000 particles, "
        f"{options.draws} draws of the posterior for each prediction"
    )
    command = f"python benchmarks/recorded_predictions.py --simulations {options.simulations} --draws {options.draws}"
    earlier = json.loads(PREDICTIONS.read_text(encoding="utf-8"))
    if earlier["settings"] == settings:
        seeds = {int(seed): {"pours": pours} for seed, pours in earlier["seeds"].items()} | seeds
    head = ["seed", "test, 4 pours", "another receiver, 16 pours", "pours inside their 90 % intervals"]
    named = " ".join(map(str, sorted(seeds)))
    write_table("recorded", head, seed_rows(seeds), f"{command} --seeds {named}", settings)
    if len(again) > 1:
        shown = f"{command} --seeds {options.seeds[0]} --perturbed {len(again) - 1}"
        write_table("rounding", ["", f"{len(again)} calibrations"], rounding_rows(again), shown, settings)
    predicted = {str(seed): one["pours"] for seed, one in sorted(seeds.items())}
    kept = {"command": command, **provenance(settings), "seeds": predicted}
    PREDICTIONS.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(11, 21)))
    parser.add_argument("--perturbed", type=int, default=0, help="calibrations of slightly changed pours")
    parser.add_argument("--simulations", type=int, default=108, help="budget per calibration")
    parser.add_argument("--draws", type=int, default=5, help="posterior draws per prediction")
    parser.add_argument("--fresh", action="store_true", help="discard stored results")
    parser.add_argument("--write", action="store_true", help="make no calibrations; write the stored ones")
    parser.add_argument("--one", type=int, nargs=2, help=argparse.SUPPRESS)  # runs one calibration in this process
    options = parser.parse_args()
    plan = load_campaign(CAMPAIGN)
    assert plan.calibration is not None
    plan = replace(plan, calibration=plan.calibration.with_settings(simulations=options.simulations), deployment=None)
    if options.one is not None:
        seed, number = options.one
        label = f"seed {seed}, perturbed {number}"
        print(json.dumps(predictions(perturbed(plan, number), seed, options.draws, label)))
        return
    machine, kept = describe(), Kept("recorded-predictions", fresh=options.fresh)
    same = [f"--simulations={options.simulations}", f"--draws={options.draws}"]

    def find(seed: int, number: int) -> dict[str, Any] | None:
        key = [machine["fingerprint"], fingerprint(plan), number, seed, options.draws]
        if options.write:
            return kept.find(key)
        found = kept.get(key, lambda: run_self(__file__, *same, "--one", str(seed), str(number)))
        errors = ", ".join(f"{split} {error(found, split):.3f}" for split in ("test", "transfer"))
        say(f"seed {seed}, perturbed {number}: {errors} ({found['cpu_s']:.0f} CPU s)")
        return found

    seeds = {seed: found for seed in options.seeds if (found := find(seed, 0)) is not None}
    again = [found for k in range(options.perturbed + 1) if (found := find(options.seeds[0], k)) is not None]
    for row in [*seed_rows(seeds), *(rounding_rows(again) if len(again) > 1 else [])]:
        print(" | ".join(row))
    for split in ("test", "transfer"):
        met = sum(error(one, split) <= GOAL for one in seeds.values())
        print(f"{split}: at most {GOAL} for {met} of {len(seeds)} seeds")
    if options.write:
        write(options, seeds, again)


if __name__ == "__main__":
    main()
