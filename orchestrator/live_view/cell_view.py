"""Rows of the robot cell: table, tray, both vessels, the moving arm, its planned and executed path, and the liquid.

`CellScene` follows a pour in real time. If the bench runs in scaled time, or the motion of the liquid is known
afterwards, it adds a playback of the pour to the queue.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np
import rerun as rr
from numpy.typing import NDArray

from actors.arm.arm_interface import ArmFigure
from actors.arm.arm_settings import arm_kind
from actors.interfaces import PourProgress
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Pour
from orchestrator.live_view import rerun_shapes as shapes
from orchestrator.live_view.recording_sink import Moment, Playback, PlaybackQueue, RecordingSink, Track
from orchestrator.live_view.simulation_view import MAXIMUM_RATE
from orchestrator.records.run_clock import run_time
from orchestrator.reports import figure_style as style
from sim_engine.outcome import ParticleState, PourMeasurement, RecordedFrames
from sim_engine.scene import Scene

if TYPE_CHECKING:
    from sim_engine.vessel.shapes import VesselSpec

PLACE = "/cell"

SLOW = 3.0
"""A bench that runs faster than this factor is shown by playback of its pours, since live motion would be too fast."""

TRAILING = 5
"""The executed path is drawn again after this many new points."""

_TRAY = 0.012
"""Thickness of the tray [m]."""

FloatArray = NDArray[np.float64]


class CellScene:
    """Writes the rows of the bench and its motion. For one thread.

    Args:
        sink: sink of the rows.
        films: queue for the playback of completed pours.
        plan: plan of the campaign.
    """

    def __init__(self, sink: RecordingSink, films: PlaybackQueue, plan: CampaignPlan) -> None:
        self._sink, self._films = sink, films
        laboratory = plan.laboratory
        self._figure: ArmFigure | None = None if laboratory.arm is None else arm_kind(laboratory.arm).figure()
        scales = [device.time_scale for device in (laboratory.bench, laboratory.arm) if device is not None]
        self.time_scale = max(scales, default=1.0) or float("inf")
        self._shown: dict[str, str] = {}
        self._trail: list[list[float]] = []
        self._moves: list[tuple[Moment, tuple[float, ...]]] = []
        self._liquid: RecordedFrames | None = None
        self._receiver_at = (0.0, 0.0, 0.0)
        self._dosed: float | None = None  # radius of a dose's particles [m]
        self._particles = None if laboratory.bench is None else laboratory.bench.theta.particles
        self._stands: tuple[float, ...] = ()
        sink.log(PLACE, shapes.fates(), static=True)  # on the parent, since clearing the liquid would remove it
        sink.log(f"{PLACE}/tool", rr.TransformAxes3D(0.06), static=True)
        self._furnish()

    def _furnish(self) -> None:
        table = -_TRAY if self._figure is None else min(self._figure.table, -_TRAY)
        self._sink.log(
            f"{PLACE}/tray",
            rr.Boxes3D(
                centers=[[0.0, 0.0, -0.5 * _TRAY - 1e-3]],
                half_sizes=[[0.16, 0.16, 0.5 * _TRAY]],
                colors=[shapes.TRAY],
                fill_mode="solid",
            ),
            static=True,
        )
        middle, half = np.zeros(2), np.array([0.45, 0.4])
        if self._figure is not None:
            home = self._figure.ends(np.array(self._figure.home))
            base = home[0, 0, :2]
            low, high = np.minimum(base, 0.0) - 0.3, np.maximum(base, 0.0) + 0.3
            middle, half = 0.5 * (low + high), 0.5 * (high - low)
            # The initial pose of the arm; its appearance is static.
            self._sink.times(wall=run_time(), step=0, sim_time=0.0)
            self._sink.log(f"{PLACE}/arm", shapes.bars(self._figure, home), static=True)
            self._sink.rows(f"{PLACE}/arm", [self._sink.now], shapes.stances(home[None]))
        self._sink.log(
            f"{PLACE}/table",
            rr.Boxes3D(
                centers=[[*middle, table - 0.015]],
                half_sizes=[[*half, 0.012]],
                colors=[shapes.TABLE],
                fill_mode="solid",
            ),
            static=True,
        )

    # ---- a pour in progress

    def begin(self, pour: Pour, scene: Scene) -> None:
        """Start a pour: show its vessels and its planned path."""
        self.show()
        self._trail, self._liquid, self._dosed = [], None, None
        if pour.dose is not None and self._particles is not None:
            self._dosed = 0.5 * (scene.liquid.volume / self._particles) ** (1.0 / 3.0)
        self._stand("pourer", scene.pourer)
        self._stand("receiver", scene.receiver)
        self._sink.clear(f"{PLACE}/liquid")
        self._sink.clear(f"{PLACE}/path/executed")
        planned = planned_poses(scene, pour)
        if planned is None:
            return
        self._sink.log(f"{PLACE}/path/planned", self._line(self._tool_places(planned), style.PREDICTED, 1.5e-3))
        if self._figure is None:
            self._sink.log(f"{PLACE}/pourer", shapes.placed(planned[0]))

    def progress(self, told: PourProgress) -> None:
        """Process progress of a pour: the arm's pose and the liquid."""
        if told.liquid is not None and self._dosed is not None:
            self._flow(told.liquid, self._dosed)
        elif told.liquid is not None:
            self._liquid = told.liquid
        if self.time_scale > SLOW and self._films.next_due is not None:
            return  # playback of the previous pour is shown
        if (stands := (*told.joints, *told.pourer)) == self._stands:
            return
        self._stands = stands
        if told.joints and self._figure is not None:
            self._moves.append((self._sink.now, told.joints))
        elif told.pourer:
            self._sink.log(f"{PLACE}/pourer", shapes.placed(np.array(told.pourer)))
            self._follow(told.pourer[:3], self._sink.now)

    def _flow(self, liquid: RecordedFrames, radius: float) -> None:
        """Show the particles of a dose at once, or keep them for its playback."""
        if self.time_scale <= SLOW:
            self._set_receiver(liquid)
            shown = shapes.swarms(liquid.positions[-1:], liquid.states[-1:], radius)
            self._sink.rows(f"{PLACE}/liquid", [self._sink.now], shown)
        else:
            self._liquid = liquid if self._liquid is None else self._liquid.joined(liquid)

    def show(self) -> None:
        """Log the arm's motion since the last call. Several poses are computed and sent at the cost of one."""
        if not self._moves or (figure := self._figure) is None:
            return
        moments, joints = [at for at, _ in self._moves], np.array([where for _, where in self._moves])
        self._moves = []
        tools = figure.tool(joints)
        self._sink.rows(f"{PLACE}/arm", moments, shapes.stances(figure.ends(joints)))
        self._sink.rows(f"{PLACE}/tool", moments, shapes.places(tools))
        self._sink.rows(f"{PLACE}/pourer", moments, shapes.places(figure.pourer(joints)))
        for at, tool in zip(moments, tools, strict=True):
            self._follow(tool[:3], at)

    def _follow(self, place: Sequence[float] | FloatArray, at: Moment) -> None:
        """Extend the executed path to a point [m]."""
        self._trail.append([float(value) for value in place])
        if len(self._trail) % TRAILING == 2 and self.time_scale <= SLOW:
            line = self._line(np.array(self._trail), style.MEASURED, 3e-3)
            self._sink.log(f"{PLACE}/path/executed", line, at=at)

    # ---- a completed pour

    def finish(
        self,
        scene: Scene,
        measured: PourMeasurement,
        *,
        now: float,
        step: int,
        beside: Callable[[FloatArray, FloatArray | None], Sequence[Track]],
        told: Callable[[], object],
    ) -> None:
        """Add the playback of a completed pour, with the arm's motion and the liquid.

        Args:
            scene: scene of the pour.
            measured: measurement of the pour.
            now: wall clock [s since 1970].
            step: step of the campaign.
            beside: returns further tracks. Its arguments are times of the pour (T,) [s], and the mass that a virtual
                bench's liquid has spilled by then (T,) [kg], if it is known.
            told: called at the end of the playback.
        """
        self.show()
        moves = self._executed(measured)
        liquid, self._liquid = self._liquid, None
        if moves is None and liquid is None:
            return
        ends = [float(each[-1]) for each in (None if moves is None else moves[0], _times(liquid)) if each is not None]
        if self.time_scale <= SLOW and liquid is None:
            return  # it was already shown live
        times = np.arange(0.0, max(ends) + 0.5 / MAXIMUM_RATE, 1.0 / MAXIMUM_RATE)
        path = self._path(moves, liquid)
        tracks = [] if moves is None else self._moved(times, *moves)
        spilled = None
        if liquid is not None:
            radius = self._dosed or 0.5 * shapes.spacing(liquid.positions[0], scene.liquid.volume)
            shown, share = self._poured(times, liquid, radius, posed=moves is None)
            tracks, spilled = [*tracks, *shown], share * measured.loaded
        tracks += beside(times, spilled)

        def begin() -> None:
            if len(path) > 1:
                self._sink.log(f"{PLACE}/path/executed", self._line(path, style.MEASURED, 3e-3))
            if liquid is not None:
                self._set_receiver(liquid)

        self._films.add(now, step, Playback(float(times[-1]), tracks, begin, told))

    def _executed(self, measured: PourMeasurement) -> tuple[FloatArray, FloatArray] | None:
        record = measured.notes.get("executed")
        return None if self._figure is None or not record else self._figure.executed(record)

    def _path(self, moves: tuple[FloatArray, FloatArray] | None, liquid: RecordedFrames | None) -> FloatArray:
        if moves is not None and self._figure is not None:
            return self._figure.tool(moves[1][::5])[:, :3]
        return np.zeros((0, 3)) if liquid is None else np.asarray(liquid.pourer_poses, float)[:, :3]

    def _moved(self, times: FloatArray, joint_times: FloatArray, joints: FloatArray) -> list[Track]:
        """Return the arm's tracks at times (T,) [s], from joints (K, n) [rad] known at other times (K,) [s]."""
        figure = self._figure
        assert figure is not None
        stands = np.column_stack([np.interp(times, joint_times, column) for column in joints.T])
        some = shapes.changes(stands)
        when, stands = times[some], stands[some]
        return [
            Track(f"{PLACE}/arm", when, shapes.stances(figure.ends(stands))),
            Track(f"{PLACE}/tool", when, shapes.places(figure.tool(stands))),
            Track(f"{PLACE}/pourer", when, shapes.places(figure.pourer(stands))),
        ]

    def _poured(
        self, times: FloatArray, liquid: RecordedFrames, radius: float, *, posed: bool
    ) -> tuple[list[Track], FloatArray]:
        """Return the liquid's tracks at times (T,) [s], and the fraction of liquid spilled by then, shape (T,)."""
        stamps = np.asarray(liquid.times, dtype=float)
        at = np.clip(np.searchsorted(stamps, times + 1e-6, side="left") - 1, 0, len(stamps) - 1)
        some = shapes.changes(at[:, None].astype(float))  # the liquid may be recorded less often, or for a shorter time
        states = {int(index): np.asarray(liquid.states[index]) for index in at}
        swarms = shapes.swarms([liquid.positions[i] for i in at[some]], [states[int(i)] for i in at[some]], radius)
        tracks = [Track(f"{PLACE}/liquid", times[some], swarms)]
        if posed:
            poses = np.asarray(liquid.pourer_poses, float)[at]
            tracks.append(shapes.moving(f"{PLACE}/pourer", times, poses))
        spilled = {index: float(np.mean(each == ParticleState.SPILLED)) for index, each in states.items()}
        return tracks, np.array([spilled[int(index)] for index in at])

    # ---- helpers

    def _stand(self, entity: str, spec: VesselSpec) -> None:
        if self._shown.get(entity) != (key := spec.content_hash()):
            self._shown[entity] = key
            self._sink.log(f"{PLACE}/{entity}/mesh", shapes.mesh(spec))

    def _set_receiver(self, liquid: RecordedFrames) -> None:
        """Move the receiver to where a virtual bench has it; elsewhere only its intended place is known."""
        if self._receiver_at != liquid.receiver_at:
            self._receiver_at = liquid.receiver_at
            self._sink.log(f"{PLACE}/receiver", rr.Transform3D(translation=liquid.receiver_at))

    def _tool_places(self, poses: FloatArray) -> FloatArray:
        return poses[:, :3] if self._figure is None else self._figure.tool_of(poses)

    def _line(self, points: FloatArray, colour: str, radius: float) -> Any:
        return rr.LineStrips3D([np.asarray(points, np.float32)], colors=[shapes.rgb(colour)], radii=[radius])


def planned_poses(scene: Scene, pour: Pour) -> FloatArray | None:
    """Return poses of the pourer along a planned pour, shape (T, 7); None if planning fails."""
    from actors.arm.pour_feasibility import plan_pour
    from actors.interfaces import InvalidActionError

    try:
        motion = plan_pour(scene, pour.action)
    except InvalidActionError:
        return None
    return motion.sample(np.linspace(0.0, motion.duration, 120))


def _times(liquid: RecordedFrames | None) -> FloatArray | None:
    return None if liquid is None else np.asarray(liquid.times, dtype=float)
