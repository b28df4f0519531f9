"""What acts between particles besides pressure: cohesion and viscosity, one pass over the pairs.

Cohesion is a pairwise attraction whose strength is scaled to a surface tension (`kernels.cohesion_strength`). Viscosity
relaxes velocities towards the neighbours' mean at a given rate (XSPH), so that it does not depend on the time step.

Source: Akinci et al. 2013 (pairwise cohesion); Schechter & Bridson 2012 (XSPH); scaling ours.
"""

import math

import taichi as ti

from sim_engine.fluid.kernels import attraction, weight
from sim_engine.fluid.density import PACKING
from sim_engine.fluid.state import SUPPORT

LONGEST_WAIT = 0.01
import os as _os
POS = float(_os.environ.get('POS','1.0'))
NEG = float(_os.environ.get('NEG','0.2'))
CAPILLARY = 0.1
LARGEST_PULL = 0.1
"""Cohesion moves a particle by at most so many spacings in a step: a strong tension at fine spacing stays stable."""


@ti.func
def interact(f: ti.template(), s, dt):
    """Change all velocities by cohesion and viscosity over dt."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    for i in range(f.moving[s]):
        f.dx[s, i] = ti.Vector([0.0, 0.0, 0.0])  # drift towards the neighbours' velocities
        f.dv[s, i] = ti.Vector([0.0, 0.0, 0.0])  # pull
        f.squares[s, i] = 0.0
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        vi = f.v[s, i]
        pull = ti.Vector([0.0, 0.0, 0.0])
        drift = ti.Vector([0.0, 0.0, 0.0])
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            distance = ti.sqrt(r.dot(r)) + 1e-9
            u = ti.max(1.0 - distance * inv_h, 0.0)
            w = weight(u)
            towards = w * (f.v[s, j] - vi)
            force = (attraction(u) / distance) * r
            total += w
            drift += towards
            pull -= force
            f.squares[s, j] = f.squares[s, j] + w
            f.dx[s, j] = f.dx[s, j] - towards
            f.dv[s, j] = f.dv[s, j] + force
        f.squares[s, i] = f.squares[s, i] + total
        f.dx[s, i] = f.dx[s, i] + drift
        f.dv[s, i] = f.dv[s, i] + pull
    relax = 1.0 - ti.exp(-f.viscosity[s] * dt)
    strength = f.attraction[s] * dt
    bound = LARGEST_PULL * f.spacing[s] / dt
    for i in range(f.moving[s]):
        pull = strength * f.dv[s, i]
        pull *= ti.min(1.0, bound / (pull.norm() + 1e-9))
        # A thin neighbourhood (a drip) relaxes more slowly: its weights don't add up to those of a full one.
        f.v[s, i] = f.v[s, i] + relax / ti.max(f.squares[s, i], 1.0) * f.dx[s, i] + pull


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
