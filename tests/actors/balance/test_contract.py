"""Our own balances do what every balance has to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from actors.balance.protocol import Weight
from actors.balance.serial_balance import SerialBalance
from actors.balance.settling import SettlingRule
from actors.balance.virtual_balance import BalanceSettings, Load, VirtualBalance
from actors.contracts.balance import BalanceBench, BalanceContract

from .conftest import spec_for

SETTINGS = BalanceSettings(resolution=1e-4, noise=2e-4, drift=0.0, settling_time=1.5, time_scale=0.0)


class TestABalanceOfNumbers(BalanceContract):
    @pytest.fixture
    def bench(self) -> BalanceBench:
        driver = VirtualBalance(SETTINGS)

        def put(mass: float) -> None:
            driver.put(Load((0.0,), (mass,)))
            driver.pass_time(5.0)

        return BalanceBench(driver, put, tolerance=1.5e-3, make=(VirtualBalance, SETTINGS))


class TestABalanceOnASerialLine(BalanceContract):
    @pytest.fixture
    def bench(self, virtual: Any, each_dialect: str) -> Iterator[BalanceBench]:
        far = virtual(each_dialect)
        spec = spec_for(far, each_dialect, settling=SettlingRule(deadline=40.0))
        driver = SerialBalance(spec)
        yield BalanceBench(
            driver,
            far.put,
            tolerance=0.15e-3,
            capacity=50.0,
            unplug=far.unplug,
            plug=far.plug,
            restless=lambda active: far.faults(restless=active),
            make=(SerialBalance, spec),
        )
        driver.close()


class NeverTares(VirtualBalance):
    def tare(self) -> None:
        pass


class Hasty(VirtualBalance):
    def weigh(self) -> Weight:
        return Weight(0.0, True, 0.0)


class Grams(VirtualBalance):
    def weigh(self) -> Weight:
        weight = super().weigh()
        return replace(weight, mass=1e3 * weight.mass)


@pytest.mark.parametrize(
    ("cheat", "found_by"),
    [
        (NeverTares, "test_a_tare_counts_what_is_there_as_nothing"),
        (Hasty, "test_it_weighs_what_is_put_on_it"),
        (Hasty, "test_times_of_weights_go_forwards"),
        (Grams, "test_it_weighs_what_is_put_on_it"),
    ],
)
def test_a_driver_that_cheats_is_found_out(cheat: type[VirtualBalance], found_by: str) -> None:
    driver = cheat(SETTINGS)

    def put(mass: float) -> None:
        driver.put(Load((0.0,), (mass,)))
        driver.pass_time(5.0)

    with pytest.raises(AssertionError):
        getattr(BalanceContract(), found_by)(BalanceBench(driver, put, tolerance=1.5e-3))
