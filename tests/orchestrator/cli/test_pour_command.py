"""`pour_command`: `decant pour`: what a careful person tries first. Planned without moving, with an empty pourer,
slowly.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import signal
from collections.abc import Callable, Iterator
from math import degrees, radians
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner, Result

from actors.emulators.ur_controller.controller_process import VirtualController
from actors.interfaces import UnknownPourError
from orchestrator.cli.app import app
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Pour
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.records.states import State
from orchestrator.runs.motion_approval import SafetyRecord, write_record
from orchestrator.runs.request_executor import Deadlines, RequestExecutor
from orchestrator.runs.stages import scenes_of
from sim_engine.action import Action
from tests.support import hardware_laboratory, small_campaign
from tests.support.loopback import free_address
from tests.support.terminal import Terminal
from tests.support.toy_campaign import ToyBench, ToyLaboratory
from tests.support.waiting import PATIENCE, wait_for

ACTION = ("--set", "angular_velocity=30", "--set", "x_offset=80")


@pytest.fixture
def controller() -> Iterator[VirtualController]:
    with VirtualController.start(
        free_address(), "ur10", joints=[radians(q) for q in hardware_laboratory.HOME]
    ) as started:
        hardware_laboratory.install(started)
        yield started


def decant(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


def test_dry_run_tells_and_draws_the_whole_path_and_connects_to_nobody(tmp_path: Path) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, free_address())  # nobody is there
    png = tmp_path / "path.png"
    result = decant("pour", str(campaign), *ACTION, "--dry-run", "--png", str(png))
    assert result.exit_code == 0, result.output
    for line in ("box            x ", "mm/s", "tilt           up to 110 deg", "approach", "retreat", "pour "):
        assert line in result.stdout
    assert "nothing was moved" in result.stderr
    assert png.read_bytes().startswith(b"\x89PNG")
    assert not (tmp_path / "runs").exists()


@pytest.mark.realtime
def test_dry_run_can_look_where_the_arm_stands(tmp_path: Path, controller: VirtualController) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    before = controller.fault("state")
    at_home = decant("pour", str(campaign), *ACTION, "--dry-run", "--connect")
    assert "the arm stands at home" in at_home.stderr
    after = controller.fault("state")
    assert after["joints"] == before["joints"]
    assert after["program"] == before["program"]
    assert (
        decant(
            "pour", str(hardware_laboratory.write_rig(tmp_path, free_address())), *ACTION, "--dry-run", "--connect"
        ).exit_code
        == 1
    )


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["--set", "angular_velocity=30", "--dry-run"], "x_offset has no value"),
        ([*ACTION, "--connect"], "goes with --dry-run"),
        ([*ACTION, "--slow", "0.5"], "goes with --empty"),
        ([*ACTION, "--dry-run", "--empty"], "choose one"),
        ([*ACTION, "--dry-run", "--scene", "transfer"], "no such scene"),
        (["--set", "angular_velocity=200", "--set", "x_offset=80", "--dry-run"], "deg/s"),  # beyond the file's limits
        (["--set", "angular_velocity=30", "--set", "x_offset=10", "--dry-run"], "touch"),
    ],
)
def test_pours_that_can_t_be_are_refused_before_anything_is_reached(
    tmp_path: Path, options: list[str], said: str
) -> None:
    result = decant("pour", str(hardware_laboratory.write_rig(tmp_path, free_address())), *options)
    assert result.exit_code == 2
    assert said in result.stderr
    assert not (tmp_path / "runs").exists()


@pytest.mark.realtime
@pytest.mark.slow
def test_empty_cycle_on_hardware_asks_counts_down_goes_slowly_and_leaves_a_record(
    tmp_path: Path, controller: VirtualController
) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    checksum = controller.fault("state")["checksum"]
    write_record(tmp_path / "rig.yaml", SafetyRecord(checksum, "2016300123", "", "", "", ""))
    arguments = ("pour", str(campaign), "--set", "angular_velocity=60", "--set", "x_offset=80")
    with Terminal(*arguments, "--empty", "--slow", "0.5", "--enable-motion", cwd=str(tmp_path)) as terminal:
        terminal.expect("EMPTY pourer, at 50 %")
        terminal.expect("> ")
        terminal.type("rig")
        terminal.expect("Emergency stop in hand?")
        terminal.expect("> ")
        terminal.type("yes")
        for line in ("moves in 3 s", "moves in 2 s", "moves in 1 s", "approach …", "pour …", "retreat …"):
            terminal.expect(line)
        terminal.expect("the cycle was completed")
        assert terminal.end() == 0
    record = json.loads(next((tmp_path / "runs").glob("rigged-empty-hardware-*/pour.json")).read_text())
    assert (record["mode"], record["slow"], record["robot"]["checksum"]) == ("hardware", 0.5, checksum)
    done = controller.fault("history", since=0.0)
    joints, times = np.array(done["joints"]), np.array(done["times"])
    fastest = np.abs(np.diff(joints, axis=0) / np.diff(times)[:, None]).max()
    assert degrees(fastest) < 50.0  # 90 deg/s of the return, halved
    assert np.ptp(joints[:, 5]) > radians(60.0) or np.ptp(joints, axis=0).max() > radians(60.0)
    assert joints[-1] == pytest.approx([radians(q) for q in hardware_laboratory.HOME], abs=1e-2)


@pytest.mark.slow
@pytest.mark.realtime
def test_empty_cycle_that_is_not_confirmed_moves_nothing(tmp_path: Path, controller: VirtualController) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    checksum = controller.fault("state")["checksum"]
    write_record(tmp_path / "rig.yaml", SafetyRecord(checksum, "2016300123", "", "", "", ""))
    before = controller.fault("state")["joints"]
    with Terminal(
        "pour", str(campaign), *ACTION, "--empty", "--slow", "0.2", "--enable-motion", cwd=str(tmp_path)
    ) as terminal:
        terminal.expect("> ")
        terminal.type("rig")
        terminal.expect("> ")
        terminal.type("")
        assert terminal.end() == 1
    assert "nothing has moved" in terminal.screen
    assert controller.fault("state")["joints"] == before


async def breaks_off(plan: CampaignPlan, laboratory: object, directory: Path, **_: object) -> None:
    (directory / JOURNAL_NAME).touch()
    bench = ToyBench(fails=lambda seed: UnknownPourError("protective stop. All weighings: pourer_full 512.1 g"))
    lanes = RequestExecutor(ToyLaboratory(bench=bench), scenes_of(plan), Deadlines(), 0.0)
    scene, action = next(iter(scenes_of(plan).values())), Action(angular_velocity=1.0, x_offset=0.07, height=0.06)
    await lanes.pour(Pour(scene.name, action, 1, 1), started=lambda: None, progress=lambda p: None)


async def is_interrupted_twice(plan: CampaignPlan, laboratory: object, directory: Path, **_: object) -> None:
    (directory / JOURNAL_NAME).touch()
    for _again in range(2):
        os.kill(os.getpid(), signal.SIGINT)
        with contextlib.suppress(asyncio.CancelledError):
            await asyncio.sleep(60.0)  # it is interrupted here
    raise asyncio.CancelledError


@pytest.mark.slow
@pytest.mark.parametrize(
    ("ends", "code"), [pytest.param(breaks_off, 3, marks=pytest.mark.slow), (is_interrupted_twice, 130)]
)
def test_pour_whose_outcome_is_unknown_doesn_t_promise_to_be_resumed(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, ends: Callable[..., object], code: int
) -> None:
    monkeypatch.setattr("orchestrator.runs.run_engine.run_campaign", ends)
    result = decant("pour", str(small_campaign.write_campaign(tmp_path)), *small_campaign.GOOD_ACTION, "--in-process")
    assert result.exit_code == code, result.stderr
    run = next((tmp_path / "runs").iterdir())
    assert f"this pour is not resumed; what was weighed of it is in {run}" in result.stderr
    told = result.stderr.replace("is not resumed", "")
    for promise in ("resum", "paus", "nothing is lost", "Go on"):
        assert promise not in told


WEIGHTS = ("312.0 g", "412.1 g", "428.0 g", "431.2 g", "313.5 g")
"""Pourer empty and full, tray before and after, pourer after."""


def answered(terminal: Terminal, before_start: Callable[[], object] = lambda: None) -> list[str]:
    """Answer all questions of a pour, as a person beside the bench would; returns what was asked to be allowed."""
    weights, consents = list(WEIGHTS), []
    while weights:
        asked = terminal.expect("> ").rpartition("\a")[2]
        if "weight with its unit" in asked:
            terminal.type(weights.pop(0))
        elif "'yes' or 'no'" in asked:
            consents.append(" ".join(asked.split()))
            before_start()
            before_start = lambda: None  # noqa: E731
            terminal.type("yes")
        else:
            terminal.type("done")
    return consents


@pytest.mark.slow
def test_whole_pour_on_hardware_is_asked_for_confirmed_made_and_weighed(
    tmp_path: Path, controller: VirtualController
) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    checksum = controller.fault("state")["checksum"]
    write_record(tmp_path / "rig.yaml", SafetyRecord(checksum, "2016300123", "", "", "", ""))
    action = ("--set", "angular_velocity=60", "--set", "x_offset=80")
    with Terminal("pour", str(campaign), *action, "--in-process", "--enable-motion", cwd=str(tmp_path)) as terminal:
        terminal.expect("> ")
        terminal.type("rig")
        terminal.expect("mode hardware")
        consents = answered(terminal)
        assert terminal.end() == 0
    assert len(consents) == 1
    assert "Hands out of the cell" in consents[0]
    assert "spilled 3.2 g, retained 1.5 g" in terminal.screen
    run = next((tmp_path / "runs").glob("rigged-pour-hardware-*"))
    assert json.loads((run / "summary.json").read_text())["mode"] == "hardware"
    tilted = np.ptp(np.array(controller.fault("history", since=0.0)["joints"]), axis=0).max()
    assert degrees(tilted) == pytest.approx(110.0, abs=2.0)


@pytest.mark.slow
def test_protective_stop_in_a_pour_is_mended_by_consent_weighed_and_left_for_a_person_to_judge(
    tmp_path: Path, controller: VirtualController
) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    checksum = controller.fault("state")["checksum"]
    write_record(tmp_path / "rig.yaml", SafetyRecord(checksum, "2016300123", "", "", "", ""))
    action = ("--set", "angular_velocity=30", "--set", "x_offset=80")
    with Terminal("pour", str(campaign), *action, "--in-process", "--enable-motion", cwd=str(tmp_path)) as terminal:
        terminal.expect("> ")
        terminal.type("rig")
        consents = answered(terminal, lambda: controller.fault("protective_stop", after=6.5))
        assert terminal.end() == 3
    assert [("made ready" in c, "upright" in c) for c in consents[1:]] == [(True, False), (False, True)]
    assert "protective stop during tilt" in terminal.screen
    joints = controller.fault("state")["joints"]
    assert joints == pytest.approx([radians(q) for q in hardware_laboratory.HOME], abs=1e-2)


@pytest.mark.slow
def test_terminal_that_is_closed_in_a_pour_leaves_the_arm_at_home_and_the_pour_unknown(
    tmp_path: Path, controller: VirtualController
) -> None:
    campaign = hardware_laboratory.write_rig(tmp_path, controller.address)
    checksum = controller.fault("state")["checksum"]
    write_record(tmp_path / "rig.yaml", SafetyRecord(checksum, "2016300123", "", "", "", ""))
    terminal = Terminal("pour", str(campaign), *ACTION, "--in-process", "--enable-motion", cwd=str(tmp_path))
    try:
        for typed in ("rig", *WEIGHTS[:3]):
            terminal.expect("> ")
            terminal.type(typed)
        terminal.expect("May it?")
        terminal.expect("> ")
        terminal.type("yes")
        terminal.expect("now")
        wait_for(lambda: controller.fault("state")["program"], "program on the controller")
        terminal.close()
        assert terminal.process.wait(PATIENCE) != 0
    finally:
        terminal.__exit__(None, None, None)
    assert controller.fault("state")["joints"] == pytest.approx(
        [radians(q) for q in hardware_laboratory.HOME], abs=1e-2
    )
    with JournalReader(next((tmp_path / "runs").glob("*/journal.sqlite"))) as journal:
        assert journal.state() is State.UNKNOWN
