"""Vessels as moving signed distance grids: look-up, swept contact, cavity membership, and lowered rims.

**Swept contact.** The distance alone does not make a thin wall tight: a particle that steps over the middle of the wall
is pushed out on the far side. Therefore every step is also swept. The particle's path in the vessel's own frame, which
includes the vessel's motion, is traced through the grid and stops at solid.

**Lowered rims.** A layer of particles needs more head at a lip than liquid does, so rims are lower for slow particles:
the grid is looked up a little higher, by an offset that grows from zero over the uppermost spacings.

A film that runs over a lip under gravity has the thickness e = u²/g at the speed u (critical flow, Froude number 1),
and its middle is e/2 above the lip. Particles' centres stay at least half a spacing from solid. A film thinner than d
passes with its middle at d/2, and needs (d − e)/2 more head than liquid does. Near a rim the solid is therefore looked
up that much higher. This lowers it for this particle, straight down in the world, by

    rim_correction · max(d − u²/g, 0),    rim_correction = ½,

where u is the particle's speed relative to the vessel. For liquid at rest the lip is half a spacing lower, and the
retained volume agrees with hydrostatics. For liquid faster than √(g d) the lip is unchanged, and the liquid leaves at
the true lip. Shortening the wall along itself, whatever the flow, made jets leave behind the true lip.

A film of a thick liquid that runs down at the mean speed u has the thickness √(3νu/g) (Nusselt 1916), if that is
larger.

The lowering follows the speed within √(d/g), the time in which liquid passes a spacing, and not faster than `SLOWLY`
allows.

Source: derived here; critical flow over a crest: Henderson 1966, Open Channel Flow, section 2.4.
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.kernels import dot, length, square, turned, turned_back
from sim_engine.fluid.state import VESSELS
from sim_engine.liquids import LARGEST_RIM_CORRECTION

FAR = 1.0
"""Distance [m] reported beyond a grid."""

TRACE_STEPS = 24

LIP_BLEND = 6.0
"""Height below a rim over which its lowering builds up, in spacings."""

STRETCH = 1.0 + LARGEST_RIM_CORRECTION / LIP_BLEND
"""Largest gradient of the stretched distance: solid within STRETCH times a displacement may be reached by it."""


@ti.func
def look_up(f: ti.template(), s, b, y, sag):
    """Where the grid is read for a point of the vessel frame: near the rim `sag` [m] higher in the world."""
    # y + sag min(over / blend, 1) up: full at the lowered rim, zero from LIP_BLEND d below it; `up` is the world's.
    place = y
    blend = LIP_BLEND * f.spacing[s]
    over = y[2] - f.rim[s, b] + sag + blend
    if over > 0.0 and sag > 0.0:
        up = ti.Vector([f.turn[s, b][2, 0], f.turn[s, b][2, 1], f.turn[s, b][2, 2]])
        place = y + (sag * ti.min(over / blend, 1.0)) * up
    return place


@ti.func
def to_vessel(f: ti.template(), s, b, x, before: ti.template()):
    """World → vessel frame, at the end of the step or before it."""
    y = x
    if ti.static(before):
        y = turned_back(f.turn0[s, b], x - f.origin0[s, b])
    else:
        y = turned_back(f.turn[s, b], x - f.origin[s, b])
    return y


@ti.func
def to_world(f: ti.template(), s, b, y):
    """Vessel frame → world at the end of the step."""
    return turned(f.turn[s, b], y) + f.origin[s, b]


@ti.func
def distance(f: ti.template(), grids: ti.template(), s, b, y, sag):
    """Trilinear signed distance at a point of the vessel frame [m]; `FAR` beyond the grid."""
    size = f.grid_size[s, b]
    u = (look_up(f, s, b, y, sag) - f.grid_origin[s, b]) * (1.0 / f.grid_spacing[s, b])
    result = ti.cast(FAR, ti.f32)
    if (
        u[0] >= 0.0
        and u[1] >= 0.0
        and u[2] >= 0.0
        and u[0] < size[0] - 1.0
        and u[1] < size[1] - 1.0
        and u[2] < size[2] - 1.0
    ):
        i = ti.cast(u, ti.i32)
        w = u - ti.cast(i, ti.f32)
        row = size[2]
        slab = size[1] * size[2]
        k = f.grid_offset[s, b] + i[0] * slab + i[1] * row + i[2]
        # Interpolated along z in four rows, then along y, then along x.
        c00 = grids[k] + w[2] * (grids[k + 1] - grids[k])
        c01 = grids[k + row] + w[2] * (grids[k + row + 1] - grids[k + row])
        c10 = grids[k + slab] + w[2] * (grids[k + slab + 1] - grids[k + slab])
        c11 = grids[k + slab + row] + w[2] * (grids[k + slab + row + 1] - grids[k + slab + row])
        c0 = c00 + w[1] * (c01 - c00)
        c1 = c10 + w[1] * (c11 - c10)
        result = c0 + w[0] * (c1 - c0)
    return result


@ti.func
def distance_and_gradient(f: ti.template(), grids: ti.template(), offset, s, b, y, sag):
    """(∂φ/∂y normalised, φ) as a 4-vector from the values that start at `offset`; 0 and `FAR` beyond the grid."""
    size = f.grid_size[s, b]
    u = (look_up(f, s, b, y, sag) - f.grid_origin[s, b]) * (1.0 / f.grid_spacing[s, b])
    result = ti.Vector([0.0, 0.0, 0.0, FAR])
    if (
        u[0] >= 0.0
        and u[1] >= 0.0
        and u[2] >= 0.0
        and u[0] < size[0] - 1.0
        and u[1] < size[1] - 1.0
        and u[2] < size[2] - 1.0
    ):
        i = ti.cast(u, ti.i32)
        w = u - ti.cast(i, ti.f32)
        row = size[2]
        slab = size[1] * size[2]
        k = offset + i[0] * slab + i[1] * row + i[2]
        # Derivatives of the trilinear interpolation: gx = ∂φ/∂u_x and so on, in grid spacings; d: differences along z.
        d00 = grids[k + 1] - grids[k]
        d01 = grids[k + row + 1] - grids[k + row]
        d10 = grids[k + slab + 1] - grids[k + slab]
        d11 = grids[k + slab + row + 1] - grids[k + slab + row]
        c00 = grids[k] + w[2] * d00
        c01 = grids[k + row] + w[2] * d01
        c10 = grids[k + slab] + w[2] * d10
        c11 = grids[k + slab + row] + w[2] * d11
        c0 = c00 + w[1] * (c01 - c00)
        c1 = c10 + w[1] * (c11 - c10)
        gx = c1 - c0
        gy = (c01 - c00) + w[0] * ((c11 - c10) - (c01 - c00))
        gz0 = d00 + w[1] * (d01 - d00)
        gz1 = d10 + w[1] * (d11 - d10)
        gz = gz0 + w[0] * (gz1 - gz0)
        steep = ti.sqrt(gx * gx + gy * gy + gz * gz) + 1e-12
        result = ti.Vector([gx / steep, gy / steep, gz / steep, c0 + w[0] * (c1 - c0)])
    return result


@ti.func
def in_cavity(f: ti.template(), cavities: ti.template(), s, b, y):
    """Whether the grid node nearest to a point of the vessel frame lies in the cavity."""
    size = f.grid_size[s, b]
    i = ti.cast(ti.floor((y - f.grid_origin[s, b]) / f.grid_spacing[s, b] + 0.5), ti.i32)
    inside = 0
    if i[0] >= 0 and i[1] >= 0 and i[2] >= 0 and i[0] < size[0] and i[1] < size[1] and i[2] < size[2]:
        inside = ti.cast(cavities[f.cavity_offset[s, b] + (i[0] * size[1] + i[1]) * size[2] + i[2]], ti.i32)
    return inside


@ti.func
def swept(f: ti.template(), grids: ti.template(), s, b, y0, y1, skin, sag):
    """End of a particle's motion from y0 towards y1 (vessel frame): y1, or a point slid along the wall that it meets.

    |∇φ| ≤ STRETCH, so each point has a ball around it without solid. The balls around both ends may cover the way, as
    for particles that lie on a wall or move along it. Then nothing is in between, and the end is moved off the wall as
    far as needed. Otherwise the way is traced: first along itself, then along its remaining part in the wall's tangent
    plane, in steps that never enter solid.

    Args:
        skin: distance kept from solid [m]; less if the particle is already closer.
    """
    # Sphere tracing (Hart 1996) with the Lipschitz constant STRETCH: a ball of the radius φ/STRETCH is free of solid.
    y = y0
    path = y1 - y0
    remaining = length(path)
    clear = skin
    first_phi = ti.cast(0.0, ti.f32)
    query = y0
    lookups = 0
    leg = 0
    while leg < 2:
        wall = distance_and_gradient(f, grids, f.grid_offset[s, b], s, b, query, sag)
        n = ti.Vector([wall[0], wall[1], wall[2]])
        phi = wall[3]
        # Look-up 0 at y0, 1 at y1: without solid in between the trace is not needed. From 2 on: tracing at y.
        if lookups == 0:
            first_phi = phi
            clear = ti.min(clear, 0.9 / STRETCH * ti.max(phi, 0.0))
            query = y1
            if remaining <= phi / STRETCH - clear or remaining < 1e-9:
                y = y1
                leg = 2
        elif lookups == 1:
            query = y0
            if phi > 0.0 and first_phi + phi >= STRETCH * remaining:
                y = y1 + ti.max(clear - phi, 0.0) * n
                leg = 2
        else:
            free = phi / STRETCH - clear
            if remaining <= free or remaining < 1e-9:
                y += path
                leg = 2
            elif free < 1e-5 or lookups > TRACE_STEPS:
                # At solid: the remaining path loses its part into the wall, min(path · n, 0) n, once.
                if leg == 0:
                    path -= ti.min(dot(path, n), 0.0) * n
                clear *= 0.5
                lookups = 1
                leg += 1
            else:
                y += path * (free / remaining)
                path *= 1.0 - free / remaining
            remaining = length(path)
            query = y
        lookups += 1
    return y


@ti.func
def crossed(f: ti.template(), grids: ti.template(), s, b, y0, y1, sag):
    """1 if a straight step in the vessel frame passes the middle of a wall; sampled, independent of the sweep."""
    # φ is −t/2 in the middle of a wall of thickness t; a sample below −0.35 t counts as there.
    path = y1 - y0
    path_length = length(path)
    travelled = ti.cast(0.0, ti.f32)
    hit = 0
    lookups = 0
    while lookups < 64:
        phi = distance(f, grids, s, b, y0 + path * (travelled / (path_length + 1e-12)), sag)
        lookups += 1
        if phi < -0.35 * f.wall[s, b]:
            hit = 1
            lookups = 64
        if travelled >= path_length:
            lookups = 64
        # steps of the free ball's radius, but at least a quarter of the wall and a 48th of the path
        travelled = ti.min(
            travelled + ti.max(phi / STRETCH, ti.max(0.25 * f.wall[s, b], path_length / 48.0)), path_length
        )
    return hit


NEAR = 4.0
"""Distance from a wall within which a particle has the wall's rim lowered, in spacings."""

SLOWLY = 0.05
"""Largest movement of a rim per step, in spacings. Centres keep 0.2 spacings from solid, and so stay outside."""


@ti.func
def lower_rims(f: ti.template(), s, dt, thick: ti.template()):
    """Change the lowering of each vessel's rim for each particle, over dt."""
    d = f.spacing[s]
    # Relaxation with the time constant √(d/g): share = 1 − exp(−dt √(g/d)).
    gravity = ti.max(f.gravity[s], 1e-3)
    share = 1.0 - ti.exp(-dt * ti.sqrt(gravity / d))
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        for b in range(VESSELS):
            if f.phi[i][b] < NEAR * d:
                u = f.v[i]
                if f.swing[s, b] > 0.0:
                    y = to_vessel(f, s, b, f.x[i], False)
                    u -= (turned(f.turn[s, b], y) + f.origin[s, b] - turned(f.turn0[s, b], y) - f.origin0[s, b]) / dt
                # Film e = u²/g (Froude number 1), in thick liquids at least √(3νu/g) (Nusselt 1916) [m].
                film = square(u) / gravity
                if ti.static(thick):
                    film = ti.max(film, ti.sqrt(3.0 * f.kinematic[s] * length(u) / gravity))
                aim = f.rim_correction[s] * ti.max(d - film, 0.0)
                change = share * (aim - f.sag[i][b])
                f.sag[i][b] = f.sag[i][b] + ti.min(ti.max(change, -SLOWLY * d), SLOWLY * d)
            else:
                f.sag[i][b] = 0.0
