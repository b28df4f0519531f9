"""`run_service`: one way to run a campaign, whoever calls it: checked, started, paused, stopped, resumed, recorded,
published.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable, Coroutine
from contextlib import closing
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

import decant
from actors.interfaces import LaboratoryError, RaySettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.shipped import shipped
from orchestrator.cli.app import app
from orchestrator.records.events import CampaignOpened, Event
from orchestrator.records.journal import JOURNAL_NAME
from orchestrator.records.journal_check import JournalDamagedError
from orchestrator.reports.publishing import publish_run, publish_so_far
from orchestrator.runs.run_service import RunHandle, RunRequest, RunResources, RunService, RunTaskError
from orchestrator.runs.run_tasks import calibrate_task, plan_task, run_task
from tests.golden.world import FormulaLaboratory
from tests.support.scripted_strategy import Script, one_stage, pour, states
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.toy_campaign import ToyLaboratory, logical_record, toy_plan
from tests.support.toy_daemon import HeldLaboratory, held
from tests.support.waiting import PATIENCE

SHORT = CAMPAIGN.replace("outputs: {directory: runs,", "outputs: {directory: runs, recording: false, figures: false,")


def campaign(folder: Path, *changes: tuple[str, str]) -> decant.CampaignPlan:
    text = SHORT
    for old, new in changes:
        assert old in text
        text = text.replace(old, new)
    return load_campaign(write_campaign(folder, text))


def everything_in(folder: Path) -> list[tuple[Path, int]]:
    return sorted((path, path.stat().st_mtime_ns) for path in folder.rglob("*"))


# ---- before anything starts


def test_a_check_reports_all_problems_and_warnings_and_leaves_the_disk_as_it_was(tmp_path: Path) -> None:
    plan = campaign(tmp_path, ("[60 mm, 100 mm]", "[60 mm, 300 mm]"))
    (tmp_path / "full").mkdir()
    full = campaign(tmp_path / "full", ("mass: 100 g", "mass: 900 g"))
    before = everything_in(tmp_path)
    assert any("x_offset" in text for text in RunService().check(run_task(plan)).warnings)
    report = RunService().check(run_task(full))
    assert everything_in(tmp_path) == before
    assert any("holds" in text for text in report.problems)
    with pytest.raises(RunTaskError) as refused:
        report.require()
    assert str(refused.value) == "\n".join(report.problems)
    assert RunService().check(run_task(campaign(tmp_path))).problems == ()


def test_a_task_without_its_section_is_refused(tmp_path: Path) -> None:
    plan = campaign(tmp_path)
    with pytest.raises(RunTaskError, match="nothing to calibrate"):
        calibrate_task(replace(plan, calibration=None))
    with pytest.raises(RunTaskError, match="has no 'deployment' section"):
        plan_task(replace(plan, deployment=None))
    assert not plan_task(plan).pours
    assert calibrate_task(plan).campaign.deployment is None


def test_what_can_not_be_opened_leaves_no_run_folder(tmp_path: Path) -> None:
    plan = campaign(tmp_path)
    request = run_task(replace(plan, laboratory=plan.laboratory.with_values(bench=None)))
    with pytest.raises(LaboratoryError, match="has no bench"):
        RunService().start(request, RunResources(in_process=True))
    assert not (tmp_path / "runs").exists()


def test_a_shared_pool_joins_no_cluster(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path)
    plan = replace(plan, laboratory=plan.laboratory.with_values(ray=RaySettings(address="head:6379")))
    shared: Any = object()
    assert RunResources(approved_checksum="0A").settings(plan) == plan.laboratory.with_values(accepted_checksum="0A")
    assert RunResources(simulators=shared).settings(plan).ray is None


# ---- while it runs


Made = Callable[[Path], RunHandle]


def toy_request(folder: Path, pours: int = 2) -> RunRequest:
    script = Script(*(pour(number) for number in range(1, pours + 1)))
    return RunRequest(toy_plan(folder), one_stage(script), folder / "run")


def started(folder: Path, laboratory: ToyLaboratory, **resources: Any) -> RunHandle:
    return RunService().start(toy_request(folder), RunResources(laboratory=lambda spec, bench: laboratory, **resources))


def play(work: Coroutine[Any, Any, None]) -> None:
    async def limited() -> None:
        async with asyncio.timeout(PATIENCE):
            await work

    asyncio.run(limited())


async def pouring(laboratory: HeldLaboratory, handle: RunHandle) -> asyncio.Task[Any]:
    """The run, once a pour is under way."""
    running = asyncio.create_task(handle.wait())
    await laboratory.bench.begun.wait()
    assert handle.checkpoint == "tilt"
    return running


def test_a_paused_run_weighs_its_pour_and_goes_on_with_the_next_one(tmp_path: Path) -> None:
    first, second = held(), HeldLaboratory()

    async def work() -> None:
        handle = started(tmp_path, first)
        running = await pouring(first, handle)
        handle.pause()
        first.bench.go.set()
        with pytest.raises(asyncio.CancelledError):
            await running
        assert handle.checkpoint == ""
        assert states(handle.folder)[-1] == "paused"
        result = await started(tmp_path, second).wait()
        assert result.pours == 2

    play(work())
    assert first.bench.aborted == []
    assert len(first.bench.poured) == len(second.bench.poured) == 1


def test_a_run_that_is_paused_before_it_begins_writes_nothing(tmp_path: Path) -> None:
    async def work() -> None:
        handle = started(tmp_path, HeldLaboratory())
        handle.pause()
        with pytest.raises(asyncio.CancelledError):
            await asyncio.create_task(handle.wait())

    play(work())
    assert not (tmp_path / "run").exists()


def test_an_abandoned_pour_is_unknown(tmp_path: Path) -> None:
    laboratory = held()

    async def work() -> None:
        handle = started(tmp_path, laboratory)
        running = await pouring(laboratory, handle)
        handle.pause()
        await handle.abandon_pour()
        with pytest.raises(asyncio.CancelledError):
            await running

    play(work())
    assert len(laboratory.bench.aborted) == 1
    assert states(tmp_path / "run")[-1] == "unknown"


def test_aborting_stops_the_arm_and_a_second_time_abandons_the_pour(tmp_path: Path) -> None:
    laboratory = held()

    async def work() -> None:
        handle = started(tmp_path, laboratory)
        running = await pouring(laboratory, handle)
        await handle.abort()
        assert (laboratory.arm_stops, laboratory.bench.aborted) == (1, [])
        await handle.abort()
        with pytest.raises(asyncio.CancelledError):
            await running

    play(work())
    assert (laboratory.arm_stops, len(laboratory.bench.aborted)) == (1, 1)


def test_an_arm_that_does_not_confirm_an_emergency_stop_is_reported_and_the_pour_is_abandoned(tmp_path: Path) -> None:
    class Deaf(HeldLaboratory):
        async def stop_arm(self) -> bool:
            raise LaboratoryError("the cable is cut")

    laboratory = Deaf()
    laboratory.bench.go.clear()

    async def work() -> None:
        handle = started(tmp_path, laboratory)
        running = await pouring(laboratory, handle)
        with pytest.raises(LaboratoryError, match="the cable is cut"):
            await handle.emergency_stop()
        with pytest.raises(asyncio.CancelledError):
            await running

    play(work())
    assert len(laboratory.bench.aborted) == 1
    assert states(tmp_path / "run")[-1] == "unknown"


def test_a_run_whose_journal_is_lost_is_refused_before_anything_is_written(tmp_path: Path) -> None:
    asyncio.run(started(tmp_path, ToyLaboratory()).wait())
    (tmp_path / "run" / JOURNAL_NAME).unlink()
    before = everything_in(tmp_path)
    laboratory, recorded = ToyLaboratory(), list[Path]()
    with pytest.raises(JournalDamagedError, match="pours could be repeated"):
        started(tmp_path, laboratory, recorder=lambda plan, run: recorded.append(run))
    assert everything_in(tmp_path) == before
    assert (laboratory.opened, recorded) == (0, [])


# ---- what is written about it


class Recorder:
    """Keeps what it is told."""

    dropped = 3

    def __init__(self, run: Path) -> None:
        self.path, self.events, self.closed = run / "campaign.rrd", list[Event](), 0

    def __call__(self, event: Event) -> None:
        self.events.append(event)

    def close(self) -> None:
        self.closed += 1


def formula(**resources: Any) -> RunResources:
    return RunResources(laboratory=lambda spec, pours: FormulaLaboratory(), **resources)  # type: ignore[arg-type]


def test_recorder_and_subscribers_get_every_event_and_the_run_is_published(tmp_path: Path) -> None:
    recorders, heard = list[Recorder](), list[Event]()

    def recorder(plan: decant.CampaignPlan, run: Path) -> Recorder:
        recorders.append(Recorder(run))
        return recorders[0]

    resources = formula(subscribers=[heard.append], recorder=recorder)
    with closing(RunService().start(run_task(campaign(tmp_path)), resources)) as handle:
        result = asyncio.run(handle.wait())
    assert handle.folder == result.directory
    assert handle.folder.parent == tmp_path / "runs"
    (made,) = recorders
    assert made.closed == 1
    assert made.events == heard
    assert any(isinstance(event, CampaignOpened) for event in heard)
    published = publish_run(handle)
    assert (published.recording, published.summary.files.dropped_events) == (made.path, 3)
    assert published.summary.pours == result.pours == 5
    assert published.theta is not None


def test_a_stopped_run_is_published_as_far_as_it_came(tmp_path: Path) -> None:
    request = run_task(campaign(tmp_path))
    assert publish_so_far(request) is None
    request = RunService().with_folder(request)
    assert publish_so_far(request) is None, "it has not begun"

    async def work() -> None:
        seen = asyncio.Event()
        first = lambda event: seen.set() if type(event).__name__ == "RequestFinished" else None  # noqa: E731
        handle = RunService().start(request, formula(subscribers=[first]))
        running = asyncio.create_task(handle.wait())
        await seen.wait()
        handle.pause()
        with pytest.raises(asyncio.CancelledError):
            await running

    play(work())
    published = publish_so_far(request)
    assert published is not None
    assert published.report is not None
    assert "paused" in published.report.read_text(encoding="utf-8")


@pytest.mark.timeout(900)  # three recordings: half a minute on an idle machine
def test_the_service_the_command_line_and_the_library_make_the_same_decisions(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    plan = campaign(tmp_path)
    handle = RunService().start(run_task(plan), formula())
    asyncio.run(handle.wait())

    monkeypatch.setattr("actors.laboratory.open_laboratory", lambda *_, **__: FormulaLaboratory())
    result = CliRunner().invoke(app, ["run", str(tmp_path / "small.yaml"), "--in-process"])
    assert result.exit_code == 0, result.output
    (typed,) = (run for run in (tmp_path / "runs").iterdir() if run != handle.folder)
    with pytest.warns(UserWarning, match="not simulated"):
        called = decant.run(plan).directory
    assert logical_record(handle.folder) == logical_record(typed) == logical_record(called)


def test_a_resumed_run_does_not_ask_for_full_sources_again(tmp_path: Path) -> None:
    plan = load_campaign(shipped("campaigns/mixtures.yaml"), shipped("laboratories/rack.yaml"))
    opened: list[bool] = []

    def laboratory(spec: LaboratorySettings, pours: bool) -> ToyLaboratory:
        opened.append(any(vessel.filled for vessel in spec.vessels if vessel.liquid))
        return ToyLaboratory()

    for resume in (False, True):
        request = replace(run_task(plan), folder=tmp_path, resume=resume)
        RunService().start(request, RunResources(laboratory=laboratory)).close()
    assert opened == [True, False]
