"""`balance_check`: the commissioning check of a balance, on emulators with an injected lag, drift, scatter and
error of scale.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

import pytest

from actors.balance.balance_check import EmulatedHands, check_balance
from actors.balance.display_behaviour import DisplayBehaviour
from actors.balance.scale_model import SETTLED, Load, ScaleSettings
from actors.balance.serial_balance import SerialBalance
from actors.emulators.serial_balance.balance_process import VirtualSerialBalance
from actors.interfaces import DeviceCheck
from tests.actors.balance.conftest import SOON, spec_for

SCALE = 5.0
"""Bench seconds per second: a busy machine reads a little late, and lateness counts five times."""


@pytest.fixture
def checked() -> Iterator[Callable[..., dict[str, DeviceCheck]]]:
    """The findings by name, the worst of each."""
    opened: list[SerialBalance | VirtualSerialBalance] = []

    def of(
        sheet: ScaleSettings, hands: type[EmulatedHands] = EmulatedHands, waits=(), **faults
    ) -> dict[str, DeviceCheck]:
        far = VirtualSerialBalance.start("mt-sics", baud=0, scale=sheet, time_scale=SCALE, latency=0.001)
        driver = SerialBalance(spec_for(far, "mt-sics", time_scale=SCALE, interval=0.1, **dict(waits)), "kern-1")
        opened.extend((driver, far))
        far.faults(**faults)
        worst = {"ok": 0, "warn": 1, "fail": 2}
        found = list(check_balance(driver, hands(far.put), time_scale=SCALE))
        return {check.name: check for check in sorted(found, key=lambda check: worst[check.state])}

    yield of
    for one in opened:
        one.close()


@pytest.mark.slow
def test_a_healthy_balance_passes_and_each_finding_says_what_is_right(checked):
    found = checked(ScaleSettings(settling_time=1.5))
    names = [
        "balance",
        "readings",
        "noise",
        "drift",
        "repeats",
        "lag",
        "dose",
        "return to zero",
        "linearity",
        "vibration",
    ]
    assert sorted(found) == sorted(names)
    assert {check.state for check in found.values()} == {"ok"}, found
    assert all("right: " in check.found for name, check in found.items() if name != "balance")
    lag, error = (float(part) for part in found["lag"].found.split(" s ")[0].split(" ± "))
    assert lag == pytest.approx(1.5 / SETTLED, abs=4.0 * error + 0.08)


@pytest.mark.slow
def test_a_slow_and_drifting_balance_is_named_with_what_to_do(checked):
    found = checked(ScaleSettings(settling_time=6.0, drift=2e-5))
    assert found["lag"].state == "warn"
    assert "faster filter" in found["lag"].advice
    assert found["drift"].state == "warn"
    assert float(found["drift"].found.split(" ")[0]) == pytest.approx(1.2, abs=0.15)
    assert "warm up" in found["drift"].advice


@pytest.mark.slow
def test_a_display_that_repeats_its_readings_is_named_with_the_tolerance_it_permits(checked):
    found = checked(ScaleSettings(settling_time=1.5, behaviour=DisplayBehaviour(repeat_probability=0.6)))
    assert found["repeats"].state == "warn"
    low, high = (float(text) / 100 for text in re.findall(r"(\d+) to (\d+) %", found["repeats"].found)[0])
    assert low - 0.05 < 0.6 < high + 0.1
    tolerance = float(found["dose"].found.split(" ")[0].removeprefix("±"))
    assert tolerance > 0.65, "an ideal display permits 0.57 g"
    lag, error = (float(part) for part in found["lag"].found.split(" s ")[0].split(" ± "))
    assert lag == pytest.approx(1.5 / SETTLED, abs=3.0 * error + 0.1)


class WrongWeights(EmulatedHands):
    """Weights that are two grams heavier than written on them."""

    def reference(self) -> float | None:
        mass = super().reference()
        if mass is not None:
            self.put_load(Load((0.0,), (mass + 2e-3,)))
        return mass


@pytest.mark.slow
def test_a_balance_that_weighs_wrong_fails(checked):
    found = checked(ScaleSettings(), WrongWeights)
    assert found["linearity"].state == "fail"
    assert "+2 g" in found["linearity"].found
    assert "adjust it" in found["linearity"].advice


def test_a_balance_that_never_rests_ends_the_check_with_its_error(checked):
    found = checked(ScaleSettings(), waits=SOON, restless=True)
    assert found["balance"].state == "fail"
    assert "touching the tray" in found["balance"].found
    assert "lag" not in found
