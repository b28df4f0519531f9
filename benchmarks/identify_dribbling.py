"""Measure how well ten weighed pours identify the adhesion at a pourer's lip, on a simulated bench.

    python benchmarks/identify_dribbling.py --kept FILE [--first 601] [--seeds 12] [--write]

The campaign is `configs/campaigns/dribbling.yaml`: ten slow pours that stop half-way, eight of them to calibrate on.
Per seed the true adhesion is drawn between 0.6 and 2.4, evenly on a logarithmic scale, and so are the bench's errors of
placement, tilt and speed; only the receiver's distance is searched with the adhesion. The bench's liquid has as many
particles as in the simulator, or four times as many.

Questions, fixed before the first of these seeds was run (seed 11 was used to write the campaign):

1. Do the 90 % intervals contain the truth for at least 10 of 12 seeds, with either number of particles?
2. Is the median error of the posterior's median at most a factor of 1.25?
3. Does calibration halve the error on the two test pours for at least 10 of 12 seeds?

Runs are appended to `--kept` and not repeated.
"""

from __future__ import annotations

import argparse
import json
import math
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from identify_viscosity import CLOSE, ENOUGH, bench_errors, calibrated
from machine import ROOT, say, write_table

from decant.running import load_campaign
from orchestrator.results.stage_views import evaluation_of, theta_of

CAMPAIGN = ROOT / "configs" / "campaigns" / "dribbling.yaml"
LEAST, LARGEST = 0.6, 2.4
BENCHES = {"as many particles": 1, "four times as many": 4}


def identified(bench: str, seed: int) -> dict[str, Any]:
    """Return the truth, the posterior's 5, 50 and 95 % quantiles, and the errors on the test pours of one campaign."""
    rng = np.random.default_rng([seed, 20261124])
    content: dict[str, Any] = json.loads(json.dumps(load_campaign(CAMPAIGN).resolved))
    particles = BENCHES[bench] * content["simulator"]["parameters"]["particles"]
    true = LEAST * (LARGEST / LEAST) ** rng.uniform()
    content["seed"] = seed
    content["laboratory"]["bench"] |= {
        "liquid": {"particles": particles, "lip_adhesion": true},
        **bench_errors(rng),
    }
    results = calibrated(content)
    found, scores = theta_of(results), evaluation_of(results)
    assert found is not None
    assert found.posterior is not None
    assert scores is not None
    draws = [theta["lip_adhesion"] for theta in found.posterior.thetas]
    return {
        "bench": bench,
        "seed": seed,
        "true": round(true, 4),
        "quantiles": [round(float(q), 4) for q in np.quantile(draws, (0.05, 0.5, 0.95))],
        "test": {name: scores.discrepancy[name]["test"] for name in ("theta", "uncalibrated")},
    }


def row(runs: list[dict[str, Any]]) -> list[str]:
    """Return a line of the table for the runs on one bench."""

    def of(number: int, least: float) -> str:
        return f"{number} of {len(runs)}" + ("" if number >= least * len(runs) else " (**missed**)")

    inside = sum(run["quantiles"][0] <= run["true"] <= run["quantiles"][2] for run in runs)
    ratios = [run["quantiles"][1] / run["true"] for run in runs]
    error = math.exp(median(abs(math.log(ratio)) for ratio in ratios))
    halved = sum(2.0 * run["test"]["theta"] <= run["test"]["uncalibrated"] for run in runs)
    before, after = (median(run["test"][name] for run in runs) for name in ("uncalibrated", "theta"))
    return [
        runs[0]["bench"],
        of(inside, ENOUGH),
        f"{error:.2f}" + ("" if error <= CLOSE else " (**missed**)"),
        f"{min(ratios):.2f} … {max(ratios):.2f}",
        of(halved, ENOUGH),
        f"{100 * before:.1f} → {100 * after:.1f}",
    ]


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--kept", type=Path, required=True, help="JSON lines of the finished runs")
    parser.add_argument("--first", type=int, default=601)
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    asked = parser.parse_args()
    kept: Path = asked.kept
    runs = [json.loads(line) for line in kept.read_text(encoding="utf-8").splitlines()] if kept.exists() else []
    wanted = [(bench, seed) for bench in BENCHES for seed in range(asked.first, asked.first + asked.seeds)]
    for bench, seed in wanted:
        if not any((run["bench"], run["seed"]) == (bench, seed) for run in runs):
            runs.append(identified(bench, seed))
            say(json.dumps(runs[-1]))
            with kept.open("a", encoding="utf-8") as file:
                file.write(json.dumps(runs[-1]) + "\n")
    chosen = [run for run in runs if (run["bench"], run["seed"]) in wanted]
    rows = [row([run for run in chosen if run["bench"] == bench]) for bench in BENCHES]
    for line in rows:
        print(" | ".join(line))
    if asked.write:
        command = f"python benchmarks/identify_dribbling.py --kept FILE --first {asked.first} --seeds {asked.seeds}"
        head = [
            "liquid of the bench", "truth in the 90 % interval", "median error of the median, factor",
            "median over truth", "test error halved", "median test error, points",
        ]  # fmt: skip
        settings = (
            f"{asked.seeds} seeds from {asked.first}, not used before; truth from {LEAST} to {LARGEST}, searched from "
            "0 to 3; simulator with 600 particles; goals: 10 of 12, factor 1.25, 10 of 12"
        )
        write_table("dribbling", head, rows, command, settings)


if __name__ == "__main__":
    main()
