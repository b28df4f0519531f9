"""Estimate what D3 loses by its simulations: toy campaigns of a learner that knows the simulated losses exactly.

    python benchmarks/exact_simulator.py [--levels 'cliff, moderate' 'cliff, large'] [--seeds 20] [--first 8120]
                                         [--pours 15] [--out FILE] [--write]

The learner has D3's prior distribution of the simulator's errors (offsets, width, gain, noise; `Hypotheses`), but the
noise-free simulated loss at every action instead of 37 simulations. It always pours the action with the least expected
loss. Pours weigh 4,096 hypotheses, which are moved by Markov chains when few remain. It does not know the sizes of the
errors, nor the small smooth error of the simulator that is no offset. Campaigns end and count as in `mismatch.py
--settled 0.005`, on the same worlds. `--write` makes no runs; it writes the table of FILE.

Question, fixed before the runs on seeds from 8120: does this learner reach the goals of D3, 0.06 with a moderate error
and 0.12 with a large one, by more than its standard error?
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import say, write_table
from mismatch_worlds import CLIFFS, Valley
from optimiser_problems import Floats
from scipy.ndimage import map_coordinates
from scipy.special import ndtri
from scipy.stats import qmc

from actors.optimizer.model_discrepancy import STEPS, Hypotheses, latent_size
from actors.optimizer.questions import ModelDiscrepancy
from orchestrator.strategies.deployment.model_monitoring import offset_priors

HYPOTHESES, CANDIDATES = 4096, 2048
CELLS = {2: 257, 3: 65, 4: 25}
"""Points of the grid of simulated losses along each axis, by dimension."""
TOLERANCE = 0.02
"""Standard deviation of errors of the simulator that no hypothesis describes."""
FEW = 200
"""Effective number of hypotheses below which they are resampled and moved."""
SETTLED = 0.005
GOALS = {"cliff, moderate": 0.06, "cliff, large": 0.12}


@dataclass
class Learner:
    """Weighted hypotheses about a simulator whose losses (grid over the unit cube) are known."""

    grid: Floats
    discrepancy: ModelDiscrepancy
    seed: int

    def __post_init__(self) -> None:
        """Draw the prior."""
        dimension = self.grid.ndim
        self.rng = np.random.default_rng(self.seed)
        at = np.unravel_index(int(np.argmin(self.grid)), self.grid.shape)
        self.centre = np.array(at) / (np.array(self.grid.shape) - 1.0)
        sobol = qmc.Sobol(latent_size(dimension), scramble=True, rng=np.random.default_rng(self.seed))
        self.latent: Floats = ndtri(np.clip(sobol.random(HYPOTHESES), 1e-6, 1 - 1e-6))
        self.candidates: Floats = qmc.Sobol(dimension, scramble=True, rng=self.rng).random(CANDIDATES)
        self.weights = np.full(HYPOTHESES, 1.0 / HYPOTHESES)
        self.base = np.zeros(HYPOTHESES)  # log-likelihoods that are in the places of the hypotheses already
        self.points: list[Floats] = []
        self.losses: list[float] = []
        self.means = self.predicted(self.latent, self.candidates)

    def made(self, latent: Floats) -> Hypotheses:
        """Return the hypotheses of latent variables."""
        return Hypotheses.of(self.discrepancy, self.centre, latent, np.zeros(len(latent), dtype=bool))

    def predicted(self, latent: Floats, points: Floats) -> Floats:
        """Return the mean losses (J, m) of hypotheses at points (m, dimension)."""
        hypotheses = self.made(latent)
        found = np.empty((len(latent), len(points)))
        for begin in range(0, len(latent), 512):
            some = hypotheses.only(np.arange(begin, min(begin + 512, len(latent))))
            there = np.clip(some.moved(points), 0.0, 1.0) * (np.array(self.grid.shape) - 1.0)
            simulated = map_coordinates(self.grid, np.moveaxis(there, -1, 0), order=1, mode="nearest")
            found[begin : begin + 512] = np.clip(np.exp(some.gains)[:, None] * simulated, 0.0, 1.0)
        return found

    def likelihoods(self, latent: Floats, means: Floats) -> Floats:
        """Return the log-likelihoods (J,) of all pours, with mean losses (J, n)."""
        hypotheses = self.made(latent)
        spread = np.hypot(hypotheses.noises[:, None] + hypotheses.growths[:, None] * means, TOLERANCE)
        residuals = (np.array(self.losses) - means) / spread
        return np.asarray((-0.5 * residuals**2 - np.log(spread)).sum(axis=1))

    def choose(self) -> Floats:
        """Return the action with the least expected loss (dimension,)."""
        return np.asarray(self.candidates[int(np.argmin(self.weights @ self.means))])

    def learn(self, point: Floats, lost: float) -> None:
        """Weigh the hypotheses by one more pour."""
        self.points.append(point)
        self.losses.append(lost)
        logs = self.likelihoods(self.latent, self.predicted(self.latent, np.array(self.points)))
        weights = np.exp(logs - self.base - np.max(logs - self.base))
        self.weights = weights / weights.sum()
        if 1.0 / np.sum(self.weights**2) < FEW:
            self._move()

    def _move(self) -> None:
        """Resample the hypotheses, and move them by Markov chains that keep the posterior."""
        places = (np.arange(HYPOTHESES) + self.rng.random()) / HYPOTHESES
        latent = self.latent[np.minimum(np.searchsorted(np.cumsum(self.weights), places), HYPOTHESES - 1)]
        points = np.array(self.points)
        likelihood = self.likelihoods(latent, self.predicted(latent, points))
        for step in STEPS:
            proposed = np.sqrt(1.0 - step**2) * latent + step * self.rng.standard_normal(latent.shape)
            theirs = self.likelihoods(proposed, self.predicted(proposed, points))
            accepted = np.log(self.rng.random(HYPOTHESES)) < theirs - likelihood
            latent = np.where(accepted[:, None], proposed, latent)
            likelihood = np.where(accepted, theirs, likelihood)
        self.latent, self.base, self.weights = latent, likelihood, np.full(HYPOTHESES, 1.0 / HYPOTHESES)
        self.means = self.predicted(latent, self.candidates)


def grid_of(valley: Valley) -> Floats:
    """Return the simulated losses on a grid over the unit cube."""
    dimension = len(valley.space.axes)
    axes = [np.linspace(0.0, 1.0, CELLS[dimension])] * dimension
    places = np.stack(np.meshgrid(*axes, indexing="ij"), axis=-1)
    return np.apply_along_axis(valley.simulated, -1, places)


def campaign(level: str, seed: int, pours: int) -> dict[str, Any]:
    """Run one campaign; losses are without scatter."""
    valley = Valley(level, seed)
    learner = Learner(grid_of(valley), ModelDiscrepancy(offset_priors(valley.space)), seed)
    poured: list[float] = []
    while len(poured) < pours and not (len(poured) >= 3 and max(poured[-3:]) < SETTLED):
        at = learner.choose()
        learner.learn(at, valley.observe(at, len(poured)))
        poured.append(valley.true(at, len(poured)))
    made = len(poured)
    poured += [float(np.mean(poured[-3:]))] * (pours - made)
    return {"level": level, "seed": seed, "poured": poured, "made": made}


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", nargs="+", choices=list(CLIFFS), default=list(GOALS))
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=8120)
    parser.add_argument("--pours", type=int, default=15)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--write", action="store_true", help="write the table of FILE to docs/data/results.json")
    asked = parser.parse_args()
    runs: list[dict[str, Any]] = []
    if asked.out is not None and asked.out.exists():
        runs = [json.loads(line) for line in asked.out.read_text(encoding="utf-8").splitlines()]
    known = {(run["level"], run["seed"]) for run in runs}
    seeds = range(asked.first, asked.first + asked.seeds)
    for level in () if asked.write else asked.levels:
        for seed in seeds:
            if (level, seed) not in known:
                runs.append(campaign(level, seed, asked.pours))
                say(f"{level}, seed {seed}: {np.mean(runs[-1]['poured']):.3f} ({runs[-1]['made']} pours)")
                if asked.out is not None:
                    with asked.out.open("a", encoding="utf-8") as file:
                        file.write(json.dumps(runs[-1]) + "\n")
    rows = []
    for level in asked.levels:
        poured = np.array([run["poured"] for run in runs if run["level"] == level and run["seed"] in seeds])
        cells = []
        for values in (poured[:, 0], poured.mean(axis=1)):
            error = float(values.std(ddof=1)) / len(values) ** 0.5
            cells.append(f"{values.mean():.3f} ± {error:.3f}")
        rows.append([level.removeprefix("cliff, "), str(len(poured)), *cells])
        print(" | ".join(rows[-1]))
    if asked.write:
        command = f"python benchmarks/exact_simulator.py --first {asked.first} --seeds {asked.seeds}"
        head = ["simulator", "seeds", "first pour", f"mean of {asked.pours} pours ± standard error"]
        write_table(
            "exact-simulator", head, rows, command, "the worlds of the table above; no simulations, losses known"
        )


if __name__ == "__main__":
    main()
