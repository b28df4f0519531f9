"""A dose that ran away: readings and commands paused while the approach went on, and 22 g were poured for 4.7 g."""

from __future__ import annotations

import itertools
import json
import math
from pathlib import Path

import numpy as np
import pytest

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseController, DoseOrder, DosePhase
from actors.dosing.dose_estimator import DoseBelief, DoseReading, draw_lags
from actors.dosing.virtual_dosing_bench import TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from sim_engine.liquids import Liquid
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.actors.arm.ur.test_urscript_writer import Dose

RECORD = json.loads((Path(__file__).parents[2] / "data" / "doses" / "runaway.json").read_text(encoding="utf-8"))
WATER = Liquid(mass=0.36)
CUP = CupFlow(build_vessel(cylinder("beaker", inner_radius=0.04, inner_height=0.10)), WATER)


def controller_and_onset(wanted: float) -> tuple[DoseController, float]:
    """The controller of a first dose, and the tilt [rad] at which 3 % of its hypotheses flow."""
    rng = np.random.default_rng(1)
    belief = DoseBelief.prior((WATER.volume, 5e-7), draw_lags([], 100, rng), rng)
    onsets = CUP.tilt_for(belief.volume, np.zeros(100)) + belief.onset_bias
    controller = DoseController(CUP, DoseOrder(wanted), belief, DosingSettings(), step=1e-5, seed=1)
    return controller, float(np.quantile(onsets, 0.03))


def test_the_program_does_not_pass_the_earliest_onset_with_the_records_timing() -> None:
    """Readings, commands and reports of the tilt come when they came in the record; the tilt is the program's."""
    controller, onset = controller_and_onset(1e-3 * RECORD["wanted_g"])
    readings = [DoseReading(t, 0.2) for t, g in zip(RECORD["read_at"], RECORD["readings_g"], strict=True) if g < 1.0]
    dose, reported, now, largest = Dose(), 0.0, 0.0, 0.0
    for before, (time, recorded) in itertools.pairwise(
        [(0.0, None), *zip(RECORD["times"], RECORD["tilt_deg"], strict=True)]
    ):
        while now < time:
            dose.tick(0.002)
            now += 0.002
            largest = max(largest, dose.tilt)
        if recorded != before[1]:  # the record repeats an old report of the tilt
            reported = math.radians(dose.tilt)
        arrived = [reading for reading in readings if before[0] < reading.time <= time]
        command = controller.step(time, reported, arrived)
        dose.order(math.degrees(command.speed), math.degrees(min(command.highest, 1.7)), command.patience)
    assert math.degrees(onset) == pytest.approx(33.5, abs=1.5), "as in the record"
    assert largest < math.degrees(onset) + 1.0


@pytest.mark.parametrize("pause", [0.3, 0.7, 1.5])
def test_the_bound_of_the_approach_does_not_rise_without_readings(pause: float) -> None:
    bench = VirtualDosingBench(TrueCup(0.04, 0.1, 0.007, 0.014), WATER, TrueScale(lag=0.3), 1)
    rng = np.random.default_rng(1)
    belief = DoseBelief.prior((WATER.volume, 5e-7), draw_lags(bench.place_receiver(), 100, rng), rng)
    order = DoseOrder(0.05, receiver_mass=bench.receiver_mass)
    controller = DoseController(CUP, order, belief, DosingSettings(), seed=1)
    bounds: list[tuple[float, float]] = []

    class Silent:
        def step(self, time: float, tilt: float, readings: list[DoseReading]) -> object:
            begun = next((t for t, _ in bounds), math.inf)
            command = controller.step(time, tilt, [r for r in readings if not begun <= r.time < begun + pause])
            if controller.phase is DosePhase.APPROACH and tilt > math.radians(20.0):
                bounds.append((time, command.highest))
            return command

    record = bench.dose(Silent())  # type: ignore[arg-type]
    first = bounds[0][0]
    quiet = [highest for time, highest in bounds if first + 0.4 < time < first + pause]
    assert all(after <= before for before, after in itertools.pairwise(quiet))
    assert record.received < 0.0515
