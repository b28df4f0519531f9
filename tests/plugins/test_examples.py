"""The example's balances and vessels do what ours have to do."""

from __future__ import annotations

import math
from collections.abc import Iterator
from decimal import Decimal

import pytest

from decant.plugins import LineError, Load, Reading, ReadingStatus, VesselSpec, build_vessel
from decant.plugins.testing import BalanceBench, BalanceContract
from tests.plugins.decant_example.balance import SpringBalance, SpringSettings
from tests.plugins.decant_example.dialect import PLAIN
from tests.plugins.decant_example.vessel import Cone


class TestSpring(BalanceContract):
    @pytest.fixture
    def bench(self) -> Iterator[BalanceBench]:
        spec = SpringSettings(swing=1.0, time_scale=10.0)
        driver = SpringBalance(spec)
        filling, empty = Load((0.0, 3600.0), (0.0, 1.0)), Load((0.0,), (0.0,))
        yield BalanceBench(
            driver,
            lambda mass: driver.put(Load((0.0,), (mass,))),
            tolerance=0.1e-3,
            restless=lambda active: driver.put(filling if active else empty),
            make=(SpringBalance, spec),
        )
        driver.close()


@pytest.mark.parametrize(
    ("line", "status", "mass"),
    [
        (b"12.3 g", ReadingStatus.STABLE, 0.0123),
        (b"-0.5 g!", ReadingStatus.UNSTABLE, -0.0005),
        (b"1.2 kg", ReadingStatus.STABLE, 1.2),
    ],
)
def test_lines_of_the_dialect_are_read_and_written(line: bytes, status: ReadingStatus, mass: float) -> None:
    reading = PLAIN.decode(line)
    assert isinstance(reading, Reading)
    assert (reading.status, reading.mass()) == (status, pytest.approx(mass))
    assert PLAIN.encode(reading) == line + b"\r\n"


@pytest.mark.parametrize("line", [b"", b"12.3", b"12,3 g", b"12.3 g?", b"x12.3 g"])
def test_half_a_line_is_no_weight(line: bytes) -> None:
    with pytest.raises(LineError):
        PLAIN.decode(line)
    with pytest.raises(ValueError, match="no words"):
        PLAIN.encode(Reading(ReadingStatus.OVER, None))
    assert PLAIN.encode(Reading(ReadingStatus.STABLE, Decimal("1.0"), "g")) == b"1.0 g\r\n"


def test_a_cone_holds_what_a_cone_holds() -> None:
    cone = Cone(top="45 mm", bottom="30 mm", height="100 mm")  # type: ignore[arg-type]
    vessel = build_vessel(VesselSpec(name="cone-1", shape=cone))
    r, s, h = 0.045, 0.03, 0.1
    assert vessel.capacity == pytest.approx(math.pi * h * (r * r + r * s + s * s) / 3.0, rel=1e-6)
    assert vessel.rim_height == pytest.approx(h + 0.004)
