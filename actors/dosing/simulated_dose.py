"""A dose on a simulated bench: the controller against the virtual dosing bench, as one measured pour.

The same target and seed give the same dose, whatever was poured before: content and knowledge of the source are part of
the target.

Limitations: without particles straight cups only.
"""

from __future__ import annotations

import functools
import math
from collections.abc import Callable, Sequence
from typing import Any, Literal

import numpy as np

from actors.dosing.dose_controller import DoseController, DoseOrder, DosePhase, DoseResult
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import DoseSeries, after_dose, check_dose, series_of, source_of, unknown_amount
from actors.dosing.particle_liquid import ParticleLiquid
from actors.dosing.tilt_command import TiltCommand
from actors.dosing.virtual_dosing_bench import DoseRecord, TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from actors.interfaces import (
    DoseTarget,
    InvalidActionError,
    PourProgress,
    ProgressCallback,
    UnknownPourError,
)
from sim_engine.live_pour import LivePours
from sim_engine.outcome import PourMeasurement, RecordedFrames
from sim_engine.scene import PourTask, Scene
from sim_engine.vessel.vessel import Vessel, build_vessel

STRAIGHT = 0.03
"""Largest relative difference between a cup's capacity and that of the cylinder of its opening."""

FILTERS: tuple[Literal["first", "fourth", "average"], ...] = ("first", "fourth", "average")
"""Filters that a simulated bench's balance may have."""

PROGRESS_INTERVAL = 0.1
"""Time between two reports of the progress [s of the dose]."""

SIGNALS = 200
"""Largest number of samples of a dose's signals in its record."""


def simulated_dose(
    scene: Scene,
    dose: DoseTarget,
    seed: int,
    settings: DosingSettings,
    *,
    held_tilt: float = 0.0,
    progress: ProgressCallback | None = None,
    particles: Callable[[float], tuple[PourTask, LivePours]] | None = None,
) -> PourMeasurement:
    """Pour a wanted amount out of the scene's pourer.

    Args:
        scene: pourer and liquid.
        dose: wanted amount.
        seed: of the bench and of the controller.
        settings: of the dose.
        held_tilt: by which the pourer is held more tilted than commanded [rad].
        progress: receives the progress, as fast as the dose is computed.
        particles: returns the pour of particles out of a source with this content [kg], and what simulates it; None:
            the bench's formula.

    Raises:
        InvalidActionError: see `check_dose`, and without particles `check_straight`.
        LaboratoryError: the particles could not be simulated.
        UnknownPourError: the amount in the receiver is not known at the end.
    """
    check_dose(scene, dose)
    if particles is None:
        check_straight(scene)
    frames: list[RecordedFrames] = []

    def liquid(bench: VirtualDosingBench) -> ParticleLiquid:
        assert particles is not None
        task, pours = particles(bench.content)
        return ParticleLiquid(bench, pours, task, None if progress is None else frames.append)

    poured = None if particles is None else liquid
    series, bench, placed = _set_up(scene, dose, seed, settings, held_tilt, poured)
    loaded = bench.content
    controller = series.controller(DoseOrder(dose.amount, dose.limit, receiver_mass=bench.receiver_mass), seed=seed)
    record = bench.dose(controller if progress is None else _Shown(controller, progress, frames))
    result = controller.result
    assert result is not None, "a dose ends within LONGEST_DOSE"
    if result.amount is None:
        raise UnknownPourError(unknown_amount(result))
    series.finish(result)
    retained = max(loaded - record.spilled - result.amount, 0.0)  # the receiver was weighed, the source was not
    notes = _notes(dose, result, record, bench, series, placed)
    return PourMeasurement(loaded, record.spilled, retained, {"dose": notes})


class _Shown:
    """A controller that reports what it estimates: ten times a second of the dose, and whenever its phase changes.

    Args:
        controller: decides.
        progress: receives the reports.
        frames: of the particles since the last report.
    """

    def __init__(self, controller: DoseController, progress: ProgressCallback, frames: list[RecordedFrames]) -> None:
        self._controller, self._progress, self._frames = controller, progress, frames
        self._phase, self._next = DosePhase.CHECK, 0.0
        self._zero: float | None = None

    def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand:
        """See `actors.dosing.virtual_dosing_bench.Doser`."""
        command = self._controller.step(time, tilt, readings)
        last, phase = readings[-1].mass if readings else None, self._controller.phase
        if last is not None and (self._zero is None or phase is DosePhase.CHECK):
            self._zero = last
        if time >= self._next or phase is not self._phase:
            self._phase, self._next = phase, time + PROGRESS_INTERVAL
            reading = None if last is None or self._zero is None else last - self._zero
            shown = self._controller.progress(reading)
            done = min(max(shown.amount / shown.target, 0.0), 1.0)
            liquid = functools.reduce(RecordedFrames.joined, self._frames) if self._frames else None
            self._frames.clear()
            self._progress(PourProgress("dose", done, tilt=tilt, balance=reading, liquid=liquid, dose=shown))
        return command


def _set_up(
    scene: Scene,
    dose: DoseTarget,
    seed: int,
    settings: DosingSettings,
    held_tilt: float,
    poured: Callable[[VirtualDosingBench], ParticleLiquid] | None,
) -> tuple[DoseSeries, VirtualDosingBench, tuple[DoseReading, ...]]:
    source = source_of(scene, dose)
    constants = seed if dose.source is None else source.constants
    seeded = np.random.default_rng((constants, 31))
    scale = TrueScale(
        FILTERS[int(seeded.integers(len(FILTERS)))],
        lag=float(seeded.uniform(0.15, 0.45)),
        step=1e-4,
    )
    rng = seeded if dose.source is None else np.random.default_rng((seed, 31))
    pourer = build_vessel(scene.pourer)
    true = source.mass if dose.source is None else source.mass + source.deviation * float(rng.standard_normal())
    liquid = scene.liquid.model_copy(
        update={"mass": min(max(true, 1e-3), 0.99 * pourer.capacity * scene.liquid.density)}
    )
    wetness = 0.0 if source.unused else 0.2 if source.fill else 0.7
    bench = VirtualDosingBench(
        _cup(pourer),
        liquid,
        scale,
        constants,
        dose_seed=None if dose.source is None else seed,
        wetness=wetness,
        held_tilt=held_tilt,
        poured=poured,
    )
    placed = bench.place_receiver()
    return series_of(scene, dose, settings, placed, rng, step=scale.step), bench, placed


def check_straight(scene: Scene) -> None:
    """Check that the virtual bench has a cup like the scene's pourer.

    Raises:
        InvalidActionError: the pourer is no straight cup.
    """
    true_cup(scene)


def true_cup(scene: Scene) -> TrueCup:
    """The virtual bench's own cup of the size of the scene's pourer.

    Raises:
        InvalidActionError: the vessel is no straight cup.
    """
    vessel = build_vessel(scene.pourer)
    cup = _cup(vessel)
    if not math.isclose(cup.capacity, vessel.capacity, rel_tol=STRAIGHT):
        raise InvalidActionError(
            f"{vessel.name} is no straight cup; virtual benches pour wanted amounts out of straight cups only"
        )
    return cup


def _cup(vessel: Vessel) -> TrueCup:
    return TrueCup(vessel.opening_radius, vessel.rim_height - vessel.inner_floor)


def _notes(
    dose: DoseTarget,
    result: DoseResult,
    record: DoseRecord,
    bench: VirtualDosingBench,
    series: DoseSeries,
    placed: Sequence[DoseReading],
) -> dict[str, Any]:
    before = placed[-1].time + 1.0  # the dose begins a second after the last of them
    every = max(len(record.times) // SIGNALS, 1)
    return {
        **after_dose(series, result),
        "wanted": dose.amount,
        "true": record.received,
        "duration": record.duration,
        "times": [round(float(t), 3) for t in record.times[::every]],
        "tilt_deg": [round(math.degrees(float(t)), 2) for t in record.tilts[::every]],
        "in_receiver_g": [round(1e3 * float(m), 3) for m in record.true_mass[::every]],
        "read_at": [round(r.time, 3) for r in record.readings],
        "readings_g": [round(1e3 * (r.mass - bench.receiver_mass), 3) for r in record.readings],
        "placed_at": [round(r.time - before, 3) for r in placed],
        "placed_g": [round(1e3 * (r.mass - bench.receiver_mass), 3) for r in placed],
        "step_g": 1e3 * bench.scale.step,
    }
