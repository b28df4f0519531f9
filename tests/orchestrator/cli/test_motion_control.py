"""`motion_control`: jogging: small steps as typed, each axis confirmed once, limits told in words, Ctrl-C stops the
arm.
"""

from __future__ import annotations

from math import degrees, radians
from pathlib import Path
from typing import Any

import pytest

from actors.arm.arm_interface import ArmPose
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Pose
from actors.emulators.ur_controller.controller_process import VirtualController
from actors.interfaces import LaboratoryError
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.cli.motion_control import JogError, Jogging, JogStep, parse_step, steps_home
from orchestrator.runs.motion_approval import SafetyRecord, write_record
from tests.support import hardware_laboratory
from tests.support.cli_inputs import invoke
from tests.support.loopback import free_address
from tests.support.terminal import Terminal

LABORATORY = Path("configs/laboratories/virtual.yaml")


class Arm:
    """Does as it is told, and writes it down."""

    def __init__(self, joints: tuple[float, ...]) -> None:
        self._joints, self.home = list(joints), joints
        self.said: list[Any] = []

    def joints(self) -> tuple[float, ...]:
        return tuple(self._joints)

    def where(self) -> ArmPose:
        return ArmPose(Pose(x=0.5), tuple(self._joints), self.home)

    def release(self) -> None:
        self.said.append("release")

    def jog(self, axis: str, amount: float, speed: float) -> None:
        if self.said[-1] != "release":
            raise LaboratoryError("locked")
        self.said.append((axis, amount, speed))
        if axis.startswith("joint"):
            self._joints[int(axis[-1]) - 1] += amount


class Session:
    def __init__(self, *typed: str) -> None:
        spec = load_laboratory(LABORATORY).arm
        assert isinstance(spec, UrArmSettings)
        self.home = spec.home.angles
        self.arm, self.screen, self._typed = Arm(spec.home.angles), "", list(typed)
        self.jogging = Jogging(self.arm, self._read, self._tell)  # type: ignore[arg-type]

    def _read(self, prompt: str) -> str:
        self.screen += prompt
        if not self._typed:
            raise EOFError
        return self._typed.pop(0)

    def _tell(self, text: str) -> None:
        self.screen += text + "\n"

    @property
    def moved(self) -> list[tuple[str, float, float]]:
        return [step for step in self.arm.said if step != "release"]


@pytest.mark.parametrize(
    ("typed", "step"),
    [
        ("j5 +2", JogStep("joint 5", 2.0, "deg")),
        ("z − 1,234", JogStep("z", -1.234, "mm")),  # 1234 mm are no step
        ("J1 -0,5", JogStep("joint 1", -0.5, "deg")),
        ("z -5", JogStep("z", -5.0, "mm")),
        ("rx 3", JogStep("rx", 3.0, "deg")),
        ("x50", JogStep("x", 50.0, "mm")),
    ],
)
def test_what_is_typed_is_a_step(typed: str, step: JogStep) -> None:
    assert parse_step(typed) == step


@pytest.mark.parametrize("typed", ["j7 1", "j5", "j5 11", "z 51", "z 0", "w 1", "z 5 mm", "j5 1e3", "5"])
def test_anything_else_or_a_larger_step_is_refused_in_words(typed: str) -> None:
    with pytest.raises(JogError, match="step"):
        parse_step(typed)


def test_first_step_along_an_axis_in_either_direction_is_confirmed() -> None:
    session = Session("j5 2", "", "j5 3", "j5 -1", "no", "z 5", "", "quit")
    session.jogging.run()
    assert [(axis, round(amount, 6)) for axis, amount, _ in session.moved] == [
        ("joint 5", round(radians(2), 6)),
        ("joint 5", round(radians(3), 6)),
        ("z", 0.005),
    ]
    assert session.moved[0][2] == pytest.approx(radians(5.0))
    assert session.moved[2][2] == pytest.approx(0.02)
    assert "not moved" in session.screen
    assert "joints" in session.screen


def test_home_is_reached_by_small_steps_only_after_its_name_was_typed() -> None:
    session = Session("j1 10", "", "j1 10", "j4 -7", "", "home", "no", "home", "home")
    session.jogging.run()
    assert [degrees(a - b) for a, b in zip(session.arm.joints(), session.home, strict=True)] == pytest.approx([0.0] * 6)
    assert "not moved" in session.screen
    assert "Ctrl-C" in session.screen
    assert max(abs(amount) for _, amount, _ in session.moved) <= radians(10.0) + 1e-9


def test_home_from_home_is_no_step() -> None:
    assert steps_home((0.1, 0.2, 0.3, 0.4, 0.5, 0.6), (0.1, 0.2, 0.3, 0.4, 0.5, 0.6)) == []
    steps = steps_home((0.0,) * 6, (radians(25.0), 0.0, 0.0, 0.0, 0.0, radians(-5.0)))
    assert len(steps) == 6
    assert sum(step.amount for step in steps if step.axis == "joint 1") == pytest.approx(25.0)


@pytest.mark.slow
@pytest.mark.realtime
def test_arm_of_hardware_moves_by_what_was_typed_and_ctrl_c_stops_it(tmp_path: Path) -> None:
    start = [radians(q) for q in hardware_laboratory.HOME]
    with VirtualController.start(free_address(), "ur10", joints=start) as controller:
        hardware_laboratory.install(controller)
        laboratory = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", controller.address)
        write_record(laboratory, SafetyRecord(controller.fault("state")["checksum"], "2016300123", "", "", "", ""))
        with Terminal("robot", "jog", str(laboratory), "--enable-motion", cwd=str(tmp_path)) as terminal:
            terminal.expect("> ")
            terminal.type("rig")
            terminal.expect("jog> ")
            terminal.type("j6 2")
            terminal.expect("Enter moves")
            terminal.type("")
            terminal.expect("jog> ")
            moved = controller.fault("state")["joints"]
            assert degrees(moved[5] - start[5]) == pytest.approx(2.0, abs=0.1)
            terminal.type("j6 10")
            # the program prompts again if the arm refuses, or stops because this machine is too busy
            terminal.wait_for(lambda: degrees(controller.fault("state")["joints"][5] - start[5]) > 3.0, unless="jog> ")
            terminal.interrupt()
            terminal.expect("stopping the arm")
            terminal.expect("operator during jog")
            stopped = degrees(controller.fault("state")["joints"][5] - start[5])
            assert stopped < 11.5
            terminal.expect("jog> ")
            terminal.type("z 60")
            terminal.expect("at most 50 mm")
            terminal.type("quit")
            assert terminal.end() == 0
        assert degrees(controller.fault("state")["joints"][5] - start[5]) == pytest.approx(stopped, abs=0.2)


@pytest.mark.realtime
@pytest.mark.slow
def test_arm_of_hardware_goes_home_after_its_laboratory_and_home_were_typed(tmp_path: Path) -> None:
    home = [radians(q) for q in hardware_laboratory.HOME]
    start = [*home[:4], home[4] + radians(3.0), home[5] - radians(12.0)]
    with VirtualController.start(free_address(), "ur10", joints=start) as controller:
        hardware_laboratory.install(controller)
        laboratory = hardware_laboratory.write_laboratory(tmp_path / "rig.yaml", controller.address)
        write_record(laboratory, SafetyRecord(controller.fault("state")["checksum"], "2016300123", "", "", "", ""))
        refused = invoke(f"robot home {laboratory}")
        assert refused.exit_code == 2
        assert f"decant robot home {laboratory} --enable-motion" in refused.stderr
        for answer, status, reached in (("no", 2, start), ("home", 0, home)):
            with Terminal("robot", "home", str(laboratory), "--enable-motion", cwd=str(tmp_path)) as terminal:
                terminal.expect("> ")
                terminal.type("rig")
                terminal.expect("type 'home' to begin > ")
                terminal.type(answer)
                assert terminal.end() == status
            joints = [degrees(q) for q in controller.fault("state")["joints"]]
            assert joints == pytest.approx([degrees(q) for q in reached], abs=0.1)
