"""`franka_arm`: what a Franka needs is said before anything starts."""

from __future__ import annotations

import xml.etree.ElementTree as ET
from pathlib import Path

import pytest

import actors.arm.franka
from actors.arm.franka.franka_arm import MODELS
from orchestrator.campaigns.file_loading import load_campaign
from sim_engine.errors import DecantError


def test_without_the_extra_the_shipped_laboratory_says_what_to_install(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("actors.device_kinds.installed", lambda module: module != "franky_sim")
    with pytest.raises(DecantError, match=r"franka\.yaml:.* pip install 'decant-pouring\[franka-sim\]'") as error:
        load_campaign(Path("configs/campaigns/quickstart.yaml"), Path("configs/laboratories/franka.yaml"))
    assert str(error.value).count("pip install") == 1


@pytest.mark.parametrize("model", MODELS)
def test_a_description_has_seven_limited_joints_and_names_its_source(model: str) -> None:
    file = Path(actors.arm.franka.__file__).with_name(f"{model}.urdf")
    joints = [joint for joint in ET.parse(file).getroot().iter("joint") if joint.get("type") == "revolute"]
    assert [joint.get("name") for joint in joints] == [f"joint{n}" for n in range(1, 8)]
    assert all(float(joint.find("limit").get("velocity")) > 2.0 for joint in joints)  # type: ignore[union-attr,arg-type]
    assert "Apache-2.0" in file.read_text(encoding="utf-8")
