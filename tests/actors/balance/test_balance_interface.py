"""Errors of weights that do not settle."""

from __future__ import annotations

from decimal import Decimal

import pytest

from actors.balance.balance_interface import NotStableError, unsettled
from actors.balance.readings import Reading, ReadingStatus


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (ReadingStatus.STABLE, "(last 512.7 g, marked as stable, but not the same for long enough)"),
        (ReadingStatus.UNSTABLE, "(last 512.7 g, unstable)"),
    ],
)
def test_a_mark_of_the_balance_does_not_contradict_that_no_weight_was_stable(status: ReadingStatus, said: str) -> None:
    error, text = unsettled(Reading(status, Decimal("512.7"), "g"), "512.7 g", 8.0, 0)
    assert error is NotStableError
    assert said in text
