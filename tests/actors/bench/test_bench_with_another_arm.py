"""An arm that is no UR goes everywhere where a UR goes: pours and doses on a virtual bench, recordings, pictures, and
the check of a gripper. None of these places names a kind of arm.
"""

from __future__ import annotations

import asyncio
from collections.abc import Iterator
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml
from typer.testing import CliRunner

from actors.arm.arm_settings import ARMS
from actors.bench.virtual_bench import FollowedBench
from actors.grippers.digital_gripper import DigitalSettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.cli.app import app
from orchestrator.recordings.recording_export import _executed
from sim_engine.action import DEG
from tests.actors.bench.test_dose_procedure import check_amount, dosed
from tests.support import other_arm
from tests.support.wired_bench import ACTION, LABORATORIES, opened_stage

pytestmark = pytest.mark.realtime


@pytest.fixture(autouse=True)
def _registered() -> Iterator[None]:
    with other_arm.registered():
        yield


def laboratory(folder: Path, name: str = "virtual-dosing", **sections: object) -> Path:
    """A shipped virtual laboratory with the other arm in the place of its UR."""
    settings = yaml.safe_load((LABORATORIES / f"{name}.yaml").read_text())
    settings["arm"] |= {"kind": "other", "warning_time": "0.2 s", "approach_speed": "90 deg/s"}
    settings["bench"].pop("doses", None)
    del settings["arm"]["model"]
    path = folder / "other.yaml"
    path.write_text(yaml.safe_dump({**settings, **sections}))
    return path


def spec(folder: Path, scale: float = 1.0) -> LaboratorySettings:
    loaded = load_laboratory(laboratory(folder))
    paced = {name: getattr(loaded, name).with_values(time_scale=scale) for name in ("arm", "balance", "bench")}
    return loaded.with_values(in_process=True, operator=loaded.operator.with_values(time=1.0), **paced)


def test_a_kind_that_is_registered_too_late_is_an_error_and_no_endless_loop(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = laboratory(tmp_path)
    with monkeypatch.context() as patch:
        patch.setattr(ARMS, "_content", ({name: kind for name, kind in ARMS.all.items() if name != "other"}, (), {}))
        LaboratorySettings.model_rebuild(force=True)
    with pytest.raises(RuntimeError, match="'other' was registered after"):
        load_laboratory(path)


def test_it_pours_on_a_virtual_bench_and_its_tilt_is_exported(tmp_path: Path) -> None:
    async def scenario() -> None:
        settings = spec(tmp_path, scale=4.0)
        async with opened_stage(settings) as stage:
            assert isinstance(stage.bench.ground_truth, FollowedBench)
            measured = await stage.pour()
            assert measured.delivered == pytest.approx(stage.contents.in_receiver, abs=5e-3)
            assert measured.delivered > 0.05, "the liquid did not follow the arm"
        plan = SimpleNamespace(laboratory=settings)
        tilts = np.array(_executed(measured.notes, plan))  # type: ignore[arg-type]
        assert tilts[:, 1].max() == pytest.approx(ACTION.max_angle / DEG, abs=1.0)

    asyncio.run(scenario())


def test_it_pours_a_wanted_amount(tmp_path: Path) -> None:
    async def scenario() -> None:
        async with opened_stage(spec(tmp_path)) as stage:
            check_amount(stage, await dosed(stage, 25.0), 25.0)

    asyncio.run(scenario())


def test_its_path_is_drawn(tmp_path: Path) -> None:
    laboratory(tmp_path)
    campaign = {
        "name": "other",
        "laboratory": "other.yaml",
        "pourer": str(LABORATORIES.parent / "vessels" / "beaker.yaml"),
        "liquid": {"mass": "200 g"},
        "deployment": {
            "strategy": "D1",
            "receiver": str(LABORATORIES.parent / "vessels" / "tumbler.yaml"),
            "motion": {"max_angle": "100 deg", "height": "80 mm"},
            "actions": {"angular_velocity": ["60 deg/s", "100 deg/s"], "x_offset": ["80 mm", "100 mm"]},
            "pours": 1,
        },
    }
    (tmp_path / "campaign.yaml").write_text(yaml.safe_dump(campaign))
    png = tmp_path / "path.png"
    sets = ["--set", "angular_velocity=60 deg/s", "--set", "x_offset=90 mm"]
    drawn = CliRunner().invoke(
        app, ["pour", str(tmp_path / "campaign.yaml"), *sets, "--dry-run", "--png", str(png)], catch_exceptions=False
    )
    assert drawn.exit_code == 0, drawn.output
    assert png.read_bytes().startswith(b"\x89PNG")
    assert "joint" in drawn.stdout


@pytest.mark.parametrize("outputs", [False, True])
def test_a_gripper_on_outputs_asks_whether_the_arm_has_them(outputs: bool, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(other_arm.OtherArmSettings, "digital_outputs", outputs)
    texts: list[str] = []
    problems = SimpleNamespace(add=lambda text, *at, **how: texts.append(text), valid=lambda *keys: True)
    gripper = DigitalSettings(close="standard 0", travel=1.0, nominal_force=40.0, opening=0.1)
    gripper.check_laboratory(problems, mode="hardware", arm=other_arm.other_arm())  # type: ignore[arg-type]
    assert any("the outputs are those of a UR arm" in text for text in texts) == (not outputs)
