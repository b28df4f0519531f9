"""What the packing of particles resists with, taken out of the velocities of thick liquids.

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
from sim_engine.fluid.kernels import SIGMA, slope, wall_slope, weight
from sim_engine.fluid.state import SUPPORT, VESSELS
from sim_engine.fluid.vectors import length

BESIDE, INSIDE = 0.6, 0.9
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
        share = ti.min(ti.max((matrix.determinant() - BESIDE) / (INSIDE - BESIDE), 0.0), 1.0)
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
