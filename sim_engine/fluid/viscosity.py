"""Viscosity: velocities relax towards the neighbours' mean at a given rate (XSPH), whatever the time step.

It is slow, and acts only every few steps.

Source: Schechter & Bridson 2012 (XSPH).
"""

import taichi as ti

from sim_engine.fluid.kernels import weight
from sim_engine.fluid.state import SUPPORT

LONGEST_WAIT = 0.01
"""Viscosity acts at least that often [s]."""


@ti.func
def relax(f: ti.template(), s, dt):
    """Change all velocities by viscosity over dt."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.dx[i] = ti.Vector([0.0, 0.0, 0.0])  # drift towards the neighbours' velocities
        f.squares[i] = 0.0
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        vi = f.v[i]
        drift = ti.Vector([0.0, 0.0, 0.0])
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = xi - f.x[j]
            w = weight(ti.max(1.0 - ti.sqrt(r.dot(r)) * inv_h, 0.0))
            towards = w * (f.v[j] - vi)
            total += w
            drift += towards
            f.squares[j] = f.squares[j] + w
            f.dx[j] = f.dx[j] - towards
        f.squares[i] = f.squares[i] + total
        f.dx[i] = f.dx[i] + drift
    share = 1.0 - ti.exp(-f.viscosity[s] * dt)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # A thin neighbourhood (a drip) relaxes more slowly: its weights don't add up to those of a full one.
        f.v[i] = f.v[i] + share / ti.max(f.squares[i], 1.0) * f.dx[i]


def relax_interval(viscosity: float) -> float:
    """Time after which viscosity acts again, at most `LONGEST_WAIT` and a tenth of its own time [s].

    Args:
        viscosity: XSPH rate [1/s].
    """
    return min(LONGEST_WAIT, 0.1 / max(viscosity, 1e-9))
