"""Simulated and example pumps and spill sensors do what their contracts ask for."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from actors.liquid_devices import (
    SimulatedPump,
    SimulatedPumpSettings,
    SimulatedSpillSensor,
    SimulatedSpillSensorSettings,
)
from decant.plugins.testing import PumpContract, PumpRig, SpillRig, SpillSensorContract
from tests.plugins.decant_example.liquid_devices import Strip, StripSettings, Tap, TapSettings, Valve, Wires


class TestTap(PumpContract):
    @pytest.fixture
    def bench(self) -> Iterator[PumpRig]:
        settings, valve = TapSettings(), Valve()
        driver = Tap(settings, valve)
        yield PumpRig(
            driver,
            settings,
            lambda: valve.flowed,
            tolerance=0.5,  # a busy machine closes late
            volume=5e-6,
            unplug=lambda: setattr(valve, "plugged", False),
            make=(Tap, settings),
        )
        driver.close()


class TestSimulatedPump(PumpContract):
    @pytest.fixture
    def bench(self) -> Iterator[PumpRig]:
        settings = SimulatedPumpSettings(factor=1.0, time_scale=20.0)
        driver, moved = SimulatedPump(settings), [0.0]

        def weigh() -> float:
            moved[0] += driver.moved()
            return moved[0]

        yield PumpRig(driver, settings, weigh, tolerance=0.05, make=(SimulatedPump, settings))
        driver.close()


class TestStrip(SpillSensorContract):
    @pytest.fixture
    def bench(self) -> SpillRig:
        wires = Wires()
        return SpillRig(
            Strip(StripSettings(place="left"), wires),
            lambda wet: setattr(wires, "wet", wet),
            "left",
            unplug=lambda: setattr(wires, "plugged", False),
        )


class TestSimulatedSensor(SpillSensorContract):
    @pytest.fixture
    def bench(self) -> SpillRig:
        driver = SimulatedSpillSensor(SimulatedSpillSensorSettings())
        return SpillRig(driver, lambda wet: driver.spill(2e-3) if wet else driver.wipe(), "table")
