"""What acts between particles besides pressure: cohesion and viscosity, one pass over the pairs.

Cohesion is a pairwise attraction whose strength is scaled to a surface tension (`kernels.cohesion_acceleration`).
Viscosity relaxes velocities towards the neighbours' mean at a given rate (XSPH), so that it does not depend on the time
step. Both are slow, and act only every few steps.

Source: Akinci et al. 2013 (pairwise cohesion); Schechter & Bridson 2012 (XSPH); scaling ours.
"""

import math

import taichi as ti

from sim_engine.fluid.kernels import attraction, weight
from sim_engine.fluid.state import SUPPORT

LONGEST_WAIT = 0.01
"""Viscosity and cohesion act at least that often [s] …"""
CAPILLARY = 0.2
"""… and once in that part of the capillary time: at half of it drops heat up."""
LARGEST_PULL = 0.1
"""Cohesion moves a particle by at most so many spacings in a step: a strong tension at fine spacing stays stable."""


@ti.func
def interact(f: ti.template(), s, dt):
    """Change all velocities by cohesion and viscosity over dt."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.dx[i] = ti.Vector([0.0, 0.0, 0.0])  # drift towards the neighbours' velocities
        f.dv[i] = ti.Vector([0.0, 0.0, 0.0])  # pull
        f.squares[i] = 0.0
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        vi = f.v[i]
        pull = ti.Vector([0.0, 0.0, 0.0])
        drift = ti.Vector([0.0, 0.0, 0.0])
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = xi - f.x[j]
            distance = ti.sqrt(r.dot(r)) + 1e-9
            u = ti.max(1.0 - distance * inv_h, 0.0)
            w = weight(u)
            towards = w * (f.v[j] - vi)
            force = (attraction(u) / distance) * r
            total += w
            drift += towards
            pull -= force
            f.squares[j] = f.squares[j] + w
            f.dx[j] = f.dx[j] - towards
            f.dv[j] = f.dv[j] + force
        f.squares[i] = f.squares[i] + total
        f.dx[i] = f.dx[i] + drift
        f.dv[i] = f.dv[i] + pull
    relax = 1.0 - ti.exp(-f.viscosity[s] * dt)
    strength = f.attraction[s] * dt
    bound = LARGEST_PULL * f.spacing[s] / dt
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        pull = strength * f.dv[i]
        pull *= ti.min(1.0, bound / (pull.norm() + 1e-9))
        # A thin neighbourhood (a drip) relaxes more slowly: its weights don't add up to those of a full one.
        f.v[i] = f.v[i] + relax / ti.max(f.squares[i], 1.0) * f.dx[i] + pull


def forces_interval(viscosity: float, tension: float, density: float, spacing: float) -> float:
    """Time after which viscosity and cohesion act again: they are slow, and a pass over all pairs each.

    Args:
        viscosity: XSPH rate [1/s].
        tension: [N/m].
        density: [kg/m³].
        spacing: d [m].

    Returns:
        At most `LONGEST_WAIT`, a tenth of the viscous time, and `CAPILLARY` of the capillary time √(ρ d³ / (2π σ))
        (Brackbill et al. 1992) [s].
    """
    capillary = math.sqrt(density * spacing**3 / (2.0 * math.pi * max(tension, 1e-9)))
    return min(LONGEST_WAIT, 0.1 / max(viscosity, 1e-9), CAPILLARY * capillary)
