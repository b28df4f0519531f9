"""Action → PourMotion: the pourer's pose over time. The arm executes it and the solver replays it.

`plan_motion` makes a `PourMotion` of `Segment`s; `Motion` is the interface that executed motions share
(`sim_engine.scene.SampledMotion`).

Frames and signs: `sim_engine.action` (picture in docs/reference/frames.md). The pourer stands upright at (−x_offset,
y_offset) with its lip `height` above the receiver's rim, turns about a horizontal line along y (the pivot), holds,
and returns upright.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import Action
from sim_engine.hydrostatics import predicted_end_of_flow
from sim_engine.scene import SampledMotion, Scene
from sim_engine.vessel.vessel import Vessel

FloatArray = NDArray[np.float64]


@dataclass(frozen=True)
class Segment:
    """A stretch of constant angular acceleration.

    Attributes:
        start, duration: [s].
        tilt: at its start [rad].
        velocity: at its start [rad/s].
        acceleration: [rad/s²].
    """

    start: float
    duration: float
    tilt: float
    velocity: float
    acceleration: float

    @property
    def end_tilt(self) -> float:
        """Tilt at its end [rad]."""
        return self.tilt + self.velocity * self.duration + 0.5 * self.acceleration * self.duration**2


@dataclass(frozen=True)
class Phase:
    """A named part of a motion: 'tilt', 'hold', 'return' [s]."""

    name: str
    start: float
    end: float


class Motion(Protocol):
    """Anything that moves the pourer: planned, or read back from an arm."""

    @property
    def duration(self) -> float:
        """Duration [s]."""
        ...

    def sample(self, times: FloatArray) -> FloatArray:
        """Poses of the pourer's frame in the world, shape (T, 7): x y z [m], qw qx qy qz; clamped at both ends."""
        ...

    def tilt(self, times: FloatArray) -> FloatArray:
        """Tilt from upright, shape (T,) [rad]."""
        ...


def turn(start: float, from_tilt: float, to_tilt: float, speed: float, acceleration: float | None) -> list[Segment]:
    """Segments that turn from rest to rest: a trapezoid in velocity, a triangle if the turn is short, a step without
    `acceleration`.

    Args:
        start: [s].
        from_tilt, to_tilt: [rad].
        speed: largest angular speed [rad/s], > 0.
        acceleration: [rad/s²], > 0, or None.
    """
    way = abs(to_tilt - from_tilt)
    sign = math.copysign(1.0, to_tilt - from_tilt)
    if way == 0.0:
        return []
    if acceleration is None:
        return [Segment(start, way / speed, from_tilt, sign * speed, 0.0)]
    peak = min(speed, math.sqrt(way * acceleration))
    ramp = peak / acceleration
    cruise = max(way / peak - ramp, 0.0)
    first = Segment(start, ramp, from_tilt, 0.0, sign * acceleration)
    segments = [first]
    if cruise > 0.0:
        segments.append(Segment(start + ramp, cruise, first.end_tilt, sign * peak, 0.0))
    last = segments[-1]
    segments.append(Segment(last.start + last.duration, ramp, last.end_tilt, sign * peak, -sign * acceleration))
    return segments


@dataclass(frozen=True)
class PourMotion:
    """A planned pour: tilt about a fixed horizontal pivot, hold, return.

    Attributes:
        segments: consecutive stretches of constant angular acceleration; at rest between and after them.
        phases: named parts.
        pivot_world: a point of the pivot line in the world [m].
        pivot_vessel: the same point in the pourer's frame [m].
        tilt_error: constant error of grip added to every tilt [rad].
    """

    segments: tuple[Segment, ...]
    phases: tuple[Phase, ...]
    pivot_world: tuple[float, float, float]
    pivot_vessel: tuple[float, float, float]
    tilt_error: float = 0.0

    @property
    def duration(self) -> float:
        """Duration [s]."""
        return self.phases[-1].end

    def tilt(self, times: FloatArray) -> FloatArray:
        """Tilt from upright, shape (T,) [rad]."""
        t = np.asarray(times, dtype=float)
        tilt = np.full(t.shape, self.segments[0].tilt if self.segments else 0.0)
        for s in self.segments:
            u = np.clip(t - s.start, 0.0, s.duration)
            tilt = np.where(t >= s.start, s.tilt + s.velocity * u + 0.5 * s.acceleration * u**2, tilt)
        return tilt + self.tilt_error

    def angular_velocity(self, times: FloatArray) -> FloatArray:
        """Rate of the tilt, shape (T,) [rad/s]."""
        t = np.asarray(times, dtype=float)
        rate = np.zeros(t.shape)
        for s in self.segments:
            inside = (t >= s.start) & (t < s.start + s.duration)
            rate = np.where(inside, s.velocity + s.acceleration * (t - s.start), rate)
        return rate

    def sample(self, times: FloatArray) -> FloatArray:
        """Poses of the pourer's frame in the world, shape (T, 7): x y z [m], qw qx qy qz."""
        return _poses(self.tilt(times), self.pivot_world, self.pivot_vessel)


def _poses(
    tilt: FloatArray, pivot_world: tuple[float, float, float], pivot_vessel: tuple[float, float, float]
) -> FloatArray:
    """Poses of a pourer that is turned about a pivot, see `PourMotion.sample`."""
    cos, sin = np.cos(tilt), np.sin(tilt)
    px, py, pz = pivot_vessel
    wx, wy, wz = pivot_world
    poses = np.zeros((*tilt.shape, 7))
    poses[..., 0] = wx - (cos * px + sin * pz)
    poses[..., 1] = wy - py
    poses[..., 2] = wz - (-sin * px + cos * pz)
    poses[..., 3] = np.cos(0.5 * tilt)
    poses[..., 5] = np.sin(0.5 * tilt)
    return poses


def _pivot(
    scene: Scene, action: Action, pourer: Vessel, receiver: Vessel
) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
    """The pivot in the world and in the pourer's frame [m]."""
    lip = pourer.lip_point(0.0)
    vessel = np.array([lip[0], 0.0, lip[2]] if scene.pivot.kind == "lip" else [scene.pivot.x, 0.0, scene.pivot.z])
    start = np.array([-action.x_offset, action.y_offset, receiver.rim_height + action.height - lip[2]])
    world = start + vessel
    return (float(world[0]), float(world[1]), float(world[2])), (float(vessel[0]), float(vessel[1]), float(vessel[2]))


def recorded_motion(
    scene: Scene, action: Action, pourer: Vessel, receiver: Vessel, times: FloatArray, tilts: FloatArray
) -> SampledMotion:
    """The pourer's motion for a tilt that was recorded: a turn about the scene's pivot.

    Args:
        scene: its pivot.
        action: the placement.
        pourer, receiver: geometry of the scene's vessels.
        times: increasing; the motion starts at 0 (T,) [s].
        tilts: of the vessel, errors of grip included (T,) [rad].
    """
    poses = _poses(np.asarray(tilts, dtype=float), *_pivot(scene, action, pourer, receiver))
    return SampledMotion(np.asarray(times, dtype=float) - times[0], poses)


def plan_motion(
    scene: Scene,
    action: Action,
    pourer: Vessel,
    receiver: Vessel,
    *,
    tilt_error: float = 0.0,
    speed_factor: float = 1.0,
) -> PourMotion:
    """The pourer's motion for an action.

    Args:
        scene: its pivot, load and cap on the hold.
        action: complete action.
        pourer, receiver: geometry of the scene's vessels.
        tilt_error: constant error of grip [rad], for a virtual bench.
        speed_factor: executed over commanded speed, for a virtual bench.
    """
    world, vessel_pivot = _pivot(scene, action, pourer, receiver)
    segments = turn(0.0, 0.0, action.max_angle, action.angular_velocity * speed_factor, action.angular_acceleration)
    tilted = segments[-1].start + segments[-1].duration
    phases = [Phase("tilt", 0.0, tilted)]
    hold = action.hold_time
    if hold is None:
        tilting = PourMotion(tuple(segments), (phases[0],), world, vessel_pivot)
        end = predicted_end_of_flow(pourer, scene.liquid.volume, tilting.tilt, tilted + scene.max_hold_time)
        hold = min(max(end - tilted, 0.0), scene.max_hold_time)
    phases.append(Phase("hold", tilted, tilted + hold))
    if action.return_velocity is not None:
        back = turn(tilted + hold, action.max_angle, 0.0, action.return_velocity, action.angular_acceleration)
        segments += back
        phases.append(Phase("return", tilted + hold, back[-1].start + back[-1].duration))
    return PourMotion(tuple(segments), tuple(phases), world, vessel_pivot, tilt_error)
