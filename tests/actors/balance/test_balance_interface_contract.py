"""`balance_interface`: our own balances do what every balance has to do."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace
from typing import Any

import pytest

from actors.balance.balance_interface import BalanceError, NoConnectionError, Weight
from actors.balance.balance_settings import SettlingRule
from actors.balance.scale_model import Load
from actors.balance.serial_balance import SerialBalance
from actors.balance.simulated_balance import SimulatedBalanceSettings, VirtualBalance
from actors.contract_tests import balance_contract as contract
from actors.contract_tests.balance_contract import BalanceBench, BalanceContract
from tests.actors.balance.conftest import spec_for

SETTINGS = SimulatedBalanceSettings(resolution=1e-4, noise=2e-4, drift=0.0, settling_time=1.5, time_scale=0.0)


def of_numbers(cls: type[VirtualBalance]) -> BalanceBench:
    """A balance of numbers whose bench time passes while something is put on it."""
    driver = cls(SETTINGS)

    def put(load: Load) -> None:
        driver.put(load)
        driver.pass_time(5.0)

    def restless(active: bool) -> None:
        if active:
            put(Load((0.0, 3600.0), (0.0, 72.0)))
        else:
            driver.put(Load((0.0,), (0.0,)))

    return BalanceBench(
        driver,
        lambda mass: put(Load((0.0,), (mass,))),
        tolerance=1.5e-3,
        restless=restless,
        make=(cls, SETTINGS),
    )


def on_a_line(cls: type[SerialBalance], far: Any, dialect: str) -> BalanceBench:
    """A driver, and a virtual balance at the other end of its line."""
    spec = spec_for(far, dialect, settling=SettlingRule(deadline=40.0))
    return BalanceBench(
        cls(spec),
        far.put,
        tolerance=0.15e-3,
        capacity=50.0,
        unplug=far.unplug,
        plug=far.plug,
        restless=lambda active: far.faults(restless=active),
        ignore_tare=lambda active: far.faults(powerless=active),
        make=(cls, spec),
    )


class TestABalanceOfNumbers(BalanceContract):
    @pytest.fixture
    def bench(self) -> BalanceBench:
        return of_numbers(VirtualBalance)


class TestABalanceOnASerialLine(BalanceContract):
    @pytest.fixture
    def bench(self, virtual: Any, each_dialect: str) -> Iterator[BalanceBench]:
        bench = on_a_line(SerialBalance, virtual(each_dialect), each_dialect)
        yield bench
        bench.driver.close()


@pytest.mark.slow
class TestABalanceOverTcp(BalanceContract):
    @pytest.fixture(params=["a-and-d", "mt-sics"])
    def bench(self, request: pytest.FixtureRequest, virtual: Any) -> Iterator[BalanceBench]:
        bench = on_a_line(SerialBalance, virtual(request.param, tcp=True), request.param)
        yield bench
        bench.driver.close()


# -- balances that the contract finds ----------------------------------------------------------------------------------


class NeverTares(VirtualBalance):
    """Tare does nothing."""

    def tare(self) -> None:
        pass


class TaresInMotion(VirtualBalance):
    """Takes for zero what it shows just now."""

    def tare(self) -> None:
        self._tare += self.read().mass


class Hasty(VirtualBalance):
    """Always weighs nothing."""

    def weigh(self) -> Weight:
        return Weight(0.0, True, 0.0)


class Grams(VirtualBalance):
    """Weighs in grams."""

    def weigh(self) -> Weight:
        weight = super().weigh()
        return replace(weight, mass=1e3 * weight.mass)


class Late(VirtualBalance):
    """Returns the weight before the last one."""

    last: Weight | None = None

    def weigh(self) -> Weight:
        before, self.last = self.last, super().weigh()
        return before or self.last


class WithoutTimes(VirtualBalance):
    """Every weight has the same time."""

    def weigh(self) -> Weight:
        return replace(super().weigh(), time=0.0)

    def read(self) -> Weight:
        return replace(super().read(), time=0.0)


class Stands(VirtualBalance):
    """Shows its first reading for ever."""

    first: Weight | None = None

    def read(self) -> Weight:
        self.first = self.first or super().read()
        return self.first


class AlwaysStable(VirtualBalance):
    """Calls everything stable."""

    def weigh(self) -> Weight:
        return replace(self.read(), time=super().read().time + 1e-6)

    def read(self) -> Weight:
        return replace(super().read(), stable=True)


@pytest.mark.parametrize(
    ("cheat", "found_by", "message"),
    [
        (
            NeverTares,
            "test_a_tare_counts_what_is_there_as_nothing",
            r"after tare weigh\(\) returns (199|200|201)\.\d g; 0.0 g",
        ),
        (
            TaresInMotion,
            "test_a_tare_waits_for_rest",
            r"tare\(\) returned None, although the display never came to rest",
        ),
        (Hasty, "test_it_weighs_what_is_put_on_it", r"weigh\(\) returns 0.0 g; 200.0 g ± 1.5 g would be right"),
        (Hasty, "test_times_of_weights_go_forwards", "the time 0.000 s, after one of the time 0.000 s"),
        (Grams, "test_it_weighs_what_is_put_on_it", r"weigh\(\) returns \d{6}.\d g; 200.0 g"),
        (Late, "test_it_weighs_what_is_put_on_it", r"weigh\(\) returns (199|200|201)\.\d g; 100.0 g"),
        (
            WithoutTimes,
            "test_it_weighs_what_is_put_on_it",
            r"of the time 0.000 s, before 200.0 g were put on the balance",
        ),
        (
            WithoutTimes,
            "test_the_display_follows_what_is_put_on_it",
            r"read\(\) gives 0.000 s as the time of its reading",
        ),
        (
            AlwaysStable,
            "test_a_moving_display_is_not_called_stable",
            r"read\(\) calls a display stable that never rests",
        ),
        (AlwaysStable, "test_what_never_rests_is_no_weight", "DID NOT RAISE"),
    ],
)
def test_a_driver_that_cheats_is_found_out(
    cheat: type[VirtualBalance], found_by: str, message: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contract, "EVENT_TIMEOUT", 2.0)
    with pytest.raises((AssertionError, pytest.fail.Exception), match=message):
        getattr(BalanceContract(), found_by)(of_numbers(cheat))


def test_a_display_that_stands_is_found_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(contract, "EVENT_TIMEOUT", 0.5)
    with pytest.raises(AssertionError, match=r"read\(\) never shows a stable 200.0 g.*; it shows -?0.\d g"):
        BalanceContract().test_the_display_follows_what_is_put_on_it(of_numbers(Stands))


class BelievesItsTare(SerialBalance):
    """Takes an acknowledged tare for done."""

    def _near_zero(self) -> None:
        return None


class KeepsTheLastWeight(SerialBalance):
    """Returns the last weight when its line is cut."""

    kept: Weight | None = None

    def weigh(self) -> Weight:
        try:
            self.kept = super().weigh()
        except NoConnectionError:
            assert self.kept is not None
        return self.kept  # type: ignore[return-value]


class ShowsTheLastWeight(SerialBalance):
    """Shows the last weight when its line is cut."""

    shown: Weight | None = None

    def read(self) -> Weight:
        weight = super().read()
        if weight.stable or self.shown is None:
            self.shown = weight
        return self.shown


class WaitsForItsLine(SerialBalance):
    """Waits until its line is back."""

    def weigh(self) -> Weight:
        while True:
            try:
                return super().weigh()
            except BalanceError:
                self._check_interrupted()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("cheat", "found_by", "message"),
    [
        (
            BelievesItsTare,
            "test_a_tare_without_effect_is_an_error",
            r"tare\(\) returned None, although the balance still",
        ),
        (
            KeepsTheLastWeight,
            "test_a_lost_connection_is_an_error_and_no_weight",
            r"returned Weight.* its connection was cut",
        ),
        (
            ShowsTheLastWeight,
            "test_a_lost_connection_is_an_error_and_no_weight",
            r"shows a stable weight after its conn",
        ),
        pytest.param(
            WaitsForItsLine,
            "test_a_lost_connection_is_an_error_and_no_weight",
            r"weigh\(\), under way, still waits after 5 s",
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_driver_that_hides_a_fault_of_its_line_is_found_out(
    cheat: type[SerialBalance], found_by: str, message: str, virtual: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(contract, "EVENT_TIMEOUT", 5.0)
    bench = replace(on_a_line(cheat, virtual("kcp"), "kcp"), lost_within=5.0)
    try:
        with pytest.raises(AssertionError, match=message):
            getattr(BalanceContract(), found_by)(bench)
    finally:
        bench.driver.interrupt()
        bench.driver.close()
