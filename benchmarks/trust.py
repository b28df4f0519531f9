"""What the trust alarm costs and saves: D3 with it and without, beside D2, on simulators that are right or wrong.

Toy pours after toy simulations:

    python benchmarks/trust.py [--worlds right half ...] [--problem narrow2] [--seeds 12] [--pours 15]
                               [--simulations 37] [--model scaled] [--json]

A world is a problem of `optimiser_problems.py`, and a simulator that knows it more or less (`hybrid_models.py`), or
promises that nothing is ever spilled. A seed has the same world and the same scatter of pours in all arms. All of it in
this process.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from typing import Any

import numpy as np
from hybrid_models import SCATTER, WORLDS
from machine import describe, pin, say, show
from optimiser_problems import BY_NAME, Floats, Instance
from players import AXES, SCENE, Numbers, play

from orchestrator.strategies.campaign_plan import DeploymentPlan
from orchestrator.strategies.deployment.d2 import D2Settings, RealOnly
from orchestrator.strategies.deployment.d3 import D3Settings, Hybrid
from orchestrator.strategies.deployment.model_check import Compared, TrustSettings
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import Loss
from sim_engine.search_space import Space

SPACE = Space(AXES[:2])
SIMULATORS: dict[str, Callable[[Instance, Floats, Floats], float]] = {
    **WORLDS,
    "twice": lambda world, u, _: min(2.0 * world.true(u), 1.0),
    "promises everything": lambda world, u, _: 0.0,
}
ARMS: dict[str, TrustSettings | str] = {"D3": TrustSettings(), "D3, no alarm": "always"}


def numbers(world: Instance, simulator: str) -> Numbers:
    """What answers in a world with such a simulator."""
    sign = np.random.default_rng([world.seed, 999]).choice([-1.0, 1.0], SPACE.dimension)
    known = SIMULATORS[simulator]
    return Numbers(SPACE, world.true, world.observe, lambda at: known(world, at, sign), SCATTER)


def campaign(arm: str, simulator: str, seed: int, asked: argparse.Namespace) -> dict[str, float]:
    """One campaign; losses without noise."""
    world = Instance(BY_NAME[asked.problem], seed)
    kind = RealOnly if arm == "D2" else Hybrid
    settings = D2Settings(pours=asked.pours) if arm == "D2" else D3Settings(
        pours=asked.pours, prior_simulations=asked.simulations, model=asked.model, trust=ARMS[arm]
    )  # fmt: skip
    plan = DeploymentPlan(settings, (SCENE,), SPACE, Loss())
    strategy, toy = kind(plan, SCENE, SimulationParameters(), seed), numbers(world, simulator)
    play(strategy, toy.answer)
    best = strategy.best_values
    trust = strategy.result().trust
    return {
        "best of 3": min(toy.poured[:3]),
        "mean": float(np.mean(toy.poured)),
        "reported": 1.0 if best is None else world.true(SPACE.encode(best)),
        "alarm": float(isinstance(trust, Compared) and trust.followed is not None),
    }


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", nargs="+", choices=list(SIMULATORS), default=list(SIMULATORS))
    parser.add_argument("--problem", choices=["spill2", "narrow2"], default="narrow2")
    parser.add_argument("--model", choices=["residual", "pooled", "scaled"], default="scaled")
    parser.add_argument("--seeds", type=int, default=12)
    parser.add_argument("--pours", type=int, default=15)
    parser.add_argument("--simulations", type=int, default=37)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    rows = []
    for simulator in asked.worlds:
        for arm in ARMS:
            runs = [campaign(arm, simulator, seed, asked) for seed in range(asked.seeds)]
            row: dict[str, Any] = {"simulator": simulator, "arm": arm}
            for key in ("best of 3", "mean", "reported"):
                values = [run[key] for run in runs]
                row[key] = round(float(np.mean(values)), 3)
                row[f"{key}, error"] = round(float(np.std(values, ddof=1) / len(values) ** 0.5), 3)
            row["alarms"] = int(sum(run["alarm"] for run in runs))
            rows.append(row)
            say(f"{simulator}, {arm}: {row}")
    show({"seeds": asked.seeds, "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
