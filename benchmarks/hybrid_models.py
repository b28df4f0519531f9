"""Compare surrogates for use with simulations that are right, off, scaled, shifted or wrong.

Toy pours after toy simulations:

    python benchmarks/hybrid_models.py [--worlds right far ...] [--models residual constant] [--seeds 8]
                                       [--simulations 37] [--pours 15] [--json]

A world is `spill2` of `optimiser_problems.py` with a simulator of some accuracy. The optimiser chooses the simulations,
like D3's first stage, then the pours; `constant` uses no simulations. Everything runs in this process.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
from machine import describe, pin, say, show
from optimiser_problems import BY_NAME, Floats, Instance

from actors.optimizer.questions import Data, MinimumQuery, Point, PourQuery, SpaceFillingQuery
from actors.optimizer.suggest import propose
from sim_engine.search_space import Axis, Space

SPACE = Space((Axis("x", 0.0, 1.0), Axis("y", 0.0, 1.0)))
SCATTER = 0.02
"""Standard deviation of a simulation's noise."""

WORLDS: dict[str, Callable[[Instance, Floats, Floats], float]] = {
    "right": lambda world, u, _: world.true(u),
    "off by 0.3": lambda world, u, _: world.true(u) + 0.3,
    "half": lambda world, u, _: 0.5 * world.true(u),
    "shifted by 0.08": lambda world, u, sign: world.true(u + 0.08 * sign),
    "shifted by 0.2": lambda world, u, sign: world.true(u + 0.2 * sign),
    "wrong way round": lambda world, u, _: 1.0 - 0.8 * world.true(u),
}
"""Simulated cost at a point (2,), given a direction (2,) of −1 and 1."""


def simulations(name: str, world: Instance, count: int) -> Data:
    """Run the first stage: five Sobol points, then points chosen by the optimiser."""
    rng = np.random.default_rng([world.seed, 999])
    sign = rng.choice([-1.0, 1.0], 2)
    data = Data()

    def simulate(point: Point) -> Data:
        cost = WORLDS[name](world, np.array(point), sign) + SCATTER * float(rng.standard_normal())
        return data.added(point, cost)

    start = SpaceFillingQuery(SPACE, data.points, count=5, seed=world.seed)
    for point in propose(start).points:
        data = simulate(point)
    while len(data) < count:
        data = simulate(propose(MinimumQuery(SPACE, data, seed=100 * world.seed + len(data))).points[0])
    return data


def campaign(model: str, world: Instance, simulated: Data, pours: int) -> dict[str, float]:
    """Run the pours; return their noise-free results."""
    informed = model != "constant"
    query = PourQuery(SPACE, Data(), simulated=simulated) if informed else MinimumQuery(SPACE, Data())
    visited = []
    data = Data()
    for number in range(pours):
        if not informed and number < 3:
            point: Point = tuple(map(float, world.initial[number]))
        else:
            acquisition: Any = "lcb" if number or not informed else "posterior_minimum"
            asked = replace(query, data=data, seed=1000 * world.seed + number, acquisition=acquisition)
            point = propose(asked).points[0]
        visited.append(world.true(np.array(point)))
        data = data.added(point, world.observe(np.array(point), number))
    best = propose(replace(query, data=data, count=0)).best_point
    return {"reported": world.true(np.array(best)), "third": min(visited[:3]), "mean": float(np.mean(visited))}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    models = ["residual", "constant"]
    parser.add_argument("--worlds", nargs="+", choices=list(WORLDS), default=list(WORLDS))
    parser.add_argument("--models", nargs="+", choices=models, default=models)
    parser.add_argument("--seeds", type=int, default=8)
    parser.add_argument("--simulations", type=int, default=37)
    parser.add_argument("--pours", type=int, default=15)
    parser.add_argument("--json", action="store_true")
    asked = parser.parse_args()
    pin(None)
    problem = replace(BY_NAME["spill2"], budget=max(asked.pours, BY_NAME["spill2"].budget))
    rows = []
    for name in asked.worlds:
        worlds = [Instance(problem, seed) for seed in range(asked.seeds)]
        known = [simulations(name, world, asked.simulations) for world in worlds]
        for model in asked.models:
            runs = [campaign(model, w, s, asked.pours) for w, s in zip(worlds, known, strict=True)]
            row: dict[str, Any] = {"world": name, "model": model}
            for key in ("reported", "third", "mean"):
                values = [run[key] for run in runs]
                row[key] = round(float(np.mean(values)), 3)
                row[f"{key}_error"] = round(float(np.std(values, ddof=1) / len(values) ** 0.5), 3)
            rows.append(row)
            say(f"{name}, {model}: {row['reported']} ± {row['reported_error']}")
    show({"seeds": asked.seeds, "rows": rows, "machine": describe()}, asked.json)


if __name__ == "__main__":
    main()
