"""The solver against physics: the quick part of `decant physics`; the full one is marked slow."""

from __future__ import annotations

import math

import numpy as np
import pytest

from sim_engine.liquid import SimulationParameters
from sim_engine.pour import PourSimulator
from sim_engine.validation import at_rest, pours, suite, tilting, walls
from sim_engine.validation.result import Measurement, at_least, at_most, reported, within

STICKY = SimulationParameters(cohesion=0.0, viscosity=1.0, friction=1.0)


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


def test_liquid_at_rest_stands_as_high_as_its_volume(simulator: PourSimulator) -> None:
    measurements, _ = at_rest.at_rest(2_000, suite.PLAIN)
    assert failures(measurements[:1]) == []


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


def test_the_standard_pour_flows_as_other_solvers_say(simulator: PourSimulator) -> None:
    measurements, _ = pours.outflow(simulator, 2_000, suite.PLAIN)
    assert failures(measurements) == []


def test_outflow_is_told_from_that_of_a_thick_liquid(simulator: PourSimulator) -> None:
    thick = SimulationParameters(cohesion=0.0, viscosity=40.0, friction=0.3)
    measurements, _ = pours.outflow(simulator, 500, thick)
    assert len(failures(measurements)) >= 2


def test_parcels_of_the_jet_fall_with_g(simulator: PourSimulator) -> None:
    measurements, figure = pours.free_jet(simulator, 800, suite.PLAIN)
    assert failures(measurements) == []
    assert len(figure.series[0].x) > 20


def test_nothing_crosses_thin_walls_in_random_pours(simulator: PourSimulator) -> None:
    assert failures(walls.walls(5, 1_200, seed=3)) == []


def test_a_seed_is_repeated_to_the_bit(simulator: PourSimulator) -> None:
    assert failures(pours.repeatability(simulator, 500, suite.PLAIN)) == []


def test_cases_are_found_by_name_and_a_wrong_name_lists_them() -> None:
    assert [suite.case(c.name) for c in suite.CASES] == list(suite.CASES)
    with pytest.raises(KeyError, match="no case 'slosh'; there are rest, retention"):
        suite.case("slosh")
