"""Strength of cohesion and viscosity, and the intervals at which they act. Numbers, without Taichi."""

import math

RANGE = 3.0
"""Range of cohesion over spacing d."""
SURFACE = 0.66
"""Energy of a surface of one spacing squared by the sums of `tension`: scales cohesion to its tension. Measured by the
frequency of drops (`sim_engine.validation.capillarity`)."""
CAPILLARY = 0.56
"""Longest interval of cohesion, as a fraction of the capillary time; at 0.9 of it drops heat up."""
LONGEST_WAIT = 0.01
"""Longest interval of viscosity [s]."""


def pull_interval(tension: float, density: float, spacing: float) -> float:
    """Longest interval of cohesion: `CAPILLARY` of √(ρ d³ / (2π σ)) (Brackbill et al. 1992) [s].

    Args:
        tension: σ [N/m].
        density: of the liquid [kg/m³].
        spacing: d [m].
    """
    return CAPILLARY * math.sqrt(density * spacing**3 / (2.0 * math.pi * max(tension, 1e-9)))


def cohesion_acceleration(tension: float, density: float, spacing: float) -> float:
    """Acceleration of a particle by one unit of the energies' slopes, σ d² / SURFACE / (ρ d³ · RANGE d) [m/s²].

    Args:
        tension: σ [N/m].
        density: of the liquid [kg/m³].
        spacing: d [m].
    """
    return tension / (SURFACE * RANGE * density * spacing**2)


def adhesion(contact_angle: float, wall_distance: float) -> float:
    """Attraction of particles by walls, in units of the energies' slopes; negative values repel.

    All layers that rest on a wall have together the energy −σ cos θ per area of it.

    Args:
        contact_angle: θ [rad].
        wall_distance: of the first layer at rest, in spacings.
    """
    cosine = math.cos(contact_angle)
    if abs(cosine) < 1e-9:
        return 0.0
    reach = [1.0 - (wall_distance + k) / RANGE for k in range(math.ceil(RANGE))]
    return cosine * SURFACE / sum(_wall_bond(u) for u in reach if u > 0.0)


def _wall_bond(u: float) -> float:
    """As `wall_bond`, of a number."""
    series = 1.0 / 60.0 - u * (17.0 / 420.0 - u * (11.0 / 280.0 - u * (1.0 / 56.0 - u / 315.0)))
    return 64.0 * math.pi * u**6 * series


def eddy_rate(constant: float) -> float:
    """Rate of relaxation over the rate at which a pair separates, from Smagorinsky's constant C."""
    return 5.0 * constant**2 * math.sqrt(15.0)


def relax_interval(viscosity: float) -> float:
    """Interval of viscosity, at most `LONGEST_WAIT` and a tenth of its own time [s].

    Args:
        viscosity: XSPH rate [1/s].
    """
    return min(LONGEST_WAIT, 0.1 / max(viscosity, 1e-9))
