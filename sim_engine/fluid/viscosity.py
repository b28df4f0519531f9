"""Viscosity: in SI for thick liquids, and by relaxation (XSPH) for liquids as thin as water.

**Viscosity in SI** (`flow`): gravity and Newton's friction over a step together, implicitly, with no-slip walls. The
solution is the velocities at which the liquid's kinetic energy, the work of gravity and the loss by friction balance:

    (1 + dt L) v = v* + dt g,    L = −ν ∇² between particles, plus the wall's drag on those next to it.

Between particles,

    (L v)_i = Σ_j ν_ij 4 V (σ/h⁵) 20 u³ (v_i − v_j − ½ (ω_i + ω_j) × (x_i − x_j)),    u = 1 − r/h,

where ω_i is the rotation that fits the velocities of a particle's neighbours best, with the same weights. What is left
of a linear flow is its rate of strain, so the stress is Newton's and a free surface is free of it without further
conditions. Forces along the line of a pair alone (Weiler et al. 2018) have the same limit, but particles find motions
that hardly change their distances: layers next to walls slid over each other at up to twice the rate, and tubes flowed
25 to 42 % too fast. Linear momentum is conserved; angular momentum up to the change of ω in a step. With ω given, L is
symmetric and positive semidefinite, so any time step is stable. Conjugate gradients solve the system without a matrix,
in a few passes over the neighbour lists. ω is that of the liquid before the step, and in a second round that of the
first round's result.

Walls. A layer of particles next to a wall represents the linear part of the boundary layer, from the wall, where liquid
is at rest, to the layer's own middle at a distance s. The stress there is μ u / s, and acts on a layer whose mass per
area is ρ d c:

    drag = ν / (c d s) · (u along the wall, relative to it),    fading between ¾ and 1¼ spacings from the wall.

c is the cover of the wall: the particles of the layer per d² of wall, 1 in a square lattice. Curved walls and liquid
that expands or contracts leave 0.7 to 0.8 of them, and the stress of the same area of wall acts on fewer. It is the
kernel's sum over the layer with distances along the wall, over that of the lattice. A layer at d/2 and particles at
other distances receive the same stress: ∫ drag s ds = ν u/s. A film of one layer has nothing above it to pull it along;
gravity moves it by g e²/3ν on average (Nusselt 1916). Sparse particles represent a film thinner than d: their drag is
3ν/e², and e follows from their number of neighbours. In between, the two are weighted by the height of the liquid above
the layer, up to one spacing.

Unresolved motion keeps the eddy viscosity (see below) if that is larger. A boundary layer that is thinner than d/2,
√(πνt) < d/2 after a time t, takes more momentum from the liquid than this model does.

Source: Weiler, Koschier, Brand & Bender 2018, A physically consistent implicit viscosity solver for SPH fluids (the
implicit step; other forces between particles); forces, walls and thin films: derived here, as above.

**Relaxation** (`relax`): velocities relax towards the neighbours' mean (XSPH), at a given rate plus that of unresolved
motion. Shear over a few spacings makes particles climb over each other, and the resulting motion scatters a stream,
more with coarser particles. In a liquid such motion decays into eddies smaller than a spacing. Their viscosity is
Smagorinsky's, ν = (C d)² |S| with C = 0.17 (Lilly, from Kolmogorov's spectrum; θ may have another value) and the strain
rate |S| = √(2 S:S).

For a pair it is computed from the rate e at which the two separate, divided by their distance: averaged over all
directions e² is |S|²/15, and rigid rotation causes no strain. A relaxation at the rate k acts like a kinematic
viscosity of k d²/5. Therefore 5 C² √15 |e|, whose viscosity vanishes with the spacing, is added to the given rate. Both
are slow, and act only every few steps.

Source: Schechter & Bridson 2012 (XSPH); Smagorinsky 1963, Lilly 1967; with particles: Dalrymple & Rogers 2006.

**Packing resistance** (`yield_to_shear`): removed from the velocities of thick liquids. Particles under pressure are a
weak solid. The density constraint's displacements −Σ (λ_i + λ_j) V ∇W are the gradient of the multipliers λ only if the
neighbours of a particle are evenly distributed. If shear has pushed them together along one direction and apart along
another, the displacements resist the shear by a few percent of the pressure, however slow the shear is. The following
gradient is exact for linear λ and any arrangement of neighbours:

    ∇λ = M⁻¹ Σ (λ_j − λ_i) V ∇W,    M = Σ V (x_j − x_i) ⊗ ∇W,

It does not contain this resistance. The difference of the two, divided by the time step and averaged over each
particle's neighbours, is added to the velocities. Positions stay as the constraint has set them, because it keeps
particles apart.

The correction acts inside and, along walls, in the layer next to them. Neighbours on one side are enough for the
gradient along a wall. At right angles to it the difference contains the wall's push, and would stir liquid at rest. At
the surface M is far from the identity, and pressure is low. At the floor pressure is highest: without the layer next
to walls, most of the resistance remained. That layer's part fades until dt ν/d² = STIFFEST. Friction between particles
is too weak where neighbours are missing, at slippery walls and surfaces, and with the whole correction vortices of
2,000 mm²/s decay by 28 % too slowly; this case was used to choose where it ends.

Without the average the correction's short waves would heat the liquid: with it the velocity fluctuations of a liquid
of 100 mm²/s at rest are 0.02 m/s instead of 0.01. Momentum is not conserved to the last bit.

Source: derived here; gradients that are exact for linear functions: Randles & Libersky 1996.
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.density import PACKING
from sim_engine.fluid.kernels import SIGMA, decayed, dot, length, slope, square, turned, wall_slope, weight
from sim_engine.fluid.neighbours import AXIAL, POLAR, SCALAR, part_from_own, reflect
from sim_engine.fluid.state import SUPPORT, VESSELS
from sim_engine.fluid.walls import to_vessel

PAIRS = 80.0 * SIGMA / SUPPORT**5
"""Coefficient of a pair: 4 V (σ/h⁵) 20 in units of 1/d²."""
NEAREST = 0.25
"""Least distance of a particle from a wall, in spacings."""
FADES, ENDS = 0.75, 1.25
"""Distances in spacings between which what walls do to the layer next to them decreases to zero: ½ (FADES + ENDS) is
one layer."""
ACCURACY = 2e-3
"""Conjugate gradients end when the residual is this fraction of the velocity that gravity gives in a step (root mean
squares).
"""
COARSELY = 1e-4
"""Without gravity, conjugate gradients end when the residual is this fraction of the velocities."""
MOST_PASSES = 80
STIFFEST = 0.2
"""Longest step in units of d²/ν: pressure acts after viscosity, and in a longer step each would hide the other. At
0.4 vortices of 2,000 mm²/s decayed by 17 % too slowly."""
ALONE = SIGMA / SUPPORT**3
"""Kernel sum of a single particle, W(0) d³."""
BESIDE = 0.386
"""Part of the kernel sum that the neighbours of a particle in a plane layer add."""
ABOVE = 0.16
"""Part of the kernel sum of a layer above, times its height in spacings."""
SPARSEST = 0.3
"""Least cover of a wall by the layer next to it, in particles per d²."""
THINNEST = 0.15
"""Least thickness of films, in spacings."""
LEAST_INERTIA = 0.02
"""Added to the inertia of a neighbourhood, as a fraction of its trace: a single pair has none about its own line."""
ROUNDS = 2
"""Solutions with improved rotation. With one, vortices decay by 16 % too slowly at dt ν k² = 0.13."""


@ti.func
def drag(distance, film, cover, above):
    """Drag of a wall on a particle, in units of ν/d².

    Args:
        distance: from the wall, in spacings.
        film: thickness of a film without a layer above, in spacings, up to 1.
        cover: particles of the layer next to the wall per d² of wall.
        above: thickness of the liquid above that layer, in spacings, up to 1.
    """
    # beside · (above / (cover s) + (1 − above) 1.5 / (s film²)): Newton's shear in a layer at the distance s, and the
    # friction of a film (Nusselt 1916), which is 3 / film² at s = ½, the middle of a layer.
    s = ti.max(distance, NEAREST)
    return beside(s) / s * (above / cover + (1.0 - above) * 1.5 / (film * film))


@ti.func
def beside(distance):
    """How far a particle belongs to the layer next to a wall at a distance in spacings, 0 to 1."""
    return ti.min(ti.max((ENDS - distance) / (ENDS - FADES), 0.0), 1.0)


@ti.func
def survey(f: ti.template(), s, dt):
    """Values of every particle for the step: its viscosity (dp) and the drag of the walls (push)."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    closest = (0.1 * d) ** 2
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.squares[i] = 0.0
        f.dp[i] = 0.0
        f.dx[i] = ti.Vector([0.0, 0.0, 0.0])
        for b in ti.static(range(VESSELS)):
            f.push[i][b] = 0.0
    reflect(f, s, f.x, POLAR)
    reflect(f, s, f.v, POLAR)
    reflect(f, s, f.phi, SCALAR)
    # Sums over neighbours: squares = Σ W, dp = Σ W e² with the rate e = v_ij · r / r² at which a pair separates [1/s],
    # dx = −Σ W r, push = Σ W(distance along the wall) · membership of the partner in the layer next to it.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        total = ti.cast(0.0, ti.f32)
        strain = ti.cast(0.0, ti.f32)
        lean = ti.Vector([0.0, 0.0, 0.0])
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = f.x[i] - f.x[j]
            r2 = square(r)
            w = weight(ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0))
            parting = dot(f.v[i] - f.v[j], r) / (r2 + closest)
            strained = w * parting * parting * r2 / (r2 + closest)
            total += w
            strain += strained
            lean += w * r
            f.dx[j] = f.dx[j] + w * r
            f.squares[j] = f.squares[j] + w
            f.dp[j] = f.dp[j] + strained
            for b in ti.static(range(VESSELS)):
                of_i, of_j = beside(f.phi[i][b] / d), beside(f.phi[j][b] / d)
                if of_i * of_j > 0.0:
                    n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                    along = ti.sqrt(ti.max(r2 - dot(n, r) ** 2, 0.0))
                    lateral = weight(ti.max(1.0 - along * inv_h, 0.0))
                    f.push[i][b] = f.push[i][b] + lateral * of_j
                    f.push[j][b] = f.push[j][b] + lateral * of_i
        f.squares[i] = f.squares[i] + total
        f.dp[i] = f.dp[i] + strain
        f.dx[i] = f.dx[i] - lean
    nu = f.kinematic[s]
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # Smagorinsky: e² = |S|²/15 on average, and a relaxation at the rate k corresponds to a viscosity of k d²/5:
        # ν_i = max(ν, eddies √⟨e²⟩ d²/5) [m²/s], eddies = 5 C² √15.
        strain = ti.sqrt(f.dp[i] / (f.squares[i] + 1e-9))
        f.dp[i] = ti.max(nu, 0.2 * f.eddies[s] * d * d * strain)
        for b in ti.static(range(VESSELS)):
            # Shape of the liquid at the wall, from the kernel sums of a layer (BESIDE) and of one on top of it (ABOVE):
            # height above the layer and film thickness in spacings, cover in particles per d².
            n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
            above = ti.min(ti.max(ALONE * dot(f.dx[i], n) / (d * ABOVE), 0.0), 1.0)
            q = f.phi[i][b] / d
            cover = ALONE * (beside(q) + f.push[i][b]) / (ALONE + BESIDE)
            film = ti.min(ti.max(ALONE * f.squares[i] / BESIDE, THINNEST), 1.0)
            # The wall's part of dt L, dimensionless: push = dt ν/d² drag.
            f.push[i][b] = f.no_slip[s] * dt * nu / (d * d) * drag(q, film, ti.max(cover, SPARSEST), above)
    reflect(f, s, f.dp, SCALAR)


@ti.func
def rub(f: ti.template(), s, dt, v: ti.template(), out: ti.template()):
    """out = dt L v, walls at rest."""
    reflect(f, s, v, POLAR)
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    # (dt L v)_i = push_i v_i + Σ_j dt PAIRS/d² ½ (ν_i + ν_j) u³ (v_i − v_j), u = 1 − r/h; without the rotation ω.
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
            u = ti.max(1.0 - length(r) * inv_h, 0.0)
            pair = (scale * (nu + f.dp[j]) * u * u * u) * (vi - v[j])
            total += pair
            out[j] = out[j] - pair
        out[i] = out[i] + total


@ti.func
def cross(a, b):
    """a × b."""
    return ti.Vector([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


@ti.func
def turn_along(f: ti.template(), s, dt):
    """Add to the residual (dv) the part of the rotation of v − v_copy: the equation is linear in it."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.sums[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        f.place[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        f.move[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    reflect(f, s, f.v, POLAR)
    reflect(f, s, f.v_copy, POLAR)
    # Least squares: the rotation ω of Δv = v − v_copy minimises Σ_j u³ |Δv_ij − ω × r_ij|², hence
    #     ω = J⁻¹ Σ_j u³ r × Δv_ij,    J = Σ_j u³ (|r|² 1 − r ⊗ r), an inertia, r in units of h.
    # Second moments Σ u³ r ⊗ r go to sums (xx, xy, xz, yy), move[3] (yz) and place[0] (zz), the moment to move[0 … 2].
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        change = f.v[i] - f.v_copy[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = inv_h * (f.x[i] - f.x[j])
            u = ti.max(1.0 - length(r), 0.0)
            w = u * u * u
            m = w * ti.Vector([r[0] * r[0], r[0] * r[1], r[0] * r[2], r[1] * r[1]])
            spin = cross(r, change - f.v[j] + f.v_copy[j])
            n = w * ti.Vector([spin[0], spin[1], spin[2], r[1] * r[2]])
            zz = w * r[2] * r[2]
            f.sums[i] = f.sums[i] + m
            f.sums[j] = f.sums[j] + m
            f.move[i] = f.move[i] + n
            f.move[j] = f.move[j] + n
            f.place[i][0] = f.place[i][0] + zz
            f.place[j][0] = f.place[j][0] + zz
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xx, xy, xz, yy = f.sums[i][0], f.sums[i][1], f.sums[i][2], f.sums[i][3]
        yz, zz = f.move[i][3], f.place[i][0]
        low = LEAST_INERTIA * (xx + yy + zz) + 1e-9
        inertia = ti.Matrix([[yy + zz + low, -xy, -xz], [-xy, xx + zz + low, -yz], [-xz, -yz, xx + yy + low]])
        f.gradient[i] = inv_h * (inertia.inverse() @ ti.Vector([f.move[i][0], f.move[i][1], f.move[i][2]]))
    reflect(f, s, f.gradient, AXIAL)
    # dv_i += Σ_j dt PAIRS/d² ½ (ν_i + ν_j) u³ ½ (ω_i + ω_j) × r_ij: the residual of the solution that turns along.
    scale = dt * PAIRS / (d * d) * 0.25
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        nu = f.dp[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            r = f.x[i] - f.x[j]
            u = ti.max(1.0 - length(r) * inv_h, 0.0)
            pair = (scale * (nu + f.dp[j]) * u * u * u) * cross(f.gradient[i] + f.gradient[j], r)
            f.dv[i] = f.dv[i] + pair
            f.dv[j] = f.dv[j] - pair


@ti.func
def diagonal(f: ti.template(), s, dt):
    """Mean of the diagonal of 1 + dt L at every particle (squares), by which conjugate gradients divide."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    # D_i = 1 + Σ_walls push_i + Σ_j dt PAIRS/d² ½ (ν_i + ν_j) u³
    scale = dt * PAIRS / (d * d) * 0.5
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
        f.v_copy[i] = ti.Vector([0.0, 0.0, 0.0])
        size += square(v)
    # The residual of (1 + dt L) v = v* + dt g at the start v = v* + dt g: −dt L v, plus the drag of walls that move,
    # push · (velocity of the wall). Without the part of the rotation.
    rub(f, s, dt, f.v, f.dx)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        residual = -f.dx[i]
        for b in ti.static(range(VESSELS)):
            k = f.push[i][b]
            if k > 0.0:
                y = to_vessel(f, s, b, f.x[i], True)
                carried = (turned(f.turn[s, b], y) + f.origin[s, b] - f.x[i]) / dt
                residual += k * carried
        f.dv[i] = residual
    # Ends at Σ |residual|² ≤ N (ACCURACY g dt)², or COARSELY² Σ |v|² without gravity; at least 1e-7 m/s per particle.
    count = ti.cast(f.moving[s], ti.f32)
    limit = count * (ACCURACY * fall) ** 2
    if f.gravity[s] < 1e-3:
        limit = COARSELY**2 * size
    limit = ti.max(limit, count * 1e-14)
    # Conjugate gradients with the diagonal D as preconditioner (Hestenes & Stiefel 1952; Saad 2003, algorithm 9.1):
    #     α = rᵀD⁻¹r / pᵀAp,  v += α p,  r −= α A p,  β = r'ᵀD⁻¹r' / rᵀD⁻¹r,  p = D⁻¹r' + β p,    A = 1 + dt L
    # r: dv, p: gradient, A p: gradient + dx, D: squares, rᵀD⁻¹r: weighted_residual, pᵀAp: curvature.
    for _ in range(ROUNDS):
        turn_along(f, s, dt)
        weighted_residual = ti.cast(0.0, ti.f32)
        squared_residual = ti.cast(0.0, ti.f32)
        for i in range(f.begin[s], f.begin[s] + f.moving[s]):
            residual = f.dv[i]
            f.v_copy[i] = f.v[i]
            f.gradient[i] = residual / f.squares[i]
            squared_residual += square(residual)
            weighted_residual += square(residual) / f.squares[i]
        n = 0
        while squared_residual > limit and n < MOST_PASSES:
            rub(f, s, dt, f.gradient, f.dx)
            curvature = ti.cast(0.0, ti.f32)
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                p = f.gradient[i]
                curvature += dot(p, p + f.dx[i])
            alpha = weighted_residual / ti.max(curvature, 1e-20)
            squared_residual = 0.0
            previous = weighted_residual
            weighted_residual = 0.0
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                p = f.gradient[i]
                f.v[i] = f.v[i] + alpha * p
                residual = f.dv[i] - alpha * (p + f.dx[i])
                f.dv[i] = residual
                squared_residual += square(residual)
                weighted_residual += square(residual) / f.squares[i]
            beta = weighted_residual / ti.max(previous, 1e-20)
            for i in range(f.begin[s], f.begin[s] + f.moving[s]):
                f.gradient[i] = f.dv[i] / f.squares[i] + beta * f.gradient[i]
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
    reflect(f, s, f.x, POLAR)
    reflect(f, s, f.v, POLAR)
    # r² and |v_ij · r| of all pairs, then their weights, eight at a time:
    # W (1 − exp(−(xsph_rate + eddies |e|) dt)), e = v_ij · r / r² [1/s].
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi, vi = f.x[i], f.v[i]
        for k in range(f.first[i], f.first[i] + f.count[i]):
            r = xi - f.x[f.neighbour[k]]
            f.pair[k] = square(r)
            f.share[k] = ti.abs(dot(f.v[f.neighbour[k]] - vi, r))
    part_from_own(f, s)
    for k in range(f.list_begin[s], f.list_end[s]):
        r2 = f.pair[k]
        w = weight(ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0))
        parting = f.share[k] / (r2 + closest)
        f.share[k] = w
        f.pair[k] = w * decayed((f.viscosity[s] + f.eddies[s] * parting) * dt)
    # XSPH (Schechter & Bridson 2012): v_i += Σ_j W c_ij (v_j − v_i) / max(Σ_j W, 1), c_ij = 1 − exp(…) of the pair.
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
        # A sparse neighbourhood (a drip) relaxes more slowly: its weights sum to less than those of a full one.
        f.v[i] = f.v[i] + f.dx[i] / ti.max(f.squares[i], 1.0)


NEIGHBOURHOOD, INSIDE = 0.6, 0.9
"""A particle gets part of the correction from det M = NEIGHBOURHOOD on, and all of it from INSIDE on. If it begins at
0.4, liquid at rest boils."""
COVERED, SURROUNDED = 0.85, 0.95
"""A particle also gets part of the correction from the density ρ/ρ₀ = COVERED on, and all of it from SURROUNDED on. The
density includes the walls' part: a plane surface has 0.8."""
LEAST_DETERMINANT = 0.1
"""Below it M is not inverted."""


@ti.func
def yield_to_shear(f: ti.template(), s, dt):
    """Change all velocities, by the final multipliers of the step's density constraint."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    thin = ti.max(1.0 - dt * f.kinematic[s] / (STIFFEST * d * d), 0.0)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        # M, symmetric, is stored in sums (xx, xy, xz, yy), squares (yz) and dp (zz).
        f.sums[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
        f.squares[i] = 0.0
        f.dp[i] = 0.0
        # dx collects the constraint's displacement, that by walls first: λ wall_slope/h n.
        f.gradient[i] = ti.Vector([0.0, 0.0, 0.0])
        push = ti.Vector([0.0, 0.0, 0.0])
        for b in ti.static(range(VESSELS)):
            q = f.phi[i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                push += f.pressure[i] * wall_slope(q) * inv_h * n
        f.dx[i] = push
    reflect(f, s, f.x, POLAR)
    reflect(f, s, f.pressure, SCALAR)
    # With g = −V ∇W = V (σ/h⁵) slope r, r = x_i − x_j: M = Σ g ⊗ r, gradient = Σ (λ_j − λ_i) g = −Σ (λ_j − λ_i) V ∇W,
    # dx = Σ (λ_i + λ_j) g, as in `density.displace`.
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
        # Exact minus actual displacement, over dt: Δv = share / dt (M⁻¹ gradient − dx) [m/s], along walls next to them.
        determinant = matrix.determinant()
        even = (determinant - NEIGHBOURHOOD) / (INSIDE - NEIGHBOURHOOD)
        covered = ti.min((f.density[i] - COVERED) / (SURROUNDED - COVERED), 1.0)
        share = ti.min(ti.max(ti.max(even, thin * covered), 0.0), 1.0)
        change = ti.Vector([0.0, 0.0, 0.0])
        if share > 0.0 and determinant > LEAST_DETERMINANT:
            change = share / dt * (matrix.inverse() @ f.gradient[i] - f.dx[i])
            for b in ti.static(range(VESSELS)):
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                beside = ti.min(ti.max((ENDS - f.phi[i][b] / d) / (ENDS - FADES), 0.0), 1.0)
                change -= beside * dot(change, n) * n
        f.gradient[i] = change
        f.dx[i] = change
        f.squares[i] = 1.0
    reflect(f, s, f.gradient, POLAR)
    # v_i += (Δv_i + Σ_j W Δv_j) / (1 + Σ_j W): Shepard's average (Shepard 1968), W(0) = 1.
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
