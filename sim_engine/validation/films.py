"""Viscous liquids on walls: down a tube, down an incline, as a film that drains, as a puddle that spreads.

What is exact about them: the flow in a tube (Hagen 1839, Poiseuille 1846) and down an incline (Nusselt 1916), where
gravity and the wall's friction are in balance; the film that is left on a wall (Jeffreys 1930), e = √(νz/gt) below its
upper edge; the radius of a puddle, .894 (g V³ t / 3ν)^⅛ (Huppert 1982), once it is flat.
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquid import SimulationParameters
from sim_engine.validation.result import Measurement, Series, reported, within
from sim_engine.validation.stage import Container, run, still_pose
from sim_engine.validation.tanks import MARGIN, block, box
from sim_engine.vessel.sdf import SignedDistanceGrid

Floats = NDArray[np.float64]

WALL = 0.005
"""Thickness of the tubes' walls [m]."""


def tube(radius: float, top: float, bottom: float, spacing: float) -> Container:
    """A straight tube along z, open at both ends.

    Args:
        radius: inside [m].
        top, bottom: its ends [m].
        spacing: of the grid [m].
    """
    half = int(np.ceil((radius + WALL + MARGIN) / spacing))
    across = spacing * np.arange(-half, half + 1)
    z = np.arange(bottom - MARGIN, top + MARGIN + spacing, spacing)
    r = np.hypot(across[:, None], across[None, :])[:, :, None]
    aside = np.abs(r - radius - 0.5 * WALL) - 0.5 * WALL
    ends = np.maximum(z - top, bottom - z)[None, None, :]
    outside = np.hypot(np.maximum(aside, 0.0), np.maximum(ends, 0.0))
    values = np.asarray(outside + np.minimum(np.maximum(aside, ends), 0.0), dtype=np.float32)
    inside = np.asarray((r < radius + 0.5 * WALL) & (z > bottom) & (z < top), dtype=np.uint8)
    grid = SignedDistanceGrid(
        np.array([across[0], across[0], z[0]]), spacing, values, (inside & (values > 0.0)).astype(np.uint8)
    )
    everywhere = np.ones(values.shape, dtype=np.uint8)
    return Container(grid, np.ascontiguousarray(inside), WALL, open=everywhere)


def ring(inner: float, outer: float, low: float, high: float, d: float, seed: int = 1) -> Floats:
    """A jittered lattice in the space between two cylinders.

    Args:
        inner, outer: radii of the space that the liquid fills [m].
        low, high: heights [m].
        d: spacing [m].
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
    found = np.concatenate(points)
    return np.asarray(found + np.random.default_rng(seed).uniform(-0.05, 0.05, found.shape) * d)


def down_a_tube(
    layers: int, viscosity: float, parameters: SimulationParameters, radius: float = 0.015
) -> tuple[list[Measurement], list[Series]]:
    """A plug of liquid falls in a vertical tube that is open at both ends.

    Args:
        layers: spacings in the radius.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is not looked at.
        radius: of the tube [m].
    """
    from sim_engine.fluid.engine import engine

    d = radius / layers
    length = 8.0 * radius
    mean = GRAVITY * radius**2 / (8.0 * viscosity)
    settled = 0.6 * radius**2 / viscosity
    times = settled + np.linspace(0.0, 0.3 * radius / mean + 0.02, 8)
    start = ring(0.0, radius, 0.0, length, d)
    pipe = tube(radius, length + 0.05, -1.5 * mean * float(times[-1]) - 0.05, 0.4 * d)
    places, speeds = [], []
    for _ in run(start, d, pipe, parameters, times, viscosity=viscosity):
        x, v = engine().particles()[0].astype(float), engine().velocities().astype(float)
        middle = np.abs(x[:, 2] - np.median(x[:, 2])) < radius
        places.append(np.hypot(x[middle, 0], x[middle, 1]))
        speeds.append(-v[middle, 2])
    r, u = np.concatenate(places), np.concatenate(speeds)
    found = within(
        f"mean velocity, {layers} spacings in the radius, ν = {_mm2(viscosity)}",
        float(u.mean()),
        mean,
        0.10 * mean,
        unit="m/s",
        criterion="within 10 %",
        particles=len(start),
    )
    bins = (np.arange(layers) + 0.5) * d
    profile = [float(u[np.abs(r - b) < 0.5 * d].mean()) / mean for b in bins]
    name = f"{layers} spacings"
    fine = np.linspace(0.0, 1.0, 40)
    return [found], [
        Series(name, tuple((bins / radius).tolist()), tuple(profile)),
        Series("Poiseuille", tuple(fine.tolist()), tuple((2.0 * (1.0 - fine**2)).tolist()), "reference"),
    ]


INCLINE = math.radians(20.0)


def down_an_incline(
    layers: int, viscosity: float, parameters: SimulationParameters, thickness: float = 0.01
) -> tuple[list[Measurement], list[Series]]:
    """A film on a plane of 20°; looked at in the middle of it, away from its edges and from the channel's sides.

    Args:
        layers: spacings in the film.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is not looked at.
        thickness: of the film [m].
    """
    from sim_engine.fluid.engine import engine

    d = thickness / layers
    pull = GRAVITY * math.sin(INCLINE)
    mean = pull * thickness**2 / (3.0 * viscosity)
    settled = 0.8 * thickness**2 / viscosity
    times = settled + np.linspace(0.0, 0.02, 5)
    length, width = 12.0 * thickness, 8.0 * thickness
    local, _ = block(
        np.array([0.03, -width / 2.0, 0.0]), np.array([0.03 + length, width / 2.0, thickness]),
        round(length * width * thickness / d**3), 1,
    )  # fmt: skip
    channel = box(length + 0.06 + 3.0 * mean * float(times[-1]), width, 3.0 * thickness, 0.5 * d)
    cosine, sine = math.cos(INCLINE), math.sin(INCLINE)
    turn = np.array([[cosine, 0.0, sine], [0.0, 1.0, 0.0], [-sine, 0.0, cosine]])
    poses = still_pose(float(times[-1]))
    poses[:, 3], poses[:, 5] = math.cos(INCLINE / 2.0), math.sin(INCLINE / 2.0)
    heights, speeds, deep = [], [], []
    for _ in run(local @ turn.T, d, channel, parameters, times, poses=poses, viscosity=viscosity):
        x = engine().particles()[0].astype(float) @ turn
        v = engine().velocities().astype(float) @ turn
        middle = (np.abs(x[:, 0] - np.median(x[:, 0])) < 2.0 * thickness) & (np.abs(x[:, 1]) < width / 4.0)
        heights.append(x[middle, 2])
        speeds.append(v[middle, 0])
        deep.append(middle.sum() * d**3 / (4.0 * thickness * width / 2.0))
    z, u = np.concatenate(heights), np.concatenate(speeds)
    e = float(np.mean(deep))
    wanted = pull * e**2 / (3.0 * viscosity)
    found = within(
        f"mean velocity of a film of {layers} spacings, ν = {_mm2(viscosity)}",
        float(u.mean()),
        wanted,
        0.15 * wanted,
        unit="m/s",
        criterion="within 15 %",
        particles=len(local),
    )
    bins = (np.arange(layers) + 0.5) * d
    profile = [float(u[np.abs(z - b) < 0.5 * d].mean()) / wanted if np.any(np.abs(z - b) < 0.5 * d) else math.nan
               for b in bins]  # fmt: skip
    fine = np.linspace(0.0, 1.0, 40)
    return [found], [
        Series(f"{layers} spacings", tuple((bins / e).tolist()), tuple(profile)),
        Series("Nusselt", tuple(fine.tolist()), tuple((3.0 * (fine - fine**2 / 2.0)).tolist()), "reference"),
    ]


def left_on_a_wall(
    layers: int, viscosity: float, parameters: SimulationParameters, *, height: float = 0.1, radius: float = 0.03
) -> tuple[list[Measurement], list[Series]]:
    """A film inside a vertical tube drains.

    Args:
        layers: spacings in the film at first.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is not looked at.
        height, radius: of the tube [m].
    """
    from sim_engine.fluid.engine import engine

    first = 0.008
    d = first / layers
    times = np.linspace(0.05, 3.0, 30) * viscosity * height / (GRAVITY * first**2) * 9.0
    start = ring(radius - first, radius, 0.0, height, d)
    pipe = tube(radius, height + 0.01, 0.0, 0.4 * d)
    left = []
    for _ in run(start, d, pipe, parameters, times, viscosity=viscosity, spill_level=-0.02):
        x = engine().particles()[0].astype(float)
        left.append(float(np.mean(x[:, 2] > 0.0)))
    wanted = [jeffreys(float(t), first, height, radius, viscosity) for t in times]
    far = [abs(a - b) for a, b in zip(left, wanted, strict=True)]
    thin = math.sqrt(viscosity * height / (GRAVITY * float(times[-1])))
    return [
        within(
            f"largest distance of what is left on the wall, a film of {layers} spacings, ν = {_mm2(viscosity)}",
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
        Series(f"ν = {_mm2(viscosity)}", tuple(times.tolist()), tuple(wanted), "reference"),
    ]  # fmt: skip


def jeffreys(time: float, first: float, height: float, radius: float, viscosity: float) -> float:
    """What is left of a film after a time, over what it was: e = min(first, √(νz/gt)) at z below its upper edge."""
    z = (np.arange(2_000) + 0.5) / 2_000 * height
    e = np.minimum(first, np.sqrt(viscosity * z / (GRAVITY * time)))
    return float(np.sum(e * (2.0 * radius - e)) / (2_000 * first * (2.0 * radius - first)))


def spreading(
    particles: int, viscosity: float, parameters: SimulationParameters, volume: float = 250e-6
) -> tuple[list[Measurement], list[Series]]:
    """A cylinder of liquid is let go on a plane: a viscous dam break.

    Args:
        particles: N.
        viscosity: kinematic [m²/s].
        parameters: θ; its number of particles is replaced.
        volume: of the liquid [m³].
    """
    from sim_engine.fluid.engine import engine

    d = (volume / particles) ** (1.0 / 3.0)
    radius = (volume / math.pi) ** (1.0 / 3.0)
    start = ring(0.0, radius, 0.0, radius, d)
    volume = len(start) * d**3
    plain = box(0.5, 0.5, 2.0 * radius, 0.002)
    times = np.linspace(0.05, 2.0, 40)
    at = np.array([0.25, 0.0, 0.0])
    radii = []
    for _ in run(start + at, d, plain, parameters, times, viscosity=viscosity):
        x = engine().particles()[0].astype(float) - at
        r = np.sort(np.hypot(x[:, 0], x[:, 1]))
        # a puddle's profile (1 − r²/R²)^⅓ has its mean square of r at R²·3/7
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
        Series(name, tuple(times.tolist()), tuple(wanted.tolist()), "reference"),
    ]  # fmt: skip


def _mm2(viscosity: float) -> str:
    """A kinematic viscosity as people read it; mm²/s are centistokes."""
    return f"{1e6 * viscosity:.0f} mm²/s"
