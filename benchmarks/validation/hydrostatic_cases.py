"""Hydrostatic cases: liquid at rest in a cup, and the volume that a slowly tilted cup retains.

**At rest.** 200 mL in a straight cup of radius 40 mm stand 39.8 mm high. The height is twice that of the mass centre,
which averages over all particles and needs no definition of the surface. The density is computed from the Voronoi cells
of the inner particles, because the solver's own kernel sum would only confirm its own assumption.

**Slow tilt.** A cup that is tilted slowly retains the volume below the horizontal plane through its lip. The turn is
fast up to one degree before the liquid reaches the lip, while nothing can leave. From there on its speed is `SPEED`,
with a stop at every angle that is read. The liquid still lags: when a turn at 3 °/s stops, a real cup holds 6 to 8 % of
its brimful volume more than at rest. The last of it leaves slowly, since the flow over a lip falls with the head to the
power 5/2. Each stop lasts until the remaining outflow is half the tolerance by the tilting-cup equation with the
discharge coefficient of a sharp weir.

Particles' centres keep a distance from the walls and the lip is lowered for them (`sim_engine.fluid.walls`); their
reference is the true geometry.
"""

from __future__ import annotations

import math
import tempfile
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import ConvexHull, Voronoi

from sim_engine.hydrostatics import GRAVITY, level, retained_volume, tilting_cup_outflow
from sim_engine.liquids import SimulationParameters
from sim_engine.motion import Phase, PourMotion, Segment, turn
from sim_engine.outcome import ParticleState
from sim_engine.simulator import SETTLING, spacing
from sim_engine.vessel import profile
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import ProfileShape, VesselSpec, cylinder
from sim_engine.vessel.vessel import Vessel, build_vessel

from .case_result import Figure, Measurement, Series, at_most, within
from .container_runs import Container, filled, run

Floats = NDArray[np.float64]

RADIUS = 0.04
VOLUME = 200e-6
HEIGHT = VOLUME / (math.pi * RADIUS**2)
CUP = cylinder("cup", inner_radius=RADIUS, inner_height=0.10)

INNER = 2.0
"""Distance of an inner particle from walls and surface, in spacings: the kernel's support."""

WINDOW = np.arange(1.0, 1.201, 0.02)
"""Times over which evaluated values are averaged [s]."""


def mean_density(points: Floats, inner: NDArray[np.bool_], d: float) -> float:
    """ρ/ρ₀ of some of the particles: the volume of each, d³, over the mean volume of their Voronoi cells.

    Args:
        points: all of them, (N, 3) [m].
        inner: selected ones, (N,); their cells must be closed by neighbours.
        d: spacing [m].
    """
    cells = Voronoi(points)
    volumes = []
    for point in np.flatnonzero(inner):
        region = cells.regions[cells.point_region[point]]
        if -1 not in region:
            volumes.append(ConvexHull(cells.vertices[region]).volume)
    return d**3 / float(np.mean(volumes)) if volumes else math.nan


def at_rest(
    particles: int, parameters: SimulationParameters, seed: int = 1, mirrored: bool = False
) -> tuple[list[Measurement], Figure]:
    """Fill the cup, let it stand for a second, and measure for a fifth of a second.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        seed: of the initial positions.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    vessel = build_vessel(CUP)
    floor = vessel.inner_floor
    d = spacing(VOLUME, particles)
    start = filled(vessel, VOLUME, particles, seed, parameters, mirrored)
    early = np.arange(0.02, 1.0, 0.02)
    times = np.concatenate([early, WINDOW])
    energy, heights, densities = [], [], []
    for k, liquid in run(start, d, Container.of(vessel), parameters, times, mirrored=mirrored):
        energy.append(0.5 * float(np.mean(np.sum(liquid.velocities**2, axis=1))) / (GRAVITY * HEIGHT))
        if k < len(early):
            continue
        x = liquid.positions
        heights.append(2.0 * float(np.mean(x[:, 2] - floor)))
        if (k - len(early)) % 5 == 0:
            depth = x[:, 2] - floor
            inner = (np.hypot(x[:, 0], x[:, 1]) < RADIUS - INNER * d) & (depth > INNER * d)
            inner &= depth < HEIGHT - INNER * d
            densities.append(mean_density(x, inner, d))
    measurements = [
        within(
            "height of the surface",
            float(np.mean(heights)),
            HEIGHT,
            0.02 * HEIGHT,
            unit="m",
            criterion="within 2 %",
            particles=particles,
        ),
        within(
            "density inside, by Voronoi cells",
            float(np.mean(densities)),
            1.0,
            0.015,
            criterion="within 1.5 %",
            particles=particles,
        ),
        at_most(
            "kinetic energy per mass after 1 s, over g·H",
            float(np.mean(energy[len(early) :])),
            1e-4,
            criterion="below 0.0001",
            particles=particles,
        ),
    ]
    figure = Figure(
        titles=("Coming to rest",),
        x_labels=("time [s]",),
        y_labels=("log₁₀ of kinetic energy per mass over g·H",),
        series=(
            Series(f"{particles:,} particles", tuple(times.tolist()), tuple(np.log10(energy).tolist())),
            Series("limit", (1.0, float(times[-1])), (-4.0, -4.0), "reference"),
        ),
    )
    return measurements, figure


SLIM_RADIUS, SLIM_VOLUME = 0.027, 240e-6
SLIM_HEIGHT = SLIM_VOLUME / (math.pi * SLIM_RADIUS**2)
SLIM_CUP = cylinder("slim cup", inner_radius=SLIM_RADIUS, inner_height=0.115)


def tall_column(particles: int, parameters: SimulationParameters, mirrored: bool = False) -> list[Measurement]:
    """A slim, nearly full cup stands still for a second: it has many layers of particles, whose pressures add up.

    Args:
        particles: N.
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    vessel = build_vessel(SLIM_CUP)
    d = spacing(SLIM_VOLUME, particles)
    start = filled(vessel, SLIM_VOLUME, particles, 1, parameters, mirrored)
    heights, inside = [], np.ones(particles, bool)
    for _, liquid in run(start, d, Container.of(vessel), parameters, WINDOW, settling=SETTLING, mirrored=mirrored):
        inside = liquid.states == ParticleState.IN_POURER
        heights.append(2.0 * float(np.mean(liquid.positions[inside, 2]) - vessel.inner_floor))
    layers = f"{SLIM_HEIGHT / d:.0f} layers"
    return [
        within(
            f"still in the cup after a second, {layers}",
            float(inside.mean()),
            1.0,
            0.0,
            criterion="all of it",
            particles=particles,
        ),
        within(
            f"height of the surface, {layers}",
            float(np.mean(heights)),
            SLIM_HEIGHT,
            0.02 * SLIM_HEIGHT,
            unit="m",
            criterion="within 2 %",
            particles=particles,
        ),
    ]


ANGLES = tuple(math.radians(a) for a in (60.0, 70.0, 80.0))
SPEED = math.radians(3.0)
"""Speed of the turn from the angle at which liquid can leave [rad/s]."""
APPROACH = math.radians(30.0)
"""Speed of the turn before [rad/s]."""
BEFORE = math.radians(1.0)
READING = 0.3
"""Time over which the retained volume is averaged [s]."""
LONGEST_REST = 15.0
"""Longest stop at one angle [s]."""
TOLERANCE = 0.02
"""Largest error, as a fraction of the brimful volume."""

LIP_HEIGHT = 0.3
"""Height of the pivot above the world's origin; spilled liquid is removed well below the cup [m]."""


def straight_cup() -> Vessel:
    """A cylinder, 503 mL."""
    return build_vessel(cylinder("cylinder", inner_radius=0.04, inner_height=0.10))


def conical_cup() -> Vessel:
    """A cup that widens from 25 mm to 45 mm, 410 mL."""
    shape = ProfileShape(unit="m", inner=((0.0, 0.0), (0.025, 0.0), (0.045, 0.10)), wall=0.003, floor=0.004)
    return build_vessel(VesselSpec(name="cone", shape=shape))


def mesh_jug() -> Vessel:
    """An oval jug with a spout, from a mesh file: neither a surface of revolution nor a level rim."""
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
    """A motion that turns fast to just before the liquid reaches the lip, then slowly, with a stop at each angle.

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
    mirrored: bool = False,
) -> tuple[list[Measurement], list[Series]]:
    """Tilt a cup slowly and read its retained volume.

    Args:
        vessel: the cup.
        volume: of the load [m³]; it should spill before the first angle.
        particles: N.
        parameters: θ; its number of particles is replaced.
        angles: of the readings, increasing [rad].
        seeds: number of loads, with different initial positions, over which the result is averaged.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    from sim_engine.fluid.scene_setup import POSE_STEP

    d = spacing(volume, particles)
    motion, readings = slow_turn(vessel, volume, angles)
    poses = motion.sample(np.arange(0.0, motion.duration + 0.1, POSE_STEP))
    times = np.arange(0.02, motion.duration, 0.02)
    retained = np.zeros(len(times))
    bottom = LIP_HEIGHT - 2.0 * vessel.bounding_sphere[1]
    cup = Container.of(vessel)
    for seed in range(1, seeds + 1):
        start = filled(vessel, volume, particles, seed, parameters, mirrored) + poses[0, :3]  # upright at first
        for k, liquid in run(
            start, d, cup, parameters, times, poses=poses, settling=0.15, spill_level=bottom, mirrored=mirrored
        ):
            retained[k] += np.count_nonzero(liquid.states == ParticleState.IN_POURER) * d**3 / seeds
    measurements = []
    for angle, reading in zip(angles, readings, strict=True):
        now = (times >= reading) & (times <= reading + READING)
        measurements.append(
            within(
                f"kept by the {vessel.name} at {math.degrees(angle):.0f}°",
                float(np.mean(retained[now])),
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
            tuple((1e6 * retained[late]).tolist()),
        ),
        Series(
            f"{vessel.name}, at rest", tuple(np.degrees(shown).tolist()), tuple((1e6 * exact).tolist()), "reference"
        ),
    ]
    return measurements, curves


def retention_figure(curves: list[Series]) -> Figure:
    """Curves of all cups in one figure."""
    return Figure(("Slow-tilt retention",), ("tilt [°]",), ("kept [mL]",), tuple(curves))
