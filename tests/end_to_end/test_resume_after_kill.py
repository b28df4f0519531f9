"""A whole campaign, real processes, real kills: what is resumed ends where an undisturbed run ends, to the last bit."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import psutil
import pytest

from orchestrator.records.journal import Entry, Kind
from tests.support.command_process import (
    Workplace,
    ended,
    finished_in,
    logical,
    pour_under_way,
    started_after_they_were_finished,
)
from tests.support.hypothesis_examples import THOROUGH
from tests.support.small_campaign import CAMPAIGN as SMALL
from tests.support.small_campaign import write_campaign
from tests.support.waiting import PATIENCE

pytestmark = [pytest.mark.ray]

RUN = ("run", "small.yaml")
RESUME = (*RUN, "--resume")

CAMPAIGN = SMALL if THOROUGH else SMALL.replace("directory: runs,", "directory: runs, figures: false,")


@pytest.fixture
def workplace(tmp_path: Path) -> Iterator[Workplace]:
    place = Workplace(tmp_path)
    write_campaign(tmp_path, CAMPAIGN)
    yield place
    place.close()


class Finished:
    """What an undisturbed run in one process came to: with Ray it comes to the same."""

    def __init__(self, place: Workplace) -> None:
        self.summary = place.finish(*RUN, "--in-process")
        self.entries = place.entries()
        self.directory = place.run_directory()
        place.assert_nothing_is_left()


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Finished]:
    folder = tmp_path_factory.mktemp("undisturbed")
    write_campaign(folder, CAMPAIGN)
    place = Workplace(folder)
    yield Finished(place)
    place.close()


def assert_same_run(place: Workplace, undisturbed: Finished) -> None:
    """Same requests, outcomes, decisions and results in logical order, and nothing done twice."""
    entries = place.entries()
    for ours, theirs in zip(logical(entries), logical(undisturbed.entries), strict=True):
        assert ours == theirs
    assert started_after_they_were_finished(entries) == []


@pytest.mark.realtime
@pytest.mark.slow
def test_a_campaign_learns_from_calibration_to_its_last_pour(undisturbed: Finished) -> None:
    entries = undisturbed.entries
    stages = ["pours", "calibration", "evaluation", "deployment:narrow"]
    assert [e.stage for e in entries if e.kind == Kind.STAGE_CLOSED] == stages
    assert sum(e.kind == Kind.POUR_FINISHED for e in entries) == 3 + 2
    asked = [e.body["request"] for e in entries if e.kind == Kind.REQUESTED and e.stage == "calibration"]
    assert sum(r["type"] == "Simulate" for r in asked) == 6

    summary = json.loads((undisturbed.directory / "summary.json").read_text(encoding="utf-8"))
    (narrow,) = summary["outcome"]["receivers"].values()
    assert 0.0 <= narrow["best"]["spillage"] <= 1.0
    assert narrow["best"]["loss"] <= narrow["first"]["loss"]
    assert 0.0 <= summary["learning"]["theta"]["cohesion"] <= 0.1
    learnt = summary.pop("results")
    del summary["log"]
    assert {"calibration", "deployment:narrow"} <= learnt.keys()
    told = dict(undisturbed.summary)
    assert Path(told.pop("report")).read_text(encoding="utf-8").lower().startswith("<!doctype html>")
    assert {**told, "run": None} == {**summary, "run": None}
    assert json.loads((undisturbed.directory / "theta.json").read_text())["theta"] == summary["learning"]["theta"]
    for figure in summary["files"]["figures"].values():
        assert Path(figure).read_bytes().startswith(b"\x89PNG")


@pytest.mark.slow
@pytest.mark.realtime
def test_its_recording_can_be_read_and_shows_vessels_liquid_and_every_pour(undisturbed: Finished) -> None:
    rows = recording(Path(undisturbed.summary["files"]["recording"]))
    assert rows["/cell/pourer/mesh"] >= 1
    assert rows["/cell/receiver/mesh"] >= 1
    assert rows["/cell/liquid"] > 5
    assert rows["/learning/deployment-narrow/loss/measured"] >= 2


def recording(path: Path) -> dict[str, int]:
    """Rows by entity; every chunk is decoded."""
    from rerun.chunk import RrdReader

    reader = RrdReader(str(path))
    assert reader.blueprints()
    rows: dict[str, int] = {}
    for chunk in reader.stream():
        entity = str(chunk.entity_path)
        rows[entity] = rows.get(entity, 0) + chunk.to_record_batch().num_rows
    return rows


@pytest.mark.realtime
@pytest.mark.slow
def test_killed_in_a_pour_in_calibration_and_in_deployment_it_ends_as_if_undisturbed(
    workplace: Workplace, undisturbed: Finished
) -> None:
    def in_second_pour(entries: list[Entry]) -> bool:
        return finished_in("pours", entries) == 1 and pour_under_way(entries)

    killed, _ = workplace.interrupt(in_second_pour, signal.SIGKILL, *RUN)
    assert killed.returncode == -signal.SIGKILL
    workplace.assert_nothing_is_left()
    assert pour_under_way(workplace.entries())

    assert_a_person_is_asked(workplace)

    def in_calibration(entries: list[Entry]) -> bool:
        return finished_in("calibration", entries) >= 4 and not closed("calibration", entries)

    workplace.interrupt(in_calibration, signal.SIGKILL, *RESUME, "--answer", "repeat")
    workplace.assert_nothing_is_left()

    write_campaign(workplace.folder, CAMPAIGN)
    workplace.interrupt(pouring_into_the_narrow_cup, signal.SIGKILL, *RESUME)
    workplace.assert_nothing_is_left()

    result = workplace.finish(*RESUME)
    assert_same_run(workplace, undisturbed)
    attempts = [e.body["attempt"] for e in workplace.entries() if e.kind == Kind.POUR_STARTED]
    assert attempts == [1, 1, 2, 1, 1, 2, 1]
    assert result["outcome"]["receivers"] == undisturbed.summary["outcome"]["receivers"]
    assert recording(Path(result["files"]["recording"]))["/learning/deployment-narrow/loss/measured"] >= 2
    workplace.assert_nothing_is_left()


def assert_a_person_is_asked(place: Workplace) -> None:
    """Unless the campaign says that such pours are repeated."""
    write_campaign(place.folder, CAMPAIGN.replace("on_unknown: repeat", "on_unknown: ask"))
    before = len(place.entries())
    process = place.start(*RESUME)
    with ended(process):
        _, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 3
    assert "pour 2 of stage pours" in errors
    assert "what was its outcome?" in errors
    assert "for example --answer lost" in errors
    assert all(entry.kind == Kind.CAMPAIGN_STATE for entry in place.entries()[before:])


def pouring_into_the_narrow_cup(entries: list[Entry]) -> bool:
    return finished_in("deployment:narrow", entries) > 0 and pour_under_way(entries)


def closed(stage: str, entries: list[Entry]) -> bool:
    return any(e.stage == stage and e.kind == Kind.STAGE_CLOSED for e in entries)


@pytest.mark.slow
@pytest.mark.realtime
def test_ctrl_c_finishes_the_pour_says_how_to_go_on_and_that_works(workplace: Workplace, undisturbed: Finished) -> None:
    process, errors = workplace.interrupt(pouring_into_the_narrow_cup, signal.SIGINT, *RUN)
    assert process.returncode == 130, errors
    assert "Traceback" not in errors
    assert "a pour that has begun is finished and weighed first" in errors
    assert not pour_under_way(workplace.entries())
    workplace.assert_nothing_is_left()

    advice = errors.strip().splitlines()[-1]
    assert advice.startswith(
        "decant: interrupted; nothing is lost. Continue with: decant run small.yaml --resume --run "
    )
    command = advice.rpartition("Continue with: decant ")[2].split()
    result = workplace.finish(*command)
    assert_same_run(workplace, undisturbed)
    assert result["outcome"]["receivers"] == undisturbed.summary["outcome"]["receivers"]


@pytest.mark.realtime
@pytest.mark.slow
def test_a_simulator_killed_under_way_is_replaced_and_nobody_notices(
    workplace: Workplace, undisturbed: Finished
) -> None:
    process = workplace.start(*RUN, "--json")
    with ended(process):
        workplace.await_journal(lambda entries: finished_in("calibration", entries) >= 3, process)
        victims = simulators(process)
        assert len(victims) == 2 + 1, "two simulators and the bench's liquid"
        for victim in victims:
            os.kill(victim.pid, signal.SIGKILL)
        process.send_signal(signal.SIGCONT)
        output, errors = process.communicate(timeout=PATIENCE)
    assert process.returncode == 0, errors
    (line,) = output.splitlines()
    assert json.loads(line)["outcome"]["receivers"] == undisturbed.summary["outcome"]["receivers"]
    assert_same_run(workplace, undisturbed)
    workplace.assert_nothing_is_left()


def simulators(process: Any) -> list[psutil.Process]:
    """Processes of the pool and the bench's liquid."""
    children = psutil.Process(process.pid).children(recursive=True)
    return [child for child in children if "SimulatorProcess" in " ".join(child.cmdline())]
