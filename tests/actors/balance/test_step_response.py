"""`step_response`: the lag of a display, from readings whose lag is known."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from actors.balance.display_behaviour import DisplayBehaviour, DisplayModel
from actors.balance.scale_model import SETTLED, EmulatedScale, Load, ScaleSettings
from actors.balance.step_response import FILTERS, step_response
from tests.support.hypothesis_examples import examples


def readings(form, constant, *, interval=0.1, step=0.1, resolution=1e-4, noise=0.0, put=1.03, dead=0.0, jitter=0.0):
    rng = np.random.default_rng(1)
    times = np.arange(0.0, 12.0, interval)
    times = times + jitter * rng.uniform(0.0, interval, len(times))
    since = times - put - dead
    shape = -np.expm1(-np.maximum(since, 0) / constant) if form == "first order" else np.clip(since / constant, 0, 1)
    masses = 0.02 + step * shape + noise * rng.normal(size=len(times))
    return times, np.round(masses / resolution) * resolution


@pytest.mark.parametrize("form", ["first order", "moving average"])
@settings(max_examples=examples(6), deadline=None)
@given(
    lag=st.floats(0.15, 1.0), put=st.floats(1.0, 1.1), step=st.sampled_from([0.05, -0.05, 0.3]), jitter=st.booleans()
)
def test_the_lag_of_either_form_is_found_within_its_error(form, lag, put, step, jitter):
    constant = lag if form == "first order" else 2.0 * lag
    times, masses = readings(form, constant, put=put, step=step, jitter=0.3 * jitter)
    found = step_response(times, masses, resolution=1e-4)
    assert found.form == form
    assert found.lag == pytest.approx(lag, abs=4.0 * found.error + 0.003)
    assert found.error < 0.05
    assert found.step == pytest.approx(step, abs=2e-4)
    assert found.moved == pytest.approx(put, abs=0.08)


@pytest.mark.slow
def test_the_stated_error_covers_the_scatter_of_repeated_measurements():
    found = []
    for seed in range(12):
        rng = np.random.default_rng(seed)
        times = np.arange(0.0, 8.0, 0.15)
        masses = 0.1 * -np.expm1(-np.maximum(times - 1.0 - rng.uniform(0, 0.15), 0) / 0.4) + rng.normal(0, 5e-4, 54)
        found.append(step_response(times, masses, resolution=1e-4))
    lags = np.array([one.lag for one in found])
    assert np.mean(lags) == pytest.approx(0.4, abs=0.02)
    inside = np.mean([abs(one.lag - 0.4) < 2.0 * one.error for one in found])
    assert inside > 0.8


def test_a_display_that_is_faster_than_its_readings_has_a_lag_as_uncertain_as_long():
    times, masses = readings("first order", 0.005)
    found = step_response(times, masses, resolution=1e-4)
    assert found.lag < 0.06
    assert found.lag - 4.0 * found.error < 0.02


def test_the_emulated_scale_has_the_lag_that_its_data_sheet_says():
    scale = EmulatedScale(ScaleSettings(settling_time=2.0))
    times, masses = [], []
    for i in range(100):
        if i == 10:
            scale.put(Load((0.0,), (0.15,)))
        scale.advance(0.1)
        times.append(scale.time)
        masses.append(float(scale.reading().value) / 1e3)
    found = step_response(times, masses, resolution=1e-4)
    assert found.form == "first order"
    assert found.lag == pytest.approx(2.0 / SETTLED, abs=4.0 * found.error + 0.01)


@pytest.mark.parametrize(
    ("masses", "said"),
    [
        ([0.0] * 10 + [0.001] * 10, "changed by 1 g only; put on at least 2 g"),
        ([0.0, 0.1, 0.3, 0.0, 0.2, 0.0, 0.1, 0.2, 0.2, 0.2], "do not follow one step"),
        ([0.0] * 3, "at least four readings"),
        ([0.0] * 8 + [float("nan")], "all with a weight"),
    ],
)
def test_readings_that_are_no_step_are_refused(masses, said):
    with pytest.raises(ValueError, match=said):
        step_response([0.1 * i for i in range(len(masses))], masses, resolution=1e-4)


def held(times, masses, probability, seed):
    """The readings as a display shows them that repeats some, at most five in a row."""
    display = DisplayModel(DisplayBehaviour(repeat_probability=probability), 1e-4, (seed,))
    return times, [display.show(lambda mass=mass: mass) for mass in masses]


@pytest.mark.parametrize("probability", [0.42, 0.6])
def test_a_display_that_repeats_readings_has_its_lag_within_the_stated_error(probability):
    """Taken as new, the repeated readings are no step at all, or give a lag that is wrong by more than stated."""
    found = [
        step_response(*held(*readings("first order", 0.4, put=1.0 + 0.02 * seed), probability, seed), resolution=1e-4)
        for seed in range(5)
    ]
    assert all(abs(one.lag - 0.4) < 3.0 * one.error for one in found)
    assert all(one.error < 0.15 for one in found)
    assert np.mean([one.repeats for one in found]) == pytest.approx(probability, abs=0.2)


def test_a_known_share_of_repeats_widens_the_error_of_a_rise_without_any():
    times, masses = readings("first order", 0.2, interval=0.2)
    plain, wide = (step_response(times, masses, resolution=1e-4, repeats=p) for p in (0.0, 0.6))
    assert plain.repeats == 0.0
    assert wide.error > 2.0 * plain.error
    assert step_response(times, masses, resolution=1e-4).lag == plain.lag


def test_the_response_of_a_filter_is_read_from_its_table_without_a_visible_error() -> None:
    times = np.concatenate([[-1.0, 0.0, 50.0, 80.0], np.random.default_rng(3).uniform(0.0, 50.0, 5_000)])
    exact = 1.0 - np.exp(-np.clip(times, 0.0, 50.0))
    # linear interpolation in steps of h is off by h²/8 times the curvature, here at most 1
    assert np.abs(FILTERS["first order"][1](times) - exact).max() < 1e-3**2 / 8
