"""`events`: those who watch see everything and change nothing."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.learning.requests import Pour, Simulate
from orchestrator.records.codec import CodecError
from orchestrator.records.events import (
    CampaignClosed,
    DecisionMade,
    Event,
    Kind,
    LogLine,
    RequestFinished,
    RequestStarted,
    StageClosed,
    event_of,
)
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import RunState, read_record
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


def test_the_journal_has_what_watchers_see_and_gives_it_back(tmp_path: Path) -> None:
    seen: list[Event] = []
    run(tmp_path / "run", subscribers=[seen.append])
    written = [event for event in seen if event.kind is not None]
    with JournalReader(tmp_path / "run" / JOURNAL_NAME) as journal:
        assert [(e.kind, e.stage, e.body) for e in journal.entries()] == [(e.kind, e.stage, e.body()) for e in written]
        read = [event for _, event in journal.events()]
    not_written = {"index": 0, "count": 0, "resumed": False, "frames": None}
    for before, after in zip(written, read, strict=True):
        lost = {name: value for name, value in not_written.items() if hasattr(before, name)}
        assert after == replace(before, time=after.time, replayed=True, **lost)  # type: ignore[arg-type]


def test_a_run_that_is_followed_has_the_state_that_its_journal_has(tmp_path: Path) -> None:
    followed = RunState(Header("toy", {}), slots=2)
    run(tmp_path / "run", subscribers=[followed.take])
    read = read_record(tmp_path / "run", slots=2)
    for name in ("state", "reason", "cpu_s", "simulations", "simulated", "finished_pours", "running", "results"):
        assert getattr(followed, name) == getattr(read, name), name
    assert [replace(pour, progress=None, time=None) for pour in followed.pours] == [
        replace(pour, time=None) for pour in read.pours
    ]
    assert len(read.weighed) == 6


def test_a_read_event_needs_its_request_and_the_fields_that_have_no_default() -> None:
    with pytest.raises(CodecError, match="request 7 has no entry"):
        event_of(Kind.FINISHED, {"id": 7, "outcome": {}}, {}, time=0.0, stage="s")
    with pytest.raises(CodecError, match="Requested lacks request"):
        event_of(Kind.REQUESTED, {"id": 7}, {}, time=0.0, stage="s")
    with pytest.raises(CodecError, match="the kind 'spilled' is not known"):
        event_of("spilled", {}, {}, time=0.0, stage="s")


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
        framed = [number for number, (_, frames) in enumerate(simulated, start=1) if frames]
        assert framed == [1, 2, 4, 8][: len(simulated).bit_length()]
    plan = toy_plan(tmp_path)
    silent = replace(plan, outputs=plan.outputs.model_copy(update={"recording": False}))
    laboratory = ToyLaboratory()
    run(tmp_path / "silent", laboratory, plan=silent)
    assert all(task.frame_rate == 0.0 for task in laboratory.simulators.tasks)
    assert logical_record(tmp_path / "silent") == logical_record(tmp_path / "run")


@pytest.mark.slow
def test_recordings_spread_over_a_stage() -> None:
    assert [n for n in range(1, 200) if is_recorded(n, 6)] == [1, 2, 4, 8, 16, 32]
    assert not any(is_recorded(n, 0) for n in range(200))
