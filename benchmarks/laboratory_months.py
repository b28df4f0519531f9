"""A laboratory over 60 days: do the control charts point to the quantity that a creeping fault changes?

    python benchmarks/laboratory_months.py            # seeds 51000 to 51019: 10 with a fault, 10 still ones
    python benchmarks/laboratory_months.py --first 50000 --png charts.png   # the docs show charts-50003.png

Every day has one run with two to six pours and one or two doses. The liquid is an analytic surrogate of a bench (no
particles), whose numbers are below. Everything after it is the product: weighings become masses by the rules of the
placement, the runs are written as journals, the catalogue reads them, and the charts of each day use what had been
weighed until then. A fault begins on day 12 to 30 and grows linearly.

- right: the first violation after the fault's begin is of the quantity that it changes, and comes at the latest five
  days after the fault has passed two standard deviations of a single value.
- false alarm: any violation on a still bench, and any before the fault.
"""

from __future__ import annotations

import argparse
import json
import tempfile
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from actors.balance.weighing_plan import Placement, Weighing, measurement, weighing_uncertainty
from actors.interfaces import DoseSource, DoseTarget
from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.learning.requests import Pour, Poured, Prediction
from orchestrator.learning.stage_result import DOSE
from orchestrator.records.events import Requested, RequestFinished, RequestStarted
from orchestrator.records.journal import JOURNAL_NAME, Journal
from orchestrator.records.journal_file import Header
from orchestrator.records.run_registry import enter, use_state_directory
from sim_engine.action import Action
from sim_engine.outcome import PourMeasurement

DAYS, FIRST_DAY = 60, 1_900_000_000.0 - 1_900_000_000.0 % 86_400.0
LOAD, EMPTY, STEP = 0.2, 0.152, 1e-5
"""Content and weight of the pourer, and display step [kg]."""

REPEATABILITY, WETNESS = 1.5e-5, 2e-5
"""Standard deviations of one weighing, and of what is left in the emptied pourer [kg]."""

SPILLED, OF_PLACEMENT, OF_POUR, OF_DAY = 0.03, 0.006, 0.008, 0.003
"""Loss of the recommended pour, its change per mm of placement, its scatter from pour to pour and from day to day."""

PLACED = 0.3
"""Scatter of the receiver's place from day to day [mm]."""

ONSET, DOSED = (0.25, 0.1), 1.5e-4
"""Scatter of the onset of a dose's flow from dose to dose and from day to day [deg]; that of its amount [kg]."""

FILM, UNCLOSED, SECONDS = (2.5e-4, 5e-5), 4e-5, (95.0, 0.08)
"""Film and its scatter [kg]; scatter of masses that should close [kg]; time of a pour [s] and its relative scatter."""


@dataclass(frozen=True)
class Fault:
    """A creeping fault.

    Attributes:
        quantity: that it changes.
        per_day: growth, in mm, fractions, deg or kg.
        two_deviations: size that changes the quantity by two standard deviations of a single value.
    """

    quantity: str
    per_day: float
    two_deviations: float


FAULTS = {
    "placement": Fault("prediction_error", 0.3, 2.0 * float(np.hypot(OF_POUR, OF_DAY)) / OF_PLACEMENT),
    "balance": Fault("empty_pourer_g", 0.001 / 7.0, 2.0 * float(np.hypot(REPEATABILITY, WETNESS)) / EMPTY),
    "gripper": Fault("onset_deg", 0.15, 2.0 * float(np.hypot(*ONSET))),
    "film": Fault("film_g", 1e-5, 2.0 * FILM[1]),
}


@dataclass(frozen=True)
class Bench:
    """The surrogate on one day: the faults' sizes, and its random numbers."""

    rng: np.random.Generator
    placement: float = 0.0
    balance: float = 0.0
    gripper: float = 0.0
    film: float = 0.0

    def weighed(self, mass: float) -> Weighing:
        """A reading of the balance."""
        shown = (1.0 - self.balance) * mass + self.rng.normal(0.0, REPEATABILITY)
        return Weighing(round(shown / STEP) * STEP, weighing_uncertainty(STEP, REPEATABILITY))

    def pours(self) -> Iterator[tuple[Pour, PourMeasurement]]:
        """The pours of one day, weighed below the receiver."""
        place, day, onset = (self.rng.normal(0.0, s) for s in (PLACED, OF_DAY, ONSET[1]))
        empty = self.weighed(EMPTY + abs(self.rng.normal(0.0, WETNESS)))
        expected = Prediction(SPILLED, 0.004, OF_POUR)
        pours = int(self.rng.integers(2, 7))
        for number in range(1, pours + 1):
            lost = SPILLED + OF_PLACEMENT * (self.placement + place) + day + self.rng.normal(0.0, OF_POUR)
            spilled, retained = LOAD * max(lost, 0.0), 1e-3
            film = self.weighed(max(FILM[0] + self.film + self.rng.normal(0.0, FILM[1]), 0.0))
            table = {
                "pourer_empty": empty,
                "pourer_full": self.weighed(EMPTY + LOAD),
                "received": self.weighed(LOAD - spilled - retained),
                "pourer_after": self.weighed(EMPTY + retained),
            }
            masses = measurement(Placement.RECEIVER, table)
            readings = [1e3 * self.weighed(0.0).mass for _ in range(8)]
            notes: dict[str, Any] = {
                **masses.notes,
                "cycle": {"film_g": 1e3 * film.mass, "missing_g": 1e3 * float(self.rng.normal(0.0, UNCLOSED))},
                "signals": {"read_at": [i / 8 - 1.0 for i in range(8)], "readings_g": readings},
            }
            yield (
                Pour("cup", Action(0.7, 0.1, 0.03), number, number, predicted=expected),
                PourMeasurement(masses.loaded, masses.spilled, masses.retained, notes),
            )
        for number in range(pours + 1, pours + 1 + int(self.rng.integers(1, 3))):
            bias = np.radians(-self.gripper + onset + self.rng.normal(0.0, ONSET[0]))
            amount = 0.05 + float(self.rng.normal(0.0, DOSED))
            about = {"received": amount, "spilled": None, "knowledge": {"onset_flow": [float(bias), 0.0]}}
            target = DoseTarget(0.05, 1e-3, "", DoseSource("beaker", LOAD, 5e-4, fill=True, constants=7))
            yield (
                Pour("cup", Action(0.7, 0.1, 0.03), number, number, purpose=DOSE, dose=target),
                PourMeasurement(LOAD, 0.0, LOAD - amount, {DOSE: about}),
            )


def write_day(folder: Path, day: int, bench: Bench, laboratory: str = "months") -> Path:
    """Write the run of one day as a journal, and return its folder."""
    scene = {
        "name": "cup",
        "liquid": {"name": "water"},
        "pourer": {"name": "beaker"},
        "receiver": {"name": "cup"},
    }
    deployment = {"scenes": [scene], "loss": {}, "settings": {"strategy": "D3"}}
    plan = {"laboratory": {"name": laboratory}, "deployment": deployment, "seed": day}
    now = FIRST_DAY + 86_400.0 * day + 32_400.0
    run = folder / f"day-{day:02}"
    journal = Journal.create(run / JOURNAL_NAME, Header("daily", plan, now))
    try:
        for number, (request, measured) in enumerate(bench.pours(), start=1):
            now += 300.0
            seconds = float(SECONDS[0] * np.exp(bench.rng.normal(0.0, SECONDS[1])))
            about: dict[str, Any] = {"time": now, "stage": "deployment:cup"}
            journal.append(
                Requested(id=number, request=request, **about),
                RequestStarted(id=number, request=request, **about),
                RequestFinished(id=number, request=request, outcome=Poured(measured), seconds=seconds, **about),
            )
    finally:
        journal.close()
    return run


def write_laboratory(folder: Path, seed: int, fault: str = "", days: int = DAYS) -> float:
    """Write the runs of all days, and return the day on which the fault begins."""
    begins = float(np.random.default_rng((seed, 1)).uniform(12.0, 30.0))
    runs = []
    for day in range(days):
        size = {} if not fault else {fault: FAULTS[fault].per_day * max(day - begins, 0.0)}
        runs.append(write_day(folder, day, Bench(np.random.default_rng((seed, 2, day)), **size)))
    enter(runs)
    return begins


def judged(seed: int, fault: str, png: Path | None = None) -> dict[str, Any]:
    """Make one laboratory and judge its charts."""
    with tempfile.TemporaryDirectory() as folder:
        use_state_directory(Path(folder) / "state")
        begins = write_laboratory(Path(folder) / "runs", seed, fault)
        began = time.process_time()
        with Catalogue() as catalogue:
            catalogue.refresh()
            charts = catalogue.charts({})
        seconds = time.process_time() - began
    if png is not None:
        from orchestrator.reports.control_chart_figure import draw_charts
        from orchestrator.reports.figure_style import save

        save(draw_charts(charts), png)
    noticed = sorted((_day(v.noticed), chart.quantity) for chart in charts for v in chart.violations)
    row: dict[str, Any] = {"seed": seed, "fault": fault or "still", "cpu_s": round(seconds, 2), "violations": noticed}
    if not fault:
        return {**row, "false_alarms": len(noticed)}
    limit = begins + FAULTS[fault].two_deviations / FAULTS[fault].per_day
    later = [entry for entry in noticed if entry[0] >= begins]
    first = later[0] if later else (None, None)
    right = first[1] == FAULTS[fault].quantity and first[0] is not None and first[0] <= limit + 5.0
    about = {"begins": round(begins, 1), "two_deviations_on": round(limit, 1), "first": first, "right": right}
    return {**row, **about, "false_alarms": len(noticed) - len(later)}


def _day(moment: float) -> int:
    return int((moment - FIRST_DAY) // 86_400)


def main() -> None:
    """Print one line of JSON for each laboratory, and the sums."""
    parser = argparse.ArgumentParser(description=str(__doc__).partition("\n")[0])
    parser.add_argument("--first", type=int, default=51_000, help="seed of the first laboratory")
    parser.add_argument("--png", type=Path, help="file of the pictures: SEED is added to its name")
    arguments = parser.parse_args()
    names = list(FAULTS)
    faults = [names[i % len(names)] for i in range(10)] + [""] * 10
    rows = []
    for seed, fault in enumerate(faults, start=arguments.first):
        png = None if arguments.png is None else arguments.png.with_stem(f"{arguments.png.stem}-{seed}")
        rows.append(judged(seed, fault, png))
        print(json.dumps(rows[-1]), flush=True)
    right = sum(bool(row.get("right")) for row in rows)
    still = [row["false_alarms"] for row in rows if row["fault"] == "still"]
    print(json.dumps({"right": f"{right} of 10", "false_alarms_of_still": still, "cpu_s": round(time.process_time())}))


if __name__ == "__main__":
    main()
