"""`file_loading`: the arm of a laboratory's file is of one of the kinds that are installed, ours as everybody's."""

from __future__ import annotations

from pathlib import Path

import pytest

from actors.arm.arm_settings import ARMS
from actors.arm.simulated_arm import SimulatedArmSettings
from actors.arm.ur_settings import UrArmSettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.campaigns.yaml.yaml_errors import ConfigError

SHIPPED = Path("configs/laboratories/virtual.yaml").read_text(encoding="utf-8")
UNTIL, FROM = SHIPPED.index("arm:"), SHIPPED.index("balance:")


def written(folder: Path, arm: str) -> Path:
    path = folder / "laboratory.yaml"
    path.write_text(SHIPPED[:UNTIL] + arm + SHIPPED[FROM:], encoding="utf-8")
    return path


def refusal(folder: Path, arm: str) -> str:
    with pytest.raises(ConfigError) as error:
        load_laboratory(written(folder, arm))
    return str(error.value)


def test_ours_come_in_by_the_door(tmp_path):
    assert {"simulated", "ur"} <= set(ARMS.names)
    assert ARMS.package("ur").startswith("decant-pouring ")
    arm = load_laboratory(written(tmp_path, "arm: {kind: simulated}\n")).arm
    assert arm == SimulatedArmSettings(time_scale=30.0)


def test_an_arm_without_a_kind_is_a_ur_robot(tmp_path):
    whole = SHIPPED[UNTIL:FROM]
    bare = load_laboratory(written(tmp_path, whole)).arm
    assert isinstance(bare, UrArmSettings)
    assert load_laboratory(written(tmp_path, whole.replace("arm:\n", "arm:\n  kind: ur\n", 1))).arm == bare


def test_what_is_wrong_with_a_kind_is_told_with_its_place(tmp_path):
    assert "7:13: arm.kind: 'simulatd' is not known here; did you mean 'simulated'?" in refusal(
        tmp_path, "arm: {kind: simulatd}\n"
    )
    assert "7:24: arm.model: belongs to franka and ur, not to simulated" in refusal(
        tmp_path, "arm: {kind: simulated, model: ur10}\n"
    )
    assert "a simulated arm stands nowhere" in refusal(
        tmp_path, "arm: {kind: simulated}\ncell: {receiver: {x: 700 mm, y: 0 mm, z: 0 mm}, direction: 0 deg}\n"
    )
