"""Viscosity in SI: gravity and Newton's friction over a step at once, implicitly, with walls that liquid sticks to.

Sought are the velocities at which the liquid's kinetic energy, what gravity does to it and what friction takes balance:

    (1 + dt L) v = v* + dt g,    L = −ν ∇² between particles, and the wall's drag on those beside it.

Between particles, after Weiler et al. 2018,

    (L v)_i = Σ_j ν_ij 10 V (σ/h⁵) 20 u³ ((v_i − v_j)·e) e,    u = 1 − r/h, e = (x_i − x_j)/r:

forces along the line of a pair that depend on how fast it parts: liquid that turns as a whole is left alone, momentum
and angular momentum are kept, and a free surface is free of stress by itself. L is symmetric and not negative, so that
any time step is stable; conjugate gradients solve it without a matrix, in a few passes over the neighbour lists.

Walls. A layer of particles beside a wall sees the linear part of the boundary layer, from the wall, where liquid is at
rest, to its own middle at a distance s. The stress there is μ u / s, and acts on a layer whose mass per area is ρ d:

    drag = ν / (d s) · (u along the wall, relative to it),    fading between ¾ and 1¼ spacings from the wall,

which takes the same stress from a layer at d/2 as from particles that lie anywhere: ∫ drag s ds = ν u/s. A film of one
layer has nothing above it to pull it along; gravity moves it by g e²/3ν in the mean (Nusselt 1916), and sparse
particles stand for a film thinner than d: their drag is 3ν/e², with e from how many neighbours they have.

What is not resolved keeps the viscosity of eddies (`viscosity.py`) where that is larger. A boundary layer that is
thinner than d/2, √(πνt) < d/2 after a time t, takes more from the liquid than this.

Source: Weiler, Koschier, Brand & Bender 2018, A physically consistent implicit viscosity solver for SPH fluids; walls
and thin films: ours, as above.

Viscosity: velocities relax towards the neighbours' mean (XSPH), at a given rate and at that of unresolved motion.

Shear that is felt over a few spacings makes particles climb over each other; what they gain scatters a stream, the
more the coarser they are. In a liquid such motion decays into eddies smaller than a spacing. Their viscosity is that
of Smagorinsky, ν = (C d)² |S| with C = 0.17 (Lilly, from Kolmogorov's spectrum; θ may have another one) and the strain
rate |S| = √(2 S:S). Of a pair it is taken from the rate e at which the two part, over their distance: over all
directions the mean of e² is |S|²/15, and turning as a whole strains nobody. A relaxation at the rate k acts like a
kinematic viscosity of k d²/5, so to the given rate is added 5 C² √15 |e|, whose viscosity vanishes as spacings do.

Both are slow, and act only every few steps.

Source: Schechter & Bridson 2012 (XSPH); Smagorinsky 1963, Lilly 1967; with particles: Dalrymple & Rogers 2006.

What the packing of particles resists with, taken out of the velocities of thick liquids.

Particles under pressure are a weak solid. The density constraint's displacements −Σ (λ_i + λ_j) V ∇W are the gradient
of the multipliers λ only where the neighbours of a particle lie evenly around it; where shear has pushed them together
along one direction and apart along another, they hold back the shear, by a few percent of the pressure and however slow
it is. A gradient that is exact for linear λ, whatever the neighbours,

    ∇λ = M⁻¹ Σ (λ_j − λ_i) V ∇W,    M = Σ V (x_j − x_i) ⊗ ∇W,

knows nothing of that. What the two differ by, divided by the time step and averaged over each particle's neighbours, is
added to the velocities. Positions stay where the constraint has put them: it is what keeps particles apart.

Only inside: beside walls and the surface M is far from the identity, and the difference is none of the packing's alone;
there, liquid at rest would be stirred. Without the average its short waves would heat the liquid: with it a liquid of
100 mm²/s at rest jiggles at .02 m/s in place of .01. Momentum is not kept to the bit.

Source: ours; gradients that are exact for linear functions: Randles & Libersky 1996.
"""

import taichi as ti

from sim_engine.fluid.density import PACKING
from sim_engine.fluid.kernels import SIGMA, decayed, dot, length, slope, square, turned, wall_slope, weight
from sim_engine.fluid.state import SUPPORT, VESSELS
from sim_engine.fluid.walls import to_vessel

LAYERED = 1.14
"""The sum over pairs is that of the continuum among particles in disorder, and 0.76 of it where they lie in layers
that slide over each other, as they do beside walls: between the two."""
PAIRS = LAYERED * 200.0 * SIGMA / SUPPORT**5
"""Of a pair's coefficient: 10 V (σ/h⁵) 20 in units of 1/d²."""
NEAREST = 0.25
"""No particle is taken to be nearer to a wall than that many spacings."""
FADES, ENDS = 0.75, 1.25
"""Between these distances, in spacings, the wall's drag goes over to nothing: ½ (FADES + ENDS) is one layer."""
ACCURACY = 2e-3
"""Conjugate gradients end when what is left over is that part of what gravity does in a step (root mean squares) …"""
COARSELY = 1e-4
"""… or that part of the velocities themselves, where there is no gravity."""
MOST_PASSES = 80
STIFFEST = 0.4
"""Longest step in units of d²/ν: pressure acts after viscosity, and a longer step would hide one from the other."""
ALONE = SIGMA / SUPPORT**3
"""Kernel sum of a particle on its own, W(0) d³ …"""
BESIDE = 0.386
"""… what its neighbours in a plane layer add to it …"""
ABOVE = 0.16
"""… and what a layer above has, times its height in spacings."""
THINNEST = 0.15
"""Films are taken to be no thinner than that many spacings."""


@ti.func
def film(beside, above):
    """Thickness of the film that a particle next to a wall belongs to, in spacings, up to 2.

    Args:
        beside: kernel sum over its neighbours.
        above: the same, each times how much farther from the wall it is, in spacings.
    """
    return ti.min(ti.max(beside / BESIDE, THINNEST), 1.0) + ti.min(ti.max(above / ABOVE, 0.0), 1.0)


@ti.func
def drag(distance, e):
    """Of a wall on a particle, in units of ν/d².

    Args:
        distance: from the wall, in spacings.
        e: thickness of the film, in spacings.
    """
    s = ti.max(distance, NEAREST)
    layer = ti.min(ti.max((ENDS - s) / (ENDS - FADES), 0.0), 1.0) / s
    thin = ti.cast(1.0, ti.f32)
    if e < 1.0:
        thin = 1.5 / (e * e)
    else:
        thin = 1.0 + 0.5 * (2.0 - e)
    return layer * thin


@ti.func
def survey(f: ti.template(), s, dt):
    """What the step needs to know of every particle: its viscosity (dp) and what walls hold it with (push)."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    closest = (0.1 * d) ** 2
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.squares[i] = 0.0
        f.dp[i] = 0.0
        f.dx[i] = ti.Vector([0.0, 0.0, 0.0])
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        cover = ti.cast(0.0, ti.f32)
        strain = ti.cast(0.0, ti.f32)
        lean = ti.Vector([0.0, 0.0, 0.0])
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = f.x[i] - f.x[j]
            r2 = square(r)
            w = weight(ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0))
            parting = dot(f.v[i] - f.v[j], r) / (r2 + closest)
            part = w * parting * parting * r2 / (r2 + closest)
            cover += w
            strain += part
            lean += w * r
            f.dx[j] = f.dx[j] + w * r
            f.squares[j] = f.squares[j] + w
            f.dp[j] = f.dp[j] + part
        f.squares[i] = f.squares[i] + cover
        f.dp[i] = f.dp[i] + strain
        f.dx[i] = f.dx[i] - lean
    nu = f.kinematic[s]
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # A relaxation at the rate k is a viscosity of k d²/5.
        strain = ti.sqrt(f.dp[i] / (f.squares[i] + 1e-9))
        f.dp[i] = ti.max(nu, 0.2 * f.eddies[s] * d * d * strain)
        for b in ti.static(range(VESSELS)):
            n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
            e = film(ALONE * f.squares[i], ALONE * dot(f.dx[i], n) / d)
            f.push[i][b] = f.no_slip[s] * dt * nu / (d * d) * drag(f.phi[i][b] / d, e)


@ti.func
def rub(f: ti.template(), s, dt, v: ti.template(), out: ti.template()):
    """out = dt L v, walls at rest."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    scale = dt * PAIRS / (d * d) * 0.5
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        vi = v[i]
        held = ti.Vector([0.0, 0.0, 0.0])
        for b in ti.static(range(VESSELS)):
            k = f.push[i][b]
            held += k * vi
        out[i] = held
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        vi = v[i]
        nu = f.dp[i]
        total = ti.Vector([0.0, 0.0, 0.0])
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = xi - f.x[j]
            r2 = square(r) + 1e-12
            u = ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0)
            pair = (scale * (nu + f.dp[j]) * u * u * u * dot(vi - v[j], r) / r2) * r
            total += pair
            out[j] = out[j] - pair
        out[i] = out[i] + total


@ti.func
def diagonal(f: ti.template(), s, dt):
    """Mean of the diagonal of 1 + dt L at every particle (squares): what conjugate gradients divide by."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    scale = dt * PAIRS / (d * d) * 0.5 / 3.0
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.squares[i] = 1.0 + f.push[i][0] + f.push[i][1]
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        nu = f.dp[i]
        total = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            u = ti.max(1.0 - length(f.x[i] - f.x[j]) * inv_h, 0.0)
            pair = scale * (nu + f.dp[j]) * u * u * u
            total += pair
            f.squares[j] = f.squares[j] + pair
        f.squares[i] = f.squares[i] + total


@ti.func
def flow(f: ti.template(), s, dt):
    """Change all velocities by gravity and viscosity over dt."""
    survey(f, s, dt)
    diagonal(f, s, dt)
    fall = f.gravity[s] * dt
    size = ti.cast(0.0, ti.f32)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        v = f.v[i]
        v[2] -= fall
        f.v[i] = v
        size += square(v)
    # What is left over of the equation, as a velocity, and the direction of the search.
    rub(f, s, dt, f.v, f.dx)
    lasting = ti.cast(0.0, ti.f32)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        rest = -f.dx[i]
        for b in ti.static(range(VESSELS)):
            k = f.push[i][b]
            if k > 0.0:
                y = to_vessel(f, s, b, f.x[i], True)
                carried = (turned(f.turn[s, b], y) + f.origin[s, b] - f.x[i]) / dt
                rest += k * carried
        f.dv[i] = rest
        f.gradient[i] = rest / f.squares[i]
        lasting += square(rest) / f.squares[i]
    count = ti.cast(f.moving[s], ti.f32)
    limit = count * (ACCURACY * fall) ** 2
    if f.gravity[s] < 1e-3:
        limit = COARSELY**2 * size
    limit = ti.max(limit, count * 1e-14)
    left = 2.0 * limit
    n = 0
    while left > limit and n < MOST_PASSES:
        rub(f, s, dt, f.gradient, f.dx)
        along = ti.cast(0.0, ti.f32)
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            p = f.gradient[i]
            along += dot(p, p + f.dx[i])
        stride = lasting / ti.max(along, 1e-20)
        left = 0.0
        before = lasting
        lasting = 0.0
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            p = f.gradient[i]
            f.v[i] = f.v[i] + stride * p
            rest = f.dv[i] - stride * (p + f.dx[i])
            f.dv[i] = rest
            left += square(rest)
            lasting += square(rest) / f.squares[i]
        turn = lasting / ti.max(before, 1e-20)
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            f.gradient[i] = f.dv[i] / f.squares[i] + turn * f.gradient[i]
        n += 1
    f.passes[s] = f.passes[s] + n


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


NEIGHBOURHOOD, INSIDE = 0.6, 0.9
"""A particle has some of the correction from det M = BESIDE on, and all of it from INSIDE on. From 0.4 on, liquid at
rest boils."""


@ti.func
def yield_to_shear(f: ti.template(), s, dt):
    """Change all velocities; the multipliers are those that the step's density constraint ended with."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # M, symmetric, is in sums (xx, xy, xz, yy), squares (yz) and dp (zz).
        f.sums[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        f.squares[i] = 0.0
        f.dp[i] = 0.0
        f.gradient[i] = ti.Vector([0.0, 0.0, 0.0])
        push = ti.Vector([0.0, 0.0, 0.0])
        for b in ti.static(range(VESSELS)):
            q = f.phi[i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                push += f.pressure[i] * wall_slope(q) * inv_h * n
        f.dx[i] = push
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        pi = f.pressure[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = xi - f.x[j]
            g = scale * slope(ti.max(1.0 - length(r) * inv_h, 0.0)) * r
            m = ti.Vector([g[0] * r[0], g[0] * r[1], g[0] * r[2], g[1] * r[1]])
            pj = f.pressure[j]
            f.sums[i] = f.sums[i] + m
            f.sums[j] = f.sums[j] + m
            f.squares[i] = f.squares[i] + g[1] * r[2]
            f.squares[j] = f.squares[j] + g[1] * r[2]
            f.dp[i] = f.dp[i] + g[2] * r[2]
            f.dp[j] = f.dp[j] + g[2] * r[2]
            f.gradient[i] = f.gradient[i] + (pj - pi) * g
            f.gradient[j] = f.gradient[j] + (pj - pi) * g
            f.dx[i] = f.dx[i] + (pj + pi) * g
            f.dx[j] = f.dx[j] - (pj + pi) * g
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        m = f.sums[i]
        matrix = ti.Matrix([[m[0], m[1], m[2]], [m[1], m[3], f.squares[i]], [m[2], f.squares[i], f.dp[i]]])
        share = ti.min(ti.max((matrix.determinant() - NEIGHBOURHOOD) / (INSIDE - NEIGHBOURHOOD), 0.0), 1.0)
        change = ti.Vector([0.0, 0.0, 0.0])
        if share > 0.0:
            change = share / dt * (matrix.inverse() @ f.gradient[i] - f.dx[i])
        f.gradient[i] = change
        f.dx[i] = change
        f.squares[i] = 1.0
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            w = weight(ti.max(1.0 - length(f.x[i] - f.x[j]) * inv_h, 0.0))
            f.dx[i] = f.dx[i] + w * f.gradient[j]
            f.dx[j] = f.dx[j] + w * f.gradient[i]
            f.squares[i] = f.squares[i] + w
            f.squares[j] = f.squares[j] + w
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.v[i] = f.v[i] + f.dx[i] / f.squares[i]
