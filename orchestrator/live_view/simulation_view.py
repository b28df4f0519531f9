"""Rows of simulated pours: vessels, particles by their fate, and the fractions of the liquid.

`SimulatedStage` adds simulations to the playback of a campaign's recording. `simulation_rrd` writes one simulated pour
as a recording of its own, for `decant simulate --rrd`. `find_pour` reads a weighed pour of a run, and `task_of` makes
the task that simulates it again, with any number of particles.
"""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from actors.arm.arm_settings import arm_kind
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.blueprints import simulation_blueprint
from orchestrator.live_view.recording_sink import Playback, PlaybackQueue, RecordingSink, Track, columns_of
from orchestrator.records.run_clock import run_time
from orchestrator.records.run_record import RunPour, read_record
from orchestrator.reports import figure_style as style
from orchestrator.runs.stages import scenes_of
from sim_engine.errors import InvalidArgumentError
from sim_engine.liquids import SimulationParameters
from sim_engine.outcome import RecordedFrames, SimulatedPour
from sim_engine.scene import PourTask, SampledMotion, Scene

MAXIMUM_RATE = 10.0
"""Frames per second of playback: 3 000 particles take about 36 kB each."""

PLACE = "/simulation"

SHARES = ("in the pourer", "falling", "received", "spilled")


class SimulatedStage:
    """Adds playbacks of simulations. For one thread.

    Args:
        sink: sink of the rows.
        films: playback queue.
    """

    def __init__(self, sink: RecordingSink, films: PlaybackQueue) -> None:
        self._sink, self._films = sink, films
        self._shown: dict[tuple[str, bool], str] = {}
        sink.log(f"{PLACE}/liquid", shapes.fates(), static=True)
        for state, name in enumerate(SHARES):
            colour = shapes.rgb(style.PARTICLE_STATES[state][1])
            sink.log(f"{PLACE}/share/{state}", rr.SeriesLines(names=name, colors=colour, widths=3), static=True)

    def film(self, frames: RecordedFrames, scene: Scene, title: str, *, now: float, step: int) -> None:
        """Show a simulation.

        Args:
            frames: recorded frames; subsampled to `MAXIMUM_RATE`.
            scene: simulated scene.
            title: title for the viewer.
            now: wall clock [s since 1970].
            step: step of the campaign.
        """
        times = np.asarray(frames.times, dtype=float)
        if len(times) == 0:
            return
        radius = 0.5 * shapes.spacing(frames.positions[0], scene.liquid.volume)
        shown = thinned(times)
        moments = times[shown] - times[shown[0]]
        states = [np.asarray(frames.states[index]) for index in shown]
        shares = [100.0 * np.bincount(each, minlength=5) / max(len(each), 1) for each in states]
        poses = np.asarray([frames.pourer_poses[index] for index in shown], float)
        liquid = shapes.swarms([frames.positions[index] for index in shown], states, radius)
        tracks = [shapes.moving(f"{PLACE}/pourer", moments, poses), Track(f"{PLACE}/liquid", moments, liquid)]
        for state, share in enumerate(np.transpose(shares)[: len(SHARES)]):
            curve = columns_of(rr.Scalars.columns(scalars=share))
            tracks.append(Track(f"{PLACE}/share/{state}", moments, curve))
        film = Playback(
            float(moments[-1]),
            tracks,
            begin=lambda: self._set(scene, title, frames.receiver_at),
            end=lambda: self._sink.clear(f"{PLACE}/share", recursive=True),  # no line to the next playback
        )
        self._films.add(now, step, film)

    def _set(self, scene: Scene, title: str, receiver_at: tuple[float, float, float]) -> None:
        self._sink.log(f"{PLACE}/title", rr.TextDocument(f"### {title}", media_type="text/markdown"))
        for role, spec in (("pourer", scene.pourer), ("receiver", scene.receiver)):
            # Viewers of the wall clock don't see rows that are left out of it.
            key, place = spec.content_hash(), (role, self._sink.on_wall)
            if self._shown.get(place) != key:
                self._shown[place] = self._shown[role, False] = key
                self._sink.log(f"{PLACE}/{role}/mesh", shapes.mesh(spec))
        self._sink.log(f"{PLACE}/receiver", rr.Transform3D(translation=receiver_at))


def thinned(times: NDArray[np.float64]) -> list[int]:
    """Return the indices of frames to show: at most `MAXIMUM_RATE`, and the last, which shows the spilled liquid."""
    frames = [0]
    for index in range(1, len(times)):
        if times[index] - times[frames[-1]] >= 1.0 / MAXIMUM_RATE - 1e-6:
            frames.append(index)
    if frames[-1] != len(times) - 1:
        frames.append(len(times) - 1)
    return frames


def simulation_rrd(path: Path, task: PourTask, result: SimulatedPour, title: str = "") -> Path:
    """Write a recording of one simulated pour.

    Args:
        path: `.rrd` to write; replaced if it exists.
        task: simulated task, with `frame_rate` > 0.
        result: result of the simulation.
        title: title of the recording; default: names of the vessels, and the seed.

    Returns:
        `path`.

    Raises:
        ValueError: the result has no frames.
        OSError: the file can't be written.
    """
    if result.frames is None:
        raise ValueError("this simulation kept no frames to record; simulate it with a record rate above 0")
    scene, outcome = task.scene, result.outcome
    title = title or f"{scene.pourer.name} into {scene.receiver.name}, seed {task.seed}"
    sink = RecordingSink(path, application="decant simulation", name=title)
    sink.keep(simulation_blueprint())
    sink.log("/", rr.ViewCoordinates.RIGHT_HAND_Z_UP, static=True)
    films = PlaybackQueue(sink)
    now = run_time()
    sink.times(wall=now, step=0, sim_time=0.0)
    SimulatedStage(sink, films).film(result.frames, scene, title, now=now, step=0)
    films.play(float("inf"))
    for source, text in (
        ("action", style.display_values(task.action.values())),
        ("parameters", style.display_values(task.parameters.model_dump())),
        (
            "outcome",
            f"received {100 * outcome.received:.2f} %, spilled {100 * outcome.spilled:.2f} %, "
            f"retained {100 * outcome.retained:.2f} %, in flight {100 * outcome.in_flight:.2f} %, "
            f"down the outside {100 * outcome.dribbled:.2f} %",
        ),
    ):
        level = rr.TextLogLevel.WARN if source == "outcome" and outcome.invalid is not None else rr.TextLogLevel.INFO
        sink.log(f"/log/{source}", rr.TextLog(text, level=level))
    sink.close()
    return path


DETAIL = 30.0
"""Frames per simulated second [1/s]."""


def find_pour(run: Path, number: int, stage: str | None = None) -> RunPour:
    """Find a weighed pour of a run. Doses are not found: their motions were not those of an action.

    Args:
        run: folder of the run.
        number: number of the pour within its stage.
        stage: stage that requested it; None: the last stage with such a pour.

    Raises:
        InvalidArgumentError: the run has no such pour.
        JournalError: the journal can't be read.
    """
    weighed = [pour for pour in read_record(run).weighed if pour.request.dose is None]
    fitting = [pour for pour in weighed if pour.request.number == number and stage in (None, pour.stage)]
    if not fitting:
        stages: dict[str, list[str]] = {}
        for pour in weighed:
            stages.setdefault(pour.stage, []).append(str(pour.request.number))
        known = "; ".join(f"{name}: {', '.join(numbers)}" for name, numbers in stages.items())
        of = "" if stage is None else f" of stage {stage}"
        hint = f"weighed were {known}" if known else "none was"
        raise InvalidArgumentError(f"{run}: there is no weighed pour {number}{of}; {hint}")
    return fitting[-1]


def task_of(plan: CampaignPlan, run: Path, pour: RunPour, particles: int | None = None) -> PourTask:
    """Make the task that simulates a pour again, with the arm's executed motion, if it was recorded, and the run's θ*.

    Args:
        plan: plan of the run.
        run: folder of the run.
        pour: pour to simulate.
        particles: number of particles instead of θ's.
    """
    measured = pour.measured
    assert measured is not None
    theta = plan.parameters
    if (saved := run / "theta.json").is_file():
        theta = SimulationParameters.model_validate(json.loads(saved.read_text(encoding="utf-8"))["theta"])
    if particles is not None:
        theta = theta.model_copy(update={"particles": particles})
    scene = scenes_of(plan)[pour.request.scene]
    scene = replace(scene, liquid=scene.liquid.model_copy(update={"mass": measured.loaded}))
    task = PourTask(scene, pour.request.action, theta, pour.request.seed % 2**31, frame_rate=DETAIL)
    arm, record = plan.laboratory.arm, measured.notes.get("executed")
    figure = None if arm is None else arm_kind(arm).figure()
    executed = None if figure is None or not record else figure.executed(record)
    if figure is None or executed is None:
        return task
    times, joints = executed
    return replace(task, motion=SampledMotion(times - times[0], figure.pourer(joints)))
