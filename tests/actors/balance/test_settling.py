"""When a weight counts."""

from __future__ import annotations

from actors.balance.balance_settings import Settling, SettlingRule

RULE = SettlingRule(readings=4, span=0.6, steps=1.0)


def fed(readings: list[float | None], step: float = 1e-4, interval: float = 0.2):
    """Grams every 0.2 s (None: not stable); the index at which a weight counted, and the weight."""
    settling = Settling(RULE)
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
