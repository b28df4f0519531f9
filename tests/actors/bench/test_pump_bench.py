"""Wanted amounts by a pump: the source is weighed and refilled, and a wet table stops the pouring."""

from __future__ import annotations

import asyncio
import json
import math
import os
import signal
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from actors.balance.simulated_balance import SimulatedBalanceSettings
from actors.bench.bench_operators import VirtualOperator
from actors.bench.pump_bench import PortionPlanner, PumpBench
from actors.dosing_settings import DosingSettings
from actors.interfaces import (
    DoseKnowledge,
    DoseSource,
    DoseTarget,
    InvalidActionError,
    LaboratoryError,
    Notice,
    NotPouredError,
    OperatorQuestion,
    PourProgress,
    UnknownPourError,
)
from actors.laboratory import InProcessLaboratory, RayLaboratory
from actors.laboratory_settings import LaboratorySettings
from actors.liquid_devices import SimulatedPump, SimulatedPumpSettings, SimulatedSpillSensorSettings, SourceSettings
from actors.runtime.remote_object import LocalDevice
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli.app import app
from orchestrator.learning.dispense import Dispensed
from orchestrator.materials.vessel_account import VesselAccount
from orchestrator.records.run_record import read_result
from orchestrator.runs.bench_check import check_bench
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import cylinder

SCENE = Scene(
    "dispense-bottle-beaker",
    cylinder("bottle", inner_radius=0.045, inner_height=0.12),
    cylinder("beaker", inner_radius=0.03, inner_height=0.09),
    Liquid(mass=0.3),
)
SOURCE_BALANCE = SourceSettings(balance=SimulatedBalanceSettings(noise=1e-5), vessel=0.24)
REFILL = SourceSettings(refill=SimulatedPumpSettings(time_scale=0.0, factor=1.0))


def laboratory(**changes: Any) -> LaboratorySettings:
    """A pump whose true flow is 8 % less than the nominal one; no waits."""
    spec = LaboratorySettings(
        name="pump",
        in_process=True,
        pump=SimulatedPumpSettings(time_scale=0.0, factor=0.92),
        balance=SimulatedBalanceSettings(placement="receiver", resolution=1e-5, noise=1e-5),
    ).with_values(**changes)
    return spec.ready()


def target(grams: float, **source: Any) -> DoseTarget:
    about: dict[str, Any] = {"name": "bottle", "mass": 0.3, "deviation": 5e-4, "fill": True, "constants": 1, **source}
    return DoseTarget(1e-3 * grams, 5e-4, "A1", DoseSource(**about))


class Stage:
    def __init__(self, opened: InProcessLaboratory | RayLaboratory, notices: list[Notice]) -> None:
        assert opened.opened is not None
        assert isinstance(opened.opened.bench, PumpBench)
        self.bench, self.operator, self.notices = opened.opened.bench, opened.opened.operator, notices
        assert self.bench._hands is not None
        self.contents = self.bench._hands.contents

    @property
    def asked(self) -> list[str]:
        assert isinstance(self.operator, VirtualOperator)
        return [question.about for question in self.operator.heard]

    async def dose(self, grams: float, progress: Callable[[PourProgress], None] | None = None, **source: Any) -> Any:
        measured = await self.bench.pour(SCENE, None, seed=5, dose=target(grams, **source), progress=progress)
        assert measured.notes["dose"]["received"] == pytest.approx(self.contents.in_receiver, abs=2e-4)
        return measured.notes["dose"] | {"spills": measured.notes.get("spills", [])}


def run(
    scenario: Callable[[Stage], Awaitable[None]], person: Any = None, *, kind: Any = InProcessLaboratory, **changes: Any
) -> None:
    async def body() -> None:
        notices: list[Notice] = []
        opened = kind(laboratory(**changes), need_bench=True, operator=person)
        opened.listen(notices.append)
        async with opened:
            await scenario(Stage(opened, notices))

    asyncio.run(body())


@pytest.mark.parametrize("metering", ["volume", "time"])
def test_a_pump_with_a_wrong_flow_meets_the_amount(metering: str) -> None:
    async def scenario(stage: Stage) -> None:
        first = await stage.dose(50)
        assert first["received"] == pytest.approx(0.05, abs=5e-4)
        assert first["end"] == "reached"
        assert first["top_ups"] >= 1
        assert stage.asked == ["dose_source", "dose_receiver"]
        assert first["left"][0] == pytest.approx(0.25, abs=1e-3)
        known = DoseKnowledge(**first["knowledge"])
        second = await stage.dose(50, mass=0.25, fill=False, knowledge=known)
        assert second["portions_g"][0][1] > first["portions_g"][0][1] + 2.0, "the next dose knows the flow"

    run(scenario, pump=SimulatedPumpSettings(time_scale=0.0, factor=0.92, metering=metering))


def test_an_amount_that_the_last_portion_allowed_has_met_is_reached() -> None:
    async def scenario(stage: Stage) -> None:
        known = DoseKnowledge((0.0, 0.0), (0.0, 0.0, 0.0, 0.0), None, 0.0, 5)
        dose = await stage.dose(50, knowledge=known)
        assert (dose["top_ups"], dose["end"]) == (1, "reached")

    exact = SimulatedPumpSettings(time_scale=0.0, factor=1.0, scatter=0.0)
    run(scenario, pump=exact, dosing=DosingSettings(most_top_ups=1))


def test_the_first_portion_of_an_unknown_pump_is_not_too_much() -> None:
    planner = PortionPlanner()
    sure = planner.portion(0.05, 5e-4)
    assert sure * math.exp(2.33 * 0.1) < 0.0521, "1 % of unknown pumps deliver 26 % more"
    planner.learn(sure, 1.1 * sure, 1e-5)
    assert planner.portion(0.01, 5e-4) * 1.1 == pytest.approx(0.01, rel=0.03)


def test_an_action_without_an_amount_is_refused() -> None:
    async def scenario(stage: Stage) -> None:
        with pytest.raises(InvalidActionError, match="wanted amounts only"):
            await stage.bench.pour(SCENE, None, seed=1)

    run(scenario)


def test_a_balance_under_the_source_corrects_its_content() -> None:
    async def scenario(stage: Stage) -> None:
        await stage.dose(20)
        stage.contents.in_pourer -= 0.04  # somebody took 40 g
        second = await stage.dose(20, mass=0.28, fill=False)
        assert second["left"][0] == pytest.approx(stage.contents.in_pourer, abs=5e-4)
        assert any("240.0 g of liquid" in one.text or "expected" in one.text for one in stage.notices)

    run(scenario, source=SOURCE_BALANCE)


def test_a_source_that_weighs_too_little_is_filled_before_the_dose() -> None:
    async def scenario(stage: Stage) -> None:
        await stage.dose(20)
        stage.contents.in_pourer = 0.03
        dose = await stage.dose(50, mass=0.28, fill=False)
        assert dose["received"] == pytest.approx(0.05, abs=5e-4)
        assert stage.asked.count("dose_source") == 2

    run(scenario, source=SOURCE_BALANCE)


def test_a_refill_device_fills_a_source_whose_content_is_known() -> None:
    async def scenario(stage: Stage) -> None:
        await stage.dose(50)
        held = stage.contents.in_pourer
        second = await stage.dose(50, before=held)
        assert stage.asked == ["dose_source", "dose_receiver", "dose_cleared", "dose_receiver"]
        assert second["left"][0] == pytest.approx(0.25, abs=1e-3)
        assert stage.contents.in_pourer == pytest.approx(0.25, abs=2e-3)
        assert second["left"][1] > 1e-3, "a refilled amount is less certain than a weighed one"

    run(scenario, source=REFILL)


def test_a_stopped_pump_makes_the_amount_unknown_and_tells_the_weight() -> None:
    async def scenario(stage: Stage) -> None:
        stops: list[asyncio.Task[None]] = []

        def progress(seen: PourProgress) -> None:
            if seen.checkpoint == "dose" and not stops:
                stops.append(asyncio.ensure_future(stage.bench.stop()))

        with pytest.raises(UnknownPourError, match=r"the balance shows \d+\.\d\d g in the receiver"):
            await stage.dose(50, progress)
        assert stage.contents.in_receiver < 0.045

    run(scenario)


@pytest.mark.slow
@pytest.mark.realtime
@pytest.mark.ray
@pytest.mark.parametrize("lost", ["pump", "balance"])
def test_a_device_whose_process_dies_in_a_portion_leaves_the_dose_unknown_and_is_started_again(
    ray_running: None, lost: str
) -> None:
    async def scenario(stage: Stage) -> None:
        device = stage.bench._pump.device if lost == "pump" else stage.bench.balance.device
        victim = await device.pid()
        flows = asyncio.Event()
        dose = asyncio.ensure_future(stage.dose(50, lambda seen: flows.set() if seen.checkpoint == "dose" else None))
        await flows.wait()
        os.kill(victim, signal.SIGKILL)
        with pytest.raises(UnknownPourError, match=r"process .*died.* not the dose that was asked for"):
            await dose
        again = await stage.dose(20)
        assert again["end"] == "reached"
        assert again["received"] == pytest.approx(0.02, abs=5e-4)
        assert await device.pid() != victim

    run(scenario, kind=RayLaboratory, pump=SimulatedPumpSettings(time_scale=5.0), in_process=False)


WET = {
    "pump": SimulatedPumpSettings(time_scale=0.0, missed=2e-3),
    "spill_sensor": SimulatedSpillSensorSettings(place="left of the balance"),
}


def test_a_wet_table_is_recorded_and_the_operator_has_to_wipe_it() -> None:
    async def scenario(stage: Stage) -> None:
        dose = await stage.dose(50)
        assert [(event["place"], event["wet"]) for event in dose["spills"]] == [("left of the balance", True)]
        assert stage.asked == ["dose_source", "dose_receiver"], "the outcome of a dose waits for nobody"
        assert any(one.level == "warning" and "left of the balance is wet" in one.text for one in stage.notices)
        second = await stage.dose(20, mass=0.25, fill=False)
        assert stage.asked[2] == "table_wet"
        assert [event["wet"] for event in second["spills"]] == [False, True]

    run(scenario, **WET)


def test_a_table_that_gets_wet_ends_the_dose() -> None:
    async def scenario(stage: Stage) -> None:
        assert stage.bench._watch is not None
        device = stage.bench._watch._device
        assert isinstance(device, LocalDevice)
        sensor, shown = device._object, []

        def progress(seen: PourProgress) -> None:
            if seen.checkpoint == "dose" and not shown:
                shown.append(seen)
                sensor.spill(5e-3)  # before the portion ends, however busy the machine is

        dose = await stage.dose(50, progress)
        assert dose["end"] == "the table became wet: left of the balance"
        assert dose["received"] < 0.045
        await stage.dose(20, mass=0.25, fill=False)
        assert "table_wet" in stage.asked

    run(scenario, spill_sensor=WET["spill_sensor"])


class Absent:
    """An operator who fills and places, and does not wipe."""

    async def ask(self, question: OperatorQuestion) -> str:
        if question.about == "table_wet":
            raise LaboratoryError("nobody wiped the table")
        return "done"

    async def announce(self, text: str, seconds: float) -> None: ...


def test_nothing_is_poured_while_the_table_is_wet() -> None:
    async def scenario(stage: Stage) -> None:
        await stage.dose(50)
        with pytest.raises(NotPouredError, match=r"nobody wiped the table\. Nothing was poured"):
            await stage.dose(20, mass=0.25, fill=False)
        assert stage.contents.in_receiver == pytest.approx(0.05, abs=2e-3)

    spec = laboratory(**WET)
    run(scenario, Absent(), **WET, operator=spec.operator.with_values(answers="person"))


def test_a_campaign_with_a_pump_runs_and_is_reported(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    text = shipped("laboratories/pump.yaml").read_text(encoding="utf-8").replace("time_scale: 10", "time_scale: 0")
    (tmp_path / "pump.yaml").write_text(text, encoding="utf-8")
    campaign = shipped("campaigns/pump.yaml").read_text(encoding="utf-8").replace("../laboratories/", "")
    campaign = campaign.replace("../vessels/", f"{shipped('vessels/beaker.yaml').parent}/")
    campaign = campaign.replace("../../runs}", "runs, recording: false}")
    (tmp_path / "campaign.yaml").write_text(campaign, encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    done = CliRunner().invoke(app, ["run", "campaign.yaml", "--in-process"], catch_exceptions=False)
    assert done.exit_code == 0, done.output
    folder = next((tmp_path / "runs").iterdir())
    result = read_result(folder).results["doses"]
    assert isinstance(result, Dispensed)
    assert [dose.filled for dose in result.doses] == [True, False, True, False]
    for dose, grams in zip(result.doses, (80, 80, 80, 20), strict=True):
        assert dose.received_g == pytest.approx(grams, abs=0.5)
    assert "4 wanted amounts" in (folder / "report.html").read_text(encoding="utf-8")
    last = VesselAccount.open().content("pump/beaker")
    assert last is not None
    assert last.mass == pytest.approx(1e-3 * (result.doses[-1].left_g or 0.0))
    assert last.deviation < 3e-4, "the balance under the source has weighed it"


def test_a_dose_is_predicted_and_the_devices_are_looked_at_without_a_flow() -> None:
    predicted = CliRunner().invoke(app, ["dose", str(shipped("campaigns/pump.yaml")), "--dry-run", "--json"])
    assert predicted.exit_code == 0, predicted.output
    doses = json.loads(predicted.stdout)["doses"]
    assert [one["wanted_g"] for one in doses] == [80, 80, 80, 20]
    for one in doses:
        low, high = one["interval_g"]
        assert low < one["wanted_g"] < high
        assert high - low < 1.0
    assert doses[3]["duration_s"] < doses[0]["duration_s"] < 30.0

    looked = CliRunner().invoke(app, ["robot", "check", str(shipped("laboratories/pump.yaml")), "--json"])
    assert looked.exit_code == 0, looked.output
    names = [check["name"] for check in json.loads(looked.stdout)["checks"]]
    assert {"balance", "pump", "refill", "spill sensor"} <= set(names)


class Unplugged(SimulatedPumpSettings):
    def driver(self) -> tuple[type[Any], tuple[Any, ...]]:
        return UnpluggedPump, (self,)


class UnpluggedPump(SimulatedPump):
    def connect(self) -> str:
        raise LaboratoryError("no answer at /dev/ttyUSB0")


def test_a_pump_that_does_not_answer_fails_the_check() -> None:
    spec = laboratory(pump=Unplugged(), spill_sensor=WET["spill_sensor"])
    report = check_bench(spec, Path("pump.yaml"), None)
    assert [(check.name, check.found) for check in report.failed] == [("pump", "no answer at /dev/ttyUSB0")]


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("mode: virtual", "mode: hardware", "'simulated' only simulates"),
        ("placement: receiver, ", "", "with a pump the balance stands under the receiver"),
        ("simulators: 1", "bench: {liquid: {}}", "a pump pours here; remove it"),
        ("kind: simulated, flow: 10", "kind: simulatd, flow: 10", "simulated"),
    ],
)
def test_mistakes_in_a_laboratory_with_a_pump_are_named(tmp_path: Path, old: str, new: str, message: str) -> None:
    text = shipped("laboratories/pump.yaml").read_text(encoding="utf-8")
    assert old in text
    (tmp_path / "pump.yaml").write_text(text.replace(old, new, 1), encoding="utf-8")
    with pytest.raises(ConfigError, match=message):
        load_laboratory(tmp_path / "pump.yaml")
