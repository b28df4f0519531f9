"""Measure how well ten weighed pours identify a parameter of a liquid, on a simulated bench.

    python benchmarks/identify.py viscosity --kept FILE [--first 501] [--seeds 12] [--write]
    python benchmarks/identify.py dribbling --kept FILE [--first 601] [--seeds 12] [--write]

Eight of the ten pours calibrate. Per seed the true value is drawn, and so are the bench's errors of placement, tilt and
speed. On one bench the liquid has as many particles as in the simulator, so that nothing but the drawn values is
unknown; on the other one more, so that the simulator is wrong, too.

- `viscosity` (`configs/campaigns/viscosity.yaml`): pours past a receiver; a hundred times the range of one guess is
  searched. For each nominal viscosity, the true one is drawn within a factor of 1.5. The guesses are the same for all
  seeds. Questions, fixed before the first of these seeds was run (seeds 1 and 2 were used to write the campaign): do
  the 90 % intervals contain the truth for at least 10 of 12 seeds, for each viscosity and either bench? Is the median
  error of the posterior's median at most a factor of 1.25?
- `dribbling` (`configs/campaigns/dribbling.yaml`): slow pours that stop half-way. The true adhesion is drawn between
  0.6 and 2.4, evenly on a logarithmic scale; only the receiver's distance is searched with it. Questions, fixed before
  (seed 11 was used to write the campaign): the same, and does calibration halve the error on the two test pours for at
  least 10 of 12 seeds?

Runs are appended to `--kept` and not repeated; two processes with different seeds may share the file.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import tempfile
import time
from pathlib import Path
from statistics import median
from typing import Any

import numpy as np
from machine import ROOT, KeptRows, say, write_table
from quickstart import KeptPours, calibration_and_test

from decant.running import build_campaign, load_campaign
from orchestrator.records.codec import Results
from orchestrator.reports.stage_views import evaluation_of, theta_of
from orchestrator.runs.run_service import RunRequest, RunResources, RunService

CAMPAIGNS = ROOT / "configs" / "campaigns"
GUESSES = {0.01: 0.03, 0.1: 0.15, 1.0: 0.5}
"""Declared viscosity for each nominal one [Pa s]."""

SPREAD = 1.5
"""Largest factor between the true and the nominal viscosity."""

LEAST, LARGEST = 0.6, 2.4
"""Range of the true adhesion."""

BENCHES = {
    "viscosity": {"as many particles": 1, "twice as many particles": 2},
    "dribbling": {"as many particles": 1, "four times as many": 4},
}
ENOUGH, CLOSE = 10 / 12, 1.25


def content_of(what: str, bench: str, seed: int, rng: np.random.Generator, **liquid: float) -> dict[str, Any]:
    """Return the campaign's content with the hidden bench of a seed; `liquid` has the hidden parameter."""
    content: dict[str, Any] = json.loads(json.dumps(load_campaign(CAMPAIGNS / f"{what}.yaml").resolved))
    particles = BENCHES[what][bench] * content["simulator"]["parameters"]["particles"]
    content["seed"] = seed
    x, y, tilt, speed = rng.standard_normal(4)
    content["laboratory"]["bench"] |= {
        "liquid": {"particles": particles, **liquid},
        "pose_error": {
            "x": f"{2.0 * x} mm", "y": f"{y} mm", "tilt": f"{0.3 * tilt} deg", "speed_factor": 1.0 + 0.01 * speed,
        },
        "time_scale": 3000,  # only speeds the bench up; the results are the same
    }  # fmt: skip
    return content


def drawn(nominal: float, bench: str, seed: int) -> tuple[float, dict[str, Any]]:
    """Return the true viscosity [Pa s], and the campaign's content with the hidden bench of a seed."""
    rng = np.random.default_rng([seed, round(1e4 * nominal)])
    true = nominal * SPREAD ** rng.uniform(-1.0, 1.0)
    content = content_of("viscosity", bench, seed, rng, viscosity_factor=true / GUESSES[nominal])
    content["liquid"]["viscosity"] = f"{GUESSES[nominal]} Pa*s"
    return true, content


def calibrated(content: dict[str, Any]) -> Results:
    """Return the results of a campaign that only calibrates; its bench's pours are not journalled."""
    with tempfile.TemporaryDirectory(prefix="decant-identify-") as folder:
        content["outputs"] = {"directory": folder, "recording": False, "figures": False}
        campaign = build_campaign(content, folder)
        assert campaign.calibration is not None
        pool = KeptPours(Path(folder) / "pours.jsonl")
        request = RunRequest(campaign, calibration_and_test(campaign.calibration))
        handle = RunService().start(request, RunResources(in_process=True, simulators=pool))
        results = asyncio.run(handle.wait()).results
        asyncio.run(pool.close())
    return results


def viscosity(bench: str, nominal: float, seed: int) -> dict[str, Any]:
    """Return the truth and the posterior's 5, 50 and 95 % quantiles [Pa s] of one campaign."""
    true, content = drawn(nominal, bench, seed)
    begun = time.process_time()
    quantiles = posterior_quantiles(calibrated(content), "viscosity_factor", GUESSES[nominal])
    cpu_s = round(time.process_time() - begun, 1)
    return {"nominal": nominal, "bench": bench, "seed": seed, "true": true, "quantiles": quantiles, "cpu_s": cpu_s}


def dribbling(bench: str, seed: int) -> dict[str, Any]:
    """Return the truth, the posterior's 5, 50 and 95 % quantiles, and the errors on the test pours of one campaign."""
    rng = np.random.default_rng([seed, 20261124])
    true = LEAST * (LARGEST / LEAST) ** rng.uniform()
    results = calibrated(content_of("dribbling", bench, seed, rng, lip_adhesion=true))
    scores = evaluation_of(results)
    assert scores is not None
    return {
        "bench": bench,
        "seed": seed,
        "true": round(true, 4),
        "quantiles": posterior_quantiles(results, "lip_adhesion", 1.0),
        "test": {name: scores.discrepancy[name]["test"] for name in ("theta", "uncalibrated")},
    }


def posterior_quantiles(results: Results, name: str, unit: float) -> list[float]:
    """Return the 5, 50 and 95 % quantiles of a parameter, in multiples of `unit`."""
    found = theta_of(results)
    assert found is not None
    assert found.posterior is not None
    draws = [unit * theta[name] for theta in found.posterior.thetas]
    return [round(float(q), 5) for q in np.quantile(draws, (0.05, 0.5, 0.95))]


def enough(number: int, runs: list[dict[str, Any]]) -> str:
    """Return the number of runs that meet a goal, with a mark if they are too few."""
    return f"{number} of {len(runs)}" + ("" if number >= ENOUGH * len(runs) else " (**missed**)")


def row(runs: list[dict[str, Any]]) -> list[str]:
    """Return a line of a table for runs on one bench, with one nominal viscosity if there are several."""
    inside = sum(run["quantiles"][0] <= run["true"] <= run["quantiles"][2] for run in runs)
    ratios = [run["quantiles"][1] / run["true"] for run in runs]
    error = math.exp(median(abs(math.log(ratio)) for ratio in ratios))
    cells = [
        runs[0]["bench"],
        enough(inside, runs),
        f"{error:.2f}" + ("" if error <= CLOSE else " (**missed**)"),
        f"{min(ratios):.2f} … {max(ratios):.2f}",
    ]
    if "nominal" in runs[0]:
        width = math.exp(median(math.log(run["quantiles"][2] / run["quantiles"][0]) for run in runs))
        return [f"{1e3 * runs[0]['nominal']:g}", *cells, f"{width:.1f}"]
    halved = sum(2.0 * run["test"]["theta"] <= run["test"]["uncalibrated"] for run in runs)
    before, after = (median(run["test"][name] for run in runs) for name in ("uncalibrated", "theta"))
    return [*cells, enough(halved, runs), f"{100 * before:.1f} → {100 * after:.1f}"]


COMMON = [
    "liquid of the bench",
    "truth in the 90 % interval",
    "median error of the median, factor",
    "median over truth",
]
HEADS = {
    "viscosity": ["nominal viscosity, mPa s", *COMMON, "95 % over 5 % quantile"],
    "dribbling": [*COMMON, "test error halved", "median test error, points"],
}
SETTINGS = {
    "viscosity": "not used for tuning; guesses 30, 150 and 500 mPa s, truth within a factor of 1.5 of the nominal "
    "value; simulator with 600 particles; goals: 10 of 12, factor 1.25",
    "dribbling": f"not used before; truth from {LEAST} to {LARGEST}, searched from 0 to 3; simulator with 600 "
    "particles; goals: 10 of 12, factor 1.25, 10 of 12",
}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=list(HEADS))
    parser.add_argument("--kept", type=Path, required=True, help="JSON lines of the finished runs")
    parser.add_argument("--first", type=int, help="first seed; default: 501 and 601")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    asked = parser.parse_args()
    kept = KeptRows(asked.kept)
    what, first = asked.what, asked.first or {"viscosity": 501, "dribbling": 601}[asked.what]
    groups = [(bench, nominal) for nominal in (GUESSES if what == "viscosity" else (None,)) for bench in BENCHES[what]]
    chosen: dict[tuple[str, float | None], list[dict[str, Any]]] = {group: [] for group in groups}
    for seed in range(first, first + asked.seeds):
        for bench, nominal in groups:
            known = [
                run for run in kept.rows if (run["bench"], run.get("nominal"), run["seed"]) == (bench, nominal, seed)
            ]
            if not known:
                known = [dribbling(bench, seed) if nominal is None else viscosity(bench, nominal, seed)]
                say(json.dumps(known[0]))
                kept.add(known[0])
            chosen[bench, nominal] += known[:1]
    rows = [row(those) for those in chosen.values()]
    for line in rows:
        print(" | ".join(line))
    if asked.write:
        command = f"python benchmarks/identify.py {what} --kept FILE --first {first} --seeds {asked.seeds}"
        settings = f"{asked.seeds} seeds from {first}, {SETTINGS[what]}"
        write_table(what, HEADS[what], rows, command, settings)


if __name__ == "__main__":
    main()
