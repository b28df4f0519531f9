"""Compare loss against number of pours for D1, D2, D3 and competing methods, on the same benches.

    python benchmarks/learning_curves.py [--strategies D1 D2 ...] [--seeds 20] [--first 3000] [--pours 15] [--kept FILE]
                                         [--write]

Benches are simulated: the valleys with steep walls of `mismatch_worlds.py`, with a simulator of moderate error. No
method has prior data of a bench; D1 and D3 have its simulator. Losses are without scatter. Each run is stored in
docs/data/learning-curves.json and not repeated; `--kept` takes the runs of D3 from a file of `mismatch.py`. `--write`
writes the table to docs/data/results.json; docs/make_learning_picture.py draws the curves.

    random, Sobol   points without any choice by results
    rule of thumb   the same slow tilt over the middle each time: a fifth of the range of speeds, the middle of others
    BoTorch qNEI    four Sobol points, then noisy expected improvement: `qLogNoisyExpectedImprovement` with a
                    `SingleTaskGP`, defaults of BoTorch; made with commit 46022671, only read here
    D1              30 simulations; the planned action is poured every time
    D2              pours only
    D3              37 simulations, and two during each pour
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from machine import TABLES, say, write_table
from mismatch import campaign
from mismatch_worlds import Valley
from players import SCENE, Floats, interval, unit
from scipy.stats import qmc
from threadpoolctl import threadpool_limits

from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.d1 import D1Settings
from orchestrator.runs.strategy_harness import StrategyHarness
from sim_engine.action import Action
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss

CURVES = TABLES.with_name("learning-curves.json")
LEVEL, PRIOR, BESIDE, SLOW = "cliff, moderate", 37, 2, 0.2
RIVAL = "BoTorch qNEI"
ARMS = ("rule of thumb", "random", "Sobol", RIVAL, "D1", "D2", "D3")
PLAYED = tuple(arm for arm in ARMS if arm != RIVAL)


def without_choice(arm: str, valley: Valley, seed: int) -> list[float]:
    """Return losses of pours at points that no result influences."""
    dimension = len(valley.space.axes)
    points: Floats = np.tile([SLOW, *[0.5] * (dimension - 1)], (15, 1))
    if arm == "random":
        points = np.random.default_rng([seed, 1]).random((15, dimension))
    elif arm == "Sobol":
        points = qmc.Sobol(dimension, scramble=True, rng=np.random.default_rng(seed)).random(64)[:15]
    return [valley.true(point) for point in points]


def planned(valley: Valley, seed: int) -> list[float]:
    """Return the losses of D1, which pours the same action every time."""
    poured: list[float] = []

    def simulated(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
        lost = valley.simulated(unit(valley.space, action)) + valley.scatter * float(rng.standard_normal())
        return float(np.clip(lost, 0.0, 1.0))

    def real(action: Action, theta: SimulationParameters, rng: np.random.Generator) -> float:
        poured.append(valley.true(unit(valley.space, action)))
        return poured[-1]

    plan = DeploymentPlan(D1Settings(), (SCENE,), valley.space, Loss())
    StrategyHarness(simulated, real).run(plan.settings.build(plan, SCENE, SimulationParameters(), seed))
    return poured[:1] * 15


def run(arm: str, seed: int) -> list[float]:
    """Return the losses of an arm's pours on the bench of a seed."""
    valley = Valley(LEVEL, seed)
    if arm == "D1":
        return planned(valley, seed)
    if arm in ("D2", "D3"):
        found = campaign("adaptive" if arm == "D3" else arm, LEVEL, seed, 15, PRIOR, 0.005 if arm == "D3" else 0.0)
        return list(found["poured"])
    return without_choice(arm, valley, seed)


SIMULATED = {"D1": "30", "D3": f"{PRIOR} (more while none is good), and {BESIDE} a pour"}


def rows(kept: dict[str, Any], seeds: list[str]) -> list[list[str]]:
    """Return one row per arm."""
    found = []
    for arm in (arm for arm in ARMS if set(seeds) <= set(kept["runs"].get(arm, {}))):
        losses = np.array([kept["runs"][arm][seed] for seed in seeds])
        cells = []
        for values in (losses[:, 0], losses.mean(axis=1), losses[:, 10:].mean(axis=1), losses.min(axis=1)):
            mean, low, high = interval(values.tolist())
            cells.append(f"{mean:.3f} ({low:.3f} … {high:.3f})")
        found.append([arm, SIMULATED.get(arm, "none"), *cells])
    return found


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--strategies", nargs="+", choices=PLAYED, default=list(PLAYED))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=3000)
    parser.add_argument("--kept", type=Path, help="runs of mismatch.py")
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    asked = parser.parse_args()
    kept: dict[str, Any] = {"level": LEVEL, "runs": {}}
    if CURVES.exists():
        kept = json.loads(CURVES.read_text())
    for line in asked.kept.read_text().splitlines() if asked.kept else ():
        made = json.loads(line)
        if (made["arm"], made["level"]) == ("adaptive", LEVEL):
            kept["runs"].setdefault("D3", {})[str(made["seed"])] = [round(x, 5) for x in made["poured"]]
    seeds = [str(seed) for seed in range(asked.first, asked.first + asked.seeds)]
    with threadpool_limits(1):
        for arm in asked.strategies:
            done = kept["runs"].setdefault(arm, {})
            missing = [seed for seed in seeds if seed not in done]
            done |= {seed: [round(x, 5) for x in run(arm, int(seed))] for seed in missing}
            say(f"{arm}: done")
            CURVES.write_text(json.dumps(kept, indent=1) + "\n")
    table = rows(kept, seeds)
    print("\n".join(" | ".join(row) for row in table))
    if asked.write:
        head = ["", "simulations", "first pour", "mean of 15 pours", "pours 11 to 15", "best of 15"]
        kept_runs = " --kept FILE" if asked.kept else ""
        command = f"python benchmarks/learning_curves.py --first {asked.first} --seeds {asked.seeds}{kept_runs} --write"
        settings = (
            f"'{LEVEL}'; mean loss without scatter, 95 % bootstrap intervals over {asked.seeds} benches; seeds from "
            f"{asked.first}, not used for tuning"
        )
        write_table("learning", head, table, command, settings)


if __name__ == "__main__":
    main()
