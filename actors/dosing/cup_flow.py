"""The tilting-cup equation of one vessel for arrays of hypotheses: head, flow, and the tilt for a wanted flow.

`CupFlow` tabulates what `sim_engine.hydrostatics` computes for one state, so that a controller can evaluate a hundred
states in a few microseconds each:

    q = C_d ∫ w(s) √(2g (h − s sin θ)) ds,    h = level(V, θ)

w(s) is the width of the opening at the distance s from the lip's lowest point, taken from the rim of the vessel's
geometry. A spout of a mesh therefore narrows the flow. In a thick liquid the film of Nusselt limits the flow, too:
1/q² = 1/q_inertia² + 1/q_viscous² with q_viscous = w g h³ / 3ν.

Limitations: those of `sim_engine.hydrostatics`. Wetting and surface tension at the lip are not modelled; an onset bias
and a flow factor stand for them (`actors.dosing.dose_estimator`).
"""

from __future__ import annotations

import functools
import math

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import DISCHARGE, GRAVITY, level_table
from sim_engine.liquids import Liquid
from sim_engine.model_validity import DRIBBLING_WEBER
from sim_engine.scene import Scene
from sim_engine.vessel.shapes import VesselSpec
from sim_engine.vessel.vessel import Vessel, build_vessel

Floats = NDArray[np.float64]

LARGEST_TILT = math.radians(125.0)
"""Largest tabulated tilt [rad]; beyond it a cup is practically empty."""

LARGEST_HEAD = 0.025
"""Largest tabulated head [m]; a larger one has the flow of this one."""


class CupFlow:
    """Flow out of one vessel; the tilt tips it towards +x.

    Args:
        vessel: the pourer.
        liquid: its density, viscosity and surface tension are used, its mass is not.
    """

    def __init__(self, vessel: Vessel, liquid: Liquid) -> None:
        self.capacity = vessel.capacity
        self._radius = vessel.opening_radius
        self.density = liquid.density
        self._viscosity = liquid.kinematic_viscosity
        self._tension = liquid.surface_tension
        self._tilt_step = math.radians(1.0)
        self._tilts = np.arange(0.0, LARGEST_TILT + 1e-9, self._tilt_step)
        volumes = np.linspace(0.0, vessel.capacity, 129)
        self._volume_step = float(volumes[1])
        self._levels = level_table(vessel, self._tilts, volumes)
        self._head_grid = LARGEST_HEAD * np.linspace(0.0, 1.0, 81) ** 2
        self._s, self._width = _opening(vessel)
        self._area_up_to = np.append(0.0, np.cumsum(self._width * np.gradient(self._s)))
        self._width_up_to = np.append(0.0, np.maximum.accumulate(self._width))
        self._flows = np.stack([self._flow_of_heads(float(tilt)) for tilt in self._tilts])
        # Volumes (rows) × heads (columns): the tilt at which a volume stands this high above the lip.
        self._aim_step = 1e-3
        aims = self._aim_step * np.arange(26)
        rising = np.maximum.accumulate(self._levels, axis=0) + 1e-12 * np.arange(len(self._tilts))[:, None]
        self._aim_tilts = np.stack([np.interp(aims, column, self._tilts) for column in rising.T])

    def head(self, volume: Floats, tilt: Floats) -> Floats:
        """Free surface above the lip, negative while nothing leaves, elementwise [m].

        Args:
            volume: [m³].
            tilt: [rad]; both are clamped to the tables.
        """
        return _bilinear(self._levels, tilt / self._tilt_step, volume / self._volume_step)

    def flow(self, head: Floats, tilt: float) -> Floats:
        """Outflow for a flow factor of 1, elementwise [m³/s].

        Args:
            head: above the lip [m].
            tilt: of the vessel [rad].
        """
        return np.interp(head, self._head_grid, self._row(tilt))

    def flow_at(self, head: Floats, tilt: Floats) -> Floats:
        """`flow` for tilts of their own, elementwise [m³/s]."""
        column = (len(self._head_grid) - 1) * np.sqrt(np.maximum(head, 0.0) / LARGEST_HEAD)
        return _bilinear(self._flows, tilt / self._tilt_step, column)

    def head_for(self, flow: Floats, tilt: float) -> Floats:
        """Inverse of `flow` [m]."""
        return np.interp(flow, self._row(tilt), self._head_grid)

    def tilt_for(self, volume: Floats, head: Floats) -> Floats:
        """Tilt at which a volume stands so high above the lip, elementwise [rad].

        Args:
            volume: [m³].
            head: at least 0 [m].
        """
        return _bilinear(self._aim_tilts, volume / self._volume_step, head / self._aim_step)

    def volume_per_tilt(self, volume: float, head: float) -> float:
        """−dV/dθ at a constant head: the flow of a cup that turns with 1 rad/s [m³/rad]."""
        # −ΔV/Δθ by central differences over 4 % of the capacity
        around = np.clip(volume + np.array([-0.02, 0.02]) * self.capacity, 0.0, self.capacity)
        low, high = self.tilt_for(around, np.full(2, head))
        return float(np.diff(around)[0] / max(low - high, 1e-4))

    def wave_period(self, volume: float) -> float:
        """Period of the first wave of an upright cup, which rises at the lip [s].

        Args:
            volume: [m³]; its mean depth counts.

        Source: linear theory of a round tank: ω² = 1.841 g/R · tanh(1.841 h/R) (Lamb, Hydrodynamics, § 257).
        """
        # ω² = g k tanh(k h), k = 1.841/R, the first zero of J_1'; T = 2π/ω
        depth = volume / (math.pi * self._radius**2)
        wave_number = 1.841 / self._radius
        return 2.0 * math.pi / math.sqrt(wave_number * GRAVITY * math.tanh(max(wave_number * depth, 0.1)))

    def clean_flow(self, tilt: float, weber: float = DRIBBLING_WEBER) -> float:
        """Smallest flow whose film leaves the lip with a Weber number; slower ones dribble [m³/s].

        Args:
            tilt: [rad].
            weber: ρU²e/σ of the film at the lip.

        Returns:
            inf if no tabulated flow reaches it.
        """
        # We = ρ U² e / σ with the film e = C_d A / w of the wetted area A = ∫ w ds and U = q / (w e), at every head
        # the distances whose lip is below the surface come first, so that sums over them are sums up to the last one
        wet = np.searchsorted(self._s * math.sin(tilt), self._head_grid)
        area, wide = self._area_up_to[wet], np.maximum(self._width_up_to[wet], 1e-6)
        flow = self._row(tilt)
        film = np.maximum(DISCHARGE * area / wide, 1e-9)
        number = self.density * (flow / (wide * film)) ** 2 * film / self._tension
        reached = np.flatnonzero(number >= weber)
        return float(flow[reached[0]]) if reached.size else math.inf

    def _row(self, tilt: float) -> Floats:
        place = min(max(tilt / self._tilt_step, 0.0), len(self._tilts) - 1.001)
        first = int(place)
        row: Floats = self._flows[first] + (place - first) * (self._flows[first + 1] - self._flows[first])
        return row

    def _flow_of_heads(self, tilt: float) -> Floats:
        """Outflow at the heads of the grid, increasing [m³/s]."""
        # q_inertia = C_d ∫ w √(2g (h − s sin θ)) ds and q_viscous = w g h³ / 3ν (Nusselt 1916), joined as in the
        # module's equation; strictly increasing, so that `head_for` can invert it.
        depth = np.maximum(self._head_grid[:, None] - self._s * math.sin(tilt), 0.0)
        width = ((depth > 0.0) * self._width).max(axis=1)
        inertia = DISCHARGE * (np.sqrt(2.0 * GRAVITY * depth) * self._width) @ np.gradient(self._s)
        viscous = width * GRAVITY * self._head_grid**3 / (3.0 * self._viscosity)
        flow = 1.0 / np.sqrt(1.0 / np.maximum(inertia, 1e-12) ** 2 + 1.0 / np.maximum(viscous, 1e-12) ** 2)
        flow[0] = 0.0
        increasing: Floats = np.maximum.accumulate(flow) + 1e-15 * np.arange(len(flow))
        return increasing


@functools.lru_cache(maxsize=32)
def _tabulated(pourer: VesselSpec, liquid: Liquid) -> CupFlow:
    return CupFlow(build_vessel(pourer), liquid)


def flow_of(scene: Scene) -> CupFlow:
    """The flow out of a scene's pourer, computed once for each vessel and liquid, whatever its mass."""
    return _tabulated(scene.pourer, scene.liquid.model_copy(update={"mass": 1.0}))


def _opening(vessel: Vessel) -> tuple[Floats, Floats]:
    """Distances from the lip's lowest point along the opening (S,) and the opening's width there (S,) [m]."""
    crest = vessel.meridians[:, -1, :2]
    radius = np.hypot(crest[:, 0], crest[:, 1])
    angle = np.linspace(0.0, math.pi, 361)
    known = np.linspace(0.0, 2.0 * math.pi, len(radius) + 1)
    closed = np.append(radius, radius[0])
    half = [np.interp(a, known, closed) for a in (angle, 2.0 * math.pi - angle)]
    # Width w(s) = Σ over both halves of the outline's |y| where x = x_lip − s; s is quadratic in its index, because w
    # grows as √s at the lip.
    x = [r * np.cos(angle) for r in half]
    length = x[0][0] - x[0][-1]
    s = length * ((np.arange(240) + 0.5) / 240.0) ** 2
    width = np.zeros_like(s)
    for r, along in zip(half, x, strict=True):
        outline = np.minimum.accumulate(along)[::-1] + 1e-12 * np.arange(len(along))
        width += np.interp(x[0][0] - s, outline, (r * np.sin(angle))[::-1])
    return s, width


def median(values: Floats) -> float:
    """The median of a few hundred values; numpy's takes ten times as long."""
    ordered, half = np.sort(values), len(values) // 2
    return 0.5 * float(ordered[half] + ordered[-1 - half])


def quantile(values: Floats, share: float) -> float:
    """numpy's default quantile of a few hundred values, which takes ten times as long there."""
    ordered, place = np.sort(values), share * (len(values) - 1)
    first = min(int(place), len(values) - 2)
    return float(ordered[first] + (place - first) * (ordered[first + 1] - ordered[first]))


def _bilinear(table: Floats, row: Floats, column: Floats) -> Floats:
    """Values of a table at fractional places, clamped to it, elementwise."""
    # (1 − u) ((1 − v) t_ij + v t_i,j+1) + u (…)_i+1, in place where it can be: this is half of a simulated dose
    rows, columns = table.shape
    row = np.minimum(np.maximum(row, 0.0), rows - 1.000001)
    column = np.minimum(np.maximum(column, 0.0), columns - 1.000001)
    place, j = row.astype(np.int64), column.astype(np.int64)
    u, v = row - place, column - j
    place *= columns
    place += j
    flat = table.ravel()
    low: Floats = flat.take(place)
    high: Floats = flat.take(place + columns)
    low += v * (flat.take(place + 1) - low)
    high += v * (flat.take(place + (columns + 1)) - high)
    high -= low
    high *= u
    high += low
    return high
