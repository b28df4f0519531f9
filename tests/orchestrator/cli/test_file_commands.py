"""`file_commands`: `decant validate`: every problem of every file, quickly, and nothing started."""

from __future__ import annotations

import json
import struct
import zipfile
from collections.abc import Callable
from pathlib import Path
from shlex import quote

import pytest

from actors.arm.ur_settings import UrArmSettings
from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign, load_laboratory
from tests.support.cli_inputs import RECORDED, ROOT, invoke, process


def test_all_that_is_wrong_with_several_files_is_told_at_once(folder: Path) -> None:
    result = invoke("validate misspelt.yaml small.yaml open-cup.yaml beaker.yaml")
    assert result.exit_code == 2
    assert result.stdout.splitlines() == [
        "small.yaml: ok (campaign, seed 3)",
        "beaker.yaml: ok (vessel, holds 197.9 mL to the brim)",
    ]
    assert "misspelt.yaml:29:3" in result.stderr
    assert "open-cup.yaml: open.stl: not watertight" in result.stderr
    assert result.stderr.splitlines()[-1] == "2 of 4 file(s) can't be used"


def test_an_unknown_engine_is_refused_by_every_command(folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_ENGINE", "cuda")
    result = invoke("validate beaker.yaml")
    assert result.exit_code == 2
    assert "DECANT_ENGINE=cuda: there is no such engine; there are taichi and quadrants" in result.stderr


def test_files_that_are_right_pass(folder: Path) -> None:
    write_recorded = folder / "recorded.yaml"
    write_recorded.write_text(RECORDED, encoding="utf-8")
    result = invoke("validate small.yaml recorded.yaml plan-only.yaml")
    write_recorded.unlink()
    assert (result.exit_code, result.stderr) == (0, "")


# What a check needs is numpy and pydantic. Each of these takes a third of a second to import, or seconds.
HEAVY = """
import sys
from orchestrator.cli.app import main
try:
    main()
finally:
    heavy = {"scipy.special", "scipy.spatial", "scipy.ndimage", "scipy.stats", "trimesh", "sklearn", "pandas", "ray",
             "taichi", "rerun", "matplotlib"}
    print("loaded:", *sorted(heavy & set(sys.modules)), file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [
        "campaigns/paper.yaml",
        pytest.param("studies/paper.yaml", marks=pytest.mark.slow),
        pytest.param("laboratories/virtual.yaml", marks=pytest.mark.slow),
    ],
)
def test_checking_a_shipped_file_wakes_nothing_heavy(file: str, inputs: Path) -> None:
    done = process(f"validate {quote(str(ROOT / 'configs' / file))}", inputs, HEAVY)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "loaded:"


@pytest.fixture
def calibrated(tmp_path: Path) -> Callable[[float], Path]:
    """A laboratory that names a recording of its robot, whose first axis is so much longer [m] than recorded."""
    with zipfile.ZipFile(ROOT / "tests" / "data" / "commissioning" / "virtual.zip") as kept:
        record = json.loads(kept.read("robot.json"))

    def write(longer: float) -> Path:
        parts = record["readout"]["primary"]
        body = bytearray.fromhex(parts["5"])  # 6 checksums, then theta, a and d of six joints
        struct.pack_into(">d", body, 24 + 12 * 8, struct.unpack_from(">d", body, 24 + 12 * 8)[0] + longer)
        (tmp_path / "day-one.json").write_text(
            json.dumps({**record, "readout": {**record["readout"], "primary": {**parts, "5": body.hex()}}})
        )
        text = (ROOT / "configs" / "laboratories" / "ur10-kern.yaml").read_text(encoding="utf-8")
        changed = text.replace("  model: ur10\n", "  model: ur10\n  calibration_file: day-one.json\n", 1)
        assert changed != text
        path = tmp_path / "rig.yaml"
        path.write_text(changed, encoding="utf-8")
        return path

    return write


@pytest.mark.slow
def test_pours_are_checked_with_the_stored_calibration_of_the_robot(calibrated: Callable[[float], Path]) -> None:
    campaign = ROOT / "configs" / "campaigns" / "first-pour.yaml"
    rig = calibrated(0.0)
    arm = load_laboratory(rig).arm
    assert isinstance(arm, UrArmSettings)
    assert arm.calibration is not None
    assert arm.robot.parameters == arm.calibration != arm.with_values(calibration=None).robot.parameters
    assert check_campaign(load_campaign(campaign, rig)) == []
    problems = [problem.message for problem in check_campaign(load_campaign(campaign, calibrated(1.0)))]
    assert any("the arm can make none of" in text for text in problems)
    resolved = load_campaign(campaign, rig).resolved
    assert resolved["laboratory"]["arm"]["calibration_file"] == str(rig.parent / "day-one.json")


@pytest.mark.parametrize(
    ("content", "message"),
    [
        (None, "No such file or directory"),
        ("{}", "is no recording of 'decant robot check --record'"),
        ("ur5e", "records a ur10, and the arm is a ur5e"),
    ],
)
def test_a_stored_calibration_that_does_not_fit_is_named(
    calibrated: Callable[[float], Path], content: str | None, message: str
) -> None:
    rig = calibrated(0.0)
    stored = rig.parent / "day-one.json"
    if content is None:
        stored.unlink()
    elif content == "{}":
        stored.write_text(content)
    else:
        rig.write_text(rig.read_text().replace("model: ur10\n", f"model: {content}\n"))
    result = invoke(f"validate {rig}")
    assert result.exit_code == 2
    assert message in " ".join(result.stderr.split())


def test_a_campaign_is_checked_on_the_laboratory_where_it_would_run(tmp_path: Path) -> None:
    other = tmp_path / "low.yaml"
    text = (ROOT / "configs/laboratories/virtual.yaml").read_text(encoding="utf-8")
    assert "z: 900 mm}" in text
    other.write_text(text.replace("z: 900 mm}", "z: 90 mm}"), encoding="utf-8")
    campaign = ROOT / "configs/campaigns/dispense.yaml"
    assert invoke(f"validate {quote(str(campaign))}").exit_code == 0
    result = invoke(f"validate {quote(str(campaign))} --laboratory {quote(str(other))}")
    assert result.exit_code == 2
    assert "low.yaml" in result.stderr.replace("\n", "")
    assert "box" in result.stderr
