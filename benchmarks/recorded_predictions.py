"""Test predictions of unseen recorded pours seed by seed.

    python benchmarks/recorded_predictions.py [--seeds 11 12 ...] [--simulations 108] [--draws 5] [--write]

For each seed the shipped campaign configs/campaigns/recorded.yaml is calibrated. Each test pour and each pour into the
other receiver is then simulated with draws of the posterior, one seed each. The prediction is their mean and their 90 %
interval. Its error is the mean |recorded − predicted|; the goals are 0.02 on both.

Each calibration runs in its own process and is stored in the cache directory, so an interrupted comparison continues.
`--write` makes no calibrations; it writes the stored ones to docs/data. Seeds that are already there stay, if they were
measured with the same settings.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import json
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from statistics import fmean
from typing import Any

from machine import ROOT, TABLES, KeptRows, describe, provenance, run_self, say, write_table
from quickstart import KeptPours

from actors.interfaces import InvalidActionError
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.learning.calibration.calibration_scores import ScoredPour
from orchestrator.learning.campaign_plan import CalibrationPlan, CampaignPlan, MeasuredPour
from orchestrator.records.codec import digest
from orchestrator.runs.run_service import RunRequest, RunResources, RunService
from orchestrator.runs.stages import (
    CALIBRATION,
    calibrated_theta,
    calibration_stages,
    measured_pours,
    posterior_draws,
    scenes_of,
    stage_seed,
)
from sim_engine.prediction_band import band
from sim_engine.resources import cache_directory
from sim_engine.scene import PourTask

CAMPAIGN = ROOT / "configs" / "campaigns" / "recorded.yaml"
PREDICTIONS = TABLES.with_name("recorded-predictions.json")
GOAL = 0.02


def recorded(plan: CalibrationPlan) -> list[ScoredPour]:
    """Return all recorded pours, with those of the other receiver last."""
    transfer = () if plan.transfer is None else plan.transfer.pours
    others = [ScoredPour(plan.transfer.scene.name, MeasuredPour.from_record(p)) for p in transfer if plan.transfer]
    return [*measured_pours(plan, {}), *others]


def predictions(plan: CampaignPlan, seed: int, draws: int) -> dict[str, Any]:
    """Calibrate, and predict the unseen pours.

    Returns:
        θ*, and for each pour its split, the recorded r, the mean of the simulated r and the ends of their interval.
    """
    calibration, begun, rows = plan.calibration, time.process_time(), []
    assert calibration is not None
    with tempfile.TemporaryDirectory(prefix="decant-recorded-") as folder:
        pool = KeptPours(Path(folder) / "pours.jsonl")
        outputs = plan.outputs.model_copy(update={"directory": Path(folder), "recording": False, "figures": False})
        stages = [stage for stage in calibration_stages(calibration) if stage.name == CALIBRATION]
        handle = RunService().start(
            RunRequest(replace(plan, seed=seed, outputs=outputs), stages), RunResources(True, simulators=pool)
        )
        found = calibrated_theta(asyncio.run(handle.wait()).results)
        scenes, drawn = scenes_of(plan), posterior_draws(found, draws)
        for one in recorded(calibration):
            if one.pour.split == "train" or one.pour.spillage is None:
                continue
            values = []
            for k, theta in enumerate(drawn):
                task = PourTask(scenes[one.scene], one.pour.action, theta, stage_seed(seed, f"draw {k}"))
                with contextlib.suppress(InvalidActionError):
                    outcome = asyncio.run(pool.simulate(task)).outcome
                    r = outcome.fractions.spillage if outcome.invalid is None else None
                    values += [] if r is None else [r]
            if values:
                interval = band(values, found.theta.particles)
                row = {"split": one.pour.split, "recorded": one.pour.spillage, "predicted": fmean(values)}
                rows.append({**row, "low": interval.low, "high": interval.high})
        asyncio.run(pool.close())
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


def mean_row(found: dict[int, dict[str, Any]]) -> list[str]:
    """Return the row of all seeds: mean, smallest and largest error, and number of pours in their intervals."""
    cells = []
    for split in ("test", "transfer"):
        errors = [error(seed, split) for seed in found.values()]
        cells.append(f"{fmean(errors):.3f} ({min(errors):.3f} … {max(errors):.3f})")
    pours = [pour for seed in found.values() for pour in seed["pours"]]
    inside = sum(pour["low"] <= pour["recorded"] <= pour["high"] for pour in pours)
    return ["mean", *cells, f"{inside} of {len(pours)}"]


def write(options: argparse.Namespace, seeds: dict[int, dict[str, Any]]) -> None:
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
    if sorted(seeds) == [*range(min(seeds), max(seeds) + 1)]:
        named = f"$(seq {min(seeds)} {max(seeds)})"
    write_table("recorded", head, [*seed_rows(seeds), mean_row(seeds)], f"{command} --seeds {named}", settings)
    predicted = {str(seed): one["pours"] for seed, one in sorted(seeds.items())}
    kept = {"command": command, **provenance(settings), "seeds": predicted}
    PREDICTIONS.write_text(json.dumps(kept, indent=1, ensure_ascii=False) + "\n", encoding="utf-8")


def main() -> None:
    """Measure, print and store."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(range(11, 21)))
    parser.add_argument("--simulations", type=int, default=108, help="budget per calibration")
    parser.add_argument("--draws", type=int, default=5, help="posterior draws per prediction")
    parser.add_argument("--write", action="store_true", help="make no calibrations; write the stored ones")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # runs one calibration in this process
    options = parser.parse_args()
    plan = load_campaign(CAMPAIGN)
    assert plan.calibration is not None
    plan = replace(plan, calibration=plan.calibration.with_settings(simulations=options.simulations), deployment=None)
    if options.one is not None:
        print(json.dumps(predictions(plan, options.one, options.draws)))
        return
    machine, kept = describe(), KeptRows(cache_directory() / "recorded-predictions.jsonl")
    same = [f"--simulations={options.simulations}", f"--draws={options.draws}"]

    def find(seed: int) -> dict[str, Any] | None:
        key = digest([machine["fingerprint"], fingerprint(plan), seed, options.draws])
        found = next((row for row in kept.rows if row["key"] == key), None)
        if options.write:
            return found
        if found is None:
            found = {"key": key, **run_self(__file__, *same, "--one", str(seed))}
            kept.add(found)
        errors = ", ".join(f"{split} {error(found, split):.3f}" for split in ("test", "transfer"))
        say(f"seed {seed}: {errors} ({found['cpu_s']:.0f} CPU s)")
        return found

    seeds = {seed: found for seed in options.seeds if (found := find(seed)) is not None}
    for row in seed_rows(seeds):
        print(" | ".join(row))
    for split in ("test", "transfer"):
        met = sum(error(one, split) <= GOAL for one in seeds.values())
        print(f"{split}: at most {GOAL} for {met} of {len(seeds)} seeds")
    if options.write:
        write(options, seeds)


if __name__ == "__main__":
    main()
