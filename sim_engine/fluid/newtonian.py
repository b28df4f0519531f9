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
"""

import taichi as ti

from sim_engine.fluid.kernels import SIGMA, weight
from sim_engine.fluid.state import SUPPORT, VESSELS
from sim_engine.fluid.vectors import dot, length, square, turned
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
