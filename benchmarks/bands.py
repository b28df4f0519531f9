"""Check the coverage of prediction intervals on pours that calibration did not see.

    python benchmarks/bands.py [CAMPAIGN] [--folds 8] [--simulations 60] [--seeds 4] [--fresh] [--json]

All recorded pours of the campaign's scene are divided into folds, each with slow and fast pours. For each fold:

1. The campaign's strategy calibrates on the other folds.
2. θ* is simulated on those training pours, which gives the residual shift.
3. The fold's pours are predicted with θ from the posterior, one per seed.

The first fold's calibration also predicts the pours of the transfer scene. An interval should contain nine pours in
ten. The output compares intervals from seeds and θ alone, with the resolution, and with the residual shift as well.

Each fold runs in its own process and is stored in the cache directory, so an interrupted benchmark continues.
"""

from __future__ import annotations

import argparse
import json
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

from calibration_power import CAMPAIGN, Answers, Kept, dealt, play, recorded, without
from machine import describe, run_self, say, show

from orchestrator.config.file_loading import load_campaign
from orchestrator.config.yaml.yaml_errors import ConfigError
from orchestrator.requests import Simulate, Simulated
from orchestrator.results.prediction_scores import rank_correlation
from orchestrator.runs.fingerprint import fingerprint
from orchestrator.runs.stages import CALIBRATION, calibrated_theta, calibration_stages, stage_seed
from orchestrator.strategies.calibration.calibration_scores import CALIBRATED, Evaluation, ScoredPour, shift_left_over
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import normalised_spillage
from sim_engine.prediction_band import PredictionInterval, band, resolution_shift

ROWS = ("seeds and θ", "with resolution", "with what was left over")


def predict(plan: CampaignPlan, seeds: int, label: str, *, transfer: bool) -> dict[str, Any]:
    """Calibrate on the training pours, and predict the others.

    Args:
        plan: campaign with a fold as test pours.
        seeds: simulations per prediction.
        label: name in progress messages.
        transfer: also predict the pours of the transfer scene.

    Returns:
        The residual shift, and for each unseen pour its split, measured r and simulated r.
    """
    calibration = plan.calibration
    assert calibration is not None
    answers, begun = Answers(plan), time.process_time()
    (stage,) = (stage for stage in calibration_stages(calibration) if stage.name == CALIBRATION)
    strategy = stage.build({}, stage_seed(plan.seed, stage.name))
    play(strategy, answers, plan.parallel_simulations, label)
    found = calibrated_theta({CALIBRATION: strategy.result()})
    pours = recorded(calibration)
    train = [scored for scored in pours if scored.pour.split == "train"]
    judge = Evaluation({CALIBRATED: found.theta}, train, stage_seed(plan.seed, "left over"))
    play(judge, answers, plan.parallel_simulations, f"{label}, θ*")
    drawn = () if found.posterior is None else found.posterior.thetas
    step = max(len(drawn) // seeds, 1)
    thetas = [SimulationParameters.model_validate({**found.theta.model_dump(), **row}) for row in drawn[::step]]
    unseen = [one for one in pours if one.pour.split == "test" or (transfer and one.pour.split == "transfer")]
    rows = [_row(answers, one, thetas or [found.theta], seeds) for one in unseen if one.pour.spillage is not None]
    answers.close()
    return {
        "left_over": shift_left_over(judge.result(), len(found.searched)),
        "particles": found.theta.particles,
        "pours": rows,
        "cpu_s": round(time.process_time() - begun, 1),
    }


def _row(answers: Answers, one: ScoredPour, thetas: Sequence[SimulationParameters], seeds: int) -> dict[str, Any]:
    values = []
    for seed in range(seeds):
        request = Simulate(one.scene, one.pour.action, thetas[seed % len(thetas)], seed, "predict")
        outcome = answers(request)
        if isinstance(outcome, Simulated) and outcome.outcome.invalid is None:
            r = normalised_spillage(outcome.outcome.fractions)
            values += [] if r is None else [r]
    return {"split": one.pour.split, "measured": one.pour.spillage, "simulated": values}


def bands_of(row: dict[str, Any], particles: int, left: float | None) -> dict[str, PredictionInterval]:
    """Return a pour's interval with one more source of error each time."""
    values = row["simulated"]
    # With this many particles the resolution error vanishes.
    return {
        ROWS[0]: band(values, max(particles, 10**9)),
        ROWS[1]: band(values, particles),
        ROWS[2]: band(values, particles, left),
    }


def summary(found: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """Return the coverage, mean width and error of the mean for each split."""
    rows = []
    for split in ("test", "transfer"):
        known = [(row, one) for one in found for row in one["pours"] if row["split"] == split and row["simulated"]]
        if not known:
            continue
        measured = [row["measured"] for row, _ in known]
        means = [sum(row["simulated"]) / len(row["simulated"]) for row, _ in known]
        shown: dict[str, Any] = {
            "pours": split,
            "count": len(known),
            "mean_error": round(sum(abs(a - b) for a, b in zip(measured, means, strict=True)) / len(known), 4),
            "spearman": rank_correlation(measured, means),
        }
        for name in ROWS:
            bands = [bands_of(row, one["particles"], one["left_over"])[name] for row, one in known]
            held = sum(one.holds(r) for one, r in zip(bands, measured, strict=True))
            width = sum(one.high - one.low for one in bands) / len(bands)
            shown[name] = {"held": held, "share": round(held / len(known), 3), "mean_width": round(width, 3)}
        rows.append(shown)
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("campaign", type=Path, nargs="?", default=CAMPAIGN, help="campaign with recorded pours")
    parser.add_argument("--folds", type=int, default=8)
    parser.add_argument("--simulations", type=int, default=60, help="simulations per calibration")
    parser.add_argument("--seeds", type=int, default=4, help="simulations per prediction, one θ each")
    parser.add_argument("--fresh", action="store_true", help="discard stored results")
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # runs one fold in this process
    options = parser.parse_args()
    try:
        plan = load_campaign(options.campaign)
    except ConfigError as error:
        raise SystemExit(str(error)) from None
    calibration = plan.calibration
    if calibration is None or calibration.records is None:
        raise SystemExit(f"{options.campaign}: a campaign with recorded pours is needed (calibration.pours.from)")
    settings = calibration.settings.model_copy(update={"simulations": options.simulations})
    whole = replace(calibration, settings=settings)
    folds = dealt(calibration.records.pours, options.folds)

    def fold_plan(number: int) -> CampaignPlan:
        left_out = without(whole, folds[number])
        return replace(plan, calibration=replace(left_out, transfer=whole.transfer), deployment=None)

    if options.one is not None:
        number = options.one
        print(json.dumps(predict(fold_plan(number), options.seeds, f"fold {number + 1}", transfer=number == 0)))
        return
    same = [str(options.campaign.resolve()), f"--folds={options.folds}", f"--seeds={options.seeds}"]
    same.append(f"--simulations={options.simulations}")
    machine, kept, found = describe(), Kept("bands", fresh=options.fresh), []
    for number in range(len(folds)):
        key = ["bands", machine["fingerprint"], fingerprint(fold_plan(number)), options.seeds, number]

        def make(number: int = number) -> dict[str, Any]:
            return run_self(__file__, *same, f"--one={number}")

        found.append(kept.get(key, make))
        say(f"fold {number + 1} of {len(folds)}: left over {found[-1]['left_over']}, {found[-1]['cpu_s']} CPU s")
    particles = found[0]["particles"]
    result = {
        "campaign": options.campaign.stem,
        "folds": options.folds,
        "simulations": options.simulations,
        "seeds": options.seeds,
        "left_over": [one["left_over"] for one in found],
        "resolution": resolution_shift(particles),
        "rows": summary(found),
        "cpu_s": round(sum(one["cpu_s"] for one in found), 1),
        "machine": machine,
    }
    show(result, options.json)


if __name__ == "__main__":
    main()
