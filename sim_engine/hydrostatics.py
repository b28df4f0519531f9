"""Hydrostatics of a tilted vessel, without particles: retained volume, level of the free surface, and outflow.

A tilt θ turns the vessel about +y, so that it tips towards +x. A point (x, y, z) of the vessel's frame is then at the
height z cos θ − x sin θ. The spill point is the lip's lowest point, or, in a tilted bottle, the inner corner of its
neck if that is higher. Volumes are midpoint sums over `Vessel.cavity_points`.

Limitations: the free surface stays horizontal (no sloshing, no clinging drops). Air enters as fast as liquid leaves (no
glugging), so a bottle's outflow is too fast. The lip is a circle of the opening's radius; spouts let out less.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from weakref import WeakKeyDictionary

import numpy as np
from numpy.typing import NDArray

from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]

GRAVITY = 9.81
"""Acceleration of gravity [m/s²]."""

DISCHARGE = 0.6
"""Discharge coefficient of the lip as a weir (Rehbock's C_d tends to 0.602 for a low head)."""

FLOW_LIMIT = 1e-7
"""Flow below which a pour counts as ended: 0.1 mL/s, about two drips a second [m³/s]."""

BINS = 4096
"""Bins in which points of a pool are counted by their height: 0.03 mm each."""

TIME_STEP = 0.01
"""Time step of the outflow equation [s]."""


@dataclass(frozen=True)
class SpillPoint:
    """The point at which liquid leaves a tilted vessel.

    Attributes:
        height: above the vessel's origin, along the vertical [m].
        z: its height along the vessel's axis; liquid beyond it has already left the pool [m].
    """

    height: float
    z: float


def spill_point(vessel: Vessel, tilt: float) -> SpillPoint:
    """The lowest barrier between the vessel's deepest pool and the outside.

    Along every meridian the barrier is the highest point between its lowest one and the lip.

    Args:
        vessel: any vessel.
        tilt: [rad].
    """
    curve = vessel.meridians
    height = curve[:, :, 2] * math.cos(tilt) - curve[:, :, 0] * math.sin(tilt)
    order = np.arange(height.shape[1])
    downstream = np.where(order >= np.argmin(height, axis=1)[:, None], height, -np.inf)
    barrier = np.argmax(downstream, axis=1)
    levels = downstream[np.arange(len(curve)), barrier]
    lowest = int(np.argmin(levels))
    at_lip = barrier[lowest] == height.shape[1] - 1
    return SpillPoint(float(levels[lowest]), math.inf if at_lip else float(curve[lowest, barrier[lowest], 2]))


def _heights(vessel: Vessel, tilt: float) -> tuple[Floats, float]:
    """Heights of the pool's quadrature points relative to the spill point [m], and the volume of each [m³]."""
    points, each = vessel.cavity_points()
    spill = spill_point(vessel, tilt)
    if spill.z < math.inf:
        points = points[points[:, 2] <= spill.z]
    heights: Floats = points[:, 2] * math.cos(tilt) - points[:, 0] * math.sin(tilt) - spill.height
    return heights, each


def _check_tilt(tilt: float) -> None:
    if not abs(tilt) <= math.pi:
        raise ValueError(f"a tilt lies between −180° and 180°, got {math.degrees(tilt):g}°")


def _check_volume(vessel: Vessel, volume: float) -> None:
    if not 0.0 <= volume <= vessel.capacity * (1.0 + 1e-9):
        raise ValueError(
            f"{vessel.name} holds between 0 and {1e6 * vessel.capacity:.4g} mL, {1e6 * volume:.4g} mL asked for"
        )


def retained_volume(vessel: Vessel, tilt: float) -> float:
    """Volume of liquid that a tilted vessel holds at rest.

    Args:
        vessel: any vessel.
        tilt: angle of the axis from vertical, tipped towards +x [rad], −π … π.

    Returns:
        Volume below the horizontal plane through the spill point [m³].

    Raises:
        ValueError: tilt outside its range.

    Source: hydrostatics; checked against quadrature for a cylinder (tests/sim_engine/test_hydrostatics.py).
    """
    _check_tilt(tilt)
    heights, each = _heights(vessel, tilt)
    return float(np.count_nonzero(heights < 0.0) * each)


def level(vessel: Vessel, volume: float, tilt: float) -> float:
    """Height of the free surface above the spill point for a volume in a tilted vessel.

    Args:
        vessel: any vessel.
        volume: [m³], between 0 and the capacity.
        tilt: [rad], −π … π.

    Returns:
        [m]; negative while nothing leaves. A volume larger than the tilted pool gets the level of a full pool.

    Raises:
        ValueError: tilt or volume outside their ranges.
    """
    _check_tilt(tilt)
    _check_volume(vessel, volume)
    heights, each = _heights(vessel, tilt)
    rank = int(np.clip(round(volume / each), 0, len(heights) - 1))
    return float(np.partition(heights, rank)[rank])


@dataclass(frozen=True)
class _Table:
    """Levels and outflow of one vessel.

    Attributes:
        tilts: (A,) evenly spaced from 0 to π [rad].
        volumes: (K,) evenly spaced from 0 to the capacity [m³].
        levels: (A, K), free surface above the spill point [m].
        head: largest level [m].
        flows: (A, F), outflow at the levels head·(k/(F−1))² for a discharge coefficient of 1 [m³/s].
    """

    tilts: Floats
    volumes: Floats
    levels: list[list[float]]
    head: float
    flows: list[list[float]]


_tables: WeakKeyDictionary[Vessel, _Table] = WeakKeyDictionary()


def _table(vessel: Vessel) -> _Table:
    if vessel not in _tables:
        tilts = np.linspace(0.0, np.pi, 73)
        volumes = np.linspace(0.0, vessel.capacity, 129)
        levels = level_table(vessel, tilts, volumes)
        head = max(float(levels.max()), 1e-6)
        heads = head * np.linspace(0.0, 1.0, 97) ** 2
        flows = np.stack([_lip_flow(vessel.opening_radius, heads, float(tilt)) for tilt in tilts])
        _tables[vessel] = _Table(tilts, volumes, levels.tolist(), head, flows.tolist())
    return _tables[vessel]


def level_table(vessel: Vessel, tilts: Floats, volumes: Floats) -> Floats:
    """Heights of the free surface above the spill point on a grid, to 1/`BINS` of the liquid's extent.

    Args:
        vessel: any vessel.
        tilts: (A,) [rad], −π … π.
        volumes: (K,) [m³], between 0 and the capacity.

    Returns:
        Shape (A, K) [m]; see `level`.
    """
    levels = np.empty((len(tilts), len(volumes)))
    for row, tilt in enumerate(tilts):
        levels[row] = _surfaces(*_heights(vessel, float(tilt)), volumes)
    return levels


def _surfaces(heights: Floats, each: float, volumes: Floats) -> Floats:
    """Heights below which points make up given volumes, to 1/`BINS` of their extent: a tenth of the cost of sorting.

    Args:
        heights: of points [m].
        each: volume of a point [m³].
        volumes: (K,) [m³].
    """
    lowest, extent = float(heights.min()), float(np.ptp(heights)) or 1e-9
    places = np.minimum((BINS / extent) * (heights - lowest), BINS - 1).astype(np.int64)
    below = np.concatenate([[0.0], each * np.cumsum(np.bincount(places, minlength=BINS))])
    surfaces: Floats = np.interp(volumes, below, lowest + extent * np.linspace(0.0, 1.0, BINS + 1))
    return surfaces


def _lip_flow(radius: float, heads: Floats, tilt: float) -> Floats:
    """q / C_d = ∫ c(s) √(2g (h − s sin θ)) ds over the wetted part of a circular opening, per head h [m³/s].

    s runs along the opening's plane from the lip's lowest point, c(s) = 2√(s(2R − s)) is the chord there. With the
    width L at a height, this is the tilting-cup equation q = ∫ L √(2g·depth) d(depth) / sin θ: the flow crosses the
    opening's plane, not its vertical projection.
    """
    # s = R(1 − cos φ) removes the square-root singularities at the chord's ends
    phi = (np.arange(200) + 0.5) * math.pi / 200
    s = radius * (1.0 - np.cos(phi))
    chord_ds = 2.0 * (radius * np.sin(phi)) ** 2 * math.pi / 200
    depth = np.maximum(heads[:, None] - s * abs(math.sin(tilt)), 0.0)
    flow: Floats = np.sqrt(2.0 * GRAVITY * depth) @ chord_ds
    return flow


def _drain(
    vessel: Vessel, volume: float, times: Floats, tilts: Floats, discharge: float
) -> tuple[Floats, Floats, Floats]:
    """Volume still in the vessel (T,) [m³], outflow (T,) [m³/s] and head (T,) [m], explicit in steps that never
    overshoot rest."""
    table = _table(vessel)
    rows = np.clip((np.abs(tilts) - table.tilts[0]) / (table.tilts[1] - table.tilts[0]), 0.0, len(table.tilts) - 1.0)
    firsts = np.minimum(rows.astype(np.int64), len(table.tilts) - 2)
    parts = (rows - firsts).tolist()
    levels, flows = table.levels, table.flows
    last_cell, last_flow = len(table.volumes) - 2, len(flows[0]) - 2
    per_volume, steps = (last_cell + 1) / vessel.capacity, np.diff(times, append=times[-1]).tolist()
    inside, outflow, heads = [0.0] * len(steps), [0.0] * len(steps), [0.0] * len(steps)
    v = volume
    for k, (dt, first, fraction) in enumerate(zip(steps, firsts.tolist(), parts, strict=True)):
        inside[k] = v
        place = v * per_volume
        cell = min(int(place), last_cell)
        rest, row, after = 1.0 - fraction, levels[first], levels[first + 1]
        low = row[cell] * rest + after[cell] * fraction
        slope = row[cell + 1] * rest + after[cell + 1] * fraction - low
        head = low + (place - cell) * slope
        if head <= 0.0:
            continue
        heads[k] = head
        place = math.sqrt(min(head / table.head, 1.0)) * (last_flow + 1)
        at = min(int(place), last_flow)
        row, after = flows[first], flows[first + 1]
        low = row[at] * rest + after[at] * fraction
        q = low + (place - at) * (row[at + 1] * rest + after[at + 1] * fraction - low)
        # at most the volume above the spill point: head divided by d(head)/dV, and at most the whole volume
        above = min(head / max(slope * per_volume, 1e-12), v)
        lost = min(discharge * q * dt, above)
        outflow[k] = lost / dt if dt > 0.0 else 0.0
        v -= lost
    return np.array(inside), np.array(outflow), np.array(heads)


@dataclass(frozen=True)
class LipFlow:
    """Flow over the lip during a pour, by the tilting-cup equation; all arrays (T,).

    Attributes:
        times: evenly spaced [s].
        tilts: at those times [rad].
        inside: volume still in the vessel [m³].
        outflow: until the next time [m³/s].
        heads: free surface above the spill point; 0 while nothing leaves [m].
    """

    times: Floats
    tilts: Floats
    inside: Floats
    outflow: Floats
    heads: Floats


def lip_flow(vessel: Vessel, volume: float, times: Floats, tilts: Floats, *, discharge: float = DISCHARGE) -> LipFlow:
    """The tilting-cup equation dV/dt = −q(h(V, θ(t)), θ(t)), in steps of about `TIME_STEP`.

    Args:
        vessel: the pourer, tipped towards +x.
        volume: at the first time [m³].
        times: increasing, shape (T,) [s].
        tilts: at those times, linear in between, shape (T,) [rad].
        discharge: coefficient C_d.

    Raises:
        ValueError: volume outside 0 … capacity, or times that do not increase.
    """
    _check_volume(vessel, volume)
    times, tilts = np.asarray(times, dtype=float), np.asarray(tilts, dtype=float)
    if times.ndim != 1 or times.shape != tilts.shape or len(times) < 2 or not np.all(np.diff(times) > 0.0):
        raise ValueError(f"outflow: increasing times and as many tilts, got shapes {times.shape} and {tilts.shape}")
    fine = np.linspace(times[0], times[-1], 1 + math.ceil((times[-1] - times[0]) / TIME_STEP))
    if len(fine) < 2:
        fine = times
    at = np.interp(fine, times, tilts)
    return LipFlow(fine, at, *_drain(vessel, volume, fine, at, discharge))


def tilting_cup_outflow(
    vessel: Vessel, volume: float, times: Floats, tilts: Floats, *, discharge: float = DISCHARGE
) -> Floats:
    """Poured volume over time of the tilting-cup equation, see `lip_flow`.

    An oracle for simulated pours and a free model of low fidelity.

    Args:
        vessel: the pourer, tipped towards +x.
        volume: at the first time [m³].
        times: increasing, shape (T,) [s].
        tilts: at those times, linear in between, shape (T,) [rad].
        discharge: coefficient C_d. Particle solvers agree best with 0.7 for a straight cup (see the tests).

    Returns:
        Volume that has left, shape (T,) [m³], never decreasing.

    Raises:
        ValueError: volume outside 0 … capacity, or times that do not increase.
    """
    flow = lip_flow(vessel, volume, times, tilts, discharge=discharge)
    return np.asarray(np.interp(np.asarray(times, dtype=float), flow.times, volume - flow.inside), dtype=float)


def predicted_end_of_flow(
    vessel: Vessel,
    volume: float,
    tilt_of_time: Callable[[Floats], Floats],
    t_end: float,
    *,
    flow_limit: float = FLOW_LIMIT,
) -> float:
    """The time at which a pour ends: it determines the hold at the largest tilt.

    Args:
        vessel: the pourer.
        volume: in it at t = 0 [m³].
        tilt_of_time: tilts (T,) [rad] at times (T,) [s].
        t_end: end of the examined time [s].
        flow_limit: flow that counts as none [m³/s].

    Returns:
        The last time before t_end with a larger flow [s]: 0 if nothing leaves, t_end if it has not stopped by then.

    Raises:
        ValueError: volume outside 0 … capacity, or t_end not above 0.
    """
    _check_volume(vessel, volume)
    if not 0.0 < t_end < math.inf:
        raise ValueError(f"end of flow: t_end must be above 0 s, got {t_end:g} s")
    times = np.linspace(0.0, t_end, int(np.clip(math.ceil(t_end / TIME_STEP), 100, 3000)) + 1)
    _, flow, _ = _drain(vessel, volume, times, np.asarray(tilt_of_time(times), dtype=float), DISCHARGE)
    flowing = np.flatnonzero(flow > flow_limit)
    return float(times[flowing[-1] + 1]) if flowing.size else 0.0  # the last time has no step after it, so no flow
