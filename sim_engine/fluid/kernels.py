"""Smoothing kernel and its planar wall integrals, as Taichi functions.

Wendland C2 in three dimensions with support h: W(q) = σ (1 − q)⁴ (1 + 4q), q = r/h, σ = 21 / (2π h³). It needs one
square root per pair, its gradient is finite at r = 0, and it does not pair particles up.

Source: Wendland 1995; Dehnen & Aly 2012 (no pairing instability). Wall integrals: ours, by integration.
"""

import math

import taichi as ti

SIGMA = 21.0 / (2.0 * math.pi)
"""σ h³."""


@ti.func
def weight(u: ti.f32) -> ti.f32:
    """W h³ / σ from u = max(1 − q, 0). Branch-free: listed pairs beyond h cost a misprediction each otherwise."""
    u2 = u * u
    return u2 * u2 * (5.0 - 4.0 * u)


@ti.func
def slope(u: ti.f32) -> ti.f32:
    """∇W = −(σ / h⁵) · slope · (x_i − x_j), from u = max(1 − q, 0)."""
    return 20.0 * u * u * u


@ti.func
def wall_density(q: ti.f32) -> ti.f32:
    """∫ W over the half-space beyond a plane at distance q·h: 1 up to q = −1, ½ at q = 0, 0 from q = 1 on."""
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
    """Shape of the cohesive pair force over u = max(1 − q, 0): 1 at its peak q = ½, 0 at q = 0 and from 1 on."""
    w = u * (1.0 - u)
    return 64.0 * w * w * w


ATTRACTION_MOMENT = 64.0 * math.factorial(7) * math.factorial(3) / math.factorial(11)
"""∫₀¹ attraction(q) q⁴ dq, for the scaling of cohesion to a tension."""


def cohesion_acceleration(tension: float, density: float, spacing: float, support: float) -> float:
    """Peak acceleration of one pair [m/s²] that gives a liquid of that spacing a surface tension.

    Fowler's sharp-interface integral σ = (π/8) n² ∫ f(r) r⁴ dr with number density n = d⁻³, solved for the amplitude
    of the pair force f.

    Args:
        tension: σ [N/m].
        density: of the liquid [kg/m³].
        spacing: d [m].
        support: h [m].

    Source: Fowler 1937; for particle methods Tartakovsky & Panchenko 2016.
    """
    force = tension * spacing**6 / (math.pi / 8.0 * ATTRACTION_MOMENT * support**5)
    return force / (density * spacing**3)
