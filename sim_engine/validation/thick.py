"""The cases of liquids with a viscosity in SI, and how large the solver's own viscosity is."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from sim_engine.action import DEG, Action
from sim_engine.liquid import Liquid, SimulationParameters
from sim_engine.pour import PourSimulator
from sim_engine.task import PourTask, Scene
from sim_engine.validation import films, wetting
from sim_engine.validation.result import Figure, Measurement, Series, reported, within
from sim_engine.validation.stage import run, stir
from sim_engine.validation.tanks import block, box
from sim_engine.vessel.spec import cylinder

Floats = NDArray[np.float64]

THETA = SimulationParameters(cohesion=0.0, viscosity=0.0)

FLOOR = (
    "Taylor and Green's vortices in a tank with slippery walls die away as exp(−2νk²t), whatever their speed. What is "
    "found above the given viscosity is the solver's own: under pressure the packing of particles is a weak solid, and "
    "what is taken out of its stress inside is left beside walls and the surface."
)
FILM = "A film of 10 mm, ν = 1,000 mm²/s, runs down a plane of 20°: mean velocity g sin α e²/3ν (Nusselt 1916)."
TUBE = (
    "A plug of ν = 2,000 mm²/s falls in a vertical tube of radius 15 mm, open at both ends: mean velocity gR²/8ν "
    "(Poiseuille). No pressure holds the particles together there, nor against the wall."
)
DRAINAGE = "A film of 8 mm, ν = 1,000 mm²/s, drains from a vertical wall of 100 mm: e = √(νz/gt) (Jeffreys 1930)."
PUDDLE = "250 mL are let go on a plane: the radius is 0.894 (gV³t/3ν)^⅛ once they are flat (Huppert 1982)."
CUP = (
    "The standard pour with .1 and 1 Pa s, at 1,000 kg/m³. Reference: SPlisHSPlasH 2.19 with the implicit viscosity of "
    "Weiler et al. 2018, in the liquid and on walls."
)

SIDE, VOLUME = 0.07, 200e-6
"""Of the tank in which the solver's own viscosity is measured [m], [m³]."""


def own_viscosity(particles: int, viscosity: float, speed: float) -> tuple[float, float, int]:
    """Viscosity at which four vortices side by side die away in a tank whose walls are slippery.

    Taylor and Green's vortices: u = (sin kx cos ky, −cos kx sin ky) U, k = 2π/side, decay as exp(−2νk²t), whatever U.

    Args:
        particles: N.
        viscosity: kinematic, that the liquid is given; 0: none [m²/s].
        speed: U [m/s].

    Returns:
        Viscosity by the decay [m²/s], spacing [m] and N.
    """
    from sim_engine.fluid.engine import engine

    k = 2.0 * math.pi / SIDE
    depth = VOLUME / SIDE**2
    start, d = block(np.array([0.0, -SIDE / 2.0, 0.0]), np.array([SIDE, SIDE / 2.0, depth]), particles, 1)
    tank = box(SIDE, SIDE, 2.0 * depth, 0.5 * d)
    lasts = min(0.8, 0.75 / ((max(viscosity, 3e-5) + 3e-5) * k**2))

    def vortices(x: Floats) -> Floats:
        a, b = k * x[:, 0], k * (x[:, 1] + SIDE / 2.0)
        return np.column_stack([np.sin(a) * np.cos(b), -np.cos(a) * np.sin(b), 0.0 * a])

    times = 0.3 + np.linspace(0.0, lasts, 21)
    found = []
    for step in run(start, d, tank, THETA, times, viscosity=viscosity, no_slip=False):
        if step == 0:
            stir(lambda x: speed * vortices(x))
        x, v = engine().particles()[0].astype(float), engine().velocities().astype(float)
        w = vortices(x)
        found.append(float((v * w).sum() / (w * w).sum()))
    left = np.array(found) / found[0]
    clear = left > 0.1
    rate = -float(np.polyfit(times[clear], np.log(left[clear]), 1)[0])
    return rate / (2.0 * k**2), d, len(start)


def floor(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """What the solver adds to the viscosity that a liquid is given, by spacing and speed."""
    speed = 0.2
    found: list[Measurement] = []
    curves: list[Series] = []
    given = (1e-5, 1e-4, 5e-4, 2e-3) if full else (1e-4, 2e-3)
    for wanted in (2_000, 8_000) if full else (2_000,):
        values = []
        for nu in given:
            value, d, n = own_viscosity(wanted, nu, speed)
            values.append(value)
            found.append(
                reported(f"viscosity by decay at U = {speed:g} m/s, d = {1e3 * d:.1f} mm, given {1e6 * nu:.0f} mm²/s",
                         value, unit="m²/s", reference=nu, particles=n)
            )  # fmt: skip
        curves.append(Series(f"{n:,} particles", tuple(1e6 * nu for nu in given), tuple(1e6 * v for v in values)))
    curves.append(Series("given", tuple(1e6 * nu for nu in given), tuple(1e6 * nu for nu in given), "reference"))
    if full:
        value, d, n = own_viscosity(2_000, 1e-4, 0.05)
        found.append(reported("the same at U = 0.05 m/s, given 100 mm²/s", value, unit="m²/s", reference=1e-4,
                              particles=n))  # fmt: skip
    thick = next(m for m in found if "given 2000" in m.name)
    found.append(within("what it adds to 2,000 mm²/s, over it", thick.value / 2e-3 - 1.0, 0.0, 0.2,
                        criterion="within 20 %", particles=thick.particles))  # fmt: skip
    return found, Figure(
        ("The solver's own viscosity",), ("given [mm²/s]",), ("by decay [mm²/s]",), tuple(curves), log_x=True
    )


def film(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """Down an incline."""
    return _figure(
        [films.down_an_incline(layers, 1e-3, THETA) for layers in ((2, 3, 4, 6) if full else (4,))],
        ("Film on an incline", "height over the film's", "velocity over the mean's"),
    )


def tube(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """Down a tube."""
    return _figure(
        [films.down_a_tube(layers, 2e-3, THETA) for layers in ((3, 5, 8) if full else (3,))],
        ("Plug in a tube", "radius over the tube's", "velocity over the mean's"),
    )


def drainage(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """A film on a wall."""
    return _figure(
        [films.left_on_a_wall(layers, 1e-3, THETA) for layers in ((2, 4) if full else (2,))],
        ("What is left on a wall", "time [s]", "over the film at first"),
    )


def puddle(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """Spreading on a plane."""
    cases = ((2_000, 2e-3), (8_000, 2e-3), (2_000, 2e-4)) if full else ((1_000, 2e-3),)
    return _figure([films.spreading(n, nu, THETA) for n, nu in cases], ("Puddle", "time [s]", "radius [m]"))


def _figure(
    runs: list[tuple[list[Measurement], list[Series]]], words: tuple[str, str, str]
) -> tuple[list[Measurement], Figure]:
    curves: list[Series] = []
    for _, series in runs:
        curves += [one for one in series if (one.name, one.kind) not in [(c.name, c.kind) for c in curves]]
    title, x, y = words
    return [m for measurements, _ in runs for m in measurements], Figure((title,), (x,), (y,), tuple(curves))


PEER: dict[float, tuple[float, ...]] = {
    1e-4: (0.985, 0.922, 0.796, 0.632, 0.462, 0.296, 0.149, 0.043),
    1e-3: (0.987, 0.933, 0.822, 0.671, 0.501, 0.339, 0.195, 0.090),
}
"""Left in the pourer at `TIMES` by kinematic viscosity [m²/s]: SPlisHSPlasH 2.19 (DFSPH, volume maps, viscosity of
Weiler et al. 2018 in the liquid and on walls), 2,000 and 1,000 particles, `benchmarks/peer.py`. For water it
has less by at most .015: .1 Pa s change next to nothing there."""
TIMES = (2.1, 2.3, 2.5, 2.7, 2.9, 3.1, 3.3, 3.5)
FAR = 0.05


def cup(simulator: PourSimulator, full: bool) -> tuple[list[Measurement], Figure]:
    """The standard pour of thicker and thicker liquids."""
    found: list[Measurement] = []
    curves: list[Series] = []
    scene = Scene(
        "standard",
        cylinder("pourer", inner_radius=0.04, inner_height=0.1),
        cylinder("receiver", inner_radius=0.045, inner_height=0.09),
        Liquid(mass=0.2, density=1000.0, surface_tension=0.033),
    )
    action = Action(
        angular_velocity=30 * DEG, x_offset=0.080, height=0.110, max_angle=120 * DEG, angular_acceleration=None,
        hold_time=2.0, return_velocity=None,
    )  # fmt: skip
    for particles in (2_000, 5_000) if full else (1_000,):
        theta = SimulationParameters(particles=particles)
        for nu in (1e-4, 1e-3):
            liquid = scene.liquid.model_copy(update={"dynamic_viscosity": 1e3 * nu})
            outcome = simulator.simulate(PourTask(replace(scene, liquid=liquid), action, theta, 1)).outcome
            left = 1.0 - np.interp(TIMES, outcome.curve_times, outcome.curve_poured)
            name = f"{nu * 1e3:g} Pa s"
            curves.append(Series(f"{name}, {particles:,} particles", TIMES, tuple(left.tolist())))
            if nu in PEER:
                far = float(np.max(np.abs(left - np.array(PEER[nu]))))
                found.append(
                    within(f"largest distance of what is left from SPlisHSPlasH's, {name}", far, 0.0, FAR,
                           criterion=f"within {FAR:g}", particles=particles)
                )  # fmt: skip
            found.append(reported(f"left at 3.1 s, {name}", float(left[TIMES.index(3.1)]), particles=particles))
    curves += [Series(f"{nu * 1e3:g} Pa s", TIMES, values, "reference") for nu, values in PEER.items()]
    return found, Figure(("Thick liquids leave a cup",), ("time [s]",), ("left in the pourer",), tuple(curves))


Work = Callable[[PourSimulator, bool], tuple[list[Measurement], Figure | None]]

CASES: tuple[tuple[str, str, str, Work], ...] = (
    ("floor", "The solver's own viscosity", FLOOR, floor),
    ("film", "Film on an incline", FILM, film),
    ("tube", "Tube", TUBE, tube),
    ("drainage", "Drainage of a wall film", DRAINAGE, drainage),
    ("puddle", "Viscous dam break", PUDDLE, puddle),
    ("wetting", "Contact angle", wetting.ABOUT, wetting.wetting),
    ("thick-outflow", "Outflow of thick liquids", CUP, cup),
)
"""Name, title, what it is about, and what runs it, in short or in full."""
