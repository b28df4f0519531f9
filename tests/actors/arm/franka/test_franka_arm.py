"""`franka_arm`: what a Franka needs is said before anything starts."""

from __future__ import annotations

import dataclasses
import re
import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest

import actors.arm.franka
from actors.arm.franka.franka_arm import MODELS, FrankaSettings
from actors.device_kinds import FrankaKind
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from sim_engine.errors import DecantError
from sim_engine.liquids import Liquid
from sim_engine.scene import Scene
from tests.support.planning_cell import ACTION, vessel


def test_without_the_extra_the_shipped_laboratory_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("actors.device_kinds.installed", lambda module: module != "franky_sim")
    with pytest.raises(DecantError, match=r"franka\.yaml:.* pip install 'decant-pouring\[franka-sim\]'") as error:
        load_campaign(Path("configs/campaigns/quickstart.yaml"), Path("configs/laboratories/franka.yaml"))
    assert str(error.value).count("pip install") == 1


def changed(folder: Path, *changes: tuple[str, str]) -> Path:
    """The shipped laboratory with other text."""
    text = Path("configs/laboratories/franka.yaml").read_text(encoding="utf-8")
    for pattern, new in changes:
        text, count = re.subn(pattern, new, text)
        assert count == 1, pattern
    path = folder / "laboratory.yaml"
    path.write_text(text, encoding="utf-8")
    return path


HARDWARE = [
    ("mode: virtual", "mode: hardware"),
    ("kind: franka", "kind: franka\n  address: 172.16.0.2"),
    ("virtual: {.*}", "port: /dev/ttyUSB0"),
    (r"operator:(?s:.)*", ""),
]
GRIPPER = "balance:", "gripper: {kind: onrobot, model: RG6}\nbalance:"


@pytest.mark.parametrize(
    ("changes", "text"),
    [
        ([("model: fr3", "model: fr4")], r"arm\.model: 'fr4' is not supported; supported are fr3, panda"),
        ([("model: fr3", "model: panda")], r"arm\.model: the emulated Franka is an FR3; write 'fr3', or 'mode: hard"),
        ([*HARDWARE, ("model: fr3", "model: panda")], r"joint 6 \(joint6\) at 243.1 deg is outside .* -1 … 215 deg"),
        ([(r", 42\.90 deg\]", "]")], r"arm\.home: has 6 joints; this arm has 7"),
        ([HARDWARE[0], *HARDWARE[2:]], r"arm: an arm of hardware needs its controller's 'address'"),
        (
            [("rx: -69.282 deg, ry: 69.282 deg, rz: -69.282 deg", "ry: 90 deg")],
            r"arm\.grip: the hand is where the liquid leaves",
        ),
        ([("z: 100 mm}  #", "z: 900 mm}  #")], r"cell\.receiver: an upright pourer beside it, .* out of reach"),
        ([*HARDWARE, GRIPPER], r"gripper: only a UR's controller has the gripper's URCap; add 'address'"),
        ([("balance:", "gripper: {kind: digital, close: standard 3, opening: 85 mm}\nbalance:")], "digital"),
    ],
)
def test_a_laboratory_that_no_franka_fits_has_one_error(
    changes: list[tuple[str, str]], text: str, tmp_path: Path
) -> None:
    pytest.importorskip("pinocchio")
    pytest.importorskip("franky_sim")
    with pytest.raises(DecantError, match=text) as error:
        load_laboratory(changed(tmp_path, *changes))
    assert str(error.value).count("laboratory.yaml:") == 1


POSE = "rx: 2.22144 rad, rz: 2.22144 rad}, tool: {z: 103.4 mm, rz: -45 deg}"
CARRIES = [
    (r"home: .*", "home: [-67.46 deg, 20.17 deg, 34.63 deg, -123.91 deg, -44.38 deg, 232.59 deg, 62.11 deg]"),
    (r"y: -650 mm, z: 0 mm}, high: {.*}}", "y: -700 mm, z: 0 mm}, high: {x: 800 mm, y: 400 mm, z: 1 m}}"),
    ("z: 100 mm}  #", "z: 250 mm}  #"),
    ("placement: tray", "placement: receiver"),
    (
        "balance:",
        "gripper: {kind: onrobot, model: RG6}\nplaces:\n"
        f"- {{name: pan, use: balance, pose: {{x: 600 mm, z: 310 mm, {POSE}}}\n"
        f"- {{name: source, holds: [pourer], pose: {{x: 420 mm, y: -520 mm, z: 310 mm, {POSE}}}\n"
        f"- {{name: rack, holds: [receiver], clearance: 8 mm, pose: {{x: 550 mm, y: -320 mm, z: 310 mm, {POSE}, rack: "
        "{rows: 1, columns: 2, row_pitch: 120 mm, column_pitch: 140 mm, direction: 90 deg}}\nbalance:",
    ),
]


def test_it_carries_between_places_and_a_rack_and_names_the_joint_that_does_not_reach_one(tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    pytest.importorskip("franky_sim")
    laboratory = load_laboratory(changed(tmp_path, *CARRIES))
    assert [place.name for place in laboratory.places] == ["pan", "source", "rack"]
    with pytest.raises(DecantError, match=r"place 'source': joint 6 \(joint6\) would turn to 28\d\.\d deg"):
        load_laboratory(changed(tmp_path, *CARRIES, ("y: -520 mm", "y: 200 mm")))


def test_the_arm_makes_the_fastest_pour_that_is_searched(tmp_path: Path) -> None:
    """The search of a campaign ends at the arm's own limit."""
    pytest.importorskip("pinocchio")
    pytest.importorskip("franky_sim")
    settings = load_laboratory(changed(tmp_path)).arm
    assert isinstance(settings, FrankaSettings)
    scene = Scene("s", vessel("beaker").spec, vessel("tumbler").spec, Liquid(name="water", mass=0.2))
    fastest = settings.tilt_speed_limit
    path = FrankaKind(settings).plan(scene, dataclasses.replace(ACTION, height=0.11, angular_velocity=fastest))
    assert path.report.tilt_speed == pytest.approx(fastest, rel=1e-3)


def test_the_pictures_show_the_base_where_the_robot_stands(tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    pytest.importorskip("franky_sim")
    arm = load_laboratory(changed(tmp_path)).arm
    assert isinstance(arm, FrankaSettings)
    bars = FrankaKind(arm).figure().ends(np.array(arm.home_joints))
    assert bars[0, 0] == pytest.approx([0.0, 0.6, -0.1])  # of a receiver at x = 600 mm, z = 100 mm


def test_a_gripper_with_a_server_of_its_own_fits_beside_a_franka(tmp_path: Path) -> None:
    pytest.importorskip("pinocchio")
    pytest.importorskip("franky_sim")
    own = GRIPPER[0], GRIPPER[1].replace("RG6}", "RG6, address: 172.16.0.9}")
    laboratory = load_laboratory(changed(tmp_path, *HARDWARE, own))
    assert laboratory.gripper is not None
    assert laboratory.gripper.beside(laboratory.arm).address == "172.16.0.9"


@pytest.mark.parametrize("model", MODELS)
def test_a_description_has_seven_limited_joints_and_names_its_source(model: str) -> None:
    file = Path(actors.arm.franka.__file__).with_name(f"{model}.urdf")
    joints = [joint for joint in ET.parse(file).getroot().iter("joint") if joint.get("type") == "revolute"]
    assert [joint.get("name") for joint in joints] == [f"joint{n}" for n in range(1, 8)]
    assert all(float(joint.find("limit").get("velocity")) > 2.0 for joint in joints)  # type: ignore[union-attr,arg-type]
    assert "Apache-2.0" in file.read_text(encoding="utf-8")
