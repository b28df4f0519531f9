"""`view_command`: `decant view`: recordings are served without a display, beside each other; pours are simulated
again.
"""

from __future__ import annotations

import re
import signal
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from actors.arm.arm_settings import arm_kind
from actors.arm.ur_settings import UrArmSettings
from actors.laboratory_settings import LaboratorySettings
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.cli.view_command import _recording_of, view
from orchestrator.learning.requests import Pour, Poured
from orchestrator.live_view.blueprints import put_beside
from orchestrator.live_view.run_recording import CampaignRecording
from orchestrator.live_view.simulation_view import find_pour, task_of
from orchestrator.records.events import Requested, RequestFinished
from orchestrator.records.journal import JOURNAL_NAME, Header, Journal
from sim_engine.errors import DecantError, InvalidArgumentError
from sim_engine.outcome import PourMeasurement
from tests.support import example_run
from tests.support.rerun_recordings import Contents, seen, viewer
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def recording(tmp_path_factory: pytest.TempPathFactory) -> Path:
    plan = example_run.campaign(pours=1)
    path = tmp_path_factory.mktemp("run") / "campaign.rrd"
    written = CampaignRecording(path, plan)
    for event in example_run.events(plan):
        written.handle(event)
    written.close()
    return path


def _journal(run: Path, notes: dict[str, object] | None = None) -> None:
    with Journal.create(run / JOURNAL_NAME, Header("narrow-cup", {})) as journal:
        for key, stage in ((1, "pours"), (2, "deployment:narrow cup")):
            pour = Pour("narrow cup", example_run.ACTION, 1, 70 + key)
            outcome = Poured(PourMeasurement(0.199, 0.01 * key, 0.001, dict(notes or {})))
            journal.append(
                Requested(stage=stage, id=key, request=pour),
                RequestFinished(stage=stage, id=key, request=pour, outcome=outcome, seconds=1.0),
            )


@pytest.mark.slow
def test_recordings_stand_beside_each_other_under_their_names(recording: Path, tmp_path: Path) -> None:
    path = put_beside({"first": recording, "second": recording}, tmp_path / "both.rrd")
    alone, both = Contents(recording), Contents(path)
    for name in ("first", "second"):
        for entity in ("/simulation/liquid", "/status", "/cell/pourer/mesh"):
            assert both.rows(f"/{name}{entity}", "sim_time") == alone.rows(entity, "sim_time") > 0
    assert both.blueprints == 1


@pytest.mark.slow
def test_recording_is_served_without_a_display_until_ctrl_c(recording: Path, tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, "-c", "from orchestrator.cli.app import main; main()", "view", str(recording)],
        stderr=subprocess.PIPE,
        stdout=subprocess.DEVNULL,
        text=True,
        env={"PATH": "/usr/bin:/bin", "PYTHONPATH": str(ROOT), "HOME": str(tmp_path)},
    )
    try:
        assert process.stderr is not None
        said = process.stderr.readline()
        found = re.search(r"rerun%2Bhttp%3A%2F%2F127.0.0.1%3A(\d+)%2Fproxy", said)
        assert found, said
        with viewer(f"rerun+http://127.0.0.1:{found[1]}/proxy", tmp_path / "seen.rrd"):
            seen(tmp_path / "seen.rrd", lambda contents: contents.rows("/simulation/liquid", "sim_time") == 62)
        process.send_signal(signal.SIGINT)
        assert process.wait(PATIENCE) == 0
    finally:
        process.kill()
        process.wait()


def test_pour_is_simulated_again_as_the_arm_moved_with_the_load_that_was_weighed(tmp_path: Path) -> None:
    from actors.arm.planned_pour import ExecutedPath, pack

    arm = load_laboratory(ROOT / "configs" / "laboratories" / "virtual.yaml").arm
    assert isinstance(arm, UrArmSettings)
    joints = np.array(arm.home.angles) + np.linspace(0.0, 0.4, 50)[:, None] * np.array([0, 0, 0, 0, 0, 1.0])
    _journal(tmp_path, {"executed": pack(ExecutedPath(np.arange(50) * 0.1, joints, True))})
    plan = replace(example_run.campaign(), laboratory=LaboratorySettings(name="virtual", arm=arm))
    (tmp_path / "theta.json").write_text('{"theta": {"particles": 700, "cohesion": 0.03}}')
    pour = find_pour(tmp_path, 1)
    assert pour.stage == "deployment:narrow cup", "the last stage with such a pour"
    assert find_pour(tmp_path, 1, "pours").request.seed == 71
    task = task_of(plan, tmp_path, pour, particles=3000)
    assert task.scene.liquid.mass == 0.199
    assert (task.parameters.particles, task.parameters.cohesion) == (3000, 0.03)
    assert task.motion is not None
    assert task.motion.duration == pytest.approx(4.9, abs=1e-3)
    assert np.allclose(task.motion.poses[:, :3], arm_kind(arm).figure().pourer(joints)[:, :3], atol=1e-4)


def test_pour_of_an_arm_of_numbers_is_simulated_by_its_action(tmp_path: Path) -> None:
    _journal(tmp_path)
    task = task_of(example_run.campaign(), tmp_path, find_pour(tmp_path, 1))
    assert task.motion is None
    assert task.action == example_run.ACTION
    assert task.frame_rate > 10.0


@pytest.mark.slow
def test_what_is_not_there_is_refused_with_what_is(recording: Path, tmp_path: Path) -> None:
    _journal(tmp_path)
    with pytest.raises(InvalidArgumentError, match="no weighed pour 7; weighed were pours: 1; deployment:narrow"):
        find_pour(tmp_path, 7)
    with pytest.raises(DecantError, match="has no recording"):
        _recording_of(tmp_path)
    with pytest.raises(DecantError, match="is not the folder of a run"):
        _recording_of(tmp_path / "nowhere")
    with pytest.raises(DecantError, match="--particles and --stage go with --pour"):
        view([recording], particles=500)
