"""Cases of cohesion as a surface tension, and of contact angles.

**Drops** without gravity: a cube of liquid becomes a sphere, and a stretched drop oscillates. The frequency is
Rayleigh's for the second mode of a free drop, ω² = 8σ / (ρR³), from which the tension follows. The time step is a tenth
of the capillary limit √(ρ d³ / (2π σ)) (Brackbill et al. 1992). Source: Rayleigh 1879; cube to sphere: Akinci et al.
2013.

**Puddles**: the height of a puddle at a contact angle θ. Its edge's pull σ(1 − cos θ) balances the pressure of its
weight, ½ρg e²: e = 2 √(σ/ρg) sin ½θ. Source: de Gennes, Brochard-Wyart and Quéré 2004, Capillarity and Wetting
Phenomena, section 2.2.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator

from .case_result import (
    CaseEffort,
    Figure,
    Measurement,
    Series,
    at_most,
    reported,
    within,
)
from .container_runs import DENSITY, EMPTY_SPACE, block, box, run, symmetric
from .sloshing import fit_oscillation

Floats = NDArray[np.float64]

RADIUS = 0.005
"""Radius of the drop, and of the sphere that has the cube's volume [m]."""
TENSION = 0.0728
"""Surface tension of water [N/m]."""
FREQUENCY = math.sqrt(8.0 * TENSION / (DENSITY * RADIUS**3)) / (2.0 * math.pi)
"""10.9 Hz."""
STRETCH = 1.15
"""Initial stretch along z; the other directions shrink by its inverse square root."""
WATCHED = 0.2
"""Observed time [s]."""
CAPILLARY = 0.1
"""Longest time step, relative to the capillary limit."""


def capillary_step(d: float, tension: float) -> float:
    """Longest time step for a spacing d [m] and a tension [N/m]: a tenth of the capillary limit [s]."""
    return CAPILLARY * math.sqrt(DENSITY * d**3 / (2.0 * math.pi * tension))


def _lattice(d: float, count: int, mirrored: bool) -> Floats:
    """A cube of count³ particles about the origin, slightly jittered, with an even number of layers along y if it is
    symmetric."""
    axis = (np.arange(count) - 0.5 * (count - 1)) * d
    along = axis + 0.5 * d * (count % 2) if mirrored else axis
    points = np.stack(np.meshgrid(axis, along, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    points += np.random.default_rng(1).uniform(-0.05, 0.05, points.shape) * d
    return symmetric(points, points[:, 1] > 0.0) if mirrored else points


def surface_radii(points: Floats, directions: int = 300) -> Floats:
    """Distance from the mass centre to the surface in evenly spread directions: that of the farthest particle near
    each.

    Args:
        points: (N, 3) [m].
        directions: number of directions.

    Returns:
        Shape (directions,) [m]; half a spacing short of the liquid's surface.
    """
    k = np.arange(directions) + 0.5
    polar, around = np.arccos(1.0 - 2.0 * k / directions), math.pi * (1.0 + math.sqrt(5.0)) * k
    ways = np.column_stack([np.cos(around) * np.sin(polar), np.sin(around) * np.sin(polar), np.cos(polar)])
    centred = points - points.mean(axis=0)
    radii = np.linalg.norm(centred, axis=1)
    cosines = (centred @ ways.T) / np.maximum(radii, 1e-12)[:, None]
    surface: Floats = np.where(cosines > math.cos(math.radians(15.0)), radii[:, None], 0.0).max(axis=0)
    return surface


def cube_to_sphere(particles: int, parameters: SimulationParameters, mirrored: bool = False) -> list[Measurement]:
    """Release a cube without gravity.

    Args:
        particles: N, approximately.
        parameters: θ; its tension is replaced by water's.
        mirrored: whether only the half y ≥ 0 is simulated.
    """
    volume = 4.0 / 3.0 * math.pi * RADIUS**3
    n = round(particles ** (1.0 / 3.0))
    d = volume ** (1.0 / 3.0) / n
    cube = _lattice(d, n, mirrored)
    theta = parameters.model_copy(update={"cohesion": TENSION})
    step = capillary_step(d, TENSION)
    times = np.array([0.5])
    ((_, drop),) = run(cube, d, EMPTY_SPACE, theta, times, gravity=0.0, longest_step=step, mirrored=mirrored)
    radii = surface_radii(drop.positions)
    return [
        at_most(
            "cube after 0.5 s: farthest from the mean radius, in spacings",
            float(np.max(np.abs(radii - radii.mean())) / d),
            1.0,
            criterion="at most one spacing (the cube: 1.7)",
            particles=len(cube),
        )
    ]


def oscillation(
    particles: int, parameters: SimulationParameters, mirrored: bool = False
) -> tuple[list[Measurement], list[Series], float]:
    """Release a stretched drop without gravity.

    Args:
        particles: N, approximately.
        parameters: θ; its tension is replaced by water's.
        mirrored: whether only the half y ≥ 0 is simulated.

    Returns:
        Measurements, curves and the tension that corresponds to the frequency [N/m].
    """
    d = (4.0 / 3.0 * math.pi * RADIUS**3 / particles) ** (1.0 / 3.0)
    lattice = _lattice(d, round(2.8 * RADIUS / d), mirrored)
    scale = np.array([STRETCH**-0.5, STRETCH**-0.5, STRETCH])
    drop = lattice[np.linalg.norm(lattice / scale, axis=1) < RADIUS]
    theta = parameters.model_copy(update={"cohesion": TENSION})
    times = np.arange(0.002, WATCHED, 0.002)
    stretch = np.empty(len(times))
    step = capillary_step(d, TENSION)
    for k, liquid in run(drop, d, EMPTY_SPACE, theta, times, gravity=0.0, longest_step=step, mirrored=mirrored):
        x = liquid.positions
        spread = np.mean((x - x.mean(axis=0)) ** 2, axis=0)
        stretch[k] = (spread[2] - 0.5 * (spread[0] + spread[1])) / spread.sum()
    # A drop that never passes the sphere creeps back without oscillation, so it has no frequency.
    frequency = decay = math.nan
    if stretch.min() < 0.0:
        frequency, decay = fit_oscillation(times - times[0], stretch, FREQUENCY)
    # a damped oscillator is slower than a free one
    free = math.hypot(frequency, decay / (2.0 * math.pi))
    tension = DENSITY * RADIUS**3 * (2.0 * math.pi * free) ** 2 / 8.0
    measurements = [
        within(
            "frequency of the drop",
            free,
            FREQUENCY,
            0.2 * FREQUENCY,
            unit="Hz",
            criterion="within 20 %",
            particles=len(drop),
        ),
        reported("tension that it means", tension, unit="N/m", reference=TENSION, particles=len(drop)),
        reported(
            "stretch that is left at the end, over the first",
            float(stretch[-1] / stretch[0]),
            reference=0.0,
            particles=len(drop),
        ),
    ]
    curve = Series(f"{len(drop):,} particles", tuple(times.tolist()), tuple(stretch.tolist()))
    return measurements, [curve], tension


def same_tension(tensions: dict[int, float]) -> Measurement:
    """Whether the coarsest and the finest drop have the same tension."""
    coarse, fine = min(tensions), max(tensions)
    name = f"tension over that at N = {coarse:,}"
    return within(name, tensions[fine] / tensions[coarse], 1.0, 0.2, criterion="within 20 %", particles=fine)


def droplet_figure(curves: list[Series]) -> Figure:
    """Curves of all resolutions and of the undamped oscillation."""
    t = np.linspace(0.0, WATCHED, 300)
    theory = curves[0].y[0] * np.cos(2.0 * math.pi * FREQUENCY * t)
    reference = Series("theory, undamped", tuple(t.tolist()), tuple(theory.tolist()), "reference")
    return Figure(("A stretched drop of 5 mm",), ("time [s]",), ("stretch along z",), (*curves, reference))


ABOUT = (
    "20 mL of water's tension, laid 4 mm high on a slippery plane, stand 2√(σ/ρg) sin ½θ high after 2 s. "
    "Coarser than the capillary length, 2.7 mm, there is one layer of particles, whatever the contact angle."
)
VOLUME, WATER_TENSION, LAID = 20e-6, 0.0728, 0.004
"""Volume of the puddle [m³], its tension [N/m], and its initial height [m]."""
VISCOSITY = 1e-4
"""Kinematic viscosity; it calms the puddle and does not affect its height [m²/s]."""


def height(angle: float) -> float:
    """Height of a wide puddle of this contact angle [rad] at rest [m]."""
    return 2.0 * math.sqrt(WATER_TENSION / (DENSITY * GRAVITY)) * math.sin(0.5 * angle)


def puddle(particles: int, angle: float, mirrored: bool = False) -> tuple[float, float, int]:
    """Height of a puddle after 2 s.

    Args:
        particles: N, approximately.
        angle: contact angle [rad].
        mirrored: whether only the half y ≥ 0 is simulated.

    Returns:
        Twice the height of the mass centre [m], spacing [m] and N.
    """
    side = math.sqrt(VOLUME / LAID)
    low, high = np.array([0.04, -side / 2.0, 0.0]), np.array([0.04 + side, side / 2.0, LAID])
    start, d = block(low, high, particles, 1, mirrored)
    plane = box(0.08 + side, 0.08 + side, 0.04, 0.5 * d)
    theta = SimulationParameters(cohesion=WATER_TENSION, xsph_rate=0.0)
    ((_, liquid),) = run(
        start, d, plane, theta, np.array([2.0]), viscosity=VISCOSITY, no_slip=False, contact_angle=angle,
        mirrored=mirrored,
    )  # fmt: skip
    return 2.0 * float(liquid.positions[:, 2].mean()), d, len(start)


def wetting(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Puddles of several contact angles."""
    angles = (60.0, 90.0, 120.0, 150.0) if effort.full else (60.0, 120.0)
    measurements: list[Measurement] = []
    curves: list[Series] = []
    for particles in effort.numbers((250, 2_000), (250, 2_000), coarse=1):
        values = []
        for degrees in angles:
            right = height(math.radians(degrees))
            value, d, n = puddle(particles, math.radians(degrees), effort.mirrored)
            values.append(1e3 * value)
            name = f"height at {degrees:g}°, d = {1e3 * d:.1f} mm"
            if d < 0.8 * right:
                measurements.append(
                    within(name, value, right, 0.2 * right, unit="m", criterion="within 20 %", particles=n)
                )
            else:
                measurements.append(reported(name, value, unit="m", reference=right, particles=n))
        curves.append(Series(f"{particles:,} particles", angles, tuple(values)))
    fine = np.linspace(0.0, 180.0, 60)
    theory = tuple(1e3 * height(math.radians(a)) for a in fine)
    curves.append(Series("theory", tuple(fine.tolist()), theory, "reference"))
    return measurements, Figure(("Puddles",), ("contact angle [°]",), ("height [mm]",), tuple(curves))
