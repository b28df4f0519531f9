"""Those who watch see everything and change nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.requests import Pour, Simulate
from orchestrator.runs.events import (
    CampaignClosed,
    DecisionMade,
    Event,
    LogLine,
    RequestFinished,
    RequestStarted,
    StageClosed,
)
from orchestrator.runs.stage_scheduler import is_recorded
from sim_engine.outcome import RecordedFrames
from sim_engine.scene import PourTask
from tests.support.scripted_strategy import run
from tests.support.toy_campaign import ToyLaboratory, logical_record, toy_plan


def test_a_watcher_that_raises_is_reported_once_and_changes_nothing(tmp_path: Path) -> None:
    run(tmp_path / "undisturbed")
    events: list[Event] = []
    calls: list[Event] = []

    def broken(event: Event) -> None:
        calls.append(event)
        raise OSError("disk full")

    run(tmp_path / "run", subscribers=[broken, events.append])
    assert len(calls) == 1
    complaints = [e for e in events if isinstance(e, LogLine) and "broken can't watch any longer: OSError" in e.text]
    assert len(complaints) == 1
    assert logical_record(tmp_path / "run") == logical_record(tmp_path / "undisturbed")


def test_watchers_see_the_whole_run(tmp_path: Path) -> None:
    events: list[Event] = []
    result = run(tmp_path / "run", subscribers=[events.append])
    started = {e.id: e.request for e in events if isinstance(e, RequestStarted)}
    finished = {e.id: e.request for e in events if isinstance(e, RequestFinished)}
    assert started == finished
    assert len([r for r in finished.values() if isinstance(r, Pour)]) == result.pours == 6
    assert len([r for r in finished.values() if isinstance(r, Simulate)]) == result.simulations
    assert {e.stage: e.result for e in events if isinstance(e, StageClosed)} == result.results
    assert any(isinstance(e, DecisionMade) for e in events)
    assert isinstance(events[-1], CampaignClosed)
    assert events[-1].state == "finished"


@pytest.mark.slow
def test_recorded_simulations_bring_frames_and_the_same_outcomes(tmp_path: Path) -> None:
    def recording(laboratory: ToyLaboratory) -> ToyLaboratory:
        plain = laboratory.simulators.simulate

        async def with_frames(task: PourTask) -> Any:
            result = await plain(task)
            return replace(result, frames=RecordedFrames([0.0], [], [], []) if task.frame_rate > 0 else None)

        laboratory.simulators.simulate = with_frames  # type: ignore[method-assign]
        return laboratory

    events: list[Event] = []
    run(tmp_path / "run", recording(ToyLaboratory()), subscribers=[events.append])
    for stage in ("first", "second"):
        done = [e for e in events if isinstance(e, RequestFinished) and e.stage == stage]
        simulated = sorted((e.id, e.frames is not None) for e in done if isinstance(e.request, Simulate))
        assert [number for number, (_, framed) in enumerate(simulated, start=1) if framed] == [1, 2]
    plan = toy_plan(tmp_path)
    silent = replace(plan, outputs=plan.outputs.model_copy(update={"frame_rate": 0.0}))
    laboratory = ToyLaboratory()
    run(tmp_path / "silent", laboratory, plan=silent)
    assert all(task.frame_rate == 0.0 for task in laboratory.simulators.tasks)
    assert logical_record(tmp_path / "silent") == logical_record(tmp_path / "run")


@pytest.mark.slow
def test_recordings_spread_over_a_stage() -> None:
    assert [n for n in range(1, 200) if is_recorded(n, 6)] == [1, 2, 4, 8, 16, 32]
    assert not any(is_recorded(n, 0) for n in range(200))
