"""Measure what a slow drift of the bench costs D3: mean loss of 40 pours, beside the same strategy on a still bench.

    python benchmarks/slow_drift.py [--levels 'cliff, small' small] [--drifts 0 0.5 2] [--programs drift still]
                                    [--still-drifts 0] [--seeds 20] [--first 71000] [--pours 40] --out FILE | --ideal

The receiver of a toy bench (`mismatch_worlds.py`) moves evenly, by some millimetres in ten pours, in a direction
that the seed draws. Strategy and optimiser are the real ones; a seed has the same world and scatter of pours in
all rows. The program `still` has hypotheses of still benches only, as before drifts were added. Runs are stored in
FILE, so an interrupted comparison continues.

Questions, fixed before the first run on seeds from 71000. Seeds 70000 to 70999 are for tuning. Losses are without
scatter:

1. Is the mean loss of 40 pours with 0.5 and with 2 mm of drift in ten pours at most 1.3 times that without drift?
2. Without drift: is it at most 1.02 times that of the program `still`?

The level `viscosity` is a simulated bench: pours of 300 particles of an oil into a slim cup, 3 mm from where the arm
takes it to be. A drift of 1 halves the oil's viscosity evenly in 40 pours. D3 makes 20 simulations before the first
pour and none between pours.

3. `--levels viscosity --drifts 0 1 --seeds 3`: is the mean loss with that drift at most 1.3 times that without?

`--ideal` prints what is attainable instead: the loss of an observer who knows the valley and the scatter exactly and
infers position and pace along x_offset alone, by Bayes' rule. Before the first pour the position is known to 1.5 mm.
"""

from __future__ import annotations

import argparse
import json
from functools import cache
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np
from mismatch_worlds import OFFSET, Floats, Valley
from players import SCENE, Numbers, interval, play
from scipy.special import ndtr

from actors.optimizer import model_discrepancy
from actors.optimizer.questions import PourQuery, Suggestion, SuggestionQuery
from actors.optimizer.suggest import propose
from orchestrator.learning.campaign_plan import DeploymentPlan
from orchestrator.learning.deployment.d3 import D3Settings, Hybrid
from orchestrator.learning.requests import Outcome, Pour, Poured, Request, Simulate, Simulated
from sim_engine.action import DEG, Action
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.outcome import Loss, PourMeasurement, PourOutcome
from sim_engine.scene import PourTask, Scene
from sim_engine.search_space import Axis, Space
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.shapes import cylinder

NEVER = 10**6
"""Number of pours from which a drift is considered by the program `still`."""

TENTH = 1e-4
"""A millimetre in ten pours, per pour [m]."""

VISCOSITY = "viscosity"
OIL = SimulationParameters(particles=300)
SLIM = Scene(
    "slim",
    cylinder("beaker", inner_radius=0.04, inner_height=0.1),
    cylinder("slim", inner_radius=0.027, inner_height=0.11),
    Liquid(name="oil", mass=0.18, density=920.0, dynamic_viscosity=0.08, surface_tension=0.033),
    fixed={"max_angle": 120 * DEG, "height": 0.11},
)
AT_THE_CUP = Space((Axis("angular_velocity", 60 * DEG, 150 * DEG), Axis("x_offset", 0.07, 0.15)))
"""Scene and searched actions of the simulated bench."""


class Drifting(Valley):
    """The world of one seed, with a receiver that moves by `drift` [m] with every pour."""

    def __init__(self, level: str, seed: int, drift: float) -> None:
        super().__init__(level, seed)
        self._drift = drift

    def true(self, unit: Floats, index: int = 0) -> float:
        """Return the loss of pour `index`, from 0, at a point of the unit cube (dimension,), without scatter."""
        moved = np.clip(np.asarray(unit, dtype=float), 0.0, 1.0)
        moved[1] += self._signs[1] * self._drift * index / (OFFSET.upper - OFFSET.lower)
        return self._lost(moved, 1.0)


class Oil:
    """A simulated bench whose oil gets thinner by the same factor with every pour.

    Attributes:
        poured: weighed losses of the pours.
    """

    def __init__(self, seed: int, halvings: float) -> None:
        self._seed, self._halvings = seed, halvings
        self.poured: list[float] = []

    def answer(self, request: Request) -> Outcome:
        """Return the outcome of a simulation or a pour."""
        assert isinstance(request, Simulate | Pour)
        bench = isinstance(request, Pour)
        parameters, seed = OIL, request.seed
        if bench:
            factor = 0.5 ** (self._halvings * len(self.poured) / 40)
            parameters = OIL.model_copy(update={"receiver_x": 0.003, "viscosity_factor": factor})
            seed = 1000 * self._seed + len(self.poured)
        outcome = simulated_outcome(request.action, parameters, seed)
        if not bench:
            return Simulated(outcome)
        self.poured.append(outcome.spilled + outcome.retained)
        mass = SLIM.liquid.mass
        return Poured(PourMeasurement(mass, mass * outcome.spilled, mass * outcome.retained))


@cache
def simulated_outcome(action: Action, parameters: SimulationParameters, seed: int) -> PourOutcome:
    """Simulate a pour; repeated ones are not."""
    outcome = simulator().simulate(PourTask(SLIM, action, parameters, seed)).outcome
    assert outcome.invalid is None, outcome.invalid
    return outcome


@cache
def simulator() -> PourSimulator:
    """The engine, once in this process."""
    return PourSimulator()


def campaign(
    level: str, seed: int, drift: float, program: str, pours: int, answers: dict[Any, Suggestion]
) -> dict[str, Any]:
    """Run one campaign.

    Args:
        drift: in ten pours [mm].
        program: 'drift' or 'still'.
        answers: of earlier campaigns on the same seed, whose beginnings are the same.
    """
    world: Numbers | Oil
    if level == VISCOSITY:
        settings = D3Settings(pours=pours, prior_simulations=20, simulations_per_pour=0)
        strategy = Hybrid(DeploymentPlan(settings, (SLIM,), AT_THE_CUP, Loss()), SLIM, OIL, seed)
        world = Oil(seed, drift)
    else:
        valley, settings = Drifting(level, seed, TENTH * drift), D3Settings(pours=pours)
        plan = DeploymentPlan(settings, (SCENE,), valley.space, Loss())
        strategy = Hybrid(plan, SCENE, SimulationParameters(), seed)
        world = numbers = Numbers(valley.space, valley.true, valley.observe, valley.simulated, valley.scatter)
        numbers.true = lambda unit: valley.true(unit, len(numbers.poured))
    first = NEVER if program == "still" else model_discrepancy.DRIFTS_FROM

    def answer(query: SuggestionQuery) -> Suggestion:
        late = isinstance(query, PourQuery) and len(query.data) >= model_discrepancy.DRIFTS_FROM
        key = repr(query), program if late else ""
        if key not in answers:
            with patch.object(model_discrepancy, "DRIFTS_FROM", first):
                answers[key] = propose(query)
        return answers[key]

    with patch("players.propose", answer):
        play(strategy, world.answer)
    texts = [decision.text for decision in strategy.decisions]
    return {
        "level": level,
        "seed": seed,
        "drift": drift,
        "program": program,
        "poured": world.poured,
        "said": [text for text in texts if text.startswith(("the bench drifts", "since pour"))],
    }


def ideal(level: str, seed: int, drift: float, pours: int, foresight: float) -> float:
    """Return the mean loss of the observer of the module docstring, who makes the pour with the least expected loss.

    Args:
        drift: in ten pours [mm].
        foresight: weight of the loss that the same place has eight pours later.
    """
    valley, rng, width = (
        Valley(level, seed),
        np.random.default_rng([seed, 20261127]),
        1e3 * (OFFSET.upper - OFFSET.lower),
    )
    middle = np.array([valley._speed, valley._offset, valley._height])[: valley.space.dimension]
    along = np.arange(-50.0, 50.0, 0.05)  # [mm]
    lost = [valley._lost(middle + np.eye(len(middle))[1] * x / width, 1.0) for x in along]
    # As D3: drifting with a probability of one half, by N(0, (r · 10 mm)²) per pour, r log-uniform.
    low, high = model_discrepancy.DRIFTS
    paces, sizes = np.arange(-0.6, 0.605, 0.01), 10.0 * low * (high / low) ** np.linspace(0.0, 1.0, 60)
    likely = np.mean([np.exp(-0.5 * (paces / size) ** 2) / size for size in sizes], axis=0)
    likely *= 0.5 / likely.sum()
    likely[len(paces) // 2] += 0.5
    starts = np.arange(-6.0, 6.05, 0.15)
    pace, start = (grid.ravel() for grid in np.meshgrid(paces, starts, indexing="ij"))
    logs = np.log(np.repeat(likely, len(starts))) - 0.5 * (start / 1.5) ** 2
    places, positions = np.arange(-14.0, 14.1, 0.2), np.arange(-32.0, 32.0, 0.1)
    costs = np.interp(places[:, None] + positions, along, lost)  # (place, position of the bench)
    truth, poured = 1.5 * rng.standard_normal(), []
    for number in range(pours):
        weights = np.exp(logs - logs.max())
        scores = 1e-6 * np.abs(places)
        for later, weight in ((0, 1.0), (min(8, pours - 1 - number), foresight)):
            cells = np.rint((start + pace * (number + later) - positions[0]) / 0.1).astype(int)
            scores += weight * costs @ np.bincount(cells, weights / weights.sum(), len(positions))
        place = places[int(np.argmin(scores))]
        cost = float(np.interp(place + truth + 0.1 * drift * number, along, lost))
        poured.append(cost)
        seen = min(max(cost + (0.003 + 0.03 * cost) * rng.standard_normal(), 0.0), 1.0)
        means = np.interp(place + start + pace * number, along, lost)
        low, high = ((seen + half - means) / np.hypot(0.004, 0.05 * means) for half in (-0.005, 0.005))
        chances = ndtr(high) - (ndtr(low) if seen > 0.005 else 0.0)
        logs = logs + np.log(np.maximum(chances, 1e-12))
    return float(np.mean(poured))


def rows(runs: list[dict[str, Any]]) -> list[str]:
    """Return a line per level, drift and program: mean loss, and the ratio to the still bench and to the other program.

    Each ratio is of the means over the seeds that both have.
    """
    lost = {(r["level"], r["program"], r["drift"], r["seed"]): float(np.mean(r["poured"])) for r in runs}
    noticed = {key for r in runs if any("drifts" in text for text in r["said"])
               for key in [(r["level"], r["program"], r["drift"], r["seed"])]}  # fmt: skip
    lines = []
    for level, program, drift in dict.fromkeys((r["level"], r["program"], r["drift"]) for r in runs):
        seeds = sorted(seed for *other, seed in lost if other == [level, program, drift])
        mean, low, high = interval([lost[level, program, drift, seed] for seed in seeds])
        line = f"{level} | {program} | {drift:g} mm | {len(seeds)} | {mean:.4f} ({low:.4f} … {high:.4f})"
        for name, other in (("still bench", (level, program, 0.0)), ("program still", (level, "still", drift))):
            both = [seed for seed in seeds if (*other, seed) in lost]
            beside = sum(lost[*other, seed] for seed in both)
            if both and beside and other != (level, program, drift):
                line += f" | {sum(lost[level, program, drift, seed] for seed in both) / beside:.2f} x {name}"
        lines.append(f"{line} | drift said: {sum((level, program, drift, seed) in noticed for seed in seeds)}")
    return lines


def main() -> None:
    """Run the campaigns that FILE lacks, and print its table."""
    parser = argparse.ArgumentParser(description="Measure what a slow drift of the bench costs D3.")
    parser.add_argument("--levels", nargs="+", default=["cliff, small", "small"])
    parser.add_argument("--drifts", nargs="+", type=float, default=[0.0, 0.5, 2.0], help="in ten pours [mm]")
    parser.add_argument("--programs", nargs="+", choices=("drift", "still"), default=["drift", "still"])
    parser.add_argument("--still-drifts", nargs="+", type=float, default=[0.0], help="the same for the program `still`")
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--first", type=int, default=71000)
    parser.add_argument("--pours", type=int, default=40)
    parser.add_argument("--out", type=Path)
    parser.add_argument("--ideal", action="store_true", help="print what is attainable on toy benches")
    chosen = parser.parse_args()
    seeds = range(chosen.first, chosen.first + chosen.seeds)
    if chosen.ideal:
        for level in chosen.levels:
            for foresight in (0.0, 1.0):
                for drift in chosen.drifts:
                    losses = [ideal(level, seed, drift, chosen.pours, foresight) for seed in seeds]
                    mean, low, high = interval(losses)
                    print(
                        f"{level} | foresight {foresight:g} | {drift:g} mm | {mean:.4f} ({low:.4f} … {high:.4f})",
                        flush=True,
                    )
        return
    if chosen.out is None:
        parser.error("--out FILE is needed")
    runs = [json.loads(line) for line in chosen.out.read_text().splitlines()] if chosen.out.exists() else []
    known = {(run["level"], run["seed"], run["drift"], run["program"]) for run in runs}
    for seed in seeds:
        for level in chosen.levels:
            answers: dict[Any, Suggestion] = {}
            for program in chosen.programs:
                for drift in chosen.drifts if program == "drift" else chosen.still_drifts:
                    if (level, seed, drift, program) not in known:
                        runs.append(campaign(level, seed, drift, program, chosen.pours, answers))
                        with chosen.out.open("a") as file:
                            file.write(json.dumps(runs[-1]) + "\n")
    print("\n".join(rows(runs)))


if __name__ == "__main__":
    main()
