"""Cases of viscous liquids on walls, and the solver's own viscosity.

- Exact references: the flow in a tube and between plates (Hagen 1839, Poiseuille 1846), and down an incline (Nusselt
  1916), where gravity and the wall's friction are in balance.
- A film that drains from a wall (Jeffreys 1930): e = √(νz/gt) below its upper edge.
- A puddle that spreads, of radius 0.894 (g V³ t / 3ν)^⅛ (Huppert 1982), once it is flat.
- The standard pour of thicker liquids, and the decay of vortices, which measures the solver's own viscosity.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquids import Liquid, SimulationParameters
from sim_engine.scene import PourTask, Scene
from sim_engine.simulator import PourSimulator
from sim_engine.vessel.distance_grid import SignedDistanceGrid
from sim_engine.vessel.shapes import cylinder

from . import capillarity as wetting
from .case_result import CaseEffort, Figure, Measurement, Series, collected, reported, within
from .container_runs import (
    MARGIN,
    Container,
    LiquidState,
    block,
    box,
    run,
    still_pose,
    stir,
    symmetric,
)
from .whole_pours import simulated

Floats = NDArray[np.float64]
AnyFloats = NDArray[np.floating]

WALL = 0.005
"""Thickness of the tubes' walls [m]."""

SETTLING = 0.02
"""Time in which a lattice loses its excess density without gaining velocity [s]: a lattice that expands in flight
throws films off their walls."""


def tube(radius: float, top: float, bottom: float, spacing: float) -> Container:
    """A straight tube along z, open at both ends.

    Args:
        radius: inside [m].
        top, bottom: its ends [m].
        spacing: of the grid [m].
    """
    half = int(np.ceil((radius + WALL + MARGIN) / spacing))
    across = spacing * np.arange(-half, half + 1)
    return _open_channel(radius, across, across, np.hypot(across[:, None], across[None, :]), top, bottom, spacing)


def slot(half_gap: float, width: float, top: float, bottom: float, spacing: float) -> Container:
    """Two vertical plates that face each other at x = ±half_gap, open at both ends and at the sides.

    Args:
        half_gap: half the distance of the plates [m].
        width: along y, in which the plates do not end [m].
        top, bottom: their ends [m].
        spacing: of the grid [m].
    """
    half = int(np.ceil((half_gap + WALL + MARGIN) / spacing))
    x = spacing * np.arange(-half, half + 1)
    wide = int(np.ceil((width / 2.0 + MARGIN) / spacing))
    y = spacing * np.arange(-wide, wide + 1)
    from_middle = np.broadcast_to(np.abs(x)[:, None], (len(x), len(y)))
    return _open_channel(half_gap, x, y, from_middle, top, bottom, spacing)


def _open_channel(
    inside: float, x: AnyFloats, y: AnyFloats, from_axis: AnyFloats, top: float, bottom: float, spacing: float
) -> Container:
    """A vertical channel with a wall between the distances `inside` and `inside` + `WALL` of its axis or middle."""
    z = np.arange(bottom - MARGIN, top + MARGIN + spacing, spacing)
    r = from_axis[:, :, None]
    aside = np.abs(r - inside - 0.5 * WALL) - 0.5 * WALL
    ends = np.maximum(z - top, bottom - z)[None, None, :]
    outside = np.hypot(np.maximum(aside, 0.0), np.maximum(ends, 0.0))
    values = np.asarray(outside + np.minimum(np.maximum(aside, ends), 0.0), dtype=np.float32)
    cavity = np.asarray((r < inside + 0.5 * WALL) & (z > bottom) & (z < top), dtype=np.uint8)
    grid = SignedDistanceGrid(np.array([x[0], y[0], z[0]]), spacing, values, (cavity & (values > 0.0)).astype(np.uint8))
    everywhere = np.ones(values.shape, dtype=np.uint8)
    return Container(grid, np.ascontiguousarray(cavity), WALL, open=everywhere)


def ring(
    inner: float, outer: float, low: float, high: float, d: float, mirrored: bool = False, seed: int = 1
) -> Floats:
    """A jittered lattice in the space between two cylinders.

    Args:
        inner, outer: radii of the space that the liquid fills [m].
        low, high: heights [m].
        d: spacing [m].
        mirrored: whether it is symmetric about y = 0.
        seed: of the jitter.

    Returns:
        Positions (N, 3) [m], half a spacing inside.
    """
    points = []
    layers = max(round((outer - inner) / d), 1)
    levels = max(round((high - low) / d), 1)
    for layer in range(layers):
        r = outer - (layer + 0.5) * (outer - inner) / layers
        many = max(round(2.0 * math.pi * r * (outer - inner) / layers * (high - low) / levels / d**3), 1)
        for level in range(levels):
            angle = 2.0 * math.pi * (np.arange(many) + 0.5 * (level % 2)) / many
            height = np.full(many, low + (level + 0.5) * (high - low) / levels)
            points.append(np.column_stack([r * np.cos(angle), r * np.sin(angle), height]))
    positions = np.concatenate(points)
    positions += np.random.default_rng(seed).uniform(-0.05, 0.05, positions.shape) * d
    return symmetric(positions, positions[:, 1] > 0.0) if mirrored else positions


def down_a_tube(
    layers: int, viscosity: float, parameters: SimulationParameters, mirrored: bool = False, radius: float = 0.015
) -> tuple[list[Measurement], list[Series]]:
    """A plug of liquid falls in a vertical tube that is open at both ends.

    Args:
        layers: spacings in the radius.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is ignored.
        mirrored: whether only the half y ≥ 0 is simulated.
        radius: of the tube [m].
    """
    length, mean = 8.0 * radius, GRAVITY * radius**2 / (8.0 * viscosity)
    d, times, bottom = radius / layers, *_when_steady(0.6, radius, viscosity, mean)
    return _fall(
        f"{layers} spacings in the radius, ν = {_mm2(viscosity)}",
        ring(0.0, radius, 0.0, length, d, mirrored),
        radius,
        d,
        run_in=lambda start: run(start, d, tube(radius, length + 0.05, bottom, 0.4 * d), parameters, times,
                                 viscosity=viscosity, settling=SETTLING, mirrored=mirrored),
        from_middle=lambda x: np.hypot(x[:, 0], x[:, 1]),
        chosen=lambda x: np.abs(x[:, 2] - np.median(x[:, 2])) < radius,
        mean=mean,
        fastest=2.0,
    )  # fmt: skip


def down_a_slot(
    layers: int, viscosity: float, parameters: SimulationParameters, mirrored: bool = False, half_gap: float = 0.010
) -> tuple[list[Measurement], list[Series]]:
    """A slab of liquid falls between two vertical plates, open at both ends and at the sides.

    Args:
        layers: spacings in half the gap.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is ignored.
        mirrored: whether only the half y ≥ 0 is simulated.
        half_gap: half the distance of the plates [m].
    """
    length, width, mean = 10.0 * half_gap, 8.0 * half_gap, GRAVITY * half_gap**2 / (3.0 * viscosity)
    times, bottom = _when_steady(1.5, half_gap, viscosity, mean)
    low, high = np.array([-half_gap, -width / 2.0, 0.0]), np.array([half_gap, width / 2.0, length])
    start, d = block(low, high, 160 * layers**3, 1, mirrored)
    return _fall(
        f"{layers} spacings in half the gap, ν = {_mm2(viscosity)}",
        start,
        half_gap,
        d,
        run_in=lambda start: run(start, d, slot(half_gap, 1.5 * width, length + 0.05, bottom, 0.4 * d), parameters,
                                 times, viscosity=viscosity, settling=SETTLING, mirrored=mirrored),
        from_middle=lambda x: np.abs(x[:, 0]),
        chosen=lambda x: (np.abs(x[:, 2] - np.median(x[:, 2])) < length / 6.0) & (np.abs(x[:, 1]) < width / 4.0),
        mean=mean,
        fastest=1.5,
    )  # fmt: skip


def _when_steady(settled: float, half: float, viscosity: float, mean: float) -> tuple[Floats, float]:
    """Times at which a fall is measured, from `settled` half²/ν on [s], and the bottom that it does not reach [m]."""
    times = settled * half**2 / viscosity + np.linspace(0.0, 0.3 * half / mean + 0.02, 8)
    return times, -1.5 * mean * float(times[-1]) - 0.05


def _fall(
    name: str,
    start: Floats,
    half: float,
    d: float,
    *,
    run_in: Callable[[Floats], Iterable[tuple[int, LiquidState]]],
    from_middle: Callable[[Floats], Floats],
    chosen: Callable[[Floats], NDArray[np.bool_]],
    mean: float,
    fastest: float,
) -> tuple[list[Measurement], list[Series]]:
    """Compare the velocity of liquid that falls in a vertical channel with Poiseuille's.

    Args:
        name: of the case.
        start: particles (N, 3) [m].
        half: distance of the wall from the channel's axis or middle [m].
        d: spacing [m].
        run_in: runs the channel, and stops at the times of measurement.
        from_middle: distances of particles (N, 3) from the axis or middle (N,) [m].
        chosen: which particles (N, 3) are measured.
        mean: the mean velocity by theory [m/s].
        fastest: velocity in the middle over the mean.
    """
    places, speeds = [], []
    for _, liquid in run_in(start):
        measured = chosen(liquid.positions)
        places.append(from_middle(liquid.positions[measured]))
        speeds.append(-liquid.velocities[measured, 2])
    r, u = np.concatenate(places), np.concatenate(speeds)
    velocity = within(f"mean velocity, {name}", float(u.mean()), mean, 0.10 * mean, unit="m/s", criterion="within 10 %",
                   particles=len(start))  # fmt: skip
    bins = (np.arange(round(half / d)) + 0.5) * d
    profile = [float(u[np.abs(r - b) < 0.5 * d].mean()) / mean for b in bins]
    fine = np.linspace(0.0, 1.0, 40)
    return [velocity], [
        Series(f"{round(half / d)} spacings", tuple((bins / half).tolist()), tuple(profile)),
        Series("Poiseuille", tuple(fine.tolist()), tuple((fastest * (1.0 - fine**2)).tolist()), "reference"),
    ]


INCLINE = math.radians(20.0)


def down_an_incline(
    layers: int, viscosity: float, parameters: SimulationParameters, mirrored: bool = False, thickness: float = 0.01
) -> tuple[list[Measurement], list[Series]]:
    """A film on a plane of 20°, measured in its middle, away from its edges and from the channel's sides.

    Args:
        layers: spacings in the film.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is ignored.
        mirrored: whether only the half y ≥ 0 is simulated.
        thickness: of the film [m].
    """
    d = thickness / layers
    pull = GRAVITY * math.sin(INCLINE)
    mean = pull * thickness**2 / (3.0 * viscosity)
    settled = 0.8 * thickness**2 / viscosity
    times = settled + np.linspace(0.0, 0.02, 5)
    length, width = 12.0 * thickness, 8.0 * thickness
    local, _ = block(
        np.array([0.03, -width / 2.0, 0.0]), np.array([0.03 + length, width / 2.0, thickness]),
        round(length * width * thickness / d**3), 1, mirrored,
    )  # fmt: skip
    channel = box(length + 0.06 + 3.0 * mean * float(times[-1]), width, 3.0 * thickness, 0.5 * d)
    cosine, sine = math.cos(INCLINE), math.sin(INCLINE)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    poses = still_pose(float(times[-1]))
    poses[:, 3], poses[:, 5] = math.cos(INCLINE / 2.0), math.sin(INCLINE / 2.0)
    heights, speeds, deep = [], [], []
    for _, liquid in run(
        local @ turn.T, d, channel, parameters, times, poses=poses, viscosity=viscosity, settling=SETTLING,
        mirrored=mirrored,
    ):  # fmt: skip
        x, v = liquid.positions @ turn, liquid.velocities @ turn
        middle = (np.abs(x[:, 0] - np.median(x[:, 0])) < 2.0 * thickness) & (np.abs(x[:, 1]) < width / 4.0)
        heights.append(x[middle, 2])
        speeds.append(v[middle, 0])
        deep.append(middle.sum() * d**3 / (4.0 * thickness * width / 2.0))
    z, u = np.concatenate(heights), np.concatenate(speeds)
    e = float(np.mean(deep))
    wanted = pull * e**2 / (3.0 * viscosity)
    measurement = within(
        f"mean velocity of a film of {layers} spacings, ν = {_mm2(viscosity)}",
        float(u.mean()),
        wanted,
        0.10 * wanted,
        unit="m/s",
        criterion="within 10 %",
        particles=len(local),
    )
    bins = (np.arange(layers) + 0.5) * d
    profile = [float(u[np.abs(z - b) < 0.5 * d].mean()) / wanted if np.any(np.abs(z - b) < 0.5 * d) else math.nan
               for b in bins]  # fmt: skip
    fine = np.linspace(0.0, 1.0, 40)
    return [measurement], [
        Series(f"{layers} spacings", tuple((bins / e).tolist()), tuple(profile)),
        Series("Nusselt", tuple(fine.tolist()), tuple((3.0 * (fine - fine**2 / 2.0)).tolist()), "reference"),
    ]


def left_on_a_wall(
    layers: int,
    viscosity: float,
    parameters: SimulationParameters,
    mirrored: bool = False,
    *,
    height: float = 0.1,
    radius: float = 0.03,
) -> tuple[list[Measurement], list[Series]]:
    """A film inside a vertical tube drains.

    Args:
        layers: initial spacings in the film.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is ignored.
        mirrored: whether only the half y ≥ 0 is simulated.
        height, radius: of the tube [m].
    """
    first = 0.008
    d = first / layers
    times = np.linspace(0.05, 3.0, 30) * viscosity * height / (GRAVITY * first**2) * 9.0
    start = ring(radius - first, radius, 0.0, height, d, mirrored)
    pipe = tube(radius, height + 0.01, 0.0, 0.4 * d)
    left = []
    for _, liquid in run(
        start, d, pipe, parameters, times, viscosity=viscosity, spill_level=-0.02, settling=SETTLING, mirrored=mirrored
    ):
        left.append(float(np.mean(liquid.positions[:, 2] > 0.0)))
    wanted = [jeffreys(float(t), first, height, radius, viscosity) for t in times]
    far = [abs(a - b) for a, b in zip(left, wanted, strict=True)]
    thin = math.sqrt(viscosity * height / (GRAVITY * float(times[-1])))
    return [
        within(
            f"largest distance of the rest on the wall, a film of {layers} spacings, ν = {_mm2(viscosity)}",
            max(far),
            0.0,
            0.05,
            criterion="within 0.05 of the film at first",
            particles=len(start),
        ),
        reported(f"left at the end, where the film is {thin / d:.1f} spacings", left[-1], reference=wanted[-1],
                 particles=len(start)),
    ], [
        Series(f"ν = {_mm2(viscosity)}, {layers} spacings", tuple(times.tolist()), tuple(left)),
        Series(f"Jeffreys, ν = {_mm2(viscosity)}", tuple(times.tolist()), tuple(wanted), "reference"),
    ]  # fmt: skip


def jeffreys(time: float, first: float, height: float, radius: float, viscosity: float) -> float:
    """Remaining over initial volume of a film after a time: e = min(first, √(νz/gt)) at z below its upper edge."""
    z = (np.arange(2_000) + 0.5) / 2_000 * height
    e = np.minimum(first, np.sqrt(viscosity * z / (GRAVITY * time)))
    return float(np.sum(e * (2.0 * radius - e)) / (2_000 * first * (2.0 * radius - first)))


def spreading(
    particles: int, viscosity: float, parameters: SimulationParameters, mirrored: bool = False, volume: float = 250e-6
) -> tuple[list[Measurement], list[Series]]:
    """Release a cylinder of liquid on a plane: a viscous dam break.

    Args:
        particles: N.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is replaced.
        mirrored: whether only the half y ≥ 0 is simulated.
        volume: of the liquid [m³].
    """
    d = (volume / particles) ** (1.0 / 3.0)
    radius = (volume / math.pi) ** (1.0 / 3.0)
    start = ring(0.0, radius, 0.0, radius, d, mirrored)
    volume = len(start) * d**3
    plain = box(0.5, 0.5, 2.0 * radius, 0.002)
    times = np.linspace(0.05, 2.0, 40)
    at = np.array([0.25, 0.0, 0.0])
    radii = []
    for _, liquid in run(start + at, d, plain, parameters, times, viscosity=viscosity, mirrored=mirrored):
        x = liquid.positions - at
        r = np.sort(np.hypot(x[:, 0], x[:, 1]))
        # a puddle's profile (1 − r²/R²)^⅓ has the mean square of r at R²·3/7
        radii.append(math.sqrt(float(np.mean(r**2)) * 7.0 / 3.0))
    wanted = 0.894 * (GRAVITY * volume**3 * times / (3.0 * viscosity)) ** 0.125
    late = times > 0.5
    error = float(np.max(np.abs(np.array(radii)[late] / wanted[late] - 1.0)))
    power = float(np.polyfit(np.log(times[late]), np.log(np.array(radii)[late]), 1)[0])
    name = f"ν = {_mm2(viscosity)}"
    return [
        within(f"largest error of the radius from 0.5 s on, {name}", error, 0.0, 0.1, criterion="within 10 %",
               particles=len(start)),
        reported(f"power of time that the radius grows with, {name}", power, reference=0.125, particles=len(start)),
    ], [
        Series(f"{name}, {len(start):,} particles", tuple(times.tolist()), tuple(radii)),
        Series(f"Huppert, {name}", tuple(times.tolist()), tuple(wanted.tolist()), "reference"),
    ]  # fmt: skip


def _mm2(viscosity: float) -> str:
    """A kinematic viscosity as text; mm²/s are centistokes."""
    return f"{1e6 * viscosity:.0f} mm²/s"


THETA = SimulationParameters(cohesion=0.0, xsph_rate=0.0)

FLOOR = (
    "Taylor and Green's vortices in a tank with slippery walls die away as exp(−2νk²t). What is found above the "
    "given viscosity is the solver's own. The solver was tuned at 2,025 particles."
)
FILM = "A film of 10 mm, ν = 1,000 mm²/s, runs down a plane of 20°: mean velocity g sin α e²/3ν (Nusselt 1916)."
TUBE = (
    "A plug of ν = 2,000 mm²/s falls in a vertical tube of radius 15 mm, open at both ends: mean velocity gR²/8ν "
    "(Poiseuille). No pressure holds the particles together there, nor against the wall."
)
SLOT = (
    "A slab of ν = 2,000 mm²/s falls between two vertical plates 20 mm apart, open at both ends and at the sides: mean "
    "velocity g a²/3ν with half the gap a (Poiseuille), in the middle of the slab."
)
DRAINAGE = "A film of 8 mm, ν = 1,000 mm²/s, drains from a vertical wall of 100 mm: e = √(νz/gt) (Jeffreys 1930)."
PUDDLE = "250 mL are let go on a plane: the radius is 0.894 (gV³t/3ν)^⅛ once they are flat (Huppert 1982)."
CUP = (
    "The standard pour with 0.1 and 1 Pa s, at 1,000 kg/m³. Reference: the volume-of-fluid solver interFoam "
    "(OpenFOAM 1912), no-slip walls, cells of 2 mm (made with commit 46022671 by `benchmarks/grid_outflow.py`)."
)

SIDE, VOLUME = 0.07, 200e-6
"""Side [m] and volume [m³] of the tank in which the solver's own viscosity is measured."""


def own_viscosity(particles: int, viscosity: float, speed: float, mirrored: bool = False) -> tuple[float, float, int]:
    """Viscosity from the decay of four vortices side by side in a tank with slip walls.

    Taylor and Green's vortices: u = (sin kx cos ky, −cos kx sin ky) U, k = 2π/side, decay as exp(−2νk²t), for any U.

    Args:
        particles: N.
        viscosity: kinematic, of the liquid; 0: none [m²/s].
        speed: U [m/s].
        mirrored: whether only the half y ≥ 0 is simulated.

    Returns:
        Viscosity by the decay [m²/s], spacing [m] and N.
    """
    k = 2.0 * math.pi / SIDE
    depth = VOLUME / SIDE**2
    start, d = block(np.array([0.0, -SIDE / 2.0, 0.0]), np.array([SIDE, SIDE / 2.0, depth]), particles, 1, mirrored)
    tank = box(SIDE, SIDE, 2.0 * depth, 0.5 * d)
    lasts = min(0.8, 0.75 / ((max(viscosity, 3e-5) + 3e-5) * k**2))

    def vortices(x: Floats) -> Floats:
        a, b = k * x[:, 0], k * (x[:, 1] + SIDE / 2.0)
        return np.column_stack([np.sin(a) * np.cos(b), -np.cos(a) * np.sin(b), 0.0 * a])

    times = 0.3 + np.linspace(0.0, lasts, 21)
    measurements = []
    for step, liquid in run(start, d, tank, THETA, times, viscosity=viscosity, no_slip=False, mirrored=mirrored):
        w, v = vortices(liquid.positions), liquid.velocities
        if step == 0:
            stir(lambda x: speed * vortices(x))
            v = v + speed * w
        measurements.append(float((v * w).sum() / (w * w).sum()))
    left = np.array(measurements) / measurements[0]
    clear = left > 0.1
    rate = -float(np.polyfit(times[clear], np.log(left[clear]), 1)[0])
    return rate / (2.0 * k**2), d, len(start)


def floor(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Viscosity that the solver adds to that of a liquid, by spacing and speed."""
    speed = 0.2
    measurements: list[Measurement] = []
    curves: list[Series] = []
    given = (1e-5, 1e-4, 5e-4, 2e-3) if effort.full else (1e-4, 2e-3)
    for wanted in effort.numbers((2_000,), (2_000, 8_000)):
        values = []
        for nu in given:
            value, d, n = own_viscosity(wanted, nu, speed, effort.mirrored)
            values.append(value)
            measurements.append(
                reported(f"viscosity by decay at U = {speed:g} m/s, d = {1e3 * d:.1f} mm, given {1e6 * nu:.0f} mm²/s",
                         value, unit="m²/s", reference=nu, particles=n)
            )  # fmt: skip
        curves.append(Series(f"{n:,} particles", tuple(1e6 * nu for nu in given), tuple(1e6 * v for v in values)))
    curves.append(Series("given", tuple(1e6 * nu for nu in given), tuple(1e6 * nu for nu in given), "reference"))
    if effort.full:
        value, d, n = own_viscosity(2_000, 1e-4, 0.05, effort.mirrored)
        measurements.append(reported("the same at U = 0.05 m/s, given 100 mm²/s", value, unit="m²/s", reference=1e-4,
                              particles=n))  # fmt: skip
    thick = next(m for m in measurements if "given 2000" in m.name)
    measurements.append(within("what it adds to 2,000 mm²/s, over it", thick.value / 2e-3 - 1.0, 0.0, 0.2,
                        criterion="within 20 %", particles=thick.particles))  # fmt: skip
    return measurements, Figure(
        ("The solver's own viscosity",), ("given [mm²/s]",), ("by decay [mm²/s]",), tuple(curves), log_x=True
    )


def film(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Down an incline."""
    return _figure(
        [down_an_incline(n, 1e-3, THETA, effort.mirrored) for n in effort.numbers((4,), (2, 3, 4, 6), coarse=1)],
        ("Film on an incline", "height over the film's", "velocity over the mean's"),
    )


def tube_flow(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Down a tube."""
    return _figure(
        [down_a_tube(n, 2e-3, THETA, effort.mirrored) for n in effort.numbers((3,), (3, 5, 8), coarse=1)],
        ("Plug in a tube", "radius over the tube's", "velocity over the mean's"),
    )


def slot_flow(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Between two plates."""
    return _figure(
        [down_a_slot(n, 2e-3, THETA, effort.mirrored) for n in effort.numbers((3,), (2, 3, 5), coarse=1)],
        ("Slab between plates", "distance from the middle over half the gap", "velocity over the mean's"),
    )


def drainage(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """A film on a wall."""
    return _figure(
        [left_on_a_wall(n, 1e-3, THETA, effort.mirrored) for n in effort.numbers((2,), (2, 4))],
        ("What is left on a wall", "time [s]", "over the film at first"),
    )


def puddle(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """Spreading on a plane."""
    cases = ((2_000, 2e-3), (8_000, 2e-3), (2_000, 2e-4)) if effort.full else ((1_000, 2e-3),)
    return _figure([spreading(n, nu, THETA, effort.mirrored) for n, nu in cases], ("Puddle", "time [s]", "radius [m]"))


def _figure(
    runs: list[tuple[list[Measurement], list[Series]]], words: tuple[str, str, str]
) -> tuple[list[Measurement], Figure]:
    measurements, curves = collected(runs)
    title, x, y = words
    return measurements, Figure((title,), (x,), (y,), tuple(curves))


GRID: dict[float, tuple[float, ...]] = {
    1e-4: (0.996, 0.959, 0.864, 0.719, 0.552, 0.386, 0.240, 0.129),
    1e-3: (1.000, 0.995, 0.949, 0.856, 0.730, 0.595, 0.468, 0.359),
}
"""Fraction left in the pourer at `TIMES` by kinematic viscosity [m²/s]: interFoam on a grid of 2 mm, which is 20 cells
per radius; made with commit 46022671 by `benchmarks/grid_outflow.py`."""
PEER: dict[float, tuple[float, ...]] = {
    1e-4: (0.985, 0.922, 0.796, 0.632, 0.462, 0.296, 0.149, 0.043),
    1e-3: (0.987, 0.933, 0.822, 0.671, 0.501, 0.339, 0.195, 0.090),
}
"""The same by SPlisHSPlasH 2.19 (DFSPH, volume maps, viscosity of Weiler et al. 2018 in the liquid and on walls), 2,000
and 1,000 particles; made with commit 46022671 by `benchmarks/peer.py`. Its fractions for water are smaller by at most
0.015: 0.1 Pa s has almost no effect there."""
TIMES = (2.1, 2.3, 2.5, 2.7, 2.9, 3.1, 3.3, 3.5)
FAR = 0.05


def cup(simulator: PourSimulator, effort: CaseEffort) -> tuple[list[Measurement], Figure]:
    """The standard pour with increasingly viscous liquids."""
    measurements: list[Measurement] = []
    curves: list[Series] = []
    scene = Scene(
        "standard",
        cylinder("pourer", inner_radius=0.04, inner_height=0.1),
        cylinder("receiver", inner_radius=0.045, inner_height=0.09),
        Liquid(mass=0.2, density=1000.0, surface_tension=0.033),
    )
    action = Action(
        angular_velocity=30 * DEG, x_offset=0.080, height=0.110, max_angle=120 * DEG, angular_acceleration=None,
        hold_time=2.0, return_velocity=None,
    )  # fmt: skip
    for particles in effort.numbers((1_000,), (2_000, 5_000)):
        theta = SimulationParameters(particles=particles)
        for nu in (1e-4, 1e-3):
            liquid = scene.liquid.model_copy(update={"dynamic_viscosity": 1e3 * nu})
            task = PourTask(replace(scene, liquid=liquid), action, theta, 1)
            outcome = simulated(simulator, task, effort.mirrored).outcome
            left = 1.0 - np.interp(TIMES, outcome.curve_times, outcome.curve_poured)
            name = f"{nu * 1e3:g} Pa s"
            curves.append(Series(f"{name}, {particles:,} particles", TIMES, tuple(left.tolist())))
            far, peer = (float(np.max(np.abs(left - np.array(other[nu])))) for other in (GRID, PEER))
            measurements.append(
                within(f"largest difference of the rest from the grid's, {name}", far, 0.0, FAR,
                       criterion=f"within {FAR:g}", particles=particles)
            )  # fmt: skip
            measurements.append(reported(f"… from SPlisHSPlasH's, {name}", peer, particles=particles))
            measurements.append(reported(f"left at 3.1 s, {name}", float(left[TIMES.index(3.1)]), particles=particles))
    for solver, fractions in (("grid", GRID), ("SPlisHSPlasH", PEER)):
        curves += [Series(f"{solver}, {nu * 1e3:g} Pa s", TIMES, left, "reference") for nu, left in fractions.items()]
    return measurements, Figure(("Thick liquids leave a cup",), ("time [s]",), ("left in the pourer",), tuple(curves))


Work = Callable[[PourSimulator, CaseEffort], tuple[list[Measurement], Figure | None]]

CASES: tuple[tuple[str, str, str, Work], ...] = (
    ("floor", "The solver's own viscosity", FLOOR, floor),
    ("film", "Film on an incline", FILM, film),
    ("tube", "Tube", TUBE, tube_flow),
    ("slot", "Slot", SLOT, slot_flow),
    ("drainage", "Drainage of a wall film", DRAINAGE, drainage),
    ("puddle", "Viscous dam break", PUDDLE, puddle),
    ("wetting", "Contact angle", wetting.ABOUT, wetting.wetting),
    ("thick-outflow", "Outflow of thick liquids", CUP, cup),
)
"""Name, title, description, and the function that runs it."""
