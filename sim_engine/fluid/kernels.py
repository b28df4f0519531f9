"""Smoothing kernel and its planar wall integrals, as Taichi functions.

Wendland C2 in three dimensions with support h: W(q) = σ (1 − q)⁴ (1 + 4q), q = r/h, σ = 21 / (2π h³). It needs one
square root per pair, its gradient is finite at r = 0, and it does not pair particles up.

Source: Wendland 1995; Dehnen & Aly 2012 (no pairing instability). Wall integrals: derived here.

Products of vectors are written out. Taichi's own products are for any shape; they make kernels a third larger, and slow
down compiling and cache look-up accordingly.
"""

import math

from sim_engine.fluid.compiler import ti

SIGMA = 21.0 / (2.0 * math.pi)
"""σ h³."""


@ti.func
def weight(u: ti.f32) -> ti.f32:
    """W h³ / σ from u = max(1 − q, 0). Branch-free: otherwise each listed pair beyond h costs a misprediction."""
    u2 = u * u
    return u2 * u2 * (5.0 - 4.0 * u)  # (1 − q)⁴ (1 + 4q), Wendland 1995: φ_{3,1}


@ti.func
def slope(u: ti.f32) -> ti.f32:
    """∇W = −(σ / h⁵) · slope · (x_i − x_j), from u = max(1 − q, 0)."""
    return 20.0 * u * u * u  # −W'(q) / q = 20 (1 − q)³


@ti.func
def decayed(x: ti.f32) -> ti.f32:
    """1 − exp(−x) for x ≥ 0, to 1e-6: (Padé's [3/3] of e^(−x/16))^16. The library's exp is scalar."""
    y = ti.min(x, 16.0) / 16.0
    y2 = y * y
    even, odd = 1.0 + 0.1 * y2, y * (0.5 + y2 / 120.0)
    e = (even - odd) / (even + odd)
    e *= e
    e *= e
    e *= e
    e *= e
    return 1.0 - e


@ti.func
def wall_density(q: ti.f32) -> ti.f32:
    """∫ W over the half-space beyond a plane at distance q·h: 1 up to q = −1, ½ at q = 0, 0 from q = 1 on."""
    # ∫_q^1 2π t W (t − q) dt by parts; the half-space and its complement add up to 1.
    u = ti.max(1.0 - ti.abs(q), 0.0)
    u6 = u * u * u
    u6 = u6 * u6
    beyond = 21.0 * u6 * (1.0 / 6.0 - u * (3.0 / 14.0 - u / 14.0))
    return ti.select(q < 0.0, 1.0 - beyond, beyond)


@ti.func
def wall_slope(q: ti.f32) -> ti.f32:
    """−h · d(wall_density)/d(distance), ≥ 0."""
    u = ti.max(1.0 - ti.abs(q), 0.0)
    u2 = u * u
    return 21.0 * u2 * u2 * u * (1.0 - u * (1.5 - u * (4.0 / 7.0)))


@ti.func
def attraction(u: ti.f32) -> ti.f32:
    """The cohesive force over q from u = max(1 − q, 0), as a vector over r/h: its size is 64 (u q)³, 1 at its peak
    q = ½ and 0 at q = 0 and from 1 on."""
    q = 1.0 - u
    return 64.0 * u * u * u * q * q


@ti.func
def attraction_turn(u: ti.f32) -> ti.f32:
    """(d(size)/dq − size/q) / q² of that force: the difference of its changes along r and across r."""
    return 64.0 * u * u * (5.0 * u - 3.0)


@ti.func
def bond(u: ti.f32) -> ti.f32:
    """∫ attraction from q to 1: flat towards q = 0, so that pairs gain no energy by closing up."""
    u2 = u * u
    return u2 * u2 * (16.0 - u * (38.4 - u * (32.0 - u * (64.0 / 7.0))))


@ti.func
def wall_bond(u: ti.f32) -> ti.f32:
    """∫ bond over the half-space beyond a plane at distance (1 − u) h, in units of h³."""
    u2 = u * u
    series = 1.0 / 60.0 - u * (17.0 / 420.0 - u * (11.0 / 280.0 - u * (1.0 / 56.0 - u / 315.0)))
    return 64.0 * math.pi * u2 * u2 * u2 * series


@ti.func
def wall_attraction(u: ti.f32) -> ti.f32:
    """d(wall_bond)/du: the attraction of the half-space."""
    u2 = u * u
    series = 1.0 / 10.0 - u * (17.0 / 60.0 - u * (11.0 / 35.0 - u * (9.0 / 56.0 - u * (2.0 / 63.0))))
    return 64.0 * math.pi * u2 * u2 * u * series


HALF_ATTRACTION = 64.0 * math.pi / 504.0
"""∫ attraction · cos over a half-space, in units of h³."""
BULK_BOND = 64.0 * 4.0 * math.pi / 3.0 / 840.0
"""∫ bond over all space, in units of h³."""


@ti.func
def dot(a, b):
    """a · b."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def square(a):
    """|a|²."""
    return a[0] * a[0] + a[1] * a[1] + a[2] * a[2]


@ti.func
def length(a):
    """|a|."""
    return ti.sqrt(a[0] * a[0] + a[1] * a[1] + a[2] * a[2])


@ti.func
def turned(m, a):
    """m a, of a rotation matrix."""
    return ti.Vector(
        [
            m[0, 0] * a[0] + m[0, 1] * a[1] + m[0, 2] * a[2],
            m[1, 0] * a[0] + m[1, 1] * a[1] + m[1, 2] * a[2],
            m[2, 0] * a[0] + m[2, 1] * a[1] + m[2, 2] * a[2],
        ]
    )


@ti.func
def turned_back(m, a):
    """mᵀ a, of a rotation matrix."""
    return ti.Vector(
        [
            m[0, 0] * a[0] + m[1, 0] * a[1] + m[2, 0] * a[2],
            m[0, 1] * a[0] + m[1, 1] * a[1] + m[2, 1] * a[2],
            m[0, 2] * a[0] + m[1, 2] * a[1] + m[2, 2] * a[2],
        ]
    )
