"""Coverage of a surrogate's 90 % intervals on recorded transfers of viscous liquids, which no simulator made.

    python benchmarks/recorded_transfers.py [--json]

Each of 205 settings of 20 campaigns (tests/data/real/liq_transfer) is predicted from the other settings of its
campaign. The cost is the mean |error| over three volumes; the axes are the aspiration and the dispense rate, linear or
logarithmic between the campaign's extremes. The first five settings of a campaign are both rates at 80 % of the
largest, and the four corners of the range, which are extrapolated from the others.

`plug-in` is the interval from the mean and the deviations of one set of hyperparameters, the most likely one.
`averaged` is that of `actors.optimizer.prediction_intervals`, which D2 and D3 report for their pours.

Questions, fixed before the Sartorius campaigns were predicted with `averaged`: are 85 to 95 % of all settings and at
least 80 % of the first five inside, and is the interval score no worse than that of `plug-in`? The method and its
constants were chosen with the eight Opentrons campaigns; the twelve Sartorius campaigns answer.
"""

from __future__ import annotations

import argparse
import csv
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from machine import describe, say, show
from players import Floats, coverage

from actors.optimizer.gaussian_process import GaussianProcess, constant_mean_process
from actors.optimizer.prediction_intervals import observation_intervals
from orchestrator.learning.requests import Prediction
from sim_engine.prediction_band import LEVEL

DATA = Path(__file__).parents[1] / "tests" / "data" / "real" / "liq_transfer" / "transfers.csv"
FIRST = 5
"""Number of settings in the initial design of a campaign: both rates at 80 % of the largest, and the four corners."""

TUNING, ANSWERS = "Opentrons", "Sartorius"
"""Robot whose campaigns were used to choose the method, and the one that answers."""


@dataclass(frozen=True)
class Transfers:
    """The settings of a campaign.

    Attributes:
        robot: that made them.
        rates: (n, 2), aspiration and dispense rate [µL/s].
        errors: (n,), mean |error| over the volumes [%].
    """

    robot: str
    rates: Floats
    errors: Floats

    def points(self, axes: str) -> Floats:
        """The rates in the unit square; `axes` is 'linear' or 'log'."""
        values = np.log(self.rates) if axes == "log" else self.rates
        low, high = values.min(axis=0), values.max(axis=0)
        return np.asarray((values - low) / (high - low))


def campaigns(robot: str = "") -> list[Transfers]:
    """Read the campaigns, of one robot or of both."""
    settings: dict[tuple[str, ...], dict[int, list[dict[str, str]]]] = {}
    with DATA.open(encoding="utf-8", newline="") as file:
        for row in csv.DictReader(file):
            if row["robot"] == robot or not robot:
                campaign = settings.setdefault((row["robot"], row["planner"], row["liquid"]), {})
                campaign.setdefault(int(row["setting"]), []).append(row)
    return [
        Transfers(
            key[0],
            np.array(
                [[float(rows[0][f"{part}_ul_s"]) for part in ("aspiration", "dispense")] for rows in one.values()]
            ),
            np.array([np.mean([abs(float(row["error_percent"])) for row in rows]) for rows in one.values()]),
        )
        for key, one in settings.items()
    ]


def plug_in(process: GaussianProcess, point: Floats) -> tuple[float, float]:
    """The interval of a prediction with one set of hyperparameters."""
    means, deviations = process.predict(point)
    return Prediction(float(means[0]), float(deviations[0]), float(process.noise_at(point)[0])).of_a_pour()


def averaged(process: GaussianProcess, point: Floats) -> tuple[float, float]:
    """The interval averaged over hyperparameters."""
    low, high = observation_intervals(process, point, LEVEL)[0]
    return float(low), float(high)


METHODS: dict[str, Callable[[GaussianProcess, Floats], tuple[float, float]]] = {
    "plug-in": plug_in,
    "averaged": averaged,
}


def left_out(transfers: Transfers, axes: str) -> Iterator[dict[str, tuple[float, float, float]]]:
    """For every setting, predicted from the others: the interval and the error, by method."""
    points, errors = transfers.points(axes), transfers.errors
    for number in range(len(errors)):
        others = np.arange(len(errors)) != number
        process = constant_mean_process(points[others], errors[others])
        place = points[number : number + 1]
        yield {name: (*method(process, place), float(errors[number])) for name, method in METHODS.items()}


def figures(chosen: list[Transfers], axes: str) -> dict[str, dict[str, Any]]:
    """Coverage of all and of the first settings, and the interval score [%], by method."""
    found = [list(left_out(one, axes)) for one in chosen]
    rows = {}
    for name in METHODS:
        inside, score = coverage([row[name] for one in found for row in one], LEVEL)
        first, _ = coverage([row[name] for one in found for row in one[:FIRST]], LEVEL)
        rows[name] = {"settings": sum(map(len, found)), "inside": inside, "first": first, "score": score}
    return rows


def main() -> None:
    """Measure and print."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--json", action="store_true", help="one line of JSON")
    options = parser.parse_args()
    rows = []
    for robot in (TUNING, ANSWERS):
        for axes in ("linear", "log"):
            for name, one in figures(campaigns(robot), axes).items():
                rows.append({"robot": robot, "axes": axes, "interval": name} | one)
                shares = f"{100 * one['inside']:.1f} % inside, of the first five {100 * one['first']:.1f} %"
                say(f"{robot}, {axes} axes, {name}: {shares}, interval score {one['score']:.2f} %")
    show({"rows": rows, "machine": describe()}, options.json)


if __name__ == "__main__":
    main()
