"""`foreground_run`: hardware moves only for somebody who asked for it, read what it will do, and typed its name. At
a real terminal.
"""

from __future__ import annotations

from collections.abc import Iterator
from math import radians
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner, Result

from actors.emulators.ur_controller.controller_process import VirtualController
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.runs.motion_approval import (
    Envelope,
    SafetyRecord,
    campaign_pours,
    envelope,
    pour_count,
    record_path,
    required_checksum,
    write_record,
)
from orchestrator.runs.stages import stages_of
from tests.support import hardware_laboratory
from tests.support.loopback import free_address
from tests.support.terminal import Terminal


@pytest.fixture(scope="module")
def controller() -> Iterator[VirtualController]:
    with VirtualController.start(
        free_address(), "ur10", joints=[radians(q) for q in hardware_laboratory.HOME]
    ) as started:
        hardware_laboratory.install(started)
        yield started


@pytest.fixture
def campaign(tmp_path: Path, controller: VirtualController) -> Path:
    """A campaign on hardware whose safety settings were accepted."""
    path = hardware_laboratory.write_rig(tmp_path, controller.address)
    accept(tmp_path, controller.fault("state")["checksum"])
    return path


def accept(folder: Path, checksum: str) -> None:
    write_record(folder / "rig.yaml", SafetyRecord(checksum, "2016300123", "ur10", "3.15.8", "2030-01-31", "a person"))


def decant(*arguments: str) -> Result:
    return CliRunner().invoke(app, list(arguments), catch_exceptions=False)


def joints(controller: VirtualController) -> Any:
    return controller.fault("state")["joints"]


@pytest.mark.realtime
@pytest.mark.parametrize("verb", ["run", "pour", "jog"])
def test_hardware_doesn_t_move_without_the_flag(campaign: Path, verb: str) -> None:
    file = campaign if verb != "jog" else campaign.with_name("rig.yaml")
    action = ["--set", "angular_velocity=30", "--set", "x_offset=80"] if verb == "pour" else []
    result = decant(*(["robot", "jog"] if verb == "jog" else [verb]), str(file), *action)
    assert result.exit_code == 2
    assert "is hardware" in result.stderr
    assert "--enable-motion" in result.stderr
    assert not (campaign.parent / "runs").exists()


@pytest.mark.slow
@pytest.mark.realtime
def test_the_flag_alone_doesn_t_arm_where_nobody_is_at_a_terminal(campaign: Path) -> None:
    for command in (["run", str(campaign)], ["robot", "jog", str(campaign.with_name("rig.yaml"))]):
        result = CliRunner().invoke(app, [*command, "--enable-motion"], input="rig\nrig\n", catch_exceptions=False)
        assert result.exit_code == 2
        assert "terminal" in result.stderr
    assert not (campaign.parent / "runs").exists()


@pytest.mark.realtime
def test_settings_that_nobody_has_accepted_can_t_be_armed(campaign: Path) -> None:
    record_path(campaign.with_name("rig.yaml")).unlink()
    result = decant("run", str(campaign), "--enable-motion")
    assert result.exit_code == 2
    assert "have not been accepted" in result.stderr
    assert "decant robot check" in result.stderr


@pytest.mark.realtime
def test_the_record_that_counts_is_that_of_the_laboratory_in_use(campaign: Path) -> None:
    other = campaign.with_name("other.yaml")
    other.write_text(campaign.with_name("rig.yaml").read_text().replace("name: rig", "name: other"))
    result = decant("run", str(campaign), "--enable-motion", "--laboratory", str(other))
    assert result.exit_code == 2
    # for rig.yaml, which the campaign names, they have
    assert "laboratory other: the controller's safety settings have not been accepted" in result.stderr
    assert "other.yaml" in result.stderr
    write_record(other, SafetyRecord("0A0B0C0D", "2016300123", "ur10", "3.15.8", "2030-01-31", "a person"))
    assert required_checksum(load_campaign(campaign, other)) == "0A0B0C0D"


@pytest.mark.realtime
def test_a_wrong_name_moves_nothing(campaign: Path, controller: VirtualController) -> None:
    before = joints(controller)
    with Terminal(
        "robot", "jog", str(campaign.with_name("rig.yaml")), "--enable-motion", cwd=str(campaign.parent)
    ) as terminal:
        terminal.expect(f"HARDWARE: laboratory rig, UR10 at {controller.address}")
        terminal.expect("> ")
        terminal.type("yes")
        assert terminal.end() == 2
    assert "motion is not enabled: 'yes' was typed" in terminal.screen
    assert not (campaign.parent / "runs").exists()
    assert joints(controller) == before


@pytest.mark.slow
@pytest.mark.realtime
def test_what_will_move_is_shown_the_name_arms_one_run_and_its_questions_come_to_the_terminal(
    campaign: Path, controller: VirtualController
) -> None:
    before = joints(controller)
    with Terminal("run", str(campaign), "--enable-motion", "--in-process", cwd=str(campaign.parent)) as terminal:
        for line in ("pours          up to 3", "box            x ", "mm/s", "deg/s, ", "clearance", "emergency stop"):
            terminal.expect(line)
        terminal.expect("> ")
        terminal.type("rig")
        terminal.expect("motion is enabled, for this run only: rig")
        terminal.expect("rigged-hardware-")
        terminal.expect("hardware bench")
        terminal.expect("nothing moves before that")
        terminal.expect("> ")
        terminal.type("give up")
        code = terminal.end()
    assert "abandoned by the operator" in terminal.screen
    assert code == 3
    assert joints(controller) == before
    assert decant("run", str(campaign), "--resume").exit_code == 2  # motion is enabled for one run only


@pytest.mark.slow
@pytest.mark.realtime
def test_settings_that_were_changed_since_stop_a_run_before_anybody_is_asked(
    campaign: Path, controller: VirtualController
) -> None:
    accept(campaign.parent, "0BADC0DE")
    with Terminal("run", str(campaign), "--enable-motion", "--in-process", cwd=str(campaign.parent)) as terminal:
        terminal.expect("> ")
        terminal.type("rig")
        code = terminal.end()
    assert code != 0
    assert "safety settings have changed" in terminal.screen
    assert "accepted was 0BADC0DE" in terminal.screen
    assert "nothing moves before that" not in terminal.screen


@pytest.mark.slow
@pytest.mark.realtime
def test_envelope_covers_the_actions_of_the_campaign_and_grows_with_them(campaign: Path) -> None:
    def worst(text: str) -> Envelope:
        campaign.write_text(text, encoding="utf-8")
        plan = load_campaign(campaign)
        assert plan.laboratory.arm is not None
        stages = stages_of(plan)
        assert pour_count(plan, stages) == 3
        return envelope(plan.laboratory.arm, campaign_pours(plan, stages))

    low = worst(hardware_laboratory.CAMPAIGN)
    assert low.worst.tilt_speed == pytest.approx(radians(90.0), rel=1e-3)  # of the return
    assert low.worst.tilt == pytest.approx(radians(110.0), abs=1e-3)
    assert not low.refused
    high = worst(hardware_laboratory.CAMPAIGN.replace("height: 60 mm", "height: 200 mm"))
    assert low.worst.high[2] + 0.05 < high.worst.high[2] < low.worst.high[2] + 0.15


@pytest.mark.slow
@pytest.mark.realtime
def test_limits_of_the_laboratory_refuse_a_campaign_that_would_break_all_of_them(campaign: Path) -> None:
    laboratory = campaign.with_name("rig.yaml")
    laboratory.write_text(laboratory.read_text().replace("tilt: 135 deg", "tilt: 60 deg"))
    result = decant("run", str(campaign), "--enable-motion")
    assert result.exit_code == 2
    assert "60" in result.stderr
    assert "lean" in result.stderr or "tilt" in result.stderr


@pytest.mark.realtime
@pytest.mark.parametrize(
    ("file", "old", "new", "said"),
    [
        (
            "rig.yaml",
            "balance: {placement: manual}",
            "balance: {placement: manual}\noperator: {answers: virtual}",
            "person",
        ),
        ("rig.yaml", "simulators: 1", "simulators: 1\nbench: {liquid: {particles: 400}}", "hides"),
        ("rig.yaml", "payload: 1.6 kg", "payload: 1.6 kg\n  time_scale: 30", "time_scale"),
        ("rigged.yaml", "seed: 3", "seed: 3\non_unknown: repeat", "repeat"),
    ],
)
def test_what_only_a_virtual_bench_may_is_an_error_on_hardware(
    campaign: Path, file: str, old: str, new: str, said: str
) -> None:
    path = campaign.with_name(file)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    result = decant("validate", str(campaign))
    assert result.exit_code == 2
    assert said in result.stderr
