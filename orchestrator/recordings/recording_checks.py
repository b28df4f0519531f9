"""Checks of a recorded pour for what cannot be: `impossible`.

Hydrostatics bounds what a tilted vessel must have poured, and what it can have poured, at every reading. If readings
are outside, the likely causes are tried: each is another meaning of a column, such as tilts from the horizontal. A
cause that explains the readings is named. Without one, only too much is refused: a stream may miss the receiver.

Limitations: errors below `TILT_MARGIN` and `MASS_MARGIN` pass; so do doses of a few grams.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from orchestrator.campaigns.yaml.yaml_errors import Problem
from orchestrator.recordings.time_series import Column, TimeSeries, arrivals
from sim_engine.hydrostatics import tilting_cup_outflow
from sim_engine.scene import Scene
from sim_engine.vessel.vessel import build_vessel

Floats = NDArray[np.float64]

TILT_MARGIN = math.radians(5.0)
"""Error of tilt, grip, fill and vessel together, as an angle [rad]."""

MASS_MARGIN, SHARE_MARGIN = 2e-3, 0.03
"""Error of a reading [kg], and as a share of the fill."""

EARLIEST, LATEST = -1.0, 3.0
"""Times from the lip to the display: clocks that differ, or fall and lag of the balance [s]."""

SLOWEST, FASTEST = 0.3, 2.0
"""Discharge coefficients of the lip. A liquid that sloshes is faster than a weir (0.6). A viscous one is slower, and is
not held to the lower bound."""

THIN = 0.02
"""Largest dynamic viscosity of a liquid that is held to it [Pa·s]."""

INTERVALS = (5e-3, 0.5)
"""Usual intervals of tilts [s]; times with shorter ones are suspected."""

FINEST = 2e-7
"""Step of readings below which masses are suspected: no balance of a pouring bench shows it [kg]."""

FILLED, FEWEST_RISING = 0.3, 15
"""Share of readings that repeat the one before, while the mass rises, that only filled cells explain; and the number of
readings while it rises that are needed for it."""


@dataclass(frozen=True)
class _Reading:
    """One meaning of the columns.

    Attributes:
        tilts, times: of the pourer (T,) [rad], [s].
        read_times, net: of the balance (R,) [s], [kg].
        quantity: column that is misread.
        cause: what it looks like, and what to do; empty for the columns as they are.
        certain: the columns as they are can't be a pour at all; then a stream that missed the receiver is no objection.
    """

    tilts: Floats
    times: Floats
    read_times: Floats
    net: Floats
    quantity: str = ""
    cause: str = ""
    certain: bool = False


def impossible(
    scene: Scene, series: TimeSeries, tilt: Column, mass: Column, zero: float, *, grip: float, step: float | None
) -> list[Problem]:
    """The problem of a recording that cannot be, with its likely cause; or none.

    Args:
        scene: the pourer, and the liquid with its mass before the pour.
        series: the table, for messages.
        tilt, mass: its columns, the mass from the first tilt on.
        zero: reading of the empty receiver [kg].
        grip: tilt of the vessel beyond the recorded one [rad].
        step: of the display as the file states it [kg].
    """
    net = mass.values - zero
    reading = _Reading(tilt.values + grip, tilt.times, mass.times, net)
    fact, place, excess = _contradiction(scene, reading)
    line = int(mass.lines[place])
    time_name = str(series.table.header.cells[series.places["time"]])
    for other in _other_meanings(reading, mass.values, step, time_name, contradicted=bool(fact)):
        contradiction, _, other_excess = _contradiction(scene, other)
        if not contradiction or (other.certain and excess and not other_excess):
            return [series.problem(line, "; ".join(filter(None, (fact, other.cause))), other.quantity)]
    if fact and excess:
        text = f"{fact}; are vessel, fill, and the zero of the tilt those of this pour?"
        return [series.problem(line, text, "mass")]
    return _filled(series, tilt, mass, step)


def _contradiction(scene: Scene, read: _Reading) -> tuple[str, int, bool]:
    """What contradicts hydrostatics, empty if nothing does; position of that reading; whether it is too much."""
    vessel, liquid = build_vessel(scene.pourer), scene.liquid
    volume = min(liquid.volume, vessel.capacity)

    def poured(margin: float, discharge: float, times: Floats) -> Floats:
        tilts = np.clip(read.tilts + margin, 0.0, math.pi)
        outflow = tilting_cup_outflow(vessel, volume, read.times, tilts, discharge=discharge)
        return liquid.density * np.interp(times, read.times, outflow)

    error = max(MASS_MARGIN, SHARE_MARGIN * liquid.mass)
    most = poured(TILT_MARGIN, FASTEST, read.read_times - EARLIEST)
    above = np.flatnonzero(read.net > most + error)
    least = poured(-TILT_MARGIN, SLOWEST, read.read_times - LATEST)
    below = np.flatnonzero(read.net < least - error) if liquid.dynamic_viscosity <= THIN else above[:0]
    if not len(above) and not len(below):
        return "", 0, False
    place = int(min(*above[:1], *below[:1], len(read.net) - 1))
    excess = bool(len(above)) and place == int(above[0])
    angle = math.degrees(float(np.interp(read.read_times[place], read.times, read.tilts)))
    change = f"{'fallen' if read.net[place] < 0.0 else 'risen'} by {1e3 * abs(read.net[place]):.3g} g"
    bound = f"at most {1e3 * most[place]:.0f}" if excess else f"at least {1e3 * least[place]:.0f}"
    fact = (
        f"the readings have {change} here, at a tilt of {angle:.1f}°, where '{scene.pourer.name}' with "
        f"{1e3 * liquid.mass:.4g} g has poured {bound} g"
    )
    return fact, place, bool(len(above))


def _other_meanings(
    read: _Reading, readings: Floats, step: float | None, time_name: str, *, contradicted: bool
) -> Iterator[_Reading]:
    """Other meanings of the columns that may be the true one; of those that explain a pour, not its absence."""
    gain = float(np.abs(read.net).max())
    finest = np.diff(np.unique(np.round(readings, 9)))
    finest = finest[finest > 0.0]
    if len(finest) > 5 and finest.min() < (FINEST if step is None else 0.02 * step) and gain < 1e-3:
        cause = "these masses look like kilograms: in grams, no balance shows such steps; name the column mass_kg"
        yield _Reading(read.tilts, read.times, read.read_times, 1e3 * read.net, "mass", cause)
    if not contradicted or gain < MASS_MARGIN:
        return

    def tilts(change: Callable[[Floats], Floats], cause: str, *, certain: bool = False) -> _Reading:
        return _Reading(change(read.tilts), read.times, read.read_times, read.net, "tilt", cause, certain)

    interval = float(np.median(np.diff(read.times)))
    last = (3600.0, "hours", "time_h") if time_name == "time_s" else (1e3, "seconds", "time_s")
    for factor, unit, name in ((60.0, "minutes", "time_min"), last):
        if interval < INTERVALS[0] <= factor * interval <= INTERVALS[1]:
            cause = f"these times look like {unit}; name the column {name}"
            yield _Reading(read.tilts, factor * read.times, factor * read.read_times, read.net, "time", cause)
    cause = "these tilts have the other sign; tilts towards the receiver are positive"
    yield tilts(np.negative, cause, certain=bool(read.tilts.max() < TILT_MARGIN < -read.tilts.min()))
    text = "these tilts look like angles from {}; tilts count from upright: write {} minus these"
    yield tilts(lambda values: 0.5 * math.pi - values, text.format("the horizontal", "90°"))
    yield tilts(lambda values: math.pi - values, text.format("upside down", "180°"))
    if np.abs(read.tilts).max() < math.radians(math.pi):
        yield tilts(np.degrees, "these tilts look like radians; name the column tilt_rad", certain=True)
    cause = "the mass falls by what is poured: the balance is below the pourer, or its cell hangs upside down"
    yield _Reading(read.tilts, read.times, read.read_times, -read.net, "mass", cause)


def _filled(series: TimeSeries, tilt: Column, mass: Column, step: float | None) -> list[Problem]:
    """The problem of cells that were filled with the value above, or interpolated; or none.

    Balance and arm have clocks of their own: a mass in every line, most of them repeated, is no reading in every line.
    """
    if len(mass) < 0.95 * len(tilt) or not np.isin(mass.lines, tilt.lines).mean() > 0.95:
        return []
    changes = np.diff(mass.values)
    finest = float(np.diff(np.unique(np.round(mass.values, 9))).min(initial=1e-2))
    described = arrivals(mass.times, mass.values, step or finest)
    rising = changes[np.abs(changes) > 1e-9]
    between = np.abs(rising / step - np.round(rising / step)) > 0.05 if step else np.zeros(0, dtype=bool)
    if described.rising >= FEWEST_RISING and described.repeated >= FILLED * described.rising:
        share, fault = described.repeated / described.rising, "repeat the one before while it rises"
        place = 1 + int(np.flatnonzero(changes == 0.0)[0])
    elif between.sum() >= FEWEST_RISING and between.mean() > 0.5:
        share, fault = float(between.mean()), f"lie between steps of {1e3 * (step or 0.0):g} g"
        place = 1 + int(np.flatnonzero(np.abs(changes) > 1e-9)[between.argmax()])
    else:
        return []
    text = (
        f"every line has a mass, and {100 * share:.0f} % of them {fault}: cells look filled with the value above, or "
        "interpolated; leave a cell empty in a line in which no reading arrived"
    )
    return [series.problem(int(mass.lines[place]), text, "mass")]
