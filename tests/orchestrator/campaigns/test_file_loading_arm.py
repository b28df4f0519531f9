"""`file_loading`: an arm and its cell in a laboratory's file mean what they say, and say where they are wrong."""

from __future__ import annotations

import math
from pathlib import Path
from textwrap import dedent

import pytest

from actors.arm.arm_settings import arm_kind
from actors.arm.ur_settings import UrArmSettings
from actors.arm_geometry import Plane, Pose, RobotCell
from orchestrator.campaigns.yaml.section_validation import PlacedProblems, validate
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from sim_engine.settings.model import Settings, meanings
from tests.support.campaign_files import written_out


class Laboratory(Settings):
    arm: UrArmSettings | None = None
    """As in a laboratory's file."""

    cell: RobotCell | None = None
    """Likewise."""


def load(text: str, mode: str = "virtual") -> UrArmSettings:
    report = Report()
    place = Place(Document.parse(dedent(text), Path("lab.yaml").resolve()))
    section = validate(Laboratory, place, report)
    if section is not None and section.arm is not None:
        arm_kind(section.arm).check_laboratory(PlacedProblems(place, report), mode=mode, cell=section.cell)
    report.raise_if_any()
    assert section is not None
    assert section.arm is not None
    return section.arm.in_laboratory(section.cell, 1.0)


BOX = "{low: {x: 250 mm, y: -600 mm, z: 0 mm}, high: {x: 1000 mm, y: 400 mm, z: 900 mm}}"
VIRTUAL = f"""\
arm:
  model: ur10e
  tool: {{z: 170 mm}}
  payload: 1.6 kg
  grip: {{y: -60 mm, rx: -90 deg}}
  home: {{base: -14 deg, shoulder: -91 deg, elbow: -115 deg, wrist1: -154 deg, wrist2: -104 deg, wrist3: 0 deg}}
  limits:
    box: {BOX}
cell:
  receiver: {{x: 750 mm, y: 0 mm, z: 60 mm}}
  direction: 90 deg
"""
HARDWARE = VIRTUAL.replace("model: ur10e", "model: ur10e\n  address: 192.168.0.10")
FULL = HARDWARE.replace(f"    box: {BOX}", f"""\
    box: {BOX}
    planes:
      - {{normal: [0, -2, 0], offset: -390 mm}}
      - {{normal: [0.6, 0, 0.8], offset: 150 mm}}
    joint_speed: 120 deg/s
    tool_speed: 800 mm/s
    tilt: 135 deg
    tilt_speed: 110 deg/s
    singularity: 0.15
    clearance: 8 mm
  payload_centre: {{x: 1 mm, y: 2 mm, z: 110 mm}}
  approach_speed: 30 deg/s
  approach_acceleration: 60 deg/s^2
  upright_speed: 15 deg/s
  warning_time: 5 s
  rate: 250 Hz""")  # fmt: skip


def test_every_key_reaches_the_arm():
    spec = load(FULL + "  table: -10 mm\n", "hardware")
    deg = math.radians
    assert (spec.model, spec.address, spec.payload) == ("ur10e", "192.168.0.10", 1.6)
    assert spec.tool == Pose(z=0.17)
    assert spec.grip == Pose(y=-0.06, rx=deg(-90.0))
    assert spec.payload_centre.vector == pytest.approx((0.001, 0.002, 0.11))
    assert spec.home.angles == pytest.approx([deg(v) for v in (-14, -91, -115, -154, -104, 0)])
    assert (spec.approach_speed, spec.approach_acceleration) == pytest.approx((deg(30.0), deg(60.0)))
    assert (spec.upright_speed, spec.warning_time, spec.rate) == pytest.approx((deg(15.0), 5.0, 250.0))
    limits, cell = spec.limits, spec.cell
    assert (limits.box.low.vector, limits.box.high.vector) == ((0.25, -0.6, 0.0), (1.0, 0.4, 0.9))
    assert limits.planes == (Plane(normal=(0.0, -1.0, 0.0), offset=-0.39), Plane(normal=(0.6, 0.0, 0.8), offset=0.15))
    assert (limits.joint_speed, limits.tilt, limits.tilt_speed) == pytest.approx((deg(120), deg(135), deg(110)))
    assert (limits.tool_speed, limits.singularity, limits.clearance) == pytest.approx((0.8, 0.15, 0.008))
    assert (cell.receiver.vector, cell.direction, cell.table) == ((0.75, 0.0, 0.06), pytest.approx(deg(90)), -0.01)


@pytest.mark.parametrize(
    ("text", "mode"),
    [
        (VIRTUAL, "virtual"),
        (FULL, "hardware"),
        (FULL.replace("[0, -2, 0]", "[0.1, -2, 0.3]"), "hardware"),
    ],
)
def test_the_resolved_arm_loads_to_the_same(text, mode):
    spec = load(text, mode)
    assert load(written_out(Laboratory, text), mode) == spec


@pytest.mark.parametrize("address", ["10.0.0.7", "ur10.lab.example", "robot-1", "127.0.0.1"])
def test_a_controller_is_found_by_address_or_name(address):
    assert load(HARDWARE.replace("192.168.0.10", address), "hardware").address == address


def changed(old: str, new: str, text: str = VIRTUAL) -> str:
    assert old in text
    return text.replace(old, new)


CASES = [
    (HARDWARE, "virtual", r"lab.yaml:3:12: arm.address: a virtual arm has no address"),
    (changed("payload: 1.6 kg", "payload: 13 kg"), "virtual", r"arm.payload: a ur10e carries at most 12.5 kg"),
    (changed("[0, -2, 0]", "[0, 1]", FULL), "hardware", r"lab.yaml:\d+:\d+: arm.limits.planes"),
    (changed("x: 250 mm", "x: 1250 mm"), "virtual", r"lab.yaml:8:10: arm.limits.box: x of 'low' should be smaller"),
    (changed("wrist3: 0 deg", "wrist3: 12 deg"), "virtual", r"lab.yaml:6:9: arm.home: the pourer leans 12.0 deg"),
    (changed("z: 60 mm", "z: -60 mm"), "virtual", r"lab.yaml:10:13: cell.receiver: stands at -0.060 m, below"),
]  # fmt: skip


@pytest.mark.parametrize(("text", "mode", "said"), CASES)
def test_mistakes_are_shown_with_their_place_and_what_would_be_right(text, mode, said):
    with pytest.raises(ConfigError, match=said):
        load(text, mode)


def test_all_mistakes_come_at_once():
    text = changed("1.6 kg", "1.6", changed("direction: 90 deg", "direction: 90"))
    with pytest.raises(ConfigError) as caught:
        load(text)
    assert len(caught.value.problems) == 2


def test_keys_are_typed_in_the_sections_that_say_them():
    # every key has a sentence for the editor's tooltip
    def sentences(model: type[Settings]) -> list[str | None]:
        return [meanings(model)[name] for name in model.written_keys().values()]

    assert all(sentences(UrArmSettings))
    assert all(sentences(RobotCell))
