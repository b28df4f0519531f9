"""The lag of a display, from its readings while a load is put on: `step_response`.

The rise is compared with the step responses of the filters that balances have (`FILTERS`), for lags from 0.04 to 2 s
and with unknown moment and duration of the placing. The result is a probability for every filter and lag: commissioning
states its mean and deviation, closed-loop dosing draws from it. The module knows no balance.

Some displays repeat their last reading while the load moves (`display_behaviour`). A reading r that equals the one
before is then old with a probability p, and says nothing about the load: its likelihood is p + (1 − p) L(r), that of a
changed reading (1 − p) L(r). Unless p is given, it is 0 as long as no reading in the middle of the rise is repeated.
Otherwise it is unknown, and the result is averaged over the values `REPEATS`. A rise of few readings may have no repeat
in its middle; then the stated error is too small unless p is given.

Limitations: a pure delay before the display moves cannot be seen, because the moment of the placing is unknown.
"""

from __future__ import annotations

import functools
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]

SMALLEST = 20.0
"""Smallest step [display steps]; a smaller one says little about the lag."""

MISFIT = 0.05
"""Largest root mean square difference between readings and model, as a fraction of the step."""

REPEATS = (0.1, 0.3, 0.5, 0.7, 0.85)
"""Probabilities of a repeated reading that are compared."""

LONGEST_HOLD = 1.5
"""Longest time for which a display may hold its reading [s]; 1.1 s were recorded (Kennedy et al. 2019)."""

SCATTER = 0.006
"""Standard deviation of a reading besides the display's step, as a fraction of the step: the model's own error."""


@dataclass(frozen=True)
class StepResponse:
    """The display's answer to a load that was put on at once.

    Attributes:
        lag: mean delay of the display behind the load [s]: the time constant of a low pass of first order, half the
            window of a moving average. A display that follows a steady flow of q [kg/s] reads q · lag too little.
        error: standard deviation of `lag` [s]: from the readings, from the choice of the filter, and from the grid.
        form: the likeliest filter, a name of `FILTERS`.
        moved: time at which the load was put on, in the time of the readings [s].
        step: change of the load [kg].
        residual: root mean square difference between readings and likeliest model, during the rise [kg].
        probability: of every filter and lag (filters, lags), in the order of `FILTERS` and `LAGS`; the sum is 1.
        repeats: probability that a reading repeats the one before instead of showing the load.
    """

    lag: float
    error: float
    form: str
    moved: float
    step: float
    residual: float
    probability: Floats
    repeats: float = 0.0


def step_response(
    times: Sequence[float], masses: Sequence[float], *, resolution: float, repeats: float | None = None
) -> StepResponse:
    """Compare the readings around one step of the load with the filters that a balance can have.

    Args:
        times: of the readings, increasing [s].
        masses: the readings, stable or not [kg]: some before the step, and some at rest after it.
        resolution: step of the display [kg].
        repeats: probability that a reading repeats the one before; None: unknown.

    Returns:
        The lag. If the display moved between two readings, its lag is shorter than their interval can show: then
        `error` is nearly as large as `lag`.

    Raises:
        ValueError: no step, one that is too small, or readings that do not follow one step.
    """
    t, m = np.asarray(times, float), np.asarray(masses, float)
    if len(t) < 4 or not np.all(np.isfinite(m)) or np.any(np.diff(t) <= 0.0):
        raise ValueError("a step needs at least four readings in order of time, all with a weight")
    start, end = float(np.median(m[:3])), float(np.median(m[-3:]))
    step = end - start
    if abs(step) < SMALLEST * resolution:
        raise ValueError(
            f"the display changed by {1e3 * step:g} g only; put on at least {SMALLEST * 1e3 * resolution:g} g"
        )
    risen = (m - start) / step
    settled = np.concatenate((np.diff(risen[:4]), np.diff(risen[-4:])))
    noise = float(np.median(np.abs(settled)))
    first = float(t[np.argmax(risen > max(0.01, 4.0 * noise))])
    held = np.concatenate(([False], m[1:] == m[:-1]))
    if repeats is None:
        motion = 3.0 * resolution / abs(step) + 4.0 * noise
        chances = np.array(REPEATS) if _holds(risen, held, motion) else np.zeros(1)
    else:
        chances = np.array([repeats])
    if not chances.any():
        held[:] = False
    rise = (t > first - (LONGEST_HOLD if held.any() else 0.3)) & (np.cumsum(risen > 0.997) < 4)
    t, risen, held = t[rise], risen[rise], held[rise]
    sigma = math.hypot(SCATTER, resolution / abs(step), noise)
    moments = first - np.arange(0.0, 1.5, MOMENT)
    fits, misfits = [], []
    for (_, response), lag in itertools.product(FILTERS.values(), LAGS):
        for duration in PLACING:
            place = (t[None, :] - moments[:, None]) / lag
            smooth = np.mean([response(place - share * duration / lag) for share in (0.1, 0.3, 0.5, 0.7, 0.9)], axis=0)
            squares = ((smooth - risen) / sigma) ** 2
            misfits.append(np.sum(squares[:, ~held] if held.any() else squares, axis=1))
            fits.append(_log_likelihood(misfits[-1], squares[:, held], chances, int(np.sum(~held))))
    # (filters, lags, probabilities of a repeat, placings and moments)
    grid = np.array(fits).reshape(len(FILTERS), len(LAGS), len(PLACING), len(chances), -1).swapaxes(2, 3)
    grid = grid.reshape(len(FILTERS), len(LAGS), len(chances), -1)
    place = np.unravel_index(int(grid.argmax()), grid.shape)
    misfit = np.array(misfits).reshape(len(FILTERS), len(LAGS), -1)[place[0], place[1], place[3]]
    residual = sigma * math.sqrt(float(misfit) / max(int(np.sum(~held)), 1))
    if residual > MISFIT + resolution / abs(step):
        raise ValueError(
            f"the readings do not follow one step (they differ by {1e3 * residual * abs(step):g} g from it); put the "
            "load on in one movement, and let go"
        )
    each = np.exp(grid - grid.max()).sum(axis=3)
    evidence = each.sum(axis=2)
    probability = evidence / evidence.sum()
    of_lag = probability.sum(axis=0)
    mean = float(of_lag @ LAGS)
    # a moment between two of the grid's is made up for by the lag
    within = (float(of_lag @ (LAGS * math.log(LAGS[1] / LAGS[0])) ** 2) + MOMENT**2) / 12.0
    return StepResponse(
        mean,
        math.sqrt(float(of_lag @ (LAGS - mean) ** 2) + within),
        list(FILTERS)[int(np.argmax(probability.sum(axis=1)))],
        float(moments[int(grid.argmax()) % len(moments)]),
        step,
        residual * abs(step),
        probability,
        float(chances @ each.sum(axis=(0, 1)) / each.sum()),
    )


def _holds(risen: Floats, held: NDArray[np.bool_], motion: float) -> bool:
    """Whether a reading within the rise is repeated, although the next change is larger than `motion`."""
    # the display of a filter that overshoots may turn near the end
    for i in np.flatnonzero(held & (risen > motion) & (risen < min(1.0 - motion, 0.9))):
        later = risen[i + 1 :][~held[i + 1 :]]
        if len(later) and later[0] - risen[i] > motion:
            return True
    return False


def _log_likelihood(misfit: Floats, squares: Floats, chances: Floats, changed: int) -> Floats:
    """Logarithm of the likelihood (chances, moments) of the readings.

    Args:
        misfit: sum of the squares of the changed readings (moments,).
        squares: of the repeated readings (moments, readings).
        chances: probabilities of a repeat.
        changed: number of changed readings.
    """
    if not squares.shape[1]:
        return np.asarray(-0.5 * misfit[None, :] + changed * np.log1p(-chances)[:, None])
    p = chances[:, None, None]
    old = np.log(p + (1.0 - p) * np.exp(-0.5 * squares)[None]).sum(axis=2)
    return np.asarray(-0.5 * misfit[None, :] + changed * np.log1p(-chances)[:, None] + old)


LAST, STEPS = 50.0, 50_000
"""Last time of a tabulated step response [lags], and its number of steps."""


def _poles(roots: Sequence[complex]) -> Callable[[Floats], Floats]:
    """Step response over time / lag of a low-pass filter with these poles, scaled to a lag of 1."""

    # a fit evaluates millions of values: interpolation is several times faster than the exponentials, and a table with
    # equal steps needs no search
    @functools.cache
    def table() -> tuple[Floats, Floats, Floats]:
        scaled = np.array(roots) * float(np.real(np.sum(-1.0 / np.array(roots))))
        weights = [1.0 / np.prod([1.0 - root / other for other in scaled if other != root]) for root in scaled]
        times = np.linspace(0.0, LAST, STEPS + 1)
        transient = np.sum([w * np.exp(root * times) for w, root in zip(weights, scaled, strict=True)], axis=0)
        values = 1.0 - np.real(transient)
        return times, values, np.diff(values) / np.diff(times)

    def response(time: Floats) -> Floats:
        times, values, slopes = table()
        time = np.clip(time, 0.0, LAST)
        k = np.minimum((time * (STEPS / LAST)).astype(np.int64), STEPS - 1)
        return np.asarray(slopes[k] * (time - times[k]) + values[k])

    return response


_BUTTERWORTH = [
    complex(-math.sin(a), math.cos(a)) for a in (math.pi / 8, 3 * math.pi / 8, 5 * math.pi / 8, 7 * math.pi / 8)
]

LAGS = np.geomspace(0.04, 2.0, 45)
"""Lags that are compared [s]."""

MOMENT = 0.03
"""Distance of the compared moments of the placing [s]."""

PLACING = (0.02, 0.12, 0.25)
"""Durations of the placing that are compared [s]."""

FILTERS: dict[str, tuple[float, Callable[[Floats], Floats]]] = {
    "first order": (1.0, _poles([-1.0])),
    "second order": (0.5, _poles([-1.0, -1.1])),
    "four equal poles": (0.25, _poles([-1.0, -1.1, -1.2, -1.3])),
    "Butterworth, fourth order": (0.25, _poles(_BUTTERWORTH)),
    "moving average": (0.33, lambda time: np.clip(0.5 * time, 0.0, 1.0)),
}
"""Filters of balances: the share of the slowest of four lags in a row that come nearest to it, and the step response
over time / lag."""
