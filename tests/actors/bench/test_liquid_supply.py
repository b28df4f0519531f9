"""`actors.bench.liquid_supply`: a pump fills the source again, and nothing is poured on a wet table."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from pathlib import Path

import pytest

from actors.balance.balance_device import DeviceBalance
from actors.balance.balance_settings import balance_kind
from actors.balance.simulated_balance import SimulatedBalanceSettings
from actors.balance.weighing_plan import Placement
from actors.bench.bench_operators import BenchContents, OperatorQuestions
from actors.bench.liquid_supply import LiquidSupply, PumpDevice, SpillWatch
from actors.interfaces import (
    DoseSource,
    LaboratoryError,
    Notice,
    NotPouredError,
    OperatorQuestion,
    OperatorSettings,
)
from actors.liquid_devices import (
    SimulatedPumpSettings,
    SimulatedSpillSensor,
    SimulatedSpillSensorSettings,
    SourceSettings,
    device_checks,
)
from actors.runtime.remote_object import LocalDevice
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from sim_engine.outcome import PourMeasurement

WATER = 998.0
"""Density [kg/m³]."""


class Site:
    """A source vessel under a simulated pump whose true flow is 8 % less than the nominal one; no waits."""

    def __init__(self, *, balance: bool) -> None:
        pump = SimulatedPumpSettings(time_scale=0.0, factor=0.92, scatter=0.0)
        scale = SimulatedBalanceSettings(noise=1e-5, time_scale=0.0)
        cls, arguments = balance_kind(scale).driver("source")
        device = LocalDevice("source-balance", lambda: cls(*arguments))
        self.notices: list[Notice] = []
        self.contents = BenchContents(Placement.RECEIVER, liquids={"pourer": 0.1})
        self.pump = LocalDevice("refill", lambda: pump.driver()[0](pump))
        self.supply = LiquidSupply(
            SourceSettings(refill=pump),
            DeviceBalance(device, 0.0) if balance else None,
            PumpDevice(self.pump, pump),
            self.contents,
            self.notices.append,
        )


@pytest.mark.parametrize(("balance", "expected"), [(False, 0.284), (True, 0.3)])
async def test_a_balance_under_the_pourer_corrects_the_flow_of_the_refill_pump(balance: bool, expected: float) -> None:
    site = Site(balance=balance)
    assert await site.supply.top_up(0.2, WATER, seed=1)
    assert site.contents.in_pourer == pytest.approx(expected, abs=5e-4)
    await site.supply.close()


async def test_a_refilled_amount_is_less_certain_than_a_weighed_one() -> None:
    site = Site(balance=False)
    source = DoseSource("beaker", 0.3, 5e-4, fill=True, constants=1, before=0.1)
    filled = await site.supply.filled(source, WATER, seed=1)
    assert filled is not None
    assert not filled.fill
    assert filled.deviation == pytest.approx(0.03 * 0.2, rel=0.01)
    assert "source beaker: refilled with 200 g" in site.notices[-1].text
    unknown = DoseSource("beaker", 0.3, 5e-4, fill=True, constants=1)
    assert await site.supply.filled(unknown, WATER, seed=1) is None, "the operator fills what is unknown"


def test_a_balance_of_the_source_needs_a_pump_and_its_place(tmp_path: Path) -> None:
    text = shipped("laboratories/night.yaml").read_text(encoding="utf-8")
    refill = "refill: {kind: simulated}"
    weighed = text.replace(refill, f"{refill}\n  balance: {{kind: simulated}}")
    path = tmp_path / "night.yaml"
    path.write_text(weighed, encoding="utf-8")
    assert load_laboratory(path).source is not None
    for wrong in (weighed.replace("use: source", "use: stand"), weighed.replace(refill, "refill_error: 0.01")):
        path.write_text(wrong, encoding="utf-8")
        with pytest.raises(ConfigError, match="add 'refill' and a place with 'use: source'"):
            load_laboratory(path)


class Person:
    """An operator who wipes the table, or does not."""

    def __init__(self, *, wipes: bool) -> None:
        self.wipes, self.heard = wipes, list[str]()

    async def ask(self, question: OperatorQuestion) -> str:
        self.heard.append(question.about)
        if not self.wipes:
            raise LaboratoryError("nobody wiped the table")
        return "done"

    async def announce(self, text: str, seconds: float) -> None: ...


def watched(
    person: Person, scenario: Callable[[Callable[[float], Awaitable[PourMeasurement]]], Awaitable[None]]
) -> None:
    """Run a scenario with a function that makes a pour which spills a mass [kg] on a watched table."""

    async def body() -> None:
        settings = SimulatedSpillSensorSettings(place="left of the balance")
        device = LocalDevice("spill-sensor", lambda: SimulatedSpillSensor(settings))
        questions = OperatorQuestions(person, OperatorSettings(answers="person"), lambda notice: None)
        watch = SpillWatch(device, settings, questions, lambda notice: None)

        async def safe() -> None: ...

        async def pour(spilled: float) -> PourMeasurement:
            async def measured() -> PourMeasurement:
                return PourMeasurement(0.1, spilled, 0.0, {})

            return await watch.watched(measured, safe)

        await scenario(pour)
        await watch.close()

    asyncio.run(body())


def test_a_wet_table_is_recorded_and_the_operator_has_to_wipe_it() -> None:
    person = Person(wipes=True)

    async def scenario(pour: Callable[[float], Awaitable[PourMeasurement]]) -> None:
        first = await pour(2e-3)
        assert [(event["place"], event["wet"]) for event in first.notes["spills"]] == [("left of the balance", True)]
        assert person.heard == [], "the outcome of a pour waits for nobody"
        second = await pour(0.0)
        assert person.heard == ["table_wet"]
        assert [event["wet"] for event in second.notes["spills"]] == [False]

    watched(person, scenario)


def test_nothing_is_poured_while_the_table_is_wet() -> None:
    async def scenario(pour: Callable[[float], Awaitable[PourMeasurement]]) -> None:
        await pour(2e-3)
        with pytest.raises(NotPouredError, match=r"nobody wiped the table\. Nothing was poured"):
            await pour(0.0)

    watched(Person(wipes=False), scenario)


def test_refill_pump_and_spill_sensor_are_connected_by_the_check() -> None:
    checks = device_checks(SourceSettings(refill=SimulatedPumpSettings()), SimulatedSpillSensorSettings())
    assert [(check.name, check.state) for check in checks] == [("refill", "ok"), ("spill sensor", "ok")]
