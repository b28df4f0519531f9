"""Measure the loss of an ideal player on the benches with steep walls: a reference for the means of `mismatch.py`.

    python benchmarks/ideal_player.py [--levels 'cliff, moderate' ...] [--first 8120] [--seeds 20] [--write]

The ideal player has what no strategy has: it knows the shape, slope and height of the bench's valley, the noiseless
simulator, and the distribution that the simulator's errors come from. Only this bench's errors of offset, speed and
width are unknown to it. It pours where the expected sum of this loss and of the least expected losses of all further
pours is least (one step ahead, hypotheses by importance sampling). A goal below its loss cannot be expected of a
strategy; it is no strict bound, since it looks only one pour ahead.

Distributions of an error, in units of the level's magnitude m: `sign` (m or −m), `uniform` (−2m to 2m), `normal`
(deviation m). The worlds have m or −m; that all errors have exactly this magnitude is known to the first only.
"""

from __future__ import annotations

import argparse
import math

import numpy as np
from machine import write_table
from mismatch_worlds import CLIFFS, OFFSET, SPEED, Valley
from optimiser_problems import Floats
from players import interval

DRAWS: dict[str, str] = {"sign": "magnitudes known", "uniform": "uniform", "normal": "normal"}
LEVELS = ("cliff, moderate", "cliff, large", "cliff, four axes")
HYPOTHESES, CANDIDATES, CONSIDERED, FURTHER = 3000, 1500, 200, 240
EDGES = np.array([0.0, 0.003, 0.01, 0.02, 0.05, 0.1, 0.2, 0.35, 0.5, 0.65, 0.8, 0.9, 0.97, 0.995])
"""Losses that divide the outcomes of a pour into classes, for the look ahead."""
SETTLED = 0.005


class Hypotheses:
    """Valleys of a bench that agree with its simulator.

    Attributes:
        speed, offset: (H,), centres in the unit cube.
        width: (H,), factors on the simulated valley's width and length.
    """

    def __init__(self, valley: Valley, draw: str, rng: np.random.Generator) -> None:
        """Draw the simulator's errors."""
        self.valley, wrong, signs = valley, valley._wrong, valley._signs
        factor, lowest = 1.0 + signs[0] * wrong.speed, SPEED.lower / (SPEED.upper - SPEED.lower)
        simulated_width = math.exp(signs[3] * wrong.width)
        speed = (valley._speed - (factor - 1.0) * lowest) / factor
        offset = valley._offset - signs[1] * wrong.offset / (OFFSET.upper - OFFSET.lower)
        if draw == "sign":
            errors: Floats = rng.choice([-1.0, 1.0], (HYPOTHESES, 3))
        elif draw == "uniform":
            errors = rng.uniform(-2.0, 2.0, (HYPOTHESES, 3))
        else:
            errors = rng.standard_normal((HYPOTHESES, 3))
        faster = 1.0 + errors[:, 0] * wrong.speed
        self.speed = faster * speed + (faster - 1.0) * lowest
        self.offset = offset + errors[:, 1] * wrong.offset / (OFFSET.upper - OFFSET.lower)
        self.width = simulated_width * np.exp(-errors[:, 2] * wrong.width)

    def losses(self, units: Floats) -> Floats:
        """Return the losses (H, A) of actions (A, dimension).

        The formula of `Valley.true` for all hypotheses at once: one by one it would take hours. A test compares both.
        """
        valley = self.valley
        speed, offset = units[None, :, 0] - self.speed[:, None], units[None, :, 1] - self.offset[:, None]
        width, length = valley._width * self.width[:, None], valley._length * self.width[:, None]
        if valley.shape == "cup":
            c, s = math.cos(valley._slope), math.sin(valley._slope)
            distance = np.hypot((c * speed + s * offset) / length, (c * offset - s * speed) / width)
        else:
            across = offset - valley._slope * speed - 0.3 * speed * speed
            if valley.shape in ("jet3", "jet4"):
                across -= 0.5 * (np.sqrt(0.3 + units[None, :, 2]) - math.sqrt(0.3 + valley._height))
            slow = np.maximum(-speed, 0.0) / length + np.maximum(speed, 0.0) / (3.0 * length)
            if valley.shape == "edge":
                across = np.where(across > 0.0, across, 0.4 * across)
            distance = np.hypot(slow, across / width)
            if valley.shape == "jet4":
                distance = np.hypot(distance, (units[None, :, 3] - valley._height) / (4.0 * width))
        found: Floats = 1.0 - np.exp(-(np.maximum(distance - 1.0, 0.0) ** 1.5))
        return found

    def candidates(self, weights: Floats, rng: np.random.Generator) -> Floats:
        """Return actions (A, dimension) in valleys of the posterior, half of them displaced."""
        valley, chosen = self.valley, rng.choice(len(weights), CANDIDATES, p=weights)
        units = np.full((CANDIDATES, len(valley.space.axes)), valley._height)
        units[:, 0], units[:, 1] = self.speed[chosen], self.offset[chosen]
        if valley.shape != "cup":  # the valley extends towards higher speeds
            along = rng.uniform(0.0, 1.5, CANDIDATES) * valley._length * self.width[chosen]
            along *= rng.integers(0, 2, CANDIDATES)
            units[:, 0] += along
            units[:, 1] += valley._slope * along + 0.3 * along * along
        units[CANDIDATES // 2 :, :2] += rng.normal(0.0, 0.03, (CANDIDATES - CANDIDATES // 2, 2))
        found: Floats = np.clip(units, 0.0, 1.0)
        return found

    def resample(self, weights: Floats, rng: np.random.Generator) -> None:
        """Replace the hypotheses by draws from their weights, moved a little."""
        chosen, number = rng.choice(len(weights), len(weights), p=weights), len(weights)
        self.speed = self.speed[chosen] + rng.normal(0.0, 0.01, number)
        self.offset = self.offset[chosen] + rng.normal(0.0, 0.008, number)
        self.width = self.width[chosen] * np.exp(rng.normal(0.0, 0.1, number))


def next_action(losses: Floats, weights: Floats, left: int, rng: np.random.Generator) -> int:
    """Return the candidate with the least expected loss of this and of `left` further pours, one step ahead.

    Args:
        losses: (H, A).
        weights: (H,), of the hypotheses.
    """
    expected = weights @ losses
    if not left:
        return int(expected.argmin())
    best = expected.argsort()
    number = len(expected)
    considered = np.unique([*best[: CONSIDERED // 2], *rng.choice(number, CONSIDERED // 2)])
    further = losses[:, np.unique([*best[: FURTHER // 6], *rng.choice(number, FURTHER - FURTHER // 6)])]
    values = []
    for action in considered:
        outcome = np.digitize(losses[:, action], EDGES)
        parts = [outcome == one for one in np.unique(outcome)]
        values.append(expected[action] + left * sum((weights[part] @ further[part]).min() for part in parts))
    return int(considered[int(np.argmin(values))])


def pours_of(level: str, seed: int, draw: str, pours: int = 15) -> list[float]:
    """Return losses of the ideal player's pours, without scatter; three below 0.5 % end a campaign.

    The remaining pours of an ended campaign count as the mean of these three.
    """
    valley, rng = Valley(level, seed), np.random.default_rng([seed, 99])
    hypotheses, logarithms = Hypotheses(valley, draw, rng), np.zeros(HYPOTHESES)
    found: list[float] = []
    while len(found) < pours and not (len(found) >= 3 and max(found[-3:]) < SETTLED):
        weights = _weights(logarithms)
        units = hypotheses.candidates(weights, rng)
        losses = hypotheses.losses(units)
        action = next_action(losses, weights, pours - 1 - len(found), rng)
        observed = valley.observe(units[action], len(found))
        found.append(valley.true(units[action], len(found)))
        logarithms -= 0.5 * ((observed - losses[:, action]) / (0.03 + 0.05 * observed)) ** 2
        weights = _weights(logarithms)
        if draw != "sign" and 1.0 / (weights**2).sum() < HYPOTHESES / 50:
            hypotheses.resample(weights, rng)
            logarithms = np.zeros(HYPOTHESES)
    return found + [float(np.mean(found[-3:]))] * (pours - len(found))


def _weights(logarithms: Floats) -> Floats:
    weights: Floats = np.exp(logarithms - logarithms.max())
    weights /= weights.sum()
    return weights


def main() -> None:
    """Run the command line."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--levels", nargs="+", choices=list(CLIFFS), default=LEVELS)
    parser.add_argument("--first", type=int, default=8120)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--write", action="store_true", help="write the table to docs/data/results.json")
    asked = parser.parse_args()
    rows = []
    for level in asked.levels:
        cells = []
        for draw in DRAWS:
            runs = [pours_of(level, seed, draw) for seed in range(asked.first, asked.first + asked.seeds)]
            mean, low, high = interval([float(np.mean(run)) for run in runs])
            cells.append(f"{mean:.3f} ({low:.3f} … {high:.3f})")
        rows.append([level.removeprefix("cliff, "), *cells])
        print(rows[-1], flush=True)
    if asked.write:
        levels = " ".join(f"'{level}'" for level in asked.levels)
        command = f"python benchmarks/ideal_player.py --levels {levels} --first {asked.first} --seeds {asked.seeds}"
        settings = (
            "the player knows the valley's shape, the noiseless simulator and the distribution of its errors; mean "
            "loss of 15 pours without scatter, 95 % bootstrap intervals; the benches of the table above"
        )
        write_table("ideal", ["simulator", *DRAWS.values()], rows, command, settings)


if __name__ == "__main__":
    main()
