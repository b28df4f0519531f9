"""Readings of a pour whose tilt is known, for many hypotheses at once and without randomness.

`PourHypotheses` are values of cup, flow and balance; `respond` computes the readings that each of them predicts, with
the equations of `actors.dosing.dose_estimator`. `displayed` is the balance alone: it turns any mass past the lip into
readings. A fit of recorded pours uses both (`orchestrator.reports`).

Limitations: those of `actors.dosing.cup_flow`.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import lfilter

from actors.dosing.cup_flow import CupFlow
from sim_engine.hydrostatics import GRAVITY

Floats = NDArray[np.float64]

TIME_STEP = 0.025
"""[s]"""


@dataclass(frozen=True)
class PourHypotheses:
    """Values (N,) of each hypothesis.

    Attributes:
        onset: tilt by which outflow begins later than the equation says [rad].
        flow: true flow over the equation's.
        volume: in the cup before the pour [m³].
        lag: total lag of the balance [s].
        lag_shape: share of the slowest of its four first-order lags.
    """

    onset: Floats
    flow: Floats
    volume: Floats
    lag: Floats
    lag_shape: Floats

    def __len__(self) -> int:
        return len(self.onset)


def respond(
    cup: CupFlow, hypotheses: PourHypotheses, times: Floats, tilts: Floats, at: Floats, fall_time: float
) -> tuple[Floats, Floats]:
    """Predicted readings, and the mass past the lip.

    Args:
        cup: flow of the vessel.
        hypotheses: N of them.
        times, tilts: of the cup, linear in between (T,) [s], [rad].
        at: times of the readings (R,) [s].
        fall_time: from the lip to the receiver [s].

    Returns:
        Readings without the receiver (N, R) [kg], and mass past the lip at these times (N, R) [kg].
    """
    end = max(float(times[-1]), float(at[-1])) + TIME_STEP
    grid = np.arange(float(times[0]), end, TIME_STEP)
    tilt = np.interp(grid, times, tilts)
    count = len(hypotheses)
    volume = np.array(hypotheses.volume, dtype=float)
    # before the first outflow nothing changes
    heads = cup.head(np.repeat(volume[:, None], len(grid), axis=1), tilt[None, :] - hypotheses.onset[:, None])
    flows = np.flatnonzero((heads > 0.0).any(axis=0))
    mass = np.zeros((count, len(grid)))
    # V' = −c q_cup(h, θ), h = head(V, θ − b), by Euler's method; m = ρ (V(0) − V)
    for k in range(int(flows[0]) if len(flows) else len(grid), len(grid)):
        head = cup.head(volume, tilt[k] - hypotheses.onset)
        if head.max() > 0.0:
            flow = np.where(head > 0.0, hypotheses.flow * cup.flow(head, float(tilt[k])), 0.0)
            volume = np.maximum(volume - flow * TIME_STEP, 0.0)
        mass[:, k] = cup.density * (hypotheses.volume - volume)
    shown = np.empty((count, len(at)))
    past = np.empty((count, len(at)))
    for n in range(count):
        shown[n] = displayed(
            grid,
            mass[n],
            at,
            lag=float(hypotheses.lag[n]),
            lag_shape=float(hypotheses.lag_shape[n]),
            fall_time=fall_time,
        )
        past[n] = np.interp(at, grid, mass[n])
    return shown, past


def displayed(
    times: Floats, mass: Floats, at: Floats, *, lag: float, lag_shape: float = 1.0, fall_time: float = 0.0
) -> Floats:
    """Readings of a balance while a mass falls onto it.

    Args:
        times: of the mass, increasing (T,) [s].
        mass: past the lip, linear in between (T,) [kg].
        at: times of the readings (R,) [s].
        lag: total lag of the balance [s].
        lag_shape: share of the slowest lag.
        fall_time: from the lip to the receiver [s].

    Returns:
        Readings (R,) [kg], with the impact of the falling liquid.
    """
    first, last = min(float(times[0]), float(at[0])), max(float(times[-1]), float(at[-1]))
    grid = np.arange(first, last + TIME_STEP, TIME_STEP)
    # load = m(t − t_f) + t_f m'(t − t_f), then four lags: y_k = y_{k−1} + dt/(τ + dt) (u_k − y_{k−1}), at rest at first
    before = grid - fall_time
    load = np.interp(before, times, mass)
    if fall_time > 0.0:
        load = load + fall_time * np.gradient(load, TIME_STEP)
    for delay in (lag_shape * lag, *3 * ((1.0 - lag_shape) * lag / 3.0,)):
        gain = TIME_STEP / (delay + TIME_STEP)  # delays by exactly `delay`
        load, _ = lfilter([gain], [1.0, gain - 1.0], load, zi=[(1.0 - gain) * load[0]])
    shown: Floats = np.interp(at, grid, load)
    return shown


def fall_time(height: float, speed: float = 0.1) -> float:
    """Time of a stream from the lip to a surface below it [s].

    Args:
        height: of the fall [m].
        speed: downwards at the lip [m/s].
    """
    # height = v t + g t²/2
    return (math.sqrt(speed**2 + 2.0 * GRAVITY * max(height, 0.0)) - speed) / GRAVITY
