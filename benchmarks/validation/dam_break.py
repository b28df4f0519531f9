"""Dam break: the front of a collapsing column, compared with the experiment of Martin and Moyce.

A column of width a and height 2a in a channel, initially a lattice, is released at once. T = t √(2g/a), Z = front / a.
The front is the mean over strips of the channel of the farthest particle, plus half a spacing.

Source: Martin & Moyce 1952, Phil. Trans. R. Soc. A 244, n² = 2, a = 2.25 in and 1.125 in (digitised).

The experiment's gate takes time to open, so its fronts start late by an unmeasured time. Fronts are therefore compared
after the delay that fits best; the delay and the error without it are reported. The slope for T > 1.9 needs no delay. A
small friction of the channel's bottom (`FLOOR`) replaces the boundary layer that slows the small tank. It is the only
friction in these cases, and the slope without it is reported, too.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import SimulationParameters

from .case_result import Figure, Measurement, Series, at_most, reported, within
from .container_runs import block, box, run

Floats = NDArray[np.float64]

MEASURED: dict[float, tuple[tuple[float, float], ...]] = {
    0.05715: (
        (0.832, 1.217), (1.219, 1.474), (1.997, 2.292), (2.547, 2.995), (3.345, 4.134), (4.034, 4.944), (4.418, 5.881),
        (5.091, 6.980), (5.685, 7.945), (6.306, 8.966), (6.822, 9.986), (7.439, 10.963), (8.031, 11.977),
    ),
    0.0286: (
        (0.849, 1.245), (1.212, 1.443), (1.602, 1.884), (2.283, 2.689), (2.950, 3.728), (3.598, 4.528), (3.905, 4.999),
        (4.592, 5.841), (4.961, 6.271), (5.316, 6.717),
    ),
}  # fmt: skip
"""Measured (T, Z) by the column's width a [m]."""

FROM, LATE = 1.2, 1.9
"""Smallest T of the comparison of fronts, and of slopes."""
STRIPS = 5
WIDTH = 10.0
"""Width of the channel, in spacings."""
ASPECT = 2.0
FLOOR = 0.05
"""Coulomb friction of the channel."""


def slope(T: Floats, Z: Floats) -> float:
    """Least-squares slope for T > 1.9."""
    late = T > LATE
    return float(np.polyfit(T[late], Z[late], 1)[0])


def dam_break(
    width: float, layers: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[list[Measurement], list[Series]]:
    """Release one column.

    Args:
        width: a, one of `MEASURED` [m].
        layers: spacings in a.
        parameters: θ; its number of particles is ignored.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    reference = np.array(MEASURED[width])
    rough, last = parameters.model_copy(update={"friction": FLOOR}), float(reference[-1, 0])
    T, Z, particles = front(width, layers, rough, last, mirrored)
    late = reference[reference[:, 0] > FROM]
    delays = np.linspace(0.0, 0.6, 121)
    errors = [float(np.max(np.abs(np.interp(late[:, 0] - s, T, Z) / late[:, 1] - 1.0))) for s in delays]
    best = int(np.argmin(errors))
    name = f"a = {1e3 * width:.1f} mm"
    wanted = slope(reference[:, 0], reference[:, 1])
    T_free, Z_free, _ = front(width, layers, parameters, last, mirrored)
    measurements = [
        at_most(
            f"largest error of the front after the gate's delay, {name}",
            errors[best],
            0.10,
            criterion="at most 10 % for T > 1.2",
            particles=particles,
        ),
        within(
            f"slope of the front, {name}",
            slope(T, Z),
            wanted,
            0.15 * wanted,
            criterion="within 15 % for T > 1.9",
            particles=particles,
        ),
        reported(f"delay of the gate that fits best, in T, {name}", float(delays[best]), particles=particles),
        reported(f"largest error of the front without a delay, {name}", errors[0], particles=particles),
        reported(
            f"slope of the front without friction, {name}",
            slope(T_free, Z_free),
            reference=wanted,
            particles=particles,
        ),
    ]
    curves = [
        Series(f"{name}, {particles:,} particles", tuple(T.tolist()), tuple(Z.tolist())),
        Series(f"{name}, experiment", tuple(reference[:, 0].tolist()), tuple(reference[:, 1].tolist()), "reference"),
    ]
    return measurements, curves


def front(
    width: float, layers: int, parameters: SimulationParameters, last: float, mirrored: bool
) -> tuple[Floats, Floats, int]:
    """Position of the front over time.

    Args:
        width: a [m].
        layers: spacings in a.
        parameters: θ; its number of particles is ignored.
        last: largest T of the simulation.
        mirrored: whether only the half y ≥ 0 is simulated.

    Returns:
        T and Z, shape (80,) each, and N.
    """
    d = width / layers
    across = WIDTH * d
    start, d = block(
        np.array([0.0, -across / 2.0, 0.0]),
        np.array([width, across / 2.0, ASPECT * width]),
        round(layers * layers * ASPECT * WIDTH),
        1,
        mirrored,
    )
    unit = math.sqrt(width / (2.0 * GRAVITY))
    channel = box(width * (2.0 * last + 3.0), across, 1.2 * ASPECT * width, 0.5 * d)
    times = np.linspace(0.1, last + 0.1, 80) * unit
    places = np.empty(len(times))
    for k, liquid in run(start, d, channel, parameters, times, mirrored=mirrored):
        x = liquid.positions
        strip = np.clip(((x[:, 1] / across + 0.5) * STRIPS).astype(int), 0, STRIPS - 1)
        places[k] = np.mean([x[strip == s, 0].max() for s in range(STRIPS)]) + 0.5 * d
    return times / unit, places / width, len(start)


def dam_figure(curves: list[Series]) -> Figure:
    """Curves of the fronts and the experiments."""
    return Figure(("Dam break",), ("T = t √(2g/a)",), ("Z = front / a",), tuple(curves))
