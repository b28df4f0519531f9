"""Viscosity: velocities relax towards the neighbours' mean (XSPH), at a given rate and at that of unresolved motion.

Shear that is felt over a few spacings makes particles climb over each other; what they gain scatters a stream, the
more the coarser they are. In a liquid such motion decays into eddies smaller than a spacing. Their viscosity is that
of Smagorinsky, ν = (C d)² |S| with C = 0.17 (Lilly, from Kolmogorov's spectrum; θ may have another one) and the strain
rate |S| = √(2 S:S). Of a pair it is taken from the rate e at which the two part, over their distance: over all
directions the mean of e² is |S|²/15, and turning as a whole strains nobody. A relaxation at the rate k acts like a
kinematic viscosity of k d²/5, so to the given rate is added 5 C² √15 |e|, whose viscosity vanishes as spacings do.

Both are slow, and act only every few steps.

Source: Schechter & Bridson 2012 (XSPH); Smagorinsky 1963, Lilly 1967; with particles: Dalrymple & Rogers 2006.
"""

import taichi as ti

from sim_engine.fluid.kernels import decayed, weight
from sim_engine.fluid.state import SUPPORT
from sim_engine.fluid.vectors import dot, square


@ti.func
def relax(f: ti.template(), s, dt):
    """Change all velocities by viscosity over dt."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    closest = (0.1 * f.spacing[s]) ** 2  # a pair at the same place does not divide by zero
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.dx[i] = ti.Vector([0.0, 0.0, 0.0])  # drift towards the neighbours' velocities
        f.squares[i] = 0.0
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi, vi = f.x[i], f.v[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            r = xi - f.x[f.neighbour[k]]
            f.pair[k] = square(r)
            f.share[k] = ti.abs(dot(f.v[f.neighbour[k]] - vi, r))
    for k in range(f.list_begin[s], f.list_end[s]):
        r2 = f.pair[k]
        w = weight(ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0))
        parting = f.share[k] / (r2 + closest)
        f.share[k] = w
        f.pair[k] = w * decayed((f.viscosity[s] + f.eddies[s] * parting) * dt)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        vi = f.v[i]
        drift = ti.Vector([0.0, 0.0, 0.0])
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            w = f.share[k]
            towards = f.pair[k] * (f.v[j] - vi)
            total += w
            drift += towards
            f.squares[j] = f.squares[j] + w
            f.dx[j] = f.dx[j] - towards
        f.squares[i] = f.squares[i] + total
        f.dx[i] = f.dx[i] + drift
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # A thin neighbourhood (a drip) relaxes more slowly: its weights don't add up to those of a full one.
        f.v[i] = f.v[i] + f.dx[i] / ti.max(f.squares[i], 1.0)
