"""What the quickstart spills on its way, and after how many pours it stops, on the bench of numbers, seed after seed.

    python benchmarks/quickstart.py [--seeds 20] [--first 2000] [--out FILE] [--write]

The shipped campaign as it is, with `configs/laboratories/twin.yaml`; only θ* is not held against its test pours, which
the deployment does not hear of. Every seed is a process with one simulator. Runs are kept in FILE, so that an
interrupted comparison goes on; `--write` makes none, and puts the table of FILE into docs/results.md.

Questions, written before it was run: no pour above 10 % after the first below 1 %? Four pours or fewer until it stops,
in the median? Do the 90 % bands of what a pour was expected to lose hold 85 to 95 % of the pours?
"""

from __future__ import annotations

import argparse
import asyncio
import json
import math
import tempfile
from dataclasses import replace
from pathlib import Path
from statistics import NormalDist, median
from typing import Any

from machine import ROOT, run_self, say
from players import interval

GOOD, BAD = 0.01, 0.10
PAGE = ROOT / "docs" / "results.md"
BEGIN, END = "<!-- measured: quickstart -->\n", "<!-- end of measured -->"


def one(seed: int) -> dict[str, Any]:
    """One campaign: every pour with what was expected of it, and why it ended."""
    from actors.laboratory import open_laboratory
    from decant.campaigns import build_campaign, load_campaign
    from orchestrator.campaign import run_campaign
    from orchestrator.report.results import deployments_of
    from orchestrator.runs import create_run
    from orchestrator.stages import EVALUATION, stages_of

    configs = ROOT / "configs"
    shipped = load_campaign(configs / "campaigns" / "quickstart.yaml", configs / "laboratories" / "twin.yaml")
    with tempfile.TemporaryDirectory(prefix="decant-quickstart-") as folder:
        content: dict[str, Any] = {**shipped.resolved, "seed": seed, "outputs": {"directory": folder, "rrd": False}}
        content["laboratory"]["bench"]["time_scale"] = 3000  # nobody watches; the numbers are the same
        campaign = build_campaign(content, folder)
        stages = tuple(stage for stage in stages_of(campaign) if stage.name != EVALUATION)
        laboratory = open_laboratory(replace(campaign.laboratory, in_process=True), need_bench=True)
        result = asyncio.run(run_campaign(campaign, laboratory, create_run(campaign), stages=stages))
        (found,) = deployments_of(result.results).values()
    pours = [
        {
            "loss": pour.loss,
            "predicted": pour.predicted,
            "deviation": math.hypot(pour.predicted_deviation or 0.0, pour.predicted_scatter or 0.0),
        }
        for pour in found.pours
        if pour.status == "weighed" and pour.loss is not None
    ]
    return {"seed": seed, "pours": pours, "ended": found.ended}


def held(pour: dict[str, Any]) -> bool:
    """Whether a pour lies in its 90 % band, which ends at nothing lost."""
    half = NormalDist().inv_cdf(0.95) * pour["deviation"]
    return bool(max(pour["predicted"] - half, 0.0) <= pour["loss"] <= pour["predicted"] + half)


def table(runs: list[dict[str, Any]]) -> str:
    """Markdown: a row for every seed, and what was asked."""
    lines = ["| seed | lost, pour by pour | pours in their 90 % band | why it ended |", "|---:|---|---:|---|"]
    bad, inside, count = 0, 0, 0
    for run in runs:
        losses = [pour["loss"] for pour in run["pours"]]
        good = next((i for i, loss in enumerate(losses) if loss < GOOD), len(losses))
        bad += sum(loss > BAD for loss in losses[good + 1 :])
        within = sum(map(held, run["pours"]))
        inside, count = inside + within, count + len(losses)
        shown = ", ".join(f"{100 * loss:.1f} %" for loss in losses)
        why = "all pours made" if run["ended"] is None else run["ended"].split(":")[0]
        lines.append(f"| {run['seed']} | {shown} | {within} of {len(losses)} | {why} |")
    stopped = [len(run["pours"]) for run in runs]
    mean, low, high = interval([min(pour["loss"] for pour in run["pours"]) for run in runs])
    lines += [
        "",
        f"{len(runs)} seeds: {bad} pours above 10 % after the first below 1 %; {median(stopped):g} pours in the median "
        f"until it stops ({min(stopped)} to {max(stopped)}); {inside} of {count} pours "
        f"({100 * inside / max(count, 1):.0f} %) in their bands; best pour of each seed {100 * mean:.1f} % in the mean "
        f"({100 * low:.1f} … {100 * high:.1f}).",
    ]
    return "\n".join(lines)


def write(text: str) -> None:
    """Put the table into the page."""
    before, rest = PAGE.read_text(encoding="utf-8").split(BEGIN)
    PAGE.write_text(f"{before}{BEGIN}{text}\n{END}{rest.split(END, 1)[1]}", encoding="utf-8")


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=2000)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--write", action="store_true", help="write the table of FILE into docs/results.md")
    parser.add_argument("--one", type=int, help=argparse.SUPPRESS)  # this is a process that makes one seed
    asked = parser.parse_args()
    if asked.one is not None:
        print(json.dumps(one(asked.one)))
        return
    runs: list[dict[str, Any]] = []
    if asked.out is not None and asked.out.exists():
        runs = [json.loads(line) for line in asked.out.read_text().splitlines()]
    wanted = range(asked.first, asked.first + asked.seeds)
    for seed in () if asked.write else wanted:
        if any(run["seed"] == seed for run in runs):
            continue
        runs.append(run_self(__file__, f"--one={seed}"))
        say(f"seed {seed}: " + ", ".join(f"{100 * pour['loss']:.1f} %" for pour in runs[-1]["pours"]))
        if asked.out is not None:
            with asked.out.open("a") as file:
                file.write(json.dumps(runs[-1]) + "\n")
    found = table(sorted((run for run in runs if run["seed"] in wanted), key=lambda run: int(run["seed"])))
    print(found)
    if asked.write:
        write(found)


if __name__ == "__main__":
    main()
