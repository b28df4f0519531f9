"""What acts between particles besides pressure: cohesion and viscosity, one pass over the pairs.

Cohesion is a pairwise attraction whose strength is scaled to a surface tension (`kernels.cohesion_strength`). Viscosity
relaxes velocities towards the neighbours' mean at a given rate (XSPH), so that it does not depend on the time step.

Source: Akinci et al. 2013 (pairwise cohesion); Schechter & Bridson 2012 (XSPH); scaling ours.
"""

import math

import taichi as ti

from sim_engine.fluid.kernels import SIGMA, slope, weight
from sim_engine.fluid.density import PACKING
from sim_engine.fluid.state import SUPPORT

LONGEST_WAIT = 0.01
import os as _os
POS = float(_os.environ.get('POS','1.0'))
NEG = float(_os.environ.get('NEG','0.2'))
CAPILLARY = 0.3
LARGEST_PULL = 0.1
"""Cohesion moves a particle by at most so many spacings in a step: a strong tension at fine spacing stays stable."""


@ti.func
def interact(f: ti.template(), s, dt):
    """Change all velocities by cohesion and viscosity over dt."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    d = f.spacing[s]
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.moving[s]):
        f.dx[s, i] = ti.Vector([0.0, 0.0, 0.0])  # drift towards the neighbours' velocities
        f.squares[s, i] = 0.0
        f.bend[s, i] = 0.0
        f.rims[s, i] = ti.select(f.facing[s, i].dot(f.facing[s, i]) > 0.0, 1.0, 0.0)
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        vi = f.v[s, i]
        ni = f.facing[s, i]
        drift = ti.Vector([0.0, 0.0, 0.0])
        total = ti.cast(0.0, ti.f32)
        bend = ti.cast(0.0, ti.f32)
        rims = ti.cast(0.0, ti.f32)
        si = ni.dot(ni)
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            u = ti.max(1.0 - ti.sqrt(r.dot(r)) * inv_h, 0.0)
            w = weight(u)
            towards = w * (f.v[s, j] - vi)
            total += w
            drift += towards
            nj = f.facing[s, j]
            both = ti.select(si * nj.dot(nj) > 0.5, 1.0, 0.0)
            turn = both * slope(u) * (nj - ni).dot(r)
            bend += turn
            rims += both * w
            f.squares[s, j] = f.squares[s, j] + w
            f.dx[s, j] = f.dx[s, j] - towards
            f.bend[s, j] = f.bend[s, j] + turn
            f.rims[s, j] = f.rims[s, j] + both * w
        f.squares[s, i] = f.squares[s, i] + total
        f.dx[s, i] = f.dx[s, i] + drift
        f.bend[s, i] = f.bend[s, i] + bend
        f.rims[s, i] = f.rims[s, i] + rims
    relax = 1.0 - ti.exp(-f.viscosity[s] * dt)
    volume = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING
    for i in range(f.moving[s]):
        curvature = ti.cast(0.0, ti.f32)
        if f.rims[s, i] > 1.0:
            curvature = scale * f.bend[s, i] / (volume * f.rims[s, i])
            curvature = ti.max(ti.min(curvature, POS / d), -NEG / d)
        f.bend[s, i] = curvature
        flag = ti.select(f.facing[s, i].dot(f.facing[s, i]) > 0.0, 1.0, 0.0)
        f.dp[s, i] = flag
        f.rims[s, i] = flag
        f.density_copy[s, i] = curvature * flag
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        ci = f.bend[s, i] * f.dp[s, i]
        fi = f.dp[s, i]
        sums = ti.cast(0.0, ti.f32)
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            w = weight(ti.max(1.0 - ti.sqrt(r.dot(r)) * inv_h, 0.0))
            fj = f.dp[s, j]
            sums += w * fj * f.bend[s, j]
            total += w * fj
            f.density_copy[s, j] = f.density_copy[s, j] + w * ci
            f.rims[s, j] = f.rims[s, j] + w * fi
        f.density_copy[s, i] = f.density_copy[s, i] + sums
        f.rims[s, i] = f.rims[s, i] + total
    for i in range(f.moving[s]):
        curvature = f.density_copy[s, i] / ti.max(f.rims[s, i], 1.0)
        pull = (dt * f.attraction[s] * f.edge[s, i] * curvature) * f.facing[s, i]
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
