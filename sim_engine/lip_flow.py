"""The film at the lip and the falling stream of a planned pour, without particles, and their dimensionless numbers.

They follow from the tilting-cup equation (`sim_engine.hydrostatics`), ρ, σ and μ of the liquid, and g, at two places:

* **At the lip**: a film of thickness e and mean velocity U that leaves over the wetted width b of the opening, Q = U e
  b.

  Inertia: U = ∫√(2g·depth) dA / A over the wetted area A of the opening. The discharge coefficient is the jet's
  contraction, e = C_d A / b.

  Viscosity: a film that runs down a vertical wall has e = (3νQ/gb)^(1/3) and U = Q/(b e); on any smaller slope it is
  thicker. If this film is thicker than the inertial one, it is used.

  Re = ρUe/μ, We = ρU²e/σ, Bo = ρge²/σ = (e / capillary length)².
* **In the falling stream**, at the level of the receiver's rim: v² = U² + 2g·(fall), a round stream of diameter D =
  √(4Q/πv). Re = ρvD/μ, We = ρv²D/σ, Bo = ρgD²/σ.

Source of the viscous film: Nusselt, Z. VDI 60 (1916): mean velocity u = ge²/3ν.

Limitations: the liquid's surface is assumed level, so in fast pours the true film is thinner and faster. The opening is
a circle; spouts concentrate the flow.
"""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from sim_engine.hydrostatics import DISCHARGE, GRAVITY, LipFlow, lip_flow
from sim_engine.liquids import Liquid
from sim_engine.motion import Motion
from sim_engine.vessel.vessel import Vessel

Floats = NDArray[np.float64]
Which = NDArray[np.bool_]

EDGE = 0.05
"""Fraction of the poured liquid omitted at either end, since every flow and its numbers begin and end at zero."""


def reynolds(liquid: Liquid, velocity: Floats, thickness: Floats) -> Floats:
    """Inertia over viscosity: ρ U e / μ."""
    return np.asarray(liquid.density * velocity * thickness / liquid.dynamic_viscosity)


def weber(liquid: Liquid, velocity: Floats, thickness: Floats) -> Floats:
    """Inertia over surface tension: ρ U² e / σ."""
    return np.asarray(liquid.density * velocity**2 * thickness / liquid.surface_tension)


def bond(liquid: Liquid, thickness: Floats | float) -> Floats:
    """Gravity over surface tension: ρ g e² / σ."""
    return np.asarray(liquid.density * GRAVITY * np.square(thickness) / liquid.surface_tension)


def capillary_length(liquid: Liquid) -> float:
    """√(σ/ρg) [m]: 2.7 mm for water."""
    return math.sqrt(liquid.surface_tension / (liquid.density * GRAVITY))


@dataclass(frozen=True)
class ValueRange:
    """Smallest and largest value, SI, without `EDGE` of the poured liquid at either end."""

    smallest: float
    largest: float


@dataclass(frozen=True)
class FlowNumbers:
    """Properties of the flow at one place during a pour.

    Attributes:
        velocity: [m/s].
        thickness: of the film at the lip, diameter of the falling stream [m].
        reynolds, weber, bond: see the module.
    """

    velocity: ValueRange
    thickness: ValueRange
    reynolds: ValueRange
    weber: ValueRange
    bond: ValueRange

    def as_json(self) -> dict[str, list[float]]:
        """JSON-ready: [smallest, largest]; lengths in millimetres."""
        return {
            "velocity_m_s": [self.velocity.smallest, self.velocity.largest],
            "thickness_mm": [self.thickness.smallest * 1e3, self.thickness.largest * 1e3],
            "reynolds": [self.reynolds.smallest, self.reynolds.largest],
            "weber": [self.weber.smallest, self.weber.largest],
            "bond": [self.bond.smallest, self.bond.largest],
        }


@dataclass(frozen=True)
class FlowCourse:
    """The steps of a pour in which liquid leaves; arrays (K,).

    Attributes:
        volume: that leaves in the step [m³].
        velocity, film: at the lip [m/s], [m].
        stream_velocity, diameter: of the stream at the receiver's rim [m/s], [m].
        covered: whether liquid covers the whole opening.
        lip: x of the lip in the world [m].
        fall: from the lip to the level of the receiver's rim, 0 if it is not above it [m].
        time: at which the step begins [s].
    """

    volume: Floats
    velocity: Floats
    film: Floats
    stream_velocity: Floats
    diameter: Floats
    covered: Which
    lip: Floats
    fall: Floats
    time: Floats

    def landing(self) -> float:
        """Position at which the middle of the stream passes the level of the receiver's rim, x in the world [m].

        A free jet that leaves horizontally with the mean velocity at the lip. In simulated pours into a narrow cup the
        received fraction falls to zero within 15 mm of the point where this position leaves the opening.
        """
        return self.quantile(self.lip + self.velocity * np.sqrt(2.0 * self.fall / GRAVITY), 0.5)

    def share(self, where: Which) -> float:
        """Fraction of the poured liquid for which a condition holds."""
        return float(self.volume[where].sum() / self.volume.sum())

    def quantile(self, values: Floats, probability: float) -> float:
        """Value that this fraction of the poured liquid does not exceed."""
        order = np.argsort(values)
        place = np.searchsorted(np.cumsum(self.volume[order]), probability * self.volume.sum())
        return float(values[order][min(int(place), len(order) - 1)])

    def lip_numbers(self, liquid: Liquid) -> FlowNumbers:
        """Dimensionless numbers of the film at the lip."""
        return self._numbers(self.velocity, self.film, liquid)

    def stream_numbers(self, liquid: Liquid) -> FlowNumbers:
        """Dimensionless numbers of the falling stream at the receiver's rim."""
        return self._numbers(self.stream_velocity, self.diameter, liquid)

    def _numbers(self, velocity: Floats, thickness: Floats, liquid: Liquid) -> FlowNumbers:
        def over(values: Floats) -> ValueRange:
            return ValueRange(self.quantile(values, EDGE), self.quantile(values, 1.0 - EDGE))

        return FlowNumbers(
            over(velocity),
            over(thickness),
            over(reynolds(liquid, velocity, thickness)),
            over(weber(liquid, velocity, thickness)),
            over(bond(liquid, thickness)),
        )


def flow_course(motion: Motion, liquid: Liquid, pourer: Vessel, receiver: Vessel) -> FlowCourse | None:
    """Film and stream over a pour.

    Args:
        motion: of the pourer.
        liquid: initial content of the pourer.
        pourer, receiver: vessels.

    Returns:
        None if nothing leaves.

    Raises:
        ValueError: the pourer cannot hold the volume.
    """
    times = np.linspace(0.0, motion.duration, max(2, math.ceil(motion.duration / 0.01)))
    flow = lip_flow(pourer, liquid.volume, times, motion.tilt(times))
    left = flow.outflow * np.diff(flow.times, append=flow.times[-1])
    leaving = left > 0.0
    if not leaving.any():
        return None
    lip, fall = (along[leaving] for along in _lip(motion, flow, pourer, receiver))
    outflow = flow.outflow[leaving]
    opening = _wetted(pourer.opening_radius, flow.heads[leaving], flow.tilts[leaving])
    velocity, film = _film(liquid, outflow, opening)
    falling = np.sqrt(velocity**2 + 2.0 * GRAVITY * fall)
    return FlowCourse(
        volume=left[leaving],
        velocity=velocity,
        film=film,
        stream_velocity=falling,
        diameter=np.sqrt(4.0 * outflow / (math.pi * falling)),
        covered=opening.covered,
        lip=lip,
        fall=fall,
        time=flow.times[leaving],
    )


def film_of_flow(liquid: Liquid, pourer: Vessel, outflow: Floats, tilt: float) -> tuple[Floats, Floats]:
    """Film at the lip of a steady flow, whatever caused it.

    Args:
        liquid, pourer: of the pour.
        outflow: above 0, shape (K,) [m³/s].
        tilt: above 0 [rad].

    Returns:
        Velocity [m/s] and thickness [m], (K,) each.
    """
    heads = 2.0 * pourer.opening_radius * np.linspace(0.0, 1.0, 400)[1:] ** 2
    flows = DISCHARGE * _wetted(pourer.opening_radius, heads, np.full(len(heads), tilt)).ideal_flow
    at = np.interp(outflow, flows, heads)
    return _film(liquid, outflow, _wetted(pourer.opening_radius, at, np.full(len(at), tilt)))


def _film(liquid: Liquid, outflow: Floats, opening: _Opening) -> tuple[Floats, Floats]:
    """Velocity and thickness of the film, (K,) each."""
    flux = outflow / opening.width
    by_inertia = flux * opening.area / opening.ideal_flow
    by_viscosity = np.cbrt(3.0 * liquid.kinematic_viscosity * flux / GRAVITY)
    film = np.maximum(by_inertia, by_viscosity)
    return flux / film, film


def _lip(motion: Motion, flow: LipFlow, pourer: Vessel, receiver: Vessel) -> tuple[Floats, Floats]:
    """The lip's x in the world and its height above the receiver's rim, at least 0, both of shape (T,) [m]."""
    x, _, z = pourer.lip_point(0.0)
    tilt, poses = motion.tilt(flow.times), motion.sample(flow.times)
    along = poses[:, 0] + x * np.cos(tilt) + z * np.sin(tilt)
    up = poses[:, 2] - x * np.sin(tilt) + z * np.cos(tilt)
    return along, np.maximum(up - receiver.rim_height, 0.0)


@dataclass(frozen=True)
class _Opening:
    """A circular opening under a level surface; arrays (K,).

    Attributes:
        area: covered by liquid [m²].
        width: largest width of the liquid [m].
        ideal_flow: ∫√(2g·depth) dA [m³/s].
        covered: whether liquid covers all of it.
    """

    area: Floats
    width: Floats
    ideal_flow: Floats
    covered: Which


def _wetted(radius: float, heads: Floats, tilts: Floats) -> _Opening:
    """s runs along the opening from the lip's lowest point; it is c(s) = 2√(s(2R − s)) wide, h − s sin θ deep there."""
    sine = np.maximum(np.abs(np.sin(tilts)), 1e-6)
    top = np.minimum(heads / sine, 2.0 * radius)
    # s = top·(1 − cos φ)/2 removes the singularities of the square roots
    phi = (np.arange(100) + 0.5) * math.pi / 100
    s = top[:, None] * 0.5 * (1.0 - np.cos(phi))
    strips = 2.0 * np.sqrt(s * (2.0 * radius - s)) * top[:, None] * 0.5 * np.sin(phi) * math.pi / 100
    ideal = np.sqrt(2.0 * GRAVITY * np.maximum(heads[:, None] - s * sine[:, None], 0.0))
    widest = np.minimum(top, radius)
    return _Opening(
        area=strips.sum(axis=1),
        width=2.0 * np.sqrt(widest * (2.0 * radius - widest)),
        ideal_flow=(ideal * strips).sum(axis=1),
        covered=heads >= 2.0 * radius * sine,
    )
