"""`balance_settings`: when a weight counts."""

from __future__ import annotations

import pytest

from actors.balance.balance_settings import Settling, SettlingRule
from actors.balance.display_behaviour import DisplayBehaviour
from actors.balance.readings import ReadingStatus
from actors.balance.scale_model import EmulatedScale, Load, ScaleSettings

RULE = SettlingRule(readings=4, span=0.6, steps=1.0)


def fed(readings: list[float | None], step: float = 1e-4, interval: float = 0.2, hold: float = 0.0):
    """Grams every 0.2 s (None: not stable); the index at which a weight counted, and the weight."""
    settling = Settling(RULE.with_values(hold=hold))
    for i, grams in enumerate(readings):
        settled = settling.feed(None if grams is None else grams / 1e3, i * interval, step)
        if settled is not None:
            return i, settled
    return None


def test_four_stable_readings_in_a_row_over_the_span_count():
    index, settled = fed([12.3] * 10)
    assert index == 3
    assert settled.mass == 0.0123


def test_readings_that_come_quickly_must_still_last_for_the_span():
    index, _ = fed([12.3] * 50, interval=0.05)
    assert index == 12


def test_readings_that_come_slowly_must_still_be_four():
    index, _ = fed([12.3] * 10, interval=2.0)
    assert index == 3


def test_an_unstable_reading_begins_anew():
    index, _ = fed([12.3, 12.3, 12.3, None, 12.3, 12.3, 12.3, 12.3])
    assert index == 7


def test_one_wrong_reading_never_counts_though_the_balance_calls_it_stable():
    index, settled = fed([12.3, 12.3, 2.3, 12.3, 12.3, 12.3, 12.3])
    assert index == 6
    assert settled.mass == 0.0123


def test_a_vessel_that_fills_slowly_does_not_count_while_it_fills():
    filling = [0.2 * i for i in range(20)]
    index, settled = fed([*filling, *[4.0] * 6])
    assert index >= 20
    assert settled.mass == 0.004


def test_the_last_digit_may_flicker():
    index, settled = fed([12.3, 12.4, 12.3, 12.4])
    assert index == 3
    assert abs(settled.mass - 0.01235) < 1e-4


def test_equal_readings_must_last_longer_than_a_display_holds_one():
    index, _ = fed([12.3] * 10, hold=1.5)
    assert index == 8
    index, _ = fed([12.3, 12.4, 12.3, 12.4], hold=1.5)
    assert index == 3, "a display that flickers is not held"


@pytest.mark.parametrize("probability", [0.42, 0.6])
@pytest.mark.parametrize("step", [1e-4, 2e-3])
@pytest.mark.parametrize(
    "habits",
    [{}, {"stable_display": True}, {"creep": 2.5e-4, "creep_time": 60.0}, {"rest_lag": 0.5, "stable_display": True}],
    ids=["held", "stable while held", "creep", "slow filter at rest"],
)
def test_no_weight_counts_while_the_load_still_moves_behind_a_held_display(probability, step, habits):
    """Each weighing begins while the receiver fills at 10 g/s; the display is read five times a second."""
    behaviour = DisplayBehaviour(repeat_probability=probability, **habits)
    for seed in range(10):
        scale = EmulatedScale(ScaleSettings(resolution=step, settling_time=1.0, behaviour=behaviour), (seed,))
        scale.put(Load((0.0, 2.0, 8.0), (0.2, 0.2, 0.26)))
        scale.advance(0.1 * (seed % 20))
        while scale.time < 2.0:  # the display rests, stable
            scale.advance(0.2)
            scale.reading()
        settling, settled = Settling(SettlingRule()), None
        while settled is None:
            scale.advance(0.2)
            reading = scale.reading()
            stable = reading.status is ReadingStatus.STABLE
            settled = settling.feed(reading.mass() if stable else None, scale.time, step)
        assert scale.time > 8.0
        assert abs(settled.mass - 0.26) <= 1.01 * step + abs(behaviour.creep) * 0.26
