"""Measure a laboratory that remembers: sequences of campaigns with the same arm and liquid, and new cups.

    python benchmarks/memory.py [--laboratories 10] [--first 61001] [--campaigns 5] [--question 1] [--into build/memory]

Each laboratory has a hidden place of the receiver, hidden walls and a hidden liquid, drawn with its seed. Each of its
campaigns has a new pourer and receiver; the receiver is put down anew within 1 mm, and the walls differ a little. The
campaign is the calibration of quickstart.yaml on the bench of twin.yaml. Compared are, on 12 further pours each:

- `12 pours`: every campaign without a memory, on 12 weighed pours;
- `4 pours`: the last campaign without a memory, on 4 pours;
- `memory`: campaigns 2 to 5 on 4 pours, with `prior: catalogue`; the first campaign had 12 pours;
- `moved`, `other liquid`: the last campaign on 4 pours with a memory that is wrong: its receiver has been moved by
  20 mm, or its bench pours another liquid, since then;
- `moved, no memory`, `other liquid, no memory`: the same without a memory.

Campaigns with a memory choose their pours by information, as is the default with a `prior`; the others spread them
evenly. The catalogue of each laboratory is a folder of its own. Finished campaigns are kept under `--into`.

Questions, fixed before the first run; seeds from 61001 on were used for nothing else:

1. Is the mean error of the last campaign with `memory` at most that with `12 pours`?
2. Is the mean error with a wrong memory at most 1.1 times that of `4 pours`? Is the moved receiver reported as a
   contradiction?

Question 2 was fixed with `4 pours` as its comparison, which is another bench. The two arms without a memory on the same
bench were added when the first laboratory had been seen. Laboratories 61003 to 61010 had evenly spread pours in all
arms, and showed that these can miss a moved receiver; they served to choose the design. The same questions were then
asked of 61011 to 61016. In 61013 the cups touched in two chosen pours; the fifth campaigns with a memory were made
again after such pours were left out.
"""

from __future__ import annotations

import argparse
import asyncio
import json
import os
import shutil
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import mean
from typing import Any

import numpy as np
from machine import ROOT, run_self, say, write_table
from quickstart import CAMPAIGN, further, kept_pours

SHIFT = 0.020
"""Distance by which the receiver of a wrong memory has been moved [m]."""

CONTROL = ", no memory"

WRONG = ("moved", "other liquid")
"""Ways in which a memory is wrong."""

RIGHT = ("12 pours", "4 pours", "memory")
"""Arms of question 1."""

ARMS = (*RIGHT, *WRONG, *(f"{arm}{CONTROL}" for arm in WRONG))


def campaign_content(seed: int, number: int, arm: str, runs: Path) -> dict[str, Any]:
    """Return the campaign `number` (from 0) of the laboratory `seed`."""
    from decant.running import load_campaign

    lab, cup = np.random.default_rng([seed, 56]), np.random.default_rng([seed, 56, number + 1])
    content: dict[str, Any] = dict(load_campaign(CAMPAIGN, ROOT / "configs" / "laboratories" / "twin.yaml").resolved)
    content = {key: value for key, value in content.items() if key != "deployment"}
    content |= {"seed": 100 * seed + number, "name": f"lab{seed}-{number}"}
    content["outputs"] = {"directory": str(runs), "recording": False, "figures": False}
    x, friction = lab.uniform(-0.012, 0.012), lab.uniform(0.1, 0.45)
    cohesion, rate = lab.uniform(0.02, 0.06), lab.uniform(2.0, 8.0)
    x += 0.001 * cup.standard_normal()
    friction = float(np.clip(friction + 0.04 * cup.standard_normal(), 0.0, 0.6))
    if arm.startswith("moved"):
        x += SHIFT if x < 0.0 else -SHIFT
    if arm.startswith("other liquid"):
        cohesion, rate = 0.12, 30.0
    bench = content["laboratory"]["bench"]
    bench["liquid"] |= {"particles": 1000, "cohesion": f"{cohesion} N/m", "xsph_rate": f"{rate} 1/s"}
    bench["liquid"]["friction"] = friction
    bench |= {"pose_error": {"x": f"{x} m"}, "time_scale": 3000}
    pourer, receiver = cup.uniform(0.037, 0.043), cup.uniform(0.030, 0.036)
    content["pourer"] = _cup(f"pourer{number}", pourer)
    content["calibration"] |= {"receiver": _cup(f"receiver{number}", receiver), "random_baseline": 0}
    content["calibration"]["pours"] = {"count": 12 if arm == "12 pours" or number == 0 else 4, "holdout": 0}
    return content | ({"prior": "catalogue"} if number and _remembers(arm) else {})


def _remembers(arm: str) -> bool:
    return arm in ("memory", *WRONG)


def _cup(name: str, radius: float) -> dict[str, Any]:
    inner = [[0, 0], [1e3 * radius, 0], [1e3 * radius, 100]]
    return {"name": name, "profile": {"unit": "mm", "inner": inner, "wall": "4 mm", "floor": "4 mm"}}


def calibrated(seed: int, number: int, arm: str, into: Path) -> dict[str, Any]:
    """Run one campaign; return the errors of θ* on 12 further pours, and what it says about its memory."""
    from decant.running import build_campaign
    from orchestrator.learning.calibration.calibration_base import Calibrated
    from orchestrator.records.codec import result_of
    from orchestrator.runs.run_service import RunRequest, RunResources, RunService
    from orchestrator.runs.stages import CALIBRATION, calibration_stages

    state = into / f"state-{seed}" / ("memory" if _remembers(arm) or number == 0 else arm.replace(",", ""))
    os.environ["DECANT_STATE"] = str(state)
    campaign = build_campaign(campaign_content(seed, number, arm, into / f"runs-{seed}"), into)
    plan = campaign.calibration
    assert plan is not None
    stages = tuple(stage for stage in calibration_stages(plan) if stage.name != "evaluation")
    pool = kept_pours(f"memory-{seed}", into)
    handle = RunService().start(RunRequest(campaign, stages), RunResources(in_process=True, simulators=pool))
    results = asyncio.run(handle.wait()).results
    found = result_of(results, CALIBRATION, Calibrated)
    assert found.found is not None
    errors = asyncio.run(further(campaign, 100 * seed + number, {"theta": found.found.theta}, [found.found.theta],
                                 None, pool))  # fmt: skip
    asyncio.run(pool.close())
    if arm in WRONG:
        shutil.rmtree(handle.folder)  # it is no part of the laboratory's past
    groups = () if found.memory is None else found.memory.groups
    return {
        **{"seed": seed, "number": number, "arm": arm, "error": errors["theta"], "simulations": found.simulations},
        **{"theta": {name: getattr(found.found.theta, name) for name in found.found.searched}},
        "probabilities": {one.group: one.probability for one in groups},
        "contradicted": [one.group for one in groups if one.contradicted],
    }


def wanted(seed: int, campaigns: int, arms: Sequence[str]) -> Iterator[tuple[int, int, str]]:
    """The campaigns of a laboratory, in order: number and arm."""
    last = campaigns - 1
    yield seed, 0, "12 pours"
    for number in range(1, campaigns):
        yield seed, number, "memory"
    yield from ((seed, last, arm) for arm in arms if arm != "memory")


def write(rows: list[dict[str, Any]], last: int) -> None:
    """Store the table of the last campaigns of the laboratories that have all arms of question 1."""
    found = {(row["seed"], row["arm"]): row for row in rows if row["number"] == last}
    seeds = [seed for seed in sorted({seed for seed, _ in found}) if all((seed, arm) in found for arm in RIGHT)]
    table = []
    for arm in ARMS:
        made = {seed: found[seed, arm] for seed in seeds if (seed, arm) in found}
        told = "" if not _remembers(arm) else sum(bool(row["contradicted"]) for row in made.values())
        cells = [f"{100.0 * made[seed]['error']:.2f}" if seed in made else "" for seed in seeds]
        table.append([arm, *cells, f"{100.0 * mean(row['error'] for row in made.values()):.2f}", str(told)])
    head = ["fifth campaign", *map(str, seeds), "mean", "contradicted in"]
    command = f"python benchmarks/memory.py --laboratories {len(seeds)} --first {seeds[0]}"
    write_table("memory", head, table, command, "mean error of θ\\* on 12 further pours of new actions, in points")


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--laboratories", type=int, default=10)
    parser.add_argument("--first", type=int, default=61001)
    parser.add_argument("--campaigns", type=int, default=5)
    parser.add_argument("--question", type=int, choices=(1, 2), default=2, help="1: without the arms of question 2")
    parser.add_argument("--into", type=Path, default=ROOT / "build" / "memory")
    parser.add_argument("--write", action="store_true", help="write the table of the finished laboratories")
    parser.add_argument("--one", help=argparse.SUPPRESS)  # runs one campaign in this process
    asked = parser.parse_args()
    into = asked.into.resolve()
    into.mkdir(parents=True, exist_ok=True)
    if asked.one is not None:
        seed, number, arm = asked.one.split(",", 2)
        print(json.dumps(calibrated(int(seed), int(number), arm, into)))
        return
    file = into / "campaigns.jsonl"
    rows = [json.loads(line) for line in file.read_text(encoding="utf-8").splitlines()] if file.exists() else []
    for seed in () if asked.write else range(asked.first, asked.first + asked.laboratories):
        for one in wanted(seed, asked.campaigns, RIGHT if asked.question == 1 else ARMS):
            if any((row["seed"], row["number"], row["arm"]) == one for row in rows):
                continue
            row = run_self(__file__, f"--one={','.join(map(str, one))}", f"--into={into}")
            rows.append(row)
            with file.open("a", encoding="utf-8") as kept:
                kept.write(json.dumps(row) + "\n")
            say(f"{one}: error {100 * row['error']:.2f} points, {row['simulations']} simulations, memory "
                f"{row['probabilities']}, contradicted {row['contradicted']}")  # fmt: skip
    if asked.write:
        write(rows, asked.campaigns - 1)
    for arm in ARMS:
        chosen = [row for row in rows if row["arm"] == arm and row["number"] == asked.campaigns - 1]
        if chosen:
            told = sum(bool(row["contradicted"]) for row in chosen)
            error = 100 * mean(row["error"] for row in chosen)
            print(f"{arm}: {len(chosen)} laboratories, mean error {error:.2f} points, contradicted in {told}")


if __name__ == "__main__":
    main()
