"""The density constraint C_i = ρ_i/ρ₀ − 1 ≤ 0, solved for positions by Jacobi iterations.

Multipliers accumulate, and `step.py` accelerates them (Chebyshev).

Walls enter as the kernel's integral over a half-space at the distance of their equivalent plane. Liquid therefore keeps
half a spacing from them and is subject to their pressure. Part of the multipliers is kept from step to step (warm
start), which helps to carry a resting column. Iterations continue until the mean compression inside is small, so that
deep vessels are solved as well as shallow ones.

Pairs are visited once and add to both of their particles. Such sums are written out (a = a + b): Taichi turns += on a
field into an atomic operation, which made a pour four times slower. The root and the kernel's slope of a pair are
computed once for each place of its particles: the density pass stores the slope for the following displacements. Values
that pairs read and add to are stored in groups of four, which the processor moves together: displacements then take a
third of the time.

Source: Macklin & Müller 2013 (position based fluids); Macklin, Müller & Chentanez 2016 (accumulated multipliers); wall
integral: after Bender et al. 2019 (volume maps), see `sim_engine/vessel/wall_correction.py`.
"""

from sim_engine.fluid.compiler import ti
from sim_engine.fluid.kernels import SIGMA, dot, length, slope, square, turned, wall_density, wall_slope, weight
from sim_engine.fluid.neighbours import POLAR, measure_pairs, reflect
from sim_engine.fluid.state import SUPPORT, VESSELS
from sim_engine.fluid.walls import to_vessel

PACKING = 1.012
"""Kernel sum of bulk liquid of spacing d over its continuum value, measured on a cup at rest. With it the density there
is 1.00, including the compression that the iterations leave."""


@ti.func
def weigh_pairs(f: ti.template(), s, inv_h):
    """The kernel and its slope of all listed pairs.

    Roots and polynomials of pairs that are adjacent in the lists are computed eight at a time, apart from reading
    scattered positions."""
    measure_pairs(f, s)
    # u = 1 − r/h; share = W h³/σ, pair = slope, so that ∇W = −(σ/h⁵) pair (x_i − x_j).
    for k in range(f.list_begin[s], f.list_end[s]):
        u = ti.max(1.0 - ti.sqrt(f.pair[k]) * inv_h, 0.0)
        f.share[k] = weight(u)
        f.pair[k] = slope(u)


@ti.func
def measure_first(f: ti.template(), s):
    """Density of all particles and, for the whole step, the norms of their constraints' gradients."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    # Volume V = d³ / PACKING of a particle: scale = V σ/h⁵ [1/m²], the common factor of V ∇W.
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.density[i] = 1.0  # W(0) of the particle itself
        f.sums[i] = ti.Vector([0.0, 0.0, 0.0, 0.0])
    weigh_pairs(f, s, inv_h)
    # ρ_i = Σ_j W_ij and (Σ_j ∇W, Σ_j |∇W|²), without their factors; a pair adds to both of its particles.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x[i]
        rho = ti.cast(0.0, ti.f32)
        sums = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            w = f.share[k]
            m = f.pair[k] * (xi - f.x[j])
            lean = ti.Vector([m[0], m[1], m[2], square(m)])
            rho += w
            sums += lean
            f.density[j] = f.density[j] + w
            f.sums[j] = f.sums[j] + ti.Vector([-lean[0], -lean[1], -lean[2], lean[3]])
        f.density[i] = f.density[i] + rho
        f.sums[i] = f.sums[i] + sums
    # squares_i = Σ_k |∇_k C_i|² + ε (Macklin & Müller 2013, equations 8 and 11; ε = 0.05/h² is their relaxation):
    # |∇_i C_i|² with ∇_i C_i = Σ_j V ∇W − Σ_walls wall_slope/h n, plus Σ_j |V ∇W|² for the neighbours k = j.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        total = -scale * ti.Vector([f.sums[i][0], f.sums[i][1], f.sums[i][2]])
        for b in ti.static(range(VESSELS)):
            q = f.phi[i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                total -= wall_slope(q) * inv_h * n
        f.squares[i] = scale * scale * f.sums[i][3] + square(total) + 0.05 * inv_h * inv_h


@ti.func
def measure(f: ti.template(), s):
    """Density of all particles."""
    # Σ_j W_ij h³/σ, including W(0); `compression` multiplies it by V σ/h³ and adds the walls.
    inv_h = 1.0 / (SUPPORT * f.spacing[s])
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.density[i] = 1.0
    weigh_pairs(f, s, inv_h)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        rho = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            w = f.share[k]
            rho += w
            f.density[j] = f.density[j] + w
        f.density[i] = f.density[i] + rho


@ti.func
def compression(f: ti.template(), s, i, volume, inv_h):
    """ρ/ρ₀ of a particle, including the walls' contribution, from the sum over its neighbours."""
    # ρ/ρ₀ = V Σ_j W_ij + Σ_walls ∫ W over the half-space beyond the wall's plane, q = φ/h − wall_shift away.
    rho = f.density[i] * volume
    for b in ti.static(range(VESSELS)):
        q = f.phi[i][b] * inv_h - f.wall_shift[s]
        if q < 1.0:
            rho += wall_density(q)
    return rho


@ti.func
def multiply_first(f: ti.template(), s, rate, thick: ti.template()):
    """All multipliers after a step's first iteration; they begin with the kept part of the last step's.

    Returns:
        Mean of max(ρ/ρ₀ − 1, 0) over the particles that are not at the surface.
    """
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    volume = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING
    inside = ti.cast(0.0, ti.f32)
    compressed = ti.cast(0.0, ti.f32)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        rho = compression(f, s, i, volume, inv_h)
        f.density[i] = rho
        excess = rho - 1.0
        if ti.static(thick):
            excess -= f.allowed[i]
        if rho > 0.95:
            inside += 1.0
            compressed += ti.max(excess, 0.0)
        # λ ← max(λ + rate C / Σ|∇C|², 0), C = ρ/ρ₀ − 1 (− `allowed`): λ ≥ 0 because liquid pushes but does not pull.
        # C is dimensionless, its gradients 1/m: multipliers are m².
        after = ti.max(f.pressure[i] + rate * excess / f.squares[i], 0.0)
        f.pressure[i] = after
        f.dp[i] = after
    return compressed / ti.max(inside, 1.0)


@ti.func
def multiply(f: ti.template(), s, rate, momentum, thick: ti.template()):
    """Change of all multipliers in a later iteration: by the density, plus a part of their last change.

    Returns:
        Mean of max(ρ/ρ₀ − 1, 0) over the particles that are not at the surface.
    """
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    volume = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING
    inside = ti.cast(0.0, ti.f32)
    compressed = ti.cast(0.0, ti.f32)
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        rho = compression(f, s, i, volume, inv_h)
        f.density[i] = rho
        excess = rho - 1.0
        if ti.static(thick):
            excess -= f.allowed[i]
        if rho > 0.95:
            inside += 1.0
            compressed += ti.max(excess, 0.0)
        # Chebyshev: λ ← max(λ + rate C / Σ|∇C|² + momentum Δλ, 0); rate and momentum are those of `Stepper.iterate`.
        before = f.pressure[i]
        after = ti.max(before + rate * excess / f.squares[i] + momentum * f.dp[i], 0.0)
        f.pressure[i] = after
        f.dp[i] = after - before
    return compressed / ti.max(inside, 1.0)


@ti.func
def measure_before(f: ti.template(), s):
    """Compression of all particles at the step's beginning, max(ρ/ρ₀ − 1, 0), to `allowed`."""
    d = f.spacing[s]
    inv_h = 1.0 / (SUPPORT * d)
    volume = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        f.density[i] = 1.0
    reflect(f, s, f.x0, POLAR)
    # The same sums at the positions x0; the lists' skin covers the displacement since then.
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.x0[i]
        rho = ti.cast(0.0, ti.f32)
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            w = weight(ti.max(1.0 - length(xi - f.x0[j]) * inv_h, 0.0))
            rho += w
            f.density[j] = f.density[j] + w
        f.density[i] = f.density[i] + rho
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        rho = f.density[i] * volume
        for b in ti.static(range(VESSELS)):
            # φ(x0) ≈ φ(x) + n · back; with a vessel in motion, x0 is first carried along to its pose at the end.
            n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
            back = f.x0[i] - f.x[i]
            if f.swing[s, b] > 0.0:
                y = to_vessel(f, s, b, f.x0[i], True)
                back += turned(f.turn[s, b], y) + f.origin[s, b] - f.x0[i]
            q = (f.phi[i][b] + dot(n, back)) * inv_h - f.wall_shift[s]
            if q < 1.0:
                rho += wall_density(q)
        f.allowed[i] = ti.max(rho - 1.0, 0.0)


@ti.func
def displace(f: ti.template(), s):
    """Displacements due to the last changes of all multipliers."""
    d = f.spacing[s]
    h = SUPPORT * d
    inv_h = 1.0 / h
    scale = SIGMA * inv_h * inv_h * inv_h * d * d * d / PACKING * inv_h * inv_h
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        move = ti.Vector([0.0, 0.0, 0.0])
        pi = f.dp[i]
        for b in ti.static(range(VESSELS)):
            q = f.phi[i][b] * inv_h - f.wall_shift[s]
            if q < 1.0:
                n = ti.Vector([f.normal[i][b, 0], f.normal[i][b, 1], f.normal[i][b, 2]])
                # The exact gradient of the wall's contribution to C: any other one does work on a resting liquid and
                # stirs it.
                push = pi * wall_slope(q) * inv_h
                move += push * n
                f.push[i][b] = f.push[i][b] + push
        f.move[i] = ti.Vector([move[0], move[1], move[2], 0.0])
        f.place[i] = ti.Vector([f.x[i][0], f.x[i][1], f.x[i][2], scale * pi])
    reflect(f, s, f.place, POLAR)
    # Δx_i = −Σ_j (Δλ_i + Δλ_j) V ∇W_ij (Macklin & Müller 2013, equation 12, with λ ≥ 0 for compression).
    for i in range(f.begin[s], f.begin[s] + f.moving[s]):
        xi = f.place[i]
        move = ti.Vector([0.0, 0.0, 0.0, 0.0])
        for k in range(f.first[i], f.first[i] + f.count[i]):
            j = f.neighbour[k]
            xj = f.place[j]
            m = ((xi[3] + xj[3]) * f.pair[k]) * (xi - xj)
            move += m
            f.move[j] = f.move[j] - m
        f.move[i] = f.move[i] + move
