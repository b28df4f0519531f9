"""`display_quality`: what is reported about a display: arrivals, repeated readings during a rise, and the tolerance
of a dose.
"""

from __future__ import annotations

import numpy as np
import pytest

from actors.balance.display_behaviour import DisplayBehaviour, DisplayModel
from actors.balance.display_quality import Repeats, arrivals, dose_tolerance, repeated_readings, smallest_change


def rise(behaviour: DisplayBehaviour, *, flow: float, interval: float, step: float, seed: int = 1) -> Repeats | None:
    model, masses = DisplayModel(behaviour, step, (seed,)), []
    times = interval * np.arange(round(14.0 / interval))
    for time in times:
        model.advance(flow * min(max(float(time) - 1.0, 0.0), 12.0), interval)
        masses.append(model.show(lambda: round(model.value / step) * step))
    return repeated_readings(times, masses, step)


@pytest.mark.parametrize("probability", [0.42, 0.6])
@pytest.mark.parametrize(("step", "flow"), [(1e-4, 8e-3), (2e-3, 20e-3)])
def test_the_share_of_repeats_lies_within_its_interval(probability, step, flow):
    truth = sum(probability**k for k in range(1, 6))
    truth /= 1.0 + truth
    found = [
        rise(DisplayBehaviour(repeat_probability=probability), flow=flow, interval=0.2, step=step, seed=seed)
        for seed in range(20)
    ]
    inside = [one is not None and one.low <= truth <= one.high for one in found]
    assert np.mean(inside) >= 0.8
    assert all(one is not None and one.longest <= 1.0 + 1e-9 for one in found)


@pytest.mark.parametrize(("step", "flow"), [(1e-4, 8e-3), (2e-3, 20e-3)])
def test_an_ideal_display_repeats_nothing(step, flow):
    found = rise(DisplayBehaviour(), flow=flow, interval=0.2, step=step)
    assert found is not None
    assert found.share == 0.0
    assert found.high < 0.1


def test_a_rise_that_is_slower_than_the_display_steps_is_not_judged():
    assert rise(DisplayBehaviour(), flow=5e-3, interval=0.2, step=2e-3) is None


def test_arrivals_and_the_real_step_of_a_display():
    found = arrivals([0.0, 0.1, 0.2, 0.3, 0.76])
    assert (found.interval, found.longest) == (pytest.approx(0.1), pytest.approx(0.46))
    assert smallest_change([0.0, 0.002, 0.002, 0.006]) == pytest.approx(0.002)
    assert smallest_change([0.1, 0.1]) == 0.0


def test_the_tolerance_of_a_dose_grows_with_each_weakness_of_the_balance():
    ideal = dose_tolerance(8e-3, 0.01, [0.1] * 20, 1e-4, 2e-5)
    assert 0.5e-3 < ideal < 0.7e-3
    held = dose_tolerance(8e-3, 0.01, [0.2] * 12 + [0.4] * 5 + [0.6] * 2 + [1.2], 1e-4, 2e-5)
    coarse = dose_tolerance(8e-3, 0.01, [0.2] * 20, 2e-3, 2e-5)
    unknown = dose_tolerance(8e-3, 0.2, [0.1] * 20, 1e-4, 2e-5)
    noisy = dose_tolerance(8e-3, 0.01, [0.1] * 20, 1e-4, 1e-3)
    assert min(held, coarse, unknown, noisy) > 1.5 * ideal
    assert dose_tolerance(2e-3, 0.2, [0.1] * 20, 1e-4, 2e-5) < 0.5 * unknown
