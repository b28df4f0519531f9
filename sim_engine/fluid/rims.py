"""How much lower a rim is for a particle than in truth: what a layer of particles lacks in head at a lip.

A film that runs over a lip under gravity is e = u²/g thick where it passes at the speed u (critical flow, Froude number
1), and its middle is e/2 above the lip. Particles' centres come no nearer to solid than half a spacing: a film thinner
than d passes with its middle at d/2, and needs (d − e)/2 more head than liquid does. So near a rim the solid is looked
up that much higher, which sets it lower for this particle, straight down in the world, by

    lip_drop · max(d − u²/g, 0),    lip_drop = ½,

u being the particle's speed relative to the vessel. Liquid at rest meets a lip half a spacing lower, and keeps what
hydrostatics says; one that flows faster than √(g d) meets the lip as it is, and leaves where the lip is. To shorten the
wall along itself, whatever the flow, made jets leave behind the true lip.

A film of a thick liquid that runs down at the mean speed u is √(3νu/g) thick (Nusselt 1916), where that is more.

The lowering follows the speed within √(d/g), in which liquid passes a spacing, and no faster than `SLOWLY` allows.

Source: ours; critical flow over a crest: Henderson 1966, Open Channel Flow, section 2.4.
"""

import taichi as ti

from sim_engine.fluid.state import VESSELS
from sim_engine.fluid.vectors import length, square, turned
from sim_engine.fluid.walls import to_vessel

NEAR = 4.0
"""Only particles within so many spacings of a wall have its rim lowered."""

SLOWLY = 0.05
"""A rim moves by at most so many spacings a step. Centres keep a fifth of a spacing from solid, and so stay outside."""


@ti.func
def lower_rims(f: ti.template(), s, dt, thick: ti.template()):
    """Change by how much each vessel's rim is lower for each particle, over dt."""
    d = f.spacing[s]
    gravity = ti.max(f.gravity[s], 1e-3)
    share = 1.0 - ti.exp(-dt * ti.sqrt(gravity / d))
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        for b in range(VESSELS):
            if f.phi[i][b] < NEAR * d:
                u = f.v[i]
                if f.swing[s, b] > 0.0:
                    y = to_vessel(f, s, b, f.x[i], False)
                    u -= (turned(f.turn[s, b], y) + f.origin[s, b] - turned(f.turn0[s, b], y) - f.origin0[s, b]) / dt
                film = square(u) / gravity
                if ti.static(thick):
                    film = ti.max(film, ti.sqrt(3.0 * f.kinematic[s] * length(u) / gravity))
                aim = f.lip_drop[s] * ti.max(d - film, 0.0)
                change = share * (aim - f.sag[i][b])
                f.sag[i][b] = f.sag[i][b] + ti.min(ti.max(change, -SLOWLY * d), SLOWLY * d)
            else:
                f.sag[i][b] = 0.0
