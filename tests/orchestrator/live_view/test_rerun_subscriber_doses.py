"""`rerun_subscriber`: the recording of a dose has what the viewer's tab "Dosing" shows."""

from __future__ import annotations

import asyncio
import contextlib
import math
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from actors.dosing.cup_flow import CupFlow
from actors.dosing.dose_controller import DoseController, DoseOrder
from actors.dosing.dose_estimator import DoseReading
from actors.dosing.dose_series import DoseSeries, SourceContent
from actors.dosing.tilt_command import TiltCommand
from actors.dosing.virtual_dosing_bench import TrueCup, TrueScale, VirtualDosingBench
from actors.dosing_settings import DosingSettings
from actors.interfaces import DoseProgress, PourProgress
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.dispense import Dispense, Dispensed
from orchestrator.learning.requests import Pour, Poured, Slots
from orchestrator.live_view.rerun_subscriber import RerunMonitor
from orchestrator.records.events import (
    CampaignClosed,
    CampaignOpened,
    Event,
    PourProgressed,
    RequestFinished,
    RequestStarted,
    StageOpened,
)
from orchestrator.runs.run_service import RunResources, RunService
from orchestrator.runs.run_tasks import run_task
from sim_engine.outcome import ParticleState, PourMeasurement, RecordedFrames
from sim_engine.vessel.vessel import build_vessel
from tests.orchestrator.reports.test_mixture_report import MIXTURES
from tests.support.rerun_recordings import Contents, timeline, views
from tests.support.small_campaign import series, write_campaign
from tests.support.waiting import PATIENCE

AMOUNT = 0.025

SERIES = series(25)


def dose_events(folder: Path) -> tuple[Any, list[Event], list[tuple[float, DoseProgress]]]:
    """A campaign of one dose on the virtual dosing bench: its plan, its events, and the dose's progress."""
    plan = load_campaign(write_campaign(folder, SERIES))
    assert plan.dispense is not None
    scene = plan.dispense.scenes[0]
    bench = VirtualDosingBench(TrueCup(0.03, 0.07), scene.liquid, TrueScale(lag=0.3), 1)
    cup, rng = CupFlow(build_vessel(scene.pourer), scene.liquid), np.random.default_rng(1)
    series = DoseSeries(cup, DosingSettings(), SourceContent(0.1), bench.place_receiver(), rng)
    controller: DoseController = series.controller(DoseOrder(AMOUNT, receiver_mass=bench.receiver_mass), seed=1)
    seen: list[tuple[float, DoseProgress]] = []
    tilts: list[float] = []

    class Watched:
        def step(self, time: float, tilt: float, readings: Sequence[DoseReading]) -> TiltCommand:
            command = controller.step(time, tilt, readings)
            reading = readings[-1].mass - bench.receiver_mass if readings else None
            amount, deviation = controller.amount
            seen.append((time, DoseProgress(controller.phase, AMOUNT, amount, deviation, controller.flow, reading)))
            tilts.append(tilt)
            return command

    record = bench.dose(Watched())
    assert controller.result is not None
    (pour,) = Dispense(plan.dispense, plan.seed).ask(Slots(0))
    assert isinstance(pour, Pour)
    begin = 1.7e9
    notes = {"dose": {"wanted": AMOUNT, "received": controller.result.amount, "end": "reached", "left": [0.075, 1e-3]}}
    poured = Poured(PourMeasurement(0.1, record.spilled, 0.1 - record.spilled - record.received, notes))
    events: list[Event] = [
        CampaignOpened(
            name=plan.name, run_directory=folder, stages=("doses",), mode="virtual", simulators=1, time=begin
        ),
        StageOpened(stage="doses", index=1, count=1, time=begin),
        RequestStarted(stage="doses", id=1, request=pour, time=begin),
        *(
            PourProgressed(
                stage="doses",
                id=1,
                number=1,
                progress=PourProgress("dose", 0.5, tilt=tilt, balance=dose.reading, dose=dose),
                time=begin + at,
            )
            for (at, dose), tilt in zip(seen, tilts, strict=True)
        ),
        RequestFinished(stage="doses", id=1, request=pour, outcome=poured, time=begin + record.duration + 1.0),
        CampaignClosed(state="finished", results={}, time=begin + record.duration + 2.0),
    ]
    return plan, events, seen


def test_a_dose_on_a_simulated_bench_is_shown_while_it_is_poured(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    plan = load_campaign(write_campaign(tmp_path, SERIES.replace("{directory: runs}", "{recording: false}")))
    plan = replace(plan, outputs=plan.outputs.model_copy(update={"directory": tmp_path / "runs", "figures": False}))
    events: list[Event] = []

    async def scenario() -> Any:
        resources = RunResources(in_process=True, subscribers=[events.append])
        with contextlib.closing(RunService().start(run_task(plan), resources)) as handle:
            return await handle.wait()

    result = asyncio.run(scenario()).results["doses"]
    assert isinstance(result, Dispensed)
    told = [event.progress for event in events if isinstance(event, PourProgressed) and event.progress.dose is not None]
    doses = [progress.dose for progress in told if progress.dose is not None]
    phases = ["check", "approach", "pour", "return", "settle", "done"]
    assert list(dict.fromkeys(dose.phase for dose in doses)) == phases
    assert {dose.target for dose in doses} == {AMOUNT}
    assert max(dose.flow for dose in doses) > 3e-3
    assert max(math.degrees(progress.tilt or 0.0) for progress in told) > 30.0
    readings = [dose.reading for dose in doses if dose.reading is not None]
    assert 1e3 * readings[-1] == pytest.approx(result.doses[0].received_g, abs=0.3)


@pytest.mark.slow
def test_the_tab_dosing_shows_entities_that_the_recording_of_a_dose_has(tmp_path: Path) -> None:
    plan, events, seen = dose_events(tmp_path)
    path = tmp_path / "dose.rrd"
    monitor = RerunMonitor(path, plan)
    for event in events:
        monitor(event)
    assert monitor.close(timeout=PATIENCE)
    assert (monitor.failed, monitor.dropped) == (0, 0)
    recorded = Contents(path)

    def numbers(what: str) -> list[float]:
        return [float(v[0]) for v in recorded.values(f"/balance/dose/{what}", "Scalars:scalars")]  # type: ignore[index]

    assert set(numbers("target")) == {25.0}
    assert sorted(numbers("estimated")) == pytest.approx(sorted(1e3 * dose.amount for _, dose in seen))
    assert len(numbers("reading")) == sum(dose.reading is not None for _, dose in seen)
    assert max(numbers("tilt")) > 30.0
    (stop,) = numbers("stop")
    assert stop == pytest.approx(next(1e3 * dose.amount for _, dose in seen if dose.phase == "return"))
    assert math.isclose(stop, 25.0, abs_tol=4.0)

    assert timeline(path) == "wall"  # also after the end: a dose has no films
    for line in ("reading", "estimated", "tilt"):
        assert recorded.values(f"/balance/dose/{line}", "Clear")  # no line to the next dose
    shown = views(path)
    assert {"Dose: wanted, balance and estimate [g]", "Tilt [deg]", "Status", "Events and decisions"} <= set(shown)
    for name, entities in shown.items():
        for entity in entities:
            there = [one for one in recorded.columns if f"{one}/".startswith(f"{entity.removesuffix('/**')}/")]
            assert there if entity.endswith("/**") else entity in there, f"'{name}' shows {entity}, not recorded"


@pytest.mark.slow
@pytest.mark.parametrize("time_scale", [1.0, 30.0])
def test_the_particles_of_a_dose_are_shown_live_or_in_a_playback(tmp_path: Path, time_scale: float) -> None:
    plan, events, _ = dose_events(tmp_path)
    assert plan.laboratory.bench is not None
    bench = plan.laboratory.bench.with_values(time_scale=time_scale)
    plan = replace(plan, laboratory=plan.laboratory.with_values(bench=bench))

    def frame(time: float) -> RecordedFrames:
        fate = int(ParticleState.RECEIVED if time > 2.0 else ParticleState.IN_POURER)
        places = np.full((5, 3), 0.01 * time, np.float32)
        return RecordedFrames(
            np.array([time]), [places], [np.full(5, fate, np.uint8)], np.eye(1, 7, 3), (0.05, 0.0, 0.0)
        )

    begin = events[2].time
    flows: list[Event] = [
        PourProgressed(
            stage="doses", id=1, number=1, progress=PourProgress("dose", 0.5, liquid=frame(at)), time=begin + at
        )
        for at in np.arange(0.1, 4.0, 0.1)
    ]
    path = tmp_path / "dose.rrd"
    monitor = RerunMonitor(path, plan)
    for event in [*events[:3], *flows, *events[-2:]]:
        monitor(event)
    assert monitor.close(timeout=PATIENCE)
    assert (monitor.failed, monitor.dropped) == (0, 0)
    fates = Contents(path).values("/cell/liquid", "Points3D:class_ids")
    assert len(fates) >= 39
    assert {int(np.asarray(each)[0]) for each in fates} == {int(ParticleState.IN_POURER), int(ParticleState.RECEIVED)}
    (receiver,) = Contents(path).values("/cell/receiver", "Transform3D:translation")
    assert np.ravel(receiver) == pytest.approx([0.05, 0.0, 0.0])


@pytest.mark.slow
def test_a_simulated_bench_pours_particles_which_the_recording_has(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    text = SERIES.replace("liquid: {particles: 400}", "doses: particles, liquid: {particles: 400}")
    plan = load_campaign(write_campaign(tmp_path, text.replace("receiver: narrow", "receiver: tumbler")))
    path, seen = tmp_path / "dose.rrd", list[PourProgress]()
    monitor = RerunMonitor(path, plan)

    def subscriber(event: Event) -> None:
        monitor(event)
        if isinstance(event, PourProgressed):
            seen.append(event.progress)

    async def scenario() -> Any:
        resources = RunResources(in_process=True, subscribers=[subscriber])
        with contextlib.closing(RunService().start(run_task(plan), resources)) as handle:
            return await handle.wait()

    (dose,) = asyncio.run(scenario()).results["doses"].doses
    assert monitor.close(timeout=PATIENCE)
    assert dose.received_g == pytest.approx(25.0, abs=5.0)  # one particle is 0.25 g
    frames = [progress.liquid for progress in seen if progress.liquid is not None]
    assert len(frames) > 20
    assert (frames[-1].states[-1] == ParticleState.RECEIVED).mean() == pytest.approx(dose.received_g / 100.0, abs=0.02)
    assert {progress.dose is None for progress in seen if progress.liquid is not None} == {False}
    fates = Contents(path).values("/cell/liquid", "Points3D:class_ids")
    assert len(fates) > 20


@pytest.mark.slow
def test_the_rack_of_mixtures_fills_in_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_STATE", str(tmp_path / "state"))
    plan = load_campaign(write_campaign(tmp_path, MIXTURES))
    path = tmp_path / "mix.rrd"
    monitor = RerunMonitor(path, plan)

    async def scenario() -> Any:
        resources = RunResources(in_process=True, subscribers=[monitor])
        with contextlib.closing(RunService().start(run_task(plan), resources)) as handle:
            return await handle.wait()

    result = asyncio.run(scenario()).results["doses"]
    assert monitor.close(timeout=PATIENCE)
    assert (monitor.failed, monitor.dropped) == (0, 0)
    recorded = Contents(path)
    rows = zip(recorded.columns["/rack/cups"]["wall"], recorded.values("/rack/cups", "Points2D:labels"), strict=True)
    labels = [texts for _, texts in sorted(rows)]  # type: ignore[type-var]
    cups = [[text for text in texts if " " in text and text[0] in "AB"] for texts in labels]  # type: ignore[attr-defined]
    shown = [cup for i, cup in enumerate(cups) if not i or cup != cups[i - 1]]
    assert shown == [
        ["B2 empty", "A1 empty"],
        ["B2 being filled", "A1 empty"],
        ["B2 done", "A1 empty"],
        ["B2 done", "A1 being filled"],
        ["B2 done", "A1 done"],
    ]
    for component in result.components():
        difference = component.received_g - component.wanted_g
        assert f"{component.received_g:.1f} {difference:+.2f}" in labels[-1]  # type: ignore[operator]
    assert recorded.values("/rack/legend", "LineStrips2D:labels")[-1] == ["water", "ethanol"]
    assert "Rack: amounts, and differences [g]" in views(path)
