"""`cases`: the solver against physics: the quick part of the validation; the full one is marked slow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from benchmarks.validation import capillarity as droplet
from benchmarks.validation import cases as suite
from benchmarks.validation import container_runs as stage
from benchmarks.validation import container_runs as tanks
from benchmarks.validation import convergence, dam_break, sloshing, torricelli
from benchmarks.validation import hydrostatic_cases as at_rest
from benchmarks.validation import hydrostatic_cases as tilting
from benchmarks.validation import jet_landing as landing
from benchmarks.validation import wall_tightness as walls
from benchmarks.validation import whole_pours as pours
from benchmarks.validation.case_result import CaseEffort, Measurement, at_least, at_most, reported, within
from sim_engine.fluid.engine import engine
from sim_engine.liquids import SimulationParameters
from sim_engine.simulator import PourSimulator

STICKY = SimulationParameters(cohesion=0.0, xsph_rate=1.0, friction=1.0)


def failures(measurements: list[Measurement]) -> list[str]:
    return [f"{m.name}: {m.value:.4g}, {m.criterion} of {m.reference}" for m in measurements if not m.passed]


def test_a_measurement_is_judged_by_its_bounds() -> None:
    assert within("height", 1.01, 1.0, 0.02, particles=1, criterion="").passed
    assert not within("height", 1.03, 1.0, 0.02, particles=1, criterion="").passed
    assert not at_most("energy", 2.0, 1.0, particles=1, criterion="").passed
    assert not at_least("arrived", 0.9, 0.95, particles=1, criterion="").passed
    assert not within("fall", math.nan, 9.81, 0.1, particles=1, criterion="").passed
    assert not reported("spread", math.nan, particles=1).passed
    assert not reported("spread", 0.5, particles=1).judged


def test_voronoi_density_of_a_lattice_and_of_a_squeezed_one() -> None:
    axis = np.arange(10) + 0.5
    points = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    points += np.random.default_rng(1).uniform(-0.1, 0.1, points.shape)
    inner = np.all((points > 2) & (points < 8), axis=1)
    assert at_rest.mean_density(points, inner, 1.0) == pytest.approx(1.0, rel=0.02)
    assert at_rest.mean_density(points * [1.0, 1.0, 0.9], inner, 1.0) == pytest.approx(1 / 0.9, rel=0.02)


@pytest.mark.parametrize("mirrored", [False, True])
def test_liquid_at_rest_stands_as_high_as_its_volume(simulator: PourSimulator, mirrored: bool) -> None:
    measurements, _ = at_rest.at_rest(2_000, suite.PLAIN, mirrored=mirrored)
    assert failures(measurements[:2]) == []


@pytest.mark.parametrize("mirrored", [pytest.param(False, marks=pytest.mark.slow), True])
def test_deep_liquid_stays_in_its_cup(simulator: PourSimulator, mirrored: bool) -> None:
    """29 layers of particles, which pressure has to pass within a step."""
    assert failures(at_rest.tall_column(5_000, suite.PLAIN, mirrored)) == []


@pytest.mark.slow  # with fewer particles below
def test_a_slowly_tilted_cup_drains_to_the_plane_through_its_lip(simulator: PourSimulator) -> None:
    """Within 2 % of the brimful volume at 80°. Dry friction on the walls, which no liquid has, would hold back more."""
    cup, angles = tilting.straight_cup(), tilting.ANGLES[-1:]
    measurements, _ = tilting.slow_tilt(cup, 100e-6, 2_000, suite.PLAIN, angles)
    assert failures(measurements) == []
    stuck, _ = tilting.slow_tilt(cup, 100e-6, 2_000, STICKY, angles)
    assert failures(stuck) != []


def test_the_slow_turn_waits_until_a_sharp_weir_would_have_drained() -> None:
    cup = tilting.straight_cup()
    motion, readings = tilting.slow_turn(cup, suite.LOAD, tilting.ANGLES)
    assert np.allclose(motion.tilt(np.array(readings)), tilting.ANGLES)
    rates = np.diff(motion.tilt(np.arange(0.0, motion.duration, 0.01))) / 0.01
    late = np.arange(len(rates)) * 0.01 > math.degrees(tilting.spill_angle(cup, suite.LOAD)) / 30.0
    assert rates[late].max() == pytest.approx(tilting.SPEED, rel=1e-6)
    assert np.diff([0.0, *readings]).min() > 5.0


@pytest.mark.parametrize(
    "particles", [500, pytest.param(1_000, marks=pytest.mark.slow), pytest.param(2_000, marks=pytest.mark.physics)]
)
def test_the_standard_pour_flows_as_that_of_infinitely_fine_particles(simulator: PourSimulator, particles: int) -> None:
    measurements, _ = pours.outflow(simulator, particles, suite.PLAIN, seeds=3)
    assert failures(measurements) == []


@pytest.mark.slow
@pytest.mark.parametrize(
    ("angle", "loads"), [pytest.param(0, 5, marks=pytest.mark.slow), pytest.param(1, 5, marks=pytest.mark.slow), (2, 1)]
)
def test_few_particles_are_held_back_by_a_lip_no_more_than_liquid_is(
    simulator: PourSimulator, angle: int, loads: int
) -> None:
    """Within 2 % of the brimful volume at 60, 70 and 80°. With the rim as it is, 500 particles keep 7 to 26 mL more."""
    cup, angles, load = tilting.straight_cup(), tilting.ANGLES[angle : angle + 1], (200e-6, 130e-6, 80e-6)[angle]
    measurements, _ = tilting.slow_tilt(cup, load, 500, suite.PLAIN, angles, loads)
    assert failures(measurements) == []


@pytest.mark.slow
def test_liquid_at_rest_needs_the_rim_lowered_and_a_stream_does_not(simulator: PourSimulator) -> None:
    as_it_is = suite.PLAIN.model_copy(update={"rim_correction": 0.0})
    measurements, _ = tilting.slow_tilt(tilting.straight_cup(), suite.LOAD, 500, as_it_is, tilting.ANGLES[:1])
    assert failures(measurements) != []
    few = [theta.model_copy(update={"particles": 500}) for theta in (as_it_is, suite.PLAIN)]
    with_it, without = (landing.landing(simulator, 90.0, theta).median for theta in few)
    assert with_it == pytest.approx(without, abs=1e-3)


def test_a_liquid_that_turns_as_a_whole_is_not_held_back_and_one_that_is_sheared_is(simulator: PourSimulator) -> None:
    """Without gravity and walls: a cube that spins keeps its spin, layers that pass each other are slowed."""
    axis = (np.arange(10) - 4.5) * 5e-3
    x = np.stack(np.meshgrid(axis, axis, axis, indexing="ij"), axis=-1).reshape(-1, 3)
    calm = SimulationParameters(cohesion=0.0, xsph_rate=0.0)
    turning, shearing = np.zeros_like(x), np.zeros_like(x)
    turning[:, 0], turning[:, 1] = -20.0 * x[:, 1], 20.0 * x[:, 0]
    shearing[:, 0] = 0.05 * (-1.0) ** np.round(x[:, 2] / 5e-3 - 0.5)

    def left(velocities: np.ndarray) -> float:
        list(stage.run(x, 5e-3, stage.EMPTY_SPACE, calm, np.array([1e-6]), gravity=0.0))
        fluid = engine()
        names, speeds = fluid.state.name.to_numpy()[: len(x)], fluid.state.v.to_numpy()
        speeds[: len(x)] = velocities[names]
        fluid.state.v.from_numpy(speeds)
        fluid.advance(0.02)
        return float(np.sum(fluid.velocities() * velocities) / np.sum(velocities**2))

    assert left(turning) > 0.998
    assert left(shearing) < 0.985


@pytest.mark.slow
def test_the_jet_lands_in_the_same_place_with_few_particles(simulator: PourSimulator) -> None:
    measurements, figure = landing.compared(simulator, (500,), 2_000, suite.PLAIN)
    assert failures([m for m in measurements if m.name.startswith("median")]) == []
    assert len(figure.series) == 4
    late = figure.series[0]
    assert late.y[-1] > late.y[0] + 5.0  # a jet reaches farther as the cup tilts on, which is seen


def test_outflow_is_told_from_that_of_a_thick_liquid(simulator: PourSimulator) -> None:
    thick = SimulationParameters(cohesion=0.0, xsph_rate=40.0, friction=0.3)
    measurements, _ = pours.outflow(simulator, 500, thick, seeds=1)
    assert len(failures(measurements)) >= 2


def test_parcels_of_the_jet_fall_with_g(simulator: PourSimulator) -> None:
    measurements, figure = pours.free_jet(simulator, 800, suite.PLAIN)
    assert failures(measurements) == []
    assert len(figure.series[0].x) > 20


@pytest.mark.slow
def test_nothing_crosses_thin_walls_in_random_pours(simulator: PourSimulator) -> None:
    assert failures(walls.walls(5, 1_200, seed=3)) == []


def test_a_seed_is_repeated_to_the_bit(simulator: PourSimulator) -> None:
    assert failures(pours.repeatability(simulator, 500, suite.PLAIN)) == []


def test_a_damped_oscillation_is_measured_and_noise_is_told_from_it() -> None:
    t = np.arange(0.0, 1.5, 0.01)
    frequency, decay = sloshing.fit_oscillation(t, 3.0 + 0.02 * np.exp(-2.5 * t) * np.cos(20.0 * t + 1.0), 3.0)
    assert 2.0 * math.pi * frequency == pytest.approx(20.0, rel=1e-3)
    assert decay == pytest.approx(2.5, rel=1e-2)


def test_the_first_mode_has_no_flow_through_the_walls_and_no_divergence() -> None:
    angle = np.linspace(0.0, 2.0 * math.pi, 40)
    x, y = at_rest.RADIUS * np.cos(angle), at_rest.RADIUS * np.sin(angle)
    flow = sloshing.first_mode(x, y, np.full(40, 0.02))
    largest = float(np.abs(sloshing.first_mode(np.full(1, 1e-6), np.zeros(1), np.full(1, 0.02))).max())
    assert np.abs((flow[:, 0] * x + flow[:, 1] * y) / at_rest.RADIUS).max() < 1e-3 * largest
    place, step = np.array([0.012, -0.007, 0.02]), 1e-5
    divergence = 0.0
    for axis in range(3):
        ends = [place.copy(), place.copy()]
        ends[0][axis] -= step
        ends[1][axis] += step
        low, high = (sloshing.first_mode(*(e[i : i + 1] for i in range(3)))[0, axis] for e in ends)
        divergence += (high - low) / (2.0 * step)
    assert abs(divergence) < 1e-3 * largest / at_rest.RADIUS


@pytest.mark.slow
def test_sloshing_is_near_theory_and_rough_walls_bring_it_to_rest_sooner(simulator: PourSimulator) -> None:
    """The full case asks for 5 %; what a thousand particles reach is 15 %."""
    smooth, _ = sloshing.sloshing(1_000, suite.PLAIN)
    assert smooth[0].value == pytest.approx(sloshing.FREQUENCY, rel=0.15)
    rough, _ = sloshing.sloshing(1_000, SimulationParameters(cohesion=0.0, xsph_rate=1.0, friction=0.3))
    assert rough[1].value > smooth[1].value > 0.0


def test_tanks_are_closed_where_they_should_be() -> None:
    tank = tanks.box(0.2, 0.05, 0.1, 0.0025)
    at = np.array([[0.1, 0.0, 0.03], [0.1, 0.02, 0.05], [-0.005, 0.0, 0.05], [0.1, 0.0, -0.005], [0.1, 0.0, 0.1]])
    assert tank.grid.sample(at) == pytest.approx([0.025, 0.005, -0.005, -0.005, 0.025], abs=2e-4)
    open_cup = tanks.holed_cup(0.04, 0.1, 0.01, 0.003, 0.001)
    closed = tanks.holed_cup(0.04, 0.1, 0.0, 0.003, 0.001)
    below = np.array([[0.0, 0.0, -0.001], [0.02, 0.0, -0.001], [0.0, 0.0, 0.02], [0.03, 0.0, 0.05]])
    assert open_cup.grid.sample(below) == pytest.approx([0.01, -0.001, math.hypot(0.01, 0.02), 0.01], abs=2e-4)
    assert closed.grid.sample(below) == pytest.approx([-0.001, -0.001, 0.02, 0.01], abs=2e-4)


def test_a_closed_cup_holds_and_one_with_a_hole_drains(simulator: PourSimulator) -> None:
    start, d = torricelli.settled(1_000, suite.PLAIN)
    assert start[:, 2].min() > 0.0
    assert 2.0 * start[:, 2].mean() == pytest.approx(at_rest.HEIGHT, rel=0.05)
    assert d == pytest.approx((at_rest.VOLUME / 1_000) ** (1 / 3))
    _, curves, discharge = torricelli.torricelli(1_000, suite.PLAIN)
    assert np.all(np.diff(curves[0].y) <= 1e-9)
    assert 0.2 < discharge < 0.7  # a hole four spacings wide passes too little


def test_the_front_of_a_dam_break_runs_as_fast_as_in_the_experiment(simulator: PourSimulator) -> None:
    measurements, _ = dam_break.dam_break(0.05715, 10, suite.PLAIN)
    assert failures([m for m in measurements if m.name.startswith("slope")]) == []
    with_delay = next(m for m in measurements if "after the gate's delay" in m.name)
    assert with_delay.value < 0.10


@pytest.mark.slow
def test_cohesion_makes_a_cube_round_and_nothing_else_does(simulator: PourSimulator) -> None:
    free = SimulationParameters(cohesion=0.0, xsph_rate=0.0, friction=0.0)
    measurement = droplet.cube_to_sphere(1000, free)[0]
    assert measurement.passed
    axis = np.arange(10) - 4.5
    cube = np.stack(np.meshgrid(axis, axis, axis), axis=-1).reshape(-1, 3)
    radii = droplet.surface_radii(cube)
    assert float(np.max(np.abs(radii - radii.mean()))) > 1.5


@pytest.mark.slow
def test_a_drop_oscillates_at_the_frequency_of_its_tension(simulator: PourSimulator) -> None:
    free = SimulationParameters(cohesion=0.0, xsph_rate=0.0, friction=0.0)
    measurements, (curve,), _ = droplet.oscillation(1_000, free)
    assert failures(measurements) == []
    assert min(curve.y) < -0.4 * curve.y[0], "it creeps"
    # Pairs of forces are equal and opposite: nothing drives a drop away, and it stays in one piece.
    x = engine().particles()[0].astype(float)
    assert float(np.linalg.norm(x.mean(axis=0))) < 0.05 * droplet.RADIUS
    assert float(np.linalg.norm(x, axis=1).max()) < 1.25 * droplet.RADIUS


@pytest.mark.slow
def test_a_thousand_particles_spill_as_fine_ones_do(simulator: PourSimulator) -> None:
    measurements, figure = convergence.convergence(simulator, convergence.QUICK, (1_000,), 2, suite.PLAIN)
    mean, largest = measurements[3:5]
    assert mean.value < 0.03
    assert largest.passed
    assert len(measurements) == len(convergence.QUICK) + 4
    assert max(figure.series[0].x) == pytest.approx(largest.value)


@pytest.mark.slow
def test_walls_that_hold_particles_off_are_far_from_the_limit(simulator: PourSimulator) -> None:
    """What the criterion must see: liquid that keeps a spacing and a half from solid, as between walls of particles."""
    thick = suite.PLAIN.model_copy(update={"wall_distance": 1.5, "friction": 0.3})
    measurements, _ = convergence.convergence(simulator, convergence.QUICK, (500,), 1, thick)
    assert failures(measurements) != []


def test_every_pour_was_made_with_fine_particles_and_splashes_are_not_judged(simulator: PourSimulator) -> None:
    assert set(convergence.FINE) == {pour.name for pour in convergence.POURS}
    splashes = [pour for pour in convergence.POURS if not convergence.has_converged(pour)]
    assert [pour.speed for pour in splashes] == [90, 110, 75]
    chosen = (splashes[1], convergence.FOUND[0])
    measurements, _ = convergence.convergence(simulator, chosen, (250,), 1, suite.PLAIN)
    assert "mean of 1 pours" in measurements[2].name
    assert measurements[3].value < 0.02 < abs(measurements[0].value - convergence.FINE[splashes[1].name][0])


def test_a_fault_of_the_solver_is_a_criterion_that_is_not_met(simulator: PourSimulator) -> None:
    def work(_: PourSimulator, __: CaseEffort) -> tuple[list[Measurement], None]:
        raise ArithmeticError("at 0.1 s: diverged")

    result = suite.Case("bad", "Bad", "", work).run(simulator, CaseEffort())
    assert not result.passed
    assert "diverged" in result.measurements[0].name


def test_cases_are_found_by_name_and_a_wrong_name_lists_them() -> None:
    assert [suite.case(c.name) for c in suite.CASES] == list(suite.CASES)
    with pytest.raises(KeyError, match="no case 'slosh'; there are rest, column"):
        suite.case("slosh")


# What the solver did not reach when the case was written, by case: a case that begins to pass, or one that passes no
# longer, fails the slow test, so that this list stays true.
NOT_MET: dict[str, str] = {
    "retention": "12 mL too much with 500 particles at 80°, where 10 are allowed",
    "landing": "the spread at 30 °/s is 1.7 mm more with 500 particles than with 10,000",
    "drainage": "a vertical film runs off too early",
    "drainage, mirrored": "a vertical film runs off too early",
    "halves": "mirrored pours spill 0.3 points more in the mean, 0.8 in a narrow cup, where 0.3 are allowed",
    "outflow, mirrored": "0.687 left at 2.7 s with 2,000 particles, where 0.685 is allowed",
}


NEAR_A_LIMIT: dict[str, tuple[int, str]] = {
    "cohesion": (1, "0.807 on one processor, 0.763 on another, where 0.8 is the least: rounding decides"),
    "convergence": (1, "the largest distance is that of 10,000 particles at 60 °/s, 0.036 where 0.04 is allowed"),
    "wetting": (2, "puddles at 60° are 3.1 to 3.8 mm high where 3.27 are allowed, at 150° 6.13 to 6.43 where 6.32 are"),
    "landing, mirrored": (1, "the spread at 30 °/s is 0.996 mm more than that of 10,000 particles, where 1 is allowed"),
    "wetting, mirrored": (2, "3.6 mm at 60° and 6.34 mm at 150°"),
}
"""How many criteria have a verdict that depends on processor and engine, and which; see docs/evidence/validation.md."""

TOO_LONG = ("walls",)
"""Take more than ten minutes of a core: they are run for docs/evidence/validation.md, and a part of each is a test of
its own."""


@pytest.mark.physics
@pytest.mark.parametrize(
    ("case", "effort", "name"),
    [
        (case, effort, f"{case.name}, mirrored" if effort.mirrored else case.name)
        for case in suite.CASES
        if case.name not in TOO_LONG
        for effort in case.efforts(full=True)
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_full_case(simulator: PourSimulator, case: suite.Case, effort: CaseEffort, name: str) -> None:
    failed = failures(list(case.run(simulator, effort).measurements))
    if name in NOT_MET:
        assert failed != [], f"{name} now meets all its criteria: take it off the list and write the page again"
    elif name in NEAR_A_LIMIT:
        assert len(failed) <= NEAR_A_LIMIT[name][0]
    else:
        assert failed == []
