"""Contact angles: how high a puddle stands.

Its edge's pull σ(1 − cos θ) balances the pressure of its weight, ½ρg e²: e = 2 √(σ/ρg) sin ½θ.

Source: de Gennes, Brochard-Wyart and Quéré 2004, Capillarity and Wetting Phenomena, section 2.2.
"""

from __future__ import annotations

import math

import numpy as np

from sim_engine.hydrostatics import GRAVITY
from sim_engine.liquid import SimulationParameters
from sim_engine.pour import PourSimulator
from sim_engine.validation.result import Figure, Measurement, Series, reported, within
from sim_engine.validation.stage import DENSITY, run
from sim_engine.validation.tanks import block, box

ABOUT = (
    "20 mL of water's tension, laid 4 mm high on a slippery plane, stand 2√(σ/ρg) sin ½θ high after 2 s: the capillary "
    "length is 2.7 mm. Coarser than that there is one layer of particles, whatever the contact angle."
)
VOLUME, TENSION, LAID = 20e-6, 0.0728, 0.004
"""Of the puddle [m³], [N/m]; its height at first [m]."""
VISCOSITY = 1e-4
"""Kinematic; it calms the puddle and has no part in its height [m²/s]."""


def height(angle: float) -> float:
    """Of a wide puddle of this contact angle [rad] at rest [m]."""
    return 2.0 * math.sqrt(TENSION / (DENSITY * GRAVITY)) * math.sin(0.5 * angle)


def puddle(particles: int, angle: float) -> tuple[float, float, int]:
    """Height of a puddle after 2 s.

    Args:
        particles: N, roughly.
        angle: contact angle [rad].

    Returns:
        Twice the height of the mass centre [m], spacing [m] and N.
    """
    from sim_engine.fluid.engine import engine

    side = math.sqrt(VOLUME / LAID)
    start, d = block(np.array([0.04, -side / 2.0, 0.0]), np.array([0.04 + side, side / 2.0, LAID]), particles, 1)
    plane = box(0.08 + side, 0.08 + side, 0.04, 0.5 * d)
    theta = SimulationParameters(cohesion=TENSION, viscosity=0.0)
    for _ in run(start, d, plane, theta, np.array([2.0]), viscosity=VISCOSITY, no_slip=False, contact_angle=angle):
        pass
    return 2.0 * float(engine().particles()[0][:, 2].mean()), d, len(start)


def wetting(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """Puddles of several contact angles."""
    angles = (60.0, 90.0, 120.0, 150.0) if full else (60.0, 120.0)
    found: list[Measurement] = []
    curves: list[Series] = []
    for particles in (250, 2_000):
        values = []
        for degrees in angles:
            right = height(math.radians(degrees))
            value, d, n = puddle(particles, math.radians(degrees))
            values.append(1e3 * value)
            name = f"height at {degrees:g}°, d = {1e3 * d:.1f} mm"
            if d < 0.8 * right:
                found.append(within(name, value, right, 0.2 * right, unit="m", criterion="within 20 %", particles=n))
            else:
                found.append(reported(name, value, unit="m", reference=right, particles=n))
        curves.append(Series(f"{particles:,} particles", angles, tuple(values)))
    fine = np.linspace(0.0, 180.0, 60)
    theory = tuple(1e3 * height(math.radians(a)) for a in fine)
    curves.append(Series("theory", tuple(fine.tolist()), theory, "reference"))
    return found, Figure(("Puddles",), ("contact angle [°]",), ("height [mm]",), tuple(curves))
