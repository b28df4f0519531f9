"""The lag of a display, from its readings while a load is put on: `step_response`.

A display follows the load as a first-order low pass or as a moving average. Both are fitted to the readings, and the
better one counts. The module knows no balance; commissioning and closed-loop dosing give it times and masses.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Form = Literal["first order", "moving average"]
_Shape = Callable[[NDArray[np.float64], float], NDArray[np.float64]]

SMALLEST = 20.0
"""Smallest step [display steps]; a smaller one says little about the lag."""

MISFIT = 0.05
"""Largest root mean square difference between readings and model, as a fraction of the step."""


@dataclass(frozen=True)
class StepResponse:
    """The display's answer to a load that was put on at once.

    Attributes:
        lag: mean delay of the display behind the load [s]: the time constant of a low pass, half the window of a moving
            average. A display that follows a steady flow of q [kg/s] reads q · lag too little.
        error: standard error of `lag` [s], from the scatter of the readings, the display's step and the choice between
            the two forms.
        form: the form that fits better.
        constant: its time constant or window [s].
        moved: time at which the display began to move, in the time of the readings [s].
        step: change of the load [kg].
        residual: root mean square difference between readings and model [kg].
    """

    lag: float
    error: float
    form: Form
    constant: float
    moved: float
    step: float
    residual: float


def step_response(
    times: Sequence[float], masses: Sequence[float], *, resolution: float, put_at: float | None = None
) -> StepResponse:
    """Fit the lag of a display to its readings around one step of the load.

    Args:
        times: of the readings, increasing [s].
        masses: the readings, stable or not [kg]: some before the step, and some at rest after it.
        resolution: step of the display [kg].
        put_at: time of the step [s], if it is known; then the lag includes a dead time before the display moves.
            Without it, a dead time is not seen.

    Returns:
        The lag. If the display moved between two readings, its lag is shorter than their interval can show: then
        `error` is as large as `lag`.

    Raises:
        ValueError: no step, one that is too small, or readings that do not follow one step.
    """
    t, m = np.asarray(times, float), np.asarray(masses, float)
    if len(t) < 8 or not np.all(np.isfinite(m)) or np.any(np.diff(t) <= 0.0):
        raise ValueError("a step needs at least eight readings in order of time, all with a weight")
    start, end = float(np.median(m[:3])), float(np.median(m[-3:]))
    step = end - start
    if abs(step) < SMALLEST * resolution:
        raise ValueError(
            f"the display changed by {1e3 * step:g} g only; put on at least {SMALLEST * 1e3 * resolution:g} g"
        )
    progress = (m - start) / step
    first = int(np.argmax(progress > max(0.02, 1.5 * resolution / abs(step))))
    if first == 0:
        raise ValueError("the load was already on at the first reading; begin to read before it is put on")
    moving = [i for i in range(first, len(t)) if progress[i] < 0.98]
    if not moving:
        interval = float(t[first] - t[first - 1])
        lag = interval / 8.0
        return StepResponse(lag, lag, "first order", lag, float(t[first - 1]), step, 0.0)
    fits = [_fit(form, t, m, first, float(t[moving[-1]] - t[first - 1])) for form in _SHAPES]
    best, other = sorted(fits, key=lambda fit: fit.residual)
    if best.residual > MISFIT * abs(step) + resolution:
        raise ValueError(
            f"the readings do not follow one step (they differ by {1e3 * best.residual:g} g from it); put the load on "
            "in one movement, and let go"
        )
    lag, error = _lag(best, t, resolution, put_at)
    if other.residual < 1.5 * max(best.residual, resolution / 4.0):  # the readings hardly tell the forms apart
        error = math.hypot(error, 0.5 * (_lag(other, t, resolution, put_at)[0] - lag))
    return StepResponse(lag, error, best.form, best.constant, best.moved, best.end - best.start, best.residual)


def _low_pass(since: NDArray[np.float64], constant: float) -> NDArray[np.float64]:
    return -np.expm1(-np.maximum(since, 0.0) / constant)


def _average(since: NDArray[np.float64], window: float) -> NDArray[np.float64]:
    return np.clip(since / window, 0.0, 1.0)


_SHAPES: dict[Form, tuple[_Shape, float]] = {"first order": (_low_pass, 1.0), "moving average": (_average, 0.5)}
"""Fraction of a step that the display shows, as a function of time and constant; and the lag per constant."""


@dataclass(frozen=True)
class _Fit:
    form: Form
    start: float
    end: float
    moved: float
    constant: float
    residual: float

    def model(self, t: NDArray[np.float64], moved: float, constant: float) -> NDArray[np.float64]:
        return self.start + (self.end - self.start) * _SHAPES[self.form][0](t - moved, constant)


def _fit(form: Form, t: NDArray[np.float64], m: NDArray[np.float64], first: int, duration: float) -> _Fit:
    """Least squares in beginning and constant; the levels before and after are linear and solved for."""
    shape, scale = _SHAPES[form][0], float(np.var(m))
    low, high = float(t[first - 1]) - duration, float(t[first])

    def levels(moved: float, constant: float) -> tuple[float, float, float]:
        s = shape(t - moved, constant)
        design = np.column_stack((1.0 - s, s))
        start, end = np.linalg.lstsq(design, m, rcond=None)[0]
        return float(start), float(end), float(np.mean((design @ (start, end) - m) ** 2))

    def cost(x: NDArray[np.float64]) -> float:
        moved, constant = float(x[0]), math.exp(float(x[1]))
        outside = max(low - moved, moved - high, 0.0) / duration
        return levels(min(max(moved, low), high), constant)[2] / scale + outside

    def search(moved: float) -> NDArray[np.float64]:
        begun = min((np.array([moved, math.log(share * duration)]) for share in (0.15, 0.4, 1.0)), key=cost)
        simplex = begun + np.array([[0.0, 0.0], [-0.3 * (high - float(t[first - 1])), 0.0], [0.0, 0.3]])
        options = {"xatol": 1e-5, "fatol": 1e-12, "maxiter": 400, "initial_simplex": simplex}
        found: NDArray[np.float64] = minimize(cost, begun, method="Nelder-Mead", options=options).x  # type: ignore[call-overload]
        return found

    x = min((search(float(t[first - 1]) + part * (high - float(t[first - 1]))) for part in (0.0, 0.5, 0.95)), key=cost)
    moved, constant = min(max(float(x[0]), low), high), math.exp(float(x[1]))
    start, end, square = levels(moved, constant)
    return _Fit(form, start, end, moved, constant, math.sqrt(square))


def _lag(fit: _Fit, t: NDArray[np.float64], resolution: float, put_at: float | None) -> tuple[float, float]:
    """Lag and its standard error [s], by linearization at the fit."""
    share = _SHAPES[fit.form][1]
    small = 1e-4 * fit.constant
    s = _SHAPES[fit.form][0](t - fit.moved, fit.constant)
    columns = [1.0 - s, s]
    for moved, constant in ((small, 0.0), (0.0, small)):
        high = fit.model(t, fit.moved + moved, fit.constant + constant)
        low = fit.model(t, fit.moved - moved, fit.constant - constant)
        columns.append((high - low) / (2.0 * small))
    jacobian = np.column_stack(columns)
    scatter = fit.residual**2 * len(t) / max(len(t) - 4, 1)
    covariance = np.linalg.pinv(jacobian.T @ jacobian) * max(scatter, resolution**2 / 12.0)
    of = np.array([0.0, 0.0, 0.0 if put_at is None else 1.0, share])
    lag = share * fit.constant + (0.0 if put_at is None else fit.moved - put_at)
    return lag, math.sqrt(max(float(of @ covariance @ of), 0.0))
