"""`rerun_subscriber`: the recording has what people want to see, and watching never holds up or breaks a run."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import rerun.blueprint as rrb
from matplotlib.collections import PathCollection, QuadMesh

from actors.arm.arm_settings import arm_kind
from actors.interfaces import PourProgress
from actors.optimizer.questions import Data, MinimumQuery
from actors.optimizer.suggest import propose, slices
from actors.runtime.child_process import ChildProcess, child_environment
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.learning.requests import Pour, Simulate, Simulated, Suggest, Suggested
from orchestrator.live_view.blueprints import Moment, campaign_blueprint
from orchestrator.live_view.learning_view import LearningStage, slices_picture, surrogate_picture
from orchestrator.live_view.recording_sink import RecordingSink
from orchestrator.live_view.rerun_subscriber import QueueThread, RerunMonitor
from orchestrator.live_view.run_recording import CampaignRecording
from orchestrator.live_view.simulation_view import simulation_rrd
from orchestrator.records.events import LogLine, PourProgressed, RequestFinished, RequestStarted
from orchestrator.reports.loss_units import DISCREPANCY
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import RecordedFrames, SimulatedPour
from sim_engine.search_space import Axis, Space
from tests.support import example_results, example_run
from tests.support.rerun_recordings import Contents
from tests.support.waiting import PATIENCE

ROOT = Path(__file__).parents[3]


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Contents:
    path = tmp_path_factory.mktemp("run") / "campaign.rrd"
    plan = example_run.campaign()
    monitor = RerunMonitor(path, plan)
    for event in example_run.events(plan):
        monitor(event)
    assert monitor.close(timeout=PATIENCE)
    assert (monitor.failed, monitor.dropped) == (0, 0)
    return Contents(path)


@pytest.mark.slow
def test_recording_shows_both_vessels_and_the_particles_of_recorded_simulations(recorded: Contents) -> None:
    for entity in ("/simulation/pourer/mesh", "/simulation/receiver/mesh"):
        assert recorded.values(entity, "Mesh3D:vertex_positions")
    # two simulations of 3 s at 10 Hz
    assert recorded.rows("/simulation/liquid", "sim_time") == 2 * 31
    assert all(len(row) == example_run.PARTICLES for row in recorded.values("/simulation/liquid", "Points3D:positions"))  # type: ignore[arg-type]
    states = {state for row in recorded.values("/simulation/liquid", "Points3D:class_ids") for state in row}  # type: ignore[attr-defined]
    assert states == {0, 2, 3}


@pytest.mark.slow
def test_pourer_moves_in_the_recording_as_it_moved_in_the_simulation(recorded: Contents) -> None:
    quaternions = recorded.values("/simulation/pourer", "Transform3D:quaternion")
    x, y, z, w = np.array([q[0] for q in quaternions], dtype=float).T  # type: ignore[index]
    tilts = np.degrees(2 * np.arctan2(y, w))
    assert np.allclose((x, z), 0.0)
    assert tilts.min() == pytest.approx(0.0, abs=1e-3)
    assert tilts.max() == pytest.approx(90.0, abs=1e-3)


def test_recorded_simulations_follow_each_other_on_the_timeline_of_simulated_time(recorded: Contents) -> None:
    times = 1e-9 * np.array(recorded.columns["/simulation/liquid"]["sim_time"], dtype=np.int64)
    assert len(np.unique(times)) == len(times), "two simulations share moments and would be shown through each other"
    assert times.max() == pytest.approx(3.0 + 0.5 + 3.0, abs=0.01)


def test_every_pour_has_its_measured_and_predicted_loss_and_the_best_so_far(recorded: Contents) -> None:
    def numbers(what: str) -> list[float]:
        return sorted(float(v[0]) for v in recorded.values(f"/learning/narrow_cup/loss/{what}", "Scalars:scalars"))  # type: ignore[index]

    # (spilled + retained) / loaded of 30, 15, 10 g beside and 2 g left, of 200 g
    assert numbers("measured") == pytest.approx([6.0, 8.5, 16.0])
    assert numbers("best") == pytest.approx([6.0, 8.5, 16.0])
    assert numbers("predicted") == pytest.approx([20 / 3, 10.0, 20.0])
    assert numbers("predicted_high") == pytest.approx([20 / 3 + 3.29, 13.29, 23.29], abs=0.01)  # nine in ten
    assert recorded.columns["/learning/narrow_cup/loss/measured"]["step"][-1] >= 3


def test_surrogates_of_calibration_and_receiver_are_in_the_recording_as_pictures(recorded: Contents) -> None:
    for place, count in (("calibration", 1), ("narrow_cup", 3)):
        pictures = recorded.values(f"/learning/{place}/surrogate", "EncodedImage:blob")
        assert len(pictures) == 1 + count, "first it is said that there will be one"
        assert bytes(pictures[0][0][:8]) == b"\x89PNG\r\n\x1a\n"  # type: ignore[index]


def test_theta_of_a_calibration_is_in_the_recording_as_the_picture_of_its_posterior(tmp_path: Path) -> None:
    calibrated = example_results.played_results()["calibration"]
    path = tmp_path / "campaign.rrd"
    sink = RecordingSink(path, application="decant", name="campaign")
    LearningStage(sink, example_run.campaign()).learnt(calibrated, 0.0)
    sink.close()
    (picture,) = Contents(path).values("/learning/calibration/theta", "EncodedImage:blob")
    (tmp_path / "theta.png").write_bytes(bytes(picture[0]))  # type: ignore[index]
    assert example_results.is_picture(tmp_path / "theta.png")


def test_picture_of_a_surrogate_has_axes_units_data_and_the_next_point() -> None:
    (event,) = example_run.three_parameters()
    assert isinstance(event, RequestFinished)
    assert isinstance(event.request, Suggest)
    assert isinstance(event.outcome, Suggested)
    figure = surrogate_picture(event.request.query, event.outcome.suggestion, DISCREPANCY, "θ")
    panels = [axes for axes in figure.axes if axes.get_title(loc="left")]
    assert [axes.get_title(loc="left") for axes in panels] == [
        "expected |measured − simulated| spillage [%]",
        "± σ [%]",
        "lower bound, mean − 2 σ [%]",
    ]
    assert panels[0].get_xlabel() == "number of particles"
    assert panels[0].get_ylabel() == "wall friction"
    assert "held: cohesion 0.04 N/m" in figure.get_suptitle()
    # (0.2, 0.9, 0.3) of the unit cube was observed, (0.3, 0.4, 0.7) is next: particles on a logarithmic axis, friction
    points = [c for c in panels[0].collections if isinstance(c, PathCollection)]
    observed, following = (np.asarray(c.get_offsets())[0] for c in points)
    assert observed == pytest.approx([500 * 8**0.2, 0.15], rel=2e-3)
    assert following == pytest.approx([500 * 8**0.3, 0.35], rel=2e-3)


def test_what_has_more_than_two_axes_is_cut_through_every_two_of_them() -> None:
    box = Space((*example_run.THETA.axes, Axis("friction", 0.0, 0.5)))
    rng = np.random.default_rng(1)
    points = rng.random((20, 3))
    costs = (points[:, 0] - 0.3) ** 2 + points[:, 2]
    problem = MinimumQuery(box, Data(tuple(map(tuple, points)), tuple(costs)), map_resolution=9)
    answer = propose(problem)
    cuts = slices(problem, answer, resolution=9)
    assert [cut.axes for cut in cuts] == [
        ("particles", "cohesion"),
        ("particles", "friction"),
        ("cohesion", "friction"),
    ]
    assert answer.surrogate in cuts, "the same surrogate as the answer's own map"
    figure = slices_picture(problem, answer, DISCREPANCY, "θ")
    drawn = [axes for axes in figure.axes if any(isinstance(c, QuadMesh) for c in axes.collections)]
    seen = [axes for axes in drawn if len([c for c in axes.collections if isinstance(c, PathCollection)]) == 2]
    assert len(seen) == 6, "mean and deviation of each of three pairs, with data and next point"


def test_two_axes_are_one_picture() -> None:
    problem = MinimumQuery(example_run.THETA, Data(((0.2, 0.3), (0.7, 0.3)), (0.2, 0.05)), map_resolution=9)
    assert slices(problem, propose(problem)) == ()


def test_page_says_at_a_glance_whether_it_is_real_and_what_is_going_on(recorded: Contents) -> None:
    pages = [str(row[0]) for row in recorded.values("/status", "TextDocument:text")]  # type: ignore[index]
    assert all(page.startswith("# VIRTUAL: ") for page in pages)
    assert any("**Pour 2**: tilting" in page for page in pages)
    assert "Best into narrow: 6.00 %" in pages[-1]


def test_how_a_run_ended_is_shown_wherever_the_time_cursor_is(recorded: Contents) -> None:
    """A finished recording opens at its beginning, when the page on the time line said that the run goes on."""
    pages = [str(row[0]) for row in recorded.values("/outcome", "TextDocument:text")]  # type: ignore[index]
    assert not {"wall", "sim_time", "step"} & set(recorded.columns["/outcome"])
    assert pages[-1].startswith("# VIRTUAL: finished\n")
    assert " of " not in pages[-1].splitlines()[2], "the stage that was reached does not stand there as if it went on"
    assert "Best into narrow: 6.00 %" in pages[-1]


def test_the_last_pictures_are_shown_wherever_the_time_cursor_is(recorded: Contents) -> None:
    """A replay begins at 0, where the pictures on the time line are announcements."""
    for place in ("calibration/surrogate", "narrow_cup/surrogate"):
        entity = f"/learning/{place}"
        assert not {"wall", "sim_time", "step"} & set(recorded.columns[f"/outcome{entity}"])
        kept = recorded.values(f"/outcome{entity}", "EncodedImage:blob")
        on_the_line = recorded.values(entity, "EncodedImage:blob")
        assert bytes(kept[-1][0]) == bytes(on_the_line[-1][0])  # type: ignore[index]
    replay = campaign_blueprint("replaying", {"narrow cup": "narrow"}, "loss").root_container.contents[-1]
    pictures = [view.origin for view in views(replay) if isinstance(view, rrb.Spatial2DView)]
    assert pictures
    assert all(str(origin).startswith("/outcome/learning/") for origin in pictures)


@pytest.mark.parametrize(
    ("moment", "timeline", "state"),
    [("calibrating", "wall", "following"), ("deploying", "wall", "following"), ("replaying", "sim_time", "playing")],
)
def test_no_view_opens_paused(moment: Moment, timeline: str, state: str) -> None:
    panel = campaign_blueprint(moment, {"narrow cup": "narrow"}, "loss").time_panel
    assert (panel.timeline, panel.play_state) == (timeline, state)


def views(container: Any) -> Iterator[Any]:
    """All views in a container of a blueprint."""
    for child in getattr(container, "contents", ()):
        if hasattr(child, "origin"):
            yield child
        else:
            yield from views(child)


def test_lanes_of_the_machine_show_who_works_at_what(recorded: Contents) -> None:
    simulators = [row[0] for row in recorded.values("/machine/activity/simulator_1", "StateChange:state")]  # type: ignore[index]
    assert simulators == ["idle", *["calibrate", "idle"] * 2]
    arm = [row[0] for row in recorded.values("/machine/activity/arm", "StateChange:state")]  # type: ignore[index]
    assert [doing for doing in arm if doing != "idle"] == ["tilt"] * 3
    assert len(recorded.values("/machine/wait", "Scalars:scalars")) == 2


def test_wall_clock_shows_films_at_their_own_pace(recorded: Contents) -> None:
    walls = np.sort(1e-9 * np.array(recorded.columns["/simulation/liquid"]["wall"], dtype=np.int64))
    assert walls[30] - walls[0] == pytest.approx(3.0, abs=0.01), "a film of three seconds lasts three seconds"


def test_vessels_are_there_on_the_wall_clock_even_if_their_first_film_was_not(tmp_path: Path) -> None:
    plan = example_run.campaign(pours=0)
    recording = CampaignRecording(tmp_path / "campaign.rrd", plan)
    request = Simulate("tumbler", example_run.ACTION, SimulationParameters(), 1, "calibrate")
    for number, length in enumerate(
        (30.0, 3.0, 3.0), start=1
    ):  # the second would begin 30 s late, the third comes then
        frames, now = example_run.frames(duration=length, rate=1.0), 1e6 + 40.0 * (number == 3)
        outcome = Simulated(example_run.outcome())
        recording.handle(
            RequestFinished(time=now, stage="calibration", id=number, request=request, outcome=outcome, frames=frames)
        )
        if number == 1:
            recording._simulated._shown.clear()  # as if nothing had been shown
            recording._films._planned.clear()
    recording.close()
    contents = Contents(recording.path)
    assert contents.rows("/simulation/pourer/mesh", "sim_time") == 2
    assert contents.rows("/simulation/pourer/mesh", "wall") == 1


def test_curves_of_a_film_end_with_it(recorded: Contents) -> None:
    def rows(entity: str) -> list[tuple[int, object]]:
        columns = recorded.columns[entity]
        times, sent = sorted(columns["sim_time"]), sorted(columns["rerun.controls.RowId"])  # type: ignore[type-var]
        return list(zip(times, sent[-len(times) :], strict=True))  # type: ignore[arg-type]

    (ended, _) = rows("/simulation/share")
    # Of rows with the same time that counts which was sent last.
    assert rows("/simulation/share/0")[30][0] == ended[0]
    assert rows("/simulation/share/0")[30][1] < ended[1] < rows("/simulation/share/0")[31][1]  # type: ignore[operator]


def test_arm_stands_at_each_moment_where_its_joints_put_it(tmp_path: Path) -> None:
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    assert plan.laboratory.arm is not None
    assert plan.deployment is not None
    recording, figure = CampaignRecording(tmp_path / "campaign.rrd", plan), arm_kind(plan.laboratory.arm).figure()
    scene = plan.deployment.scenes[0]
    pour = Pour(scene.name, scene.action({"angular_velocity": 1.5, "x_offset": 0.1}), 1, 1)
    recording.handle(RequestStarted(time=1e6, stage="deployment", id=1, request=pour))
    joints = [tuple(value + 0.1 * turned for value in figure.home) for turned in (0, 1, 1, 1, 2)]
    for tenth, stand in enumerate(joints):
        progress = PourProgress("tilt", 0.5, 0.1 * tenth, 1e-3 * tenth, stable=False, joints=stand)
        recording.handle(PourProgressed(time=1e6 + 0.1 * tenth, stage="deployment", id=1, number=1, progress=progress))
    recording.close()
    contents = Contents(recording.path)
    feet = dict(
        zip(
            (int(1e-8 * ns) for ns in contents.columns["/cell/arm"]["wall"]),  # type: ignore[operator]
            contents.values("/cell/arm", "Capsules3D:translations"),
            strict=True,
        )
    )
    for tenth, stand in ((0, joints[0]), (1, joints[1]), (4, joints[4])):
        assert np.allclose(feet.pop(10_000_000 + tenth), figure.ends(np.array(stand))[:, 0], atol=1e-6)
    assert 10_000_002 not in feet, "while it rests nothing is said"
    shown = contents.values("/balance/shown", "Scalars:scalars")
    assert [row[0] for row in shown] == pytest.approx([0.0, 1.0, 2.0, 3.0, 4.0])  # type: ignore[index]


def test_event_log_tells_decisions_results_and_warnings(recorded: Contents) -> None:
    lines = [
        str(v[0])  # type: ignore[index]
        for entity in recorded.columns
        if entity.startswith("/log/")
        for v in recorded.values(entity, "TextLog:text")
    ]
    assert lines.count("pour 2: least lower bound") == 1
    assert lines.count("after pour 1 the simulator is wrong here") == 1
    assert "the balance drifts" in lines
    assert any(line.startswith("pour 3 into narrow: 6.00 %") for line in lines)


@pytest.mark.slow
def test_recording_brings_its_blueprint_and_passes_the_viewers_own_check(tmp_path: Path) -> None:
    plan = example_run.campaign(pours=1)
    monitor = RerunMonitor(tmp_path / "campaign.rrd", plan)
    for event in example_run.events(plan):
        monitor(event)
    assert monitor.close(timeout=PATIENCE)
    assert Contents(monitor.path).blueprints == 1, "of several the viewer would take any"
    checked = subprocess.run(
        [sys.executable, "-m", "rerun", "rrd", "verify", str(monitor.path)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        env=child_environment(),
    )
    assert checked.returncode == 0, checked.stderr


@pytest.mark.slow
def test_resumed_run_keeps_the_recording_made_before_the_interruption(tmp_path: Path) -> None:
    plan = example_run.campaign()
    first = RerunMonitor(tmp_path / "campaign.rrd", plan)
    assert first.close()
    before = first.path.read_bytes()
    second = RerunMonitor(tmp_path / "campaign.rrd", plan)
    assert second.close()
    assert second.path.name == "campaign-2.rrd"
    assert first.path.read_bytes() == before


def test_recording_that_cannot_be_written_is_reported_before_the_run(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("a file where a folder is needed")
    with pytest.raises(OSError, match="taken"):
        RerunMonitor(tmp_path / "taken" / "campaign.rrd", example_run.campaign())
    task, result = example_run.simulation()
    (tmp_path / "pour.rrd").mkdir()
    with pytest.raises(OSError, match=r"pour\.rrd"):
        simulation_rrd(tmp_path / "pour.rrd", task, result)


@pytest.mark.slow
def test_an_event_that_cannot_be_drawn_costs_only_itself(tmp_path: Path) -> None:
    plan = example_run.campaign()
    monitor = RerunMonitor(tmp_path / "campaign.rrd", plan)
    told = list(example_run.events(plan))
    broken = RecordedFrames(np.array([0.0]), [np.zeros((3, 3))], [np.zeros(3, np.uint8)], np.zeros((1, 3)))
    for event in told:
        if getattr(event, "frames", None) is not None:
            object.__setattr__(event, "frames", broken)
            break
    for event in told:
        monitor(event)
    assert monitor.close(timeout=PATIENCE)
    assert monitor.failed == 1
    assert Contents(monitor.path).rows("/learning/narrow_cup/loss/measured") == 3


def test_a_recording_is_completed_while_its_process_works_however_slow_the_machine(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """On a busy machine the process that writes needed longer than the time after which it was ended."""
    with pytest.MonkeyPatch.context() as busy:
        busy.setattr(ChildProcess, "cpu_time", property(lambda process: time.monotonic()))
        assert RerunMonitor(tmp_path / "campaign.rrd", example_run.campaign()).close(timeout=0.05)
    os.kill((hung := RerunMonitor(tmp_path / "hung.rrd", example_run.campaign())).pid, signal.SIGSTOP)
    assert not hung.close(timeout=0.2), "it does nothing"
    assert [record.getMessage() for record in caplog.records] == [
        "recording hung.rrd: could not be completed: nothing was written in 0.2 s"
    ]


def test_slow_disk_drops_and_counts_events_and_never_holds_up_the_campaign() -> None:
    release = threading.Event()
    seen: list[int] = []

    def slow(item: int) -> None:
        release.wait(PATIENCE)
        seen.append(item)

    worker: QueueThread[int] = QueueThread(slow, lambda: None, capacity=5, name="slow disk")
    taken = [worker.put(i) for i in range(1000)]
    release.set()
    assert worker.close(PATIENCE)
    assert 5 <= sum(taken) <= 6  # what waits, and what is being written
    assert worker.dropped == 1000 - sum(taken)
    assert len(seen) == sum(taken)


def test_hanging_disk_does_not_keep_the_run_from_ending() -> None:
    release = threading.Event()
    worker: QueueThread[int] = QueueThread(
        lambda _: release.wait(2 * PATIENCE) and None, lambda: None, capacity=5, name="hanging disk"
    )
    worker.put(1)
    assert not worker.close(0.2)
    release.set()


@pytest.mark.slow
def test_dropped_events_are_said_in_the_recording(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    plan = example_run.campaign()
    monitor = RerunMonitor(tmp_path / "campaign.rrd", plan, capacity=1)
    for number in range(3000):
        monitor(LogLine(level="info", text=f"line {number}"))
    assert monitor.dropped > 0
    dropped = monitor.dropped
    assert monitor.close(timeout=PATIENCE)
    said = Contents(monitor.path).values("/log/recording", "TextLog:text")
    assert said == [[f"{dropped} events are missing: the recording could not keep up"]]


def test_simulation_recording_thins_particles_to_ten_frames_a_second(tmp_path: Path) -> None:
    task, result = example_run.simulation()
    dense = SimulatedPour(result.outcome, example_run.frames(rate=50.0))
    contents = Contents(simulation_rrd(tmp_path / "pour.rrd", task, dense))
    assert contents.rows("/simulation/liquid", "sim_time") == 31
    assert contents.blueprints == 1


def test_simulation_without_frames_is_refused_with_advice(tmp_path: Path) -> None:
    task, result = example_run.simulation()
    with pytest.raises(ValueError, match="record rate above 0"):
        simulation_rrd(tmp_path / "pour.rrd", task, SimulatedPour(result.outcome))
