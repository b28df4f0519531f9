"""Cohesion: the surface's energy, its tension times its area, and that energy's exact gradient as the force.

A particle's part of the surface follows from two sums over its neighbours: the attraction that does not cancel, a
vector g (|g| = 1 on a plane surface, 0 inside), and the fraction of missing bonds, δ. Its energy is

    E_i = σ d² / SURFACE · (√(max(|g| − CALM, 0)² + (ALONE δ)² + BLUNT²) − BLUNT).

The first part is the total variation of a smoothed indicator: a stress along the surface and none inside, so that the
bulk is subject to Laplace's pressure alone. A plain pairwise attraction with the same tension presses twenty to thirty
times harder. Particles under such pressure form a soft glass, which creeps instead of oscillating like a drop. The
second part keeps drops together: with the first part alone a single particle has no energy, and drops evaporate. The
forces derive from an energy, and are equal and opposite in pairs. They conserve momentum and do not heat the liquid, if
they act often enough.

Walls count as liquid, so neither wet nor dry walls have a surface. Wetting a wall then costs no energy, which is a
contact angle of 90° (Young 1805). Any other angle θ is the energy −σ cos θ per area of wet wall: walls attract (or
repel) particles so that all layers within RANGE have that energy together.

Range: at 2.2 d, the density's support, drops of 2,000 particles are damped seven times as much as at 3 d.

Source: derived here; total variation as interfacial energy: Modica 1987; forces as exact gradients: Bonet & Lok 1999.
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.kernels import (
    BULK_BOND,
    HALF_ATTRACTION,
    attraction,
    attraction_turn,
    bond,
    dot,
    length,
    wall_attraction,
    wall_bond,
)
from sim_engine.fluid.neighbours import in_eights, take_seats
from sim_engine.fluid.scene_setup import RANGE
from sim_engine.fluid.state import STRETCHES, VESSELS

ALONE = 3.0
"""Weight of the missing bonds. At 1 drops lose their density; at 2 and range 2.8 oscillations decay faster."""
CALM = 0.1
"""Remaining attraction due to the disorder of the bulk, which does not count as surface."""
BLUNT = 0.3
"""Rounds the energy off towards the bulk; a sharper transition requires shorter intervals between forces."""
BONDED = 0.9
"""Bonds of a particle that lacks none, relative to those of a continuum."""
LARGEST_PULL = 0.1
"""Largest displacement by cohesion at a time, in spacings: a strong tension at fine spacing stays stable."""

WHOLE = BULK_BOND * RANGE**3
PLANE = HALF_ATTRACTION * RANGE**3


@ti.func
def look_at_surface(f: ti.template(), s, seats, behind, inv_h):
    """Sums over pairs, and from them each particle's part of the surface.

    Stores the energy's derivatives by the two sums: by the sum over attractions in `lean`; by the sum over bonds, which
    is negative, with reversed sign in `missing`.
    """
    # Walls count as liquid: half-spaces, u = 1 − φ / (RANGE d), at most touching the particle.
    for k in range(seats, behind):
        i = f.seated[k]
        bonds = ti.cast(0.0, ti.f32)
        lean = ti.Vector([0.0, 0.0, 0.0])
        for b in ti.static(range(VESSELS)):
            u = ti.min(1.0 - f.phi[i][b] * inv_h, 1.0)
            if u > 0.0:
                bonds += RANGE**3 * wall_bond(u)
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                lean += RANGE**3 * wall_attraction(u) * n
        f.bonds[k] = bonds
        f.lean[k] = lean
    # bonds_i = Σ_j bond(r_ij), lean_i = Σ_j attraction(r_ij) r_ij, r = x_i − x_j in units of RANGE d.
    for k in range(seats, behind):
        x = f.seat[k]
        bonds = ti.cast(0.0, ti.f32)
        lean = ti.Vector([0.0, 0.0, 0.0])
        for c in range(k * STRETCHES, (k + 1) * STRETCHES):
            first, last = f.stretch[c][0], f.stretch[c][1]
            for j in range(first, first + in_eights(last - first)):
                r = x - f.seat[j]
                u = ti.select(j < last, ti.max(1.0 - length(r), 0.0), 0.0)
                w = bond(u)
                g = attraction(u) * r
                bonds += w
                lean += g
                f.bonds[j] = f.bonds[j] + w
                f.lean[j] = f.lean[j] - g
        f.bonds[k] = f.bonds[k] + bonds
        f.lean[k] = f.lean[k] + lean
    # With g⃗ = lean / PLANE, δ = BONDED − bonds / WHOLE, G = max(|g⃗| − CALM, 0) and the root
    # e = √(G² + (ALONE δ)² + BLUNT²): ∂e/∂lean = G g⃗ / (|g⃗| PLANE e), −∂e/∂bonds = ALONE² δ / (WHOLE e).
    for k in range(seats, behind):
        lean = f.lean[k] / PLANE
        size = length(lean) + 1e-9
        g = ti.max(size - CALM, 0.0)
        lacking = ti.max(BONDED - f.bonds[k] / WHOLE, 0.0)
        energy = ti.sqrt(g * g + (ALONE * lacking) ** 2 + BLUNT**2)
        f.lean[k] = (g / (size * PLANE * energy)) * lean
        f.missing[k] = ALONE**2 * lacking / (WHOLE * energy)
        f.pulled[k] = ti.Vector([0.0, 0.0, 0.0])
    # Images see only part of their neighbours: they have the values of their particles.
    images = f.begin[s] + f.particles[s]
    for k in range(seats, behind):
        if f.seated[k] >= images:
            i = f.cell[f.seated[k] - f.particles[s]]
            f.lean[k] = ti.Vector([f.lean[i][0], -f.lean[i][1], f.lean[i][2]])
            f.missing[k] = f.missing[i]


@ti.func
def pull(f: ti.template(), s, dt):
    """Change all velocities by cohesion over dt."""
    inv_h = 1.0 / (RANGE * f.spacing[s])
    seats, behind = take_seats(f, s, RANGE * f.spacing[s])
    look_at_surface(f, s, seats, behind, inv_h)
    # Gradient of Σ e by r of a pair, with g = ∂e_i/∂lean − ∂e_j/∂lean, a(r) = attraction, a'(r)/r = attraction_turn:
    # a g + (a'/r (g · r) + a (missing_i + missing_j)) r, because d bond/dr⃗ = −a r⃗. The force is its negative.
    for k in range(seats, behind):
        x = f.seat[k]
        lean = f.lean[k]
        missing = f.missing[k]
        force = ti.Vector([0.0, 0.0, 0.0])
        for c in range(k * STRETCHES, (k + 1) * STRETCHES):
            first, last = f.stretch[c][0], f.stretch[c][1]
            for j in range(first, first + in_eights(last - first)):
                r = x - f.seat[j]
                u = ti.select(j < last, ti.max(1.0 - length(r), 0.0), 0.0)
                g = lean - f.lean[j]
                across = attraction(u)
                along = attraction_turn(u) * dot(g, r) + (missing + f.missing[j]) * across
                pair = across * g + along * r
                force += pair
                f.pulled[j] = f.pulled[j] + pair
        f.pulled[k] = f.pulled[k] - force
    # Young: energy −adhesion · wall_bond(u) of the particle, so the force is −adhesion · wall_attraction(u) n.
    if f.adhesion[s] != 0.0:
        for k in range(seats, behind):
            i = f.seated[k]
            for b in ti.static(range(VESSELS)):
                u = ti.min(1.0 - f.phi[i][b] * inv_h, 1.0)
                if u > 0.0:
                    n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                    f.pulled[k] = f.pulled[k] - f.adhesion[s] * wall_attraction(u) * n
    # Δv = cohesion [m/s²] · dt · pulled, at most LARGEST_PULL · d / dt in size.
    strength = f.cohesion[s] * dt
    bound = LARGEST_PULL * f.spacing[s] / dt
    for k in range(seats, behind):
        i = f.seated[k]
        change = strength * f.pulled[k]
        f.v[i] = f.v[i] + ti.min(1.0, bound / (length(change) + 1e-9)) * change
