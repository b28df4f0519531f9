"""Slow-tilt retention: a cup that is tilted slowly keeps what lies below the horizontal plane through its lip.

The turn begins fast, up to one degree before the liquid reaches the lip, where nothing can leave yet; from there on it
goes at `SPEED`, with a stop at every angle that is read. Even so the liquid lags: at 3 °/s a real cup still holds 6 to
8 % of its brimful volume more than at rest when the turn stops, and the last of it leaves slowly (the flow over a lip
falls with the head to the power 5/2). So each stop lasts until the tilting-cup equation, with the discharge coefficient
of a sharp weir, says that what is left to flow is half the tolerance.

Particles' centres stand off the walls and the lip is lowered for them (`sim_engine.fluid.walls`); the geometry that
they are compared with is the true one.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_engine.fill import fill, spacing
from sim_engine.hydrostatics import level, retained_volume, tilting_cup_outflow
from sim_engine.liquid import SimulationParameters
from sim_engine.motion import Phase, PourMotion, Segment, turn
from sim_engine.validation.result import Figure, Measurement, Series, within
from sim_engine.validation.stage import Container, run
from sim_engine.vessel import profile
from sim_engine.vessel.build import build_vessel
from sim_engine.vessel.spec import MeshShape, ProfileShape, VesselSpec, cylinder
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]

ANGLES = tuple(math.radians(a) for a in (60.0, 70.0, 80.0))
SPEED = math.radians(3.0)
"""From where liquid can leave on [rad/s]."""
APPROACH = math.radians(30.0)
"""Before that [rad/s]."""
BEFORE = math.radians(1.0)
READING = 0.3
"""What is kept is a mean over this time [s]."""
LONGEST_REST = 15.0
"""At one angle [s]."""
TOLERANCE = 0.02
"""Largest error, as a fraction of the brimful volume."""

LIP_HEIGHT = 0.3
"""Height of the pivot above the world's origin; spilled liquid is taken out well below the cup [m]."""


def straight_cup() -> Vessel:
    """A cylinder, 503 mL."""
    return build_vessel(cylinder("cylinder", inner_radius=0.04, inner_height=0.10))


def conical_cup() -> Vessel:
    """A cup that widens from 25 mm to 45 mm, 410 mL."""
    shape = ProfileShape(inner=((0.0, 0.0), (0.025, 0.0), (0.045, 0.10)), wall=0.003, floor=0.004)
    return build_vessel(VesselSpec(name="cone", shape=shape))


def mesh_jug() -> Vessel:
    """An oval jug with a spout, from a mesh file: no surface of revolution, no level rim."""
    import trimesh

    inner = np.array([(0.0, 0.004), (0.034, 0.004), (0.034, 0.06), (0.036, 0.09), (0.036, 0.10)])
    outer = np.array([(0.0, 0.0), (0.038, 0.0), (0.038, 0.06), (0.040, 0.09), (0.040, 0.10)])
    vertices, faces = profile.revolve(profile.solid_polygon(inner, outer), segments=96)
    x, y, z = vertices.T
    angle = np.arctan2(y, x)
    spout = np.clip((z - 0.06) / 0.04, 0.0, 1.0) ** 2 * np.exp(-((angle / 0.35) ** 2))
    radius = np.hypot(x, y)
    out = np.where(radius > 0.0, 0.008 * spout / np.maximum(radius, 1e-9), 0.0)
    jug = np.column_stack([1.2 * x * (1.0 + out), y * (1.0 + out), z])
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / "jug.stl"
        trimesh.Trimesh(jug, faces).export(path)
        return build_vessel(VesselSpec(name="jug", shape=MeshShape(path=path, unit="m")), use_cache=False)


def spill_angle(vessel: Vessel, volume: float) -> float:
    """Tilt at which the liquid's surface reaches the lip [rad]."""
    low, high = 0.0, math.pi / 2.0
    for _ in range(30):
        middle = (low + high) / 2.0
        low, high = (middle, high) if level(vessel, volume, middle) < 0.0 else (low, middle)
    return low


def slow_turn(vessel: Vessel, volume: float, angles: tuple[float, ...]) -> tuple[PourMotion, list[float]]:
    """Fast to just before the liquid reaches the lip, then slowly, with a stop at each angle.

    Returns:
        The motion, and the times at which the readings begin [s].
    """
    start = max(spill_angle(vessel, volume) - BEFORE, 0.0)
    segments: list[Segment] = turn(0.0, 0.0, start, APPROACH, None)
    clock, tilt, left, readings = segments[-1].duration, start, volume, []
    for angle in angles:
        slow = turn(clock, tilt, angle, SPEED, None)
        segments += slow
        way = slow[0].duration
        times = np.arange(0.0, way + LONGEST_REST, 0.02)
        tilts = np.minimum(tilt + SPEED * times, angle)
        still_in = left - tilting_cup_outflow(vessel, left, times, tilts)
        enough = retained_volume(vessel, angle) + TOLERANCE / 2.0 * vessel.capacity
        drained = np.flatnonzero((still_in <= enough) & (times >= way))
        rest = float(times[drained[0]] - way) if len(drained) else LONGEST_REST
        readings.append(clock + way + rest)
        left = float(np.interp(way + rest + READING, times, still_in))
        clock, tilt = clock + way + rest + READING, angle
    lip = vessel.lip_point(0.0)
    pivot = (float(lip[0]), 0.0, float(lip[2]))
    return PourMotion(tuple(segments), (Phase("tilt", 0.0, clock),), (0.0, 0.0, LIP_HEIGHT), pivot), readings


def slow_tilt(
    vessel: Vessel,
    volume: float,
    particles: int,
    parameters: SimulationParameters,
    angles: tuple[float, ...] = ANGLES,
    seeds: int = 1,
) -> tuple[list[Measurement], list[Series]]:
    """Tilt a cup slowly and read what it keeps.

    Args:
        vessel: the cup.
        volume: of the load [m³]; it should spill before the first angle.
        particles: N.
        parameters: θ; its number of particles is replaced.
        angles: at which to read, increasing [rad].
        seeds: means over so many loads, from other initial positions each.
    """
    from sim_engine.fluid.engine import engine
    from sim_engine.fluid.setup import POSE_STEP
    from sim_engine.outcome import ParticleState

    d = spacing(volume, particles)
    motion, readings = slow_turn(vessel, volume, angles)
    poses = motion.sample(np.arange(0.0, motion.duration + 0.1, POSE_STEP))
    times = np.arange(0.02, motion.duration, 0.02)
    kept = np.zeros(len(times))
    bottom = LIP_HEIGHT - 2.0 * vessel.bounding_sphere[1]
    cup = Container.of(vessel)
    for seed in range(1, seeds + 1):
        local = fill(vessel, volume, particles, seed, parameters.wall_distance).astype(float)
        start = local + poses[0, :3]  # upright at first
        for k in run(start, d, cup, parameters, times, poses=poses, settling=0.15, spill_level=bottom):
            kept[k] += engine().census()[ParticleState.IN_POURER] * d**3 / seeds
    measurements = []
    for angle, reading in zip(angles, readings, strict=True):
        now = (times >= reading) & (times <= reading + READING)
        measurements.append(
            within(
                f"kept by the {vessel.name} at {math.degrees(angle):.0f}°",
                float(np.mean(kept[now])),
                retained_volume(vessel, angle),
                TOLERANCE * vessel.capacity,
                unit="m³",
                criterion=f"within 2 % of the brimful {1e6 * vessel.capacity:.0f} mL",
                particles=particles,
            )
        )
    tilts = motion.tilt(times)
    late = tilts > spill_angle(vessel, volume) - BEFORE
    shown = np.linspace(spill_angle(vessel, volume), float(tilts[-1]), 40)
    exact = np.array([min(retained_volume(vessel, float(a)), volume) for a in shown])
    curves = [
        Series(
            f"{vessel.name}, {particles:,} particles",
            tuple(np.degrees(tilts[late]).tolist()),
            tuple((1e6 * kept[late]).tolist()),
        ),
        Series(
            f"{vessel.name}, at rest", tuple(np.degrees(shown).tolist()), tuple((1e6 * exact).tolist()), "reference"
        ),
    ]
    return measurements, curves


def retention_figure(curves: list[Series]) -> Figure:
    """All cups in one picture."""
    return Figure(("Slow-tilt retention",), ("tilt [°]",), ("kept [mL]",), tuple(curves))
