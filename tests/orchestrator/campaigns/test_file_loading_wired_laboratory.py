"""`file_loading`: a laboratory over wires in a file: what fits together, what doesn't, and what may change during a
run.
"""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path

import pytest

from actors.balance.simulated_balance import SimulatedBalanceSettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from orchestrator.campaigns.fingerprint import fingerprint
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import CampaignPlan
from tests.support.campaign_files import written_out
from tests.support.counted_calls import counted_calls

CONFIGS = Path(__file__).parents[3] / "configs"
VIRTUAL = (CONFIGS / "laboratories" / "virtual.yaml").read_text(encoding="utf-8")
HARDWARE = (CONFIGS / "laboratories" / "ur10-kern.yaml").read_text(encoding="utf-8")
TWIN = (CONFIGS / "laboratories" / "twin.yaml").read_text(encoding="utf-8")


def load(folder: Path, text: str) -> LaboratorySettings:
    path = folder / "lab.yaml"
    path.write_text(text, encoding="utf-8")
    return load_laboratory(path)


def changed(text: str, *pairs: tuple[str, str]) -> str:
    for old, new in pairs:
        assert old in text
        text = text.replace(old, new)
    return text


def without(text: str, section: str) -> str:
    """The file without a top-level section."""
    kept, skipping = [], False
    for line in text.splitlines():
        skipping = line.startswith(f"{section}:") or (skipping and line.startswith((" ", "#")))
        kept += [] if skipping else [line]
    return "\n".join(kept) + "\n"


def test_the_shipped_laboratories_are_what_they_say(tmp_path):
    virtual, hardware = load(tmp_path, VIRTUAL), load(tmp_path, HARDWARE)
    assert virtual.arm is not None
    assert virtual.balance is not None
    assert virtual.balance is not None
    assert (virtual.mode, virtual.operator.answers, virtual.arm.address) == ("virtual", "virtual", "")
    assert virtual.arm.time_scale == virtual.balance.time_scale == 30.0
    assert hardware.arm is not None
    assert hardware.balance is not None
    assert hardware.balance is not None
    assert (hardware.mode, hardware.operator.answers, hardware.bench) == ("hardware", "person", None)
    assert hardware.arm.time_scale == hardware.balance.time_scale == 1.0


def test_hardware_differs_from_virtual_in_addresses_and_limits_only(tmp_path):
    virtual, hardware = load(tmp_path, VIRTUAL), load(tmp_path, HARDWARE)
    assert virtual.arm is not None
    assert hardware.arm is not None
    same = hardware.arm.with_values(address="", limits=virtual.arm.limits, time_scale=virtual.arm.time_scale)
    assert same == virtual.arm
    assert virtual.balance is not None
    assert hardware.balance is not None
    assert virtual.balance.placement == hardware.balance.placement == "tray"
    for low, narrow in zip(virtual.arm.limits.box.low.vector, hardware.arm.limits.box.low.vector, strict=True):
        assert low <= narrow


@pytest.mark.parametrize("text", [VIRTUAL, HARDWARE, TWIN], ids=["virtual", "ur10-kern", "twin"])
def test_a_laboratory_as_written_out_loads_to_the_same(tmp_path, text):
    spec = load(tmp_path, text)
    assert load(tmp_path, written_out(LaboratorySettings, text)) == spec


def quickstart(laboratory: Path) -> CampaignPlan:
    text = (CONFIGS / "campaigns" / "quickstart.yaml").read_text(encoding="utf-8")
    path = laboratory.parent / "campaign.yaml"
    text = text.replace("../laboratories/virtual.yaml", laboratory.name)
    path.write_text(text.replace("../vessels", str(CONFIGS / "vessels")), encoding="utf-8")
    return load_campaign(path)


def test_pours_are_never_repeated_on_hardware(tmp_path):
    laboratory = tmp_path / "lab.yaml"
    laboratory.write_text(HARDWARE, encoding="utf-8")
    with pytest.raises(ConfigError, match=r"on_unknown: 'repeat' needs a virtual bench"):
        quickstart(laboratory)


def test_a_controller_may_get_another_address_between_two_parts_of_a_run_and_the_cell_may_not_change(tmp_path):
    plan = load_campaign(QUICKSTART)
    hardware = replace(plan, laboratory=load(tmp_path, HARDWARE))

    def of(text: str) -> object:
        return fingerprint(replace(hardware, laboratory=load(tmp_path, text)))

    same = of(HARDWARE)
    assert of(changed(HARDWARE, ("192.168.0.10", "10.0.0.7"))) == same
    assert of(changed(HARDWARE, ("/dev/serial/by-id/usb-FTDI", "/dev/serial/by-id/usb-PROLIFIC"))) == same
    assert of(changed(HARDWARE, ("reminder: 2 min", "reminder: 1 min"))) == same
    assert of(changed(HARDWARE, ("x: 750 mm", "x: 760 mm"))) != same
    assert of(changed(HARDWARE, ("placement: tray", "placement: receiver"))) != same


QUICKSTART = CONFIGS / "campaigns" / "quickstart.yaml"


@pytest.mark.slow
def test_a_campaign_that_the_arm_can_t_make_is_refused_before_anything_starts():
    plan = load_campaign(QUICKSTART)
    assert check_campaign(plan) == []
    assert plan.laboratory.arm is not None
    arm = plan.laboratory.arm
    upright = arm.limits.with_values(tilt=1.0)
    low = replace(plan, laboratory=plan.laboratory.with_values(arm=arm.with_values(limits=upright)))
    problems = check_campaign(low)
    assert len(problems) == 2
    said = problems[0].message
    assert said.startswith("calibration: the arm can make none of 21 actions that were tried; for example")
    assert re.search(r"for example angular_velocity \S+ deg/s  x_offset \S+ mm: the arm can't", said)  # as searched
    assert "57.3 deg are allowed: lower max_angle, or raise arm.limits.tilt" in said
    assert problems[0].where == "calibration.actions"
    assert "deployment into 'narrow'" in problems[1].message


def test_an_arm_that_is_set_to_carry_less_than_the_liquid_is_refused():
    plan = load_campaign(QUICKSTART)
    assert plan.laboratory.arm is not None
    weak = replace(plan, laboratory=plan.laboratory.with_values(arm=plan.laboratory.arm.with_values(payload=0.05)))
    (problem,) = check_campaign(weak)
    assert problem.where == "liquid.mass"
    assert "set to carry 50 g (arm.payload), less than the water alone, 200 g" in problem.message


@pytest.mark.slow
def test_a_receiver_turned_away_from_home_is_refused_soon_and_in_words_of_the_bench():
    plan = load_campaign(QUICKSTART)
    assert plan.laboratory.arm is not None
    cell = plan.laboratory.arm.cell.with_values(direction=0.0)
    turned = replace(plan, laboratory=plan.laboratory.with_values(arm=plan.laboratory.arm.with_values(cell=cell)))
    doing: list[str] = []
    with counted_calls() as calls:
        first, second = check_campaign(turned, doing=doing.append)
    assert calls.count < 4_000_000  # the lengths of the run's own arm need a refined inverse kinematics
    for problem in (first, second):
        assert "home holds the pourer as for a direction of 90 deg, and cell.direction is 0 deg" in problem.message
        assert "the full pourer would be turned by 90 deg" in problem.message
        assert "set cell.direction nearer to 90 deg" in problem.message
        assert "s into the approach" not in problem.message
    assert doing[0] == "calibration: 21 actions are tried, none of 1 can be made"
    assert any(text.startswith("deployment into 'narrow': ") for text in doing)


def test_a_balance_of_numbers_may_stand_beside_an_arm(tmp_path):
    start = VIRTUAL.index("balance:")
    text = VIRTUAL[:start] + "balance: {kind: simulated, resolution: 0.2 g}\n" + VIRTUAL[VIRTUAL.index("operator:") :]
    spec = load(tmp_path, text).balance
    assert spec is not None
    assert isinstance(spec, SimulatedBalanceSettings)
    assert spec.receives_load
    assert (spec.resolution, spec.time_scale) == (pytest.approx(2e-4), 30.0)
