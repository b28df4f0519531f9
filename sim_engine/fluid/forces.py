"""What acts between particles besides pressure: cohesion and viscosity, one pass over the pairs.

Cohesion is a pairwise attraction whose strength is scaled to a surface tension (`kernels.cohesion_strength`). Viscosity
relaxes velocities towards the neighbours' mean at a given rate (XSPH), so that it does not depend on the time step.

Source: Akinci et al. 2013 (pairwise cohesion); Schechter & Bridson 2012 (XSPH); scaling ours.
"""

import taichi as ti

from sim_engine.fluid.kernels import attraction, weight
from sim_engine.fluid.state import SUPPORT


@ti.func
def velocity_change(f: ti.template(), s, i, dt):
    """Change of a particle's velocity over dt by cohesion and viscosity [m/s]."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    xi = f.x[s, i]
    vi = f.v[s, i]
    pull = ti.Vector([0.0, 0.0, 0.0])
    drift = ti.Vector([0.0, 0.0, 0.0])
    total = ti.cast(1e-6, ti.f32)
    for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
        j = f.neighbour[s, k]
        r = xi - f.x[s, j]
        distance = ti.sqrt(r.dot(r)) + 1e-9
        u = ti.max(1.0 - distance * inv_h, 0.0)
        w = weight(u)
        total += w
        drift += w * (f.v[s, j] - vi)
        pull -= (attraction(u) / distance) * r
    # A lone pair is drawn together slowly: weight of the neighbourhood relative to a full one is left in `drift`.
    relax = 1.0 - ti.exp(-f.viscosity[s] * dt)
    return relax * drift / ti.max(total, 1.0) + (f.attraction[s] * dt) * pull
