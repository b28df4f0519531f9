"""A whole campaign over wires: `decant run` with a controller on TCP and a balance on a pty, killed and resumed."""

from __future__ import annotations

import signal
from collections.abc import Iterator
from io import StringIO
from pathlib import Path

import psutil
import pytest
from ruamel.yaml import YAML

from actors.arm.planned_pour import unpack
from orchestrator.records.journal import Entry, Kind
from tests.support import small_campaign
from tests.support.command_process import Workplace, finished_in, pour_under_way, started_after_they_were_finished

pytestmark = [pytest.mark.ray]

LABORATORIES = Path(__file__).parents[2] / "configs" / "laboratories"

RUN = ("run", "small.yaml")


def write_wired(folder: Path) -> None:
    """The small campaign on the shipped virtual laboratory, with few particles."""
    yaml = YAML()
    laboratory = yaml.load(LABORATORIES / "virtual.yaml")
    laboratory["simulators"] = 2
    laboratory["bench"]["liquid"]["particles"] = 400
    laboratory["operator"]["time"] = "30 s"
    laboratory["bench"]["pose_error"] = {"x": "1 mm", "tilt": "0.5 deg"}
    yaml.dump(laboratory, folder / "lab.yaml")

    campaign = yaml.load(small_campaign.CAMPAIGN)
    campaign["laboratory"] = "lab.yaml"
    campaign["motion"]["return_velocity"] = "100 deg/s"
    calibration, deployment = campaign["calibration"], campaign["deployment"]
    calibration |= {"simulations": 3, "initial_samples": 2}
    deployment |= {"prior_simulations": 2, "simulations_per_pour": 1}
    for stage in (calibration, deployment):
        stage["motion"]["height"] = "80 mm"
        stage["actions"]["angular_velocity"] = ["60 deg/s", "100 deg/s"]
    calibration["motion"]["x_offset"] = "75 mm"
    deployment["actions"]["x_offset"] = ["70 mm", "100 mm"]
    text = StringIO()
    yaml.dump(campaign, text)
    small_campaign.write_campaign(folder, text.getvalue())


@pytest.fixture
def workplace(tmp_path: Path) -> Iterator[Workplace]:
    place = Workplace(tmp_path)
    write_wired(tmp_path)
    yield place
    place.close()


def far_ends(place: Workplace) -> list[psutil.Process]:
    """Processes in the place of hardware that a workplace's run has started."""
    found = []
    for process in psutil.process_iter():
        try:
            ours = process.environ().get("TMPDIR") == str(place.temporary)
            if ours and any(
                name in process.cmdline() for name in ("actors.emulators.ur_controller", "actors.arm.ur.rtde_worker")
            ):
                found.append(process)
        except (psutil.Error, OSError):
            continue
    return found


@pytest.mark.slow  # killed over wires is also what the kill matrix does, and killed without wires a quick test
@pytest.mark.realtime
def test_a_campaign_over_wires_is_killed_in_a_pour_resumed_and_comes_to_its_end(workplace: Workplace) -> None:
    def tilting(entries: list[Entry]) -> bool:
        announced = [e for e in entries if e.kind == Kind.NOTE and "The arm moves in" in e.body["text"]]
        return finished_in("pours", entries) == 1 and pour_under_way(entries) and len(announced) == 2

    killed, _ = workplace.interrupt(tilting, signal.SIGKILL, *RUN)
    assert killed.returncode == -signal.SIGKILL
    workplace.assert_nothing_is_left()
    assert far_ends(workplace) == []

    workplace.finish(*RUN, "--resume")
    entries = workplace.entries()
    pours = [e.body["outcome"]["measurement"] for e in entries if e.kind == Kind.POUR_FINISHED]
    assert len(pours) == 3 + 2
    assert started_after_they_were_finished(entries) == []
    for measured in pours:
        assert measured["loaded"] == pytest.approx(0.1, abs=5e-3)
        notes = measured["notes"]
        assert notes["mode"] == "virtual"
        executed = unpack(notes["executed"])
        assert executed.completed
        assert executed.times[-1] > 1.0
        assert [one["about"] for one in notes["operator"]][-2:] == ["start", "pourer_after"]
    said = [e.body["text"] for e in entries if e.kind == Kind.NOTE]
    assert sum(text.startswith("weighed, spilled:") for text in said) >= len(pours)
    workplace.assert_nothing_is_left()


@pytest.mark.realtime
@pytest.mark.slow  # over wires a stop is tried on the bench, and Ctrl-C without wires
def test_ctrl_c_during_a_pour_over_wires_finishes_and_weighs_it(workplace: Workplace) -> None:
    process, errors = workplace.interrupt(pour_under_way, signal.SIGINT, *RUN)
    assert process.returncode == 130, errors
    entries = workplace.entries()
    assert not pour_under_way(entries)
    assert [e.body["after"] for e in entries if e.kind == Kind.CAMPAIGN_STATE][-1] == "paused"
    workplace.assert_nothing_is_left()
    assert far_ends(workplace) == []
