"""The density constraint: C_i = ρ_i/ρ₀ − 1 ≤ 0, solved for positions by damped Jacobi with accumulated multipliers.

Walls enter as the kernel's integral over a half-space at the wall's distance, so that liquid keeps half a spacing from
them and feels their pressure. Part of the multipliers is kept from step to step (warm start), which helps to carry a
resting column; iterations go on until the mean compression inside is small, so that deep vessels are solved as well as
shallow ones.

Pairs are visited once and add to both of their particles. Such sums are written out (a = a + b): Taichi turns += on a
field into an atomic operation, which made a pour four times slower.

Source: Macklin & Müller 2013 (position based fluids); Macklin, Müller & Chentanez 2016 (accumulated multipliers); wall
integral: after Bender et al. 2019 (volume maps), here with the analytic half-space. Limitations: concave corners see
only the nearer wall.
"""

import taichi as ti

from sim_engine.fluid.kernels import SIGMA, slope, wall_density, wall_slope, weight
from sim_engine.fluid.state import SUPPORT, VESSELS

import os as _os
PACKING = float(_os.environ.get('PACKING','1.032'))
"""Kernel sum of a relaxed bulk of spacing d over its continuum value, measured on a cup at rest."""

EDGE = float(_os.environ.get('EDGE','0.3'))
RELAXATION = 0.4
"""Damping of the Jacobi step: for this kernel at h = 2d the iteration matrix reaches about 4; above ½ it diverges."""


@ti.func
def measure_first(f: ti.template(), s):
    """Density of all particles and, for the whole step, what their constraints' gradients amount to."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.moving[s]):
        f.density[s, i] = 1.0  # W(0) of the particle itself
        f.gradient[s, i] = ti.Vector([0.0, 0.0, 0.0])
        f.squares[s, i] = 0.0
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        rho = ti.cast(0.0, ti.f32)
        total = ti.Vector([0.0, 0.0, 0.0])
        squares = ti.cast(0.0, ti.f32)
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            r2 = r.dot(r)
            u = ti.max(1.0 - ti.sqrt(r2) * inv_h, 0.0)
            w = weight(u)
            g = slope(u)
            g2 = g * g * r2
            rho += w
            total += g * r
            squares += g2
            f.density[s, j] = f.density[s, j] + w
            f.gradient[s, j] = f.gradient[s, j] - g * r
            f.squares[s, j] = f.squares[s, j] + g2
        f.density[s, i] = f.density[s, i] + rho
        f.gradient[s, i] = f.gradient[s, i] + total
        f.squares[s, i] = f.squares[s, i] + squares
    for i in range(f.moving[s]):
        total = -scale * f.gradient[s, i]
        for b in ti.static(range(VESSELS)):
            q = f.phi[s, i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[s, i][b, 0], f.normal[s, i][b, 1], f.normal[s, i][b, 2]])
                total -= wall_slope(q) * inv_h * n
        steep = total.norm()
        f.edge[s, i] = steep
        face = ti.Vector([0.0, 0.0, 0.0])
        if steep > EDGE * inv_h:
            face = total / steep
        f.facing[s, i] = face
        f.squares[s, i] = scale * scale * f.squares[s, i] + total.dot(total) + 0.05 * inv_h * inv_h


@ti.func
def measure(f: ti.template(), s):
    """Density of all particles."""
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    for i in range(f.moving[s]):
        f.density[s, i] = 1.0
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        rho = ti.cast(0.0, ti.f32)
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            w = weight(ti.max(1.0 - ti.sqrt(r.dot(r)) * inv_h, 0.0))
            rho += w
            f.density[s, j] = f.density[s, j] + w
        f.density[s, i] = f.density[s, i] + rho


@ti.func
def multiply(f: ti.template(), s, rate, momentum):
    """Change of all multipliers, from the measured density and the walls' share.

    Returns:
        Mean of max(ρ/ρ₀ − 1, 0) over the particles that are not at the surface.
    """
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    volume = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING
    inside = ti.cast(0.0, ti.f32)
    compressed = ti.cast(0.0, ti.f32)
    for i in range(f.moving[s]):
        rho = f.density[s, i] * volume
        for b in ti.static(range(VESSELS)):
            q = f.phi[s, i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                rho += wall_density(q)
        f.density[s, i] = rho
        if rho > 0.95:
            inside += 1.0
            compressed += ti.max(rho - 1.0, 0.0)
        # C is dimensionless, its gradients 1/m: multipliers are m².
        before = f.pressure[s, i]
        after = ti.max(before + rate * (rho - 1.0) / f.squares[s, i] + momentum * f.dp[s, i], 0.0)
        f.pressure[s, i] = after
        f.dp[s, i] = after - before
    return compressed / ti.max(inside, 1.0)


@ti.func
def displace(f: ti.template(), s):
    """Displacements that the last changes of all multipliers give."""
    d = f.spacing[s]
    h = SUPPORT * d
    inv_h = 1.0 / h
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.moving[s]):
        move = ti.Vector([0.0, 0.0, 0.0])
        pi = f.dp[s, i]
        for b in ti.static(range(VESSELS)):
            q = f.phi[s, i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[s, i][b, 0], f.normal[s, i][b, 1], f.normal[s, i][b, 2]])
                # The exact gradient of the wall's share in C: any other does work on a resting liquid and stirs it.
                push = pi * wall_slope(q) * inv_h
                move += push * n
                f.push[s, i][b] = f.push[s, i][b] + push
        f.dx[s, i] = move
    for i in range(f.moving[s]):
        xi = f.x[s, i]
        pi = f.dp[s, i]
        move = ti.Vector([0.0, 0.0, 0.0])
        for k in range(f.first[s, i], f.first[s, i] + f.count[s, i]):
            j = f.neighbour[s, k]
            r = xi - f.x[s, j]
            u = ti.max(1.0 - ti.sqrt(r.dot(r)) * inv_h, 0.0)
            m = ((pi + f.dp[s, j]) * slope(u) * scale) * r
            move += m
            f.dx[s, j] = f.dx[s, j] - m
        f.dx[s, i] = f.dx[s, i] + move
