"""Loss against pours on the virtual bench: D1, D2, D3, and what they compete with, on the same benches and seeds.

python benchmarks/learning_curves.py --tables             # simulate the pours of the tables (two CPU minutes)
python benchmarks/learning_curves.py [--arms D3 ...] [--seeds 20] [--first 4000] [--pours 15] [--rival PYTHON]
"""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np
from machine import pin, say

from orchestrator.study.study_file import load_study
from sim_engine.action import DEG
from sim_engine.scene import PourTask
from sim_engine.simulator import PourSimulator

ROOT = Path(__file__).resolve().parents[1]
DATA = ROOT / "docs" / "data" / "learning-curves.json"
PARTICLES = 500
SPEEDS = np.linspace(15.0, 126.0, 10) * DEG
OFFSETS = np.linspace(0.100, 0.152, 14)
LIQUIDS = {"simulator": None, "bench": "moderate"}


def tables() -> dict[str, Any]:
    """Simulated losses of a grid of pours into the narrow cup, with the simulator's and with the bench's liquid."""
    study = load_study(ROOT / "configs/studies/paper.yaml")
    plan = study.deployment("D3").plan
    scene = next(one for one in plan.scenes if one.name.endswith("narrow"))
    simulator, found = PourSimulator(), {}
    for name, level in LIQUIDS.items():
        liquid = {} if level is None else study.level(level).bench.liquid.model_dump()
        parameters = study.base.parameters.model_copy(update=liquid | {"particles": PARTICLES})
        losses = np.empty((len(SPEEDS), len(OFFSETS)))
        for i, speed in enumerate(SPEEDS):
            for j, offset in enumerate(OFFSETS):
                action = scene.action({"angular_velocity": speed, "x_offset": offset})
                outcome = simulator.simulate(PourTask(scene, action, parameters, seed=100 * i + j)).outcome
                losses[i, j] = 1.0 - outcome.received
            say(f"{name}: {i + 1} of {len(SPEEDS)} speeds")
            print(losses[i].round(2).tolist(), flush=True)
        found[name] = losses.round(4).tolist()
    return {"speeds": SPEEDS.tolist(), "offsets": OFFSETS.tolist(), "particles": PARTICLES, "losses": found}


def main() -> None:
    """Command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--tables", action="store_true", help="simulate the pours of the tables")
    asked = parser.parse_args()
    pin(None)
    if asked.tables:
        DATA.write_text(json.dumps({"tables": tables()}) + "\n")


if __name__ == "__main__":
    main()
