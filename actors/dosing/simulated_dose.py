"""A dose on a simulated bench: the controller against the virtual dosing bench, as one measured pour.

Limitations: straight cups only, because the virtual bench has no other. Every dose begins with the prior estimate, so
that the same seed gives the same dose, whatever was poured before.
"""

from __future__ import annotations

import math
from typing import Any, Literal

import numpy as np

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseOrder, DoseResult, DosingSettings
from actors.dosing.dose_series import DoseForecast, DoseSeries, SourceContent
from actors.dosing.virtual_dosing_bench import DoseRecord, TrueCup, TrueScale, VirtualDosingBench
from actors.interfaces import DoseTarget, InvalidActionError, UnknownPourError
from sim_engine.outcome import PourMeasurement
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselError
from sim_engine.vessel.vessel import Vessel, build_vessel, check_holds

STRAIGHT = 0.03
"""Largest relative difference between a cup's capacity and that of the cylinder of its opening."""

FILTERS: tuple[Literal["first", "fourth", "average"], ...] = ("first", "fourth", "average")
"""Filters that a simulated bench's balance may have."""

SIGNALS = 200
"""Largest number of samples of a dose's signals in its record."""


def simulated_dose(scene: Scene, dose: DoseTarget, seed: int) -> PourMeasurement:
    """Pour a wanted amount out of the scene's pourer.

    Args:
        scene: pourer and liquid; the load is the content of the source.
        dose: wanted amount.
        seed: of the bench and of the controller.

    Raises:
        InvalidActionError: see `check_dose`.
        UnknownPourError: the amount in the receiver is not known at the end.
    """
    check_dose(scene, dose)
    series, bench = _set_up(scene, seed)
    loaded = bench.content
    controller = series.controller(DoseOrder(dose.amount, dose.limit, bench.receiver_mass), seed=seed)
    record = bench.dose(controller)
    result = controller.result
    assert result is not None, "a dose ends within LONGEST_DOSE"
    if result.amount is None:
        mean, deviation = (1e3 * value for value in result.estimate)
        raise UnknownPourError(
            f"the dose ended: {result.end}. The amount in the receiver is unknown; estimated are {mean:.1f} g ± "
            f"{2.0 * deviation:.1f} g"
        )
    retained = max(loaded - record.spilled - result.amount, 0.0)  # the receiver was weighed, the source was not
    return PourMeasurement(loaded, record.spilled, retained, {"dose": _notes(dose, result, record, bench)})


def check_dose(scene: Scene, dose: DoseTarget) -> None:
    """Check what is known about a dose before it begins.

    Args:
        scene: pourer, receiver and liquid.
        dose: wanted amount.

    Raises:
        InvalidActionError: the source holds too little, the receiver is too small, or the pourer is no straight cup.
    """
    held, wanted = 1e3 * scene.liquid.mass, 1e3 * dose.amount
    if held <= wanted:
        raise InvalidActionError(f"the pourer holds {held:.4g} g, and {wanted:.4g} g are wanted; fill more")
    try:
        check_holds(build_vessel(scene.receiver), (dose.amount + dose.limit) / scene.liquid.density)
    except VesselError as error:
        raise InvalidActionError(f"the receiver is too small: {error}") from error
    _true_cup(build_vessel(scene.pourer))


def forecast(scene: Scene, dose: DoseTarget, seed: int) -> DoseForecast:
    """Predict a dose of `simulated_dose`.

    Args:
        scene, dose, seed: see `simulated_dose`.

    Raises:
        InvalidActionError: see `check_dose`.
    """
    check_dose(scene, dose)
    series, bench = _set_up(scene, seed)
    return series.forecast(DoseOrder(dose.amount, dose.limit, bench.receiver_mass), seed=seed)


def _set_up(scene: Scene, seed: int) -> tuple[DoseSeries, VirtualDosingBench]:
    rng = np.random.default_rng((seed, 31))
    pourer = build_vessel(scene.pourer)
    scale = TrueScale(
        FILTERS[int(rng.integers(len(FILTERS)))],
        lag=float(rng.uniform(0.15, 0.45)),
        step=1e-4,
    )
    bench = VirtualDosingBench(_true_cup(pourer), scene.liquid, scale, seed)
    content = SourceContent(scene.liquid.mass)
    placed = bench.place_receiver()
    return DoseSeries(CupFlow(pourer, scene.liquid), DosingSettings(), content, placed, rng, step=scale.step), bench


def _true_cup(vessel: Vessel) -> TrueCup:
    """The virtual bench's own cup of the same size.

    Raises:
        InvalidActionError: the vessel is no straight cup.
    """
    height = vessel.rim_height - vessel.inner_floor
    cup = TrueCup(vessel.opening_radius, height)
    if not math.isclose(cup.capacity, vessel.capacity, rel_tol=STRAIGHT):
        raise InvalidActionError(
            f"{vessel.name} is no straight cup; a simulated bench pours wanted amounts out of straight cups only"
        )
    return cup


def _notes(dose: DoseTarget, result: DoseResult, record: DoseRecord, bench: VirtualDosingBench) -> dict[str, Any]:
    every = max(len(record.times) // SIGNALS, 1)
    return {
        "wanted": dose.amount,
        "received": result.amount,
        "true": record.received,
        "end": str(result.end),
        "top_ups": result.top_ups,
        "duration": record.duration,
        "times": [round(float(t), 3) for t in record.times[::every]],
        "tilt_deg": [round(math.degrees(float(t)), 2) for t in record.tilts[::every]],
        "in_receiver_g": [round(1e3 * float(m), 3) for m in record.true_mass[::every]],
        "read_at": [round(r.time, 3) for r in record.readings],
        "readings_g": [round(1e3 * (r.mass - bench.receiver_mass), 3) for r in record.readings],
    }
