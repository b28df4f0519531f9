"""`hydrostatics`: tilted vessels at rest and the tilting-cup equation, against tables, integrals and particle
solvers.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine.hydrostatics import level, predicted_end_of_flow, retained_volume, tilting_cup_outflow
from sim_engine.vessel.shapes import ProfileShape, VesselSpec, cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.hypothesis_examples import examples

CUP = build_vessel(cylinder("cup", inner_radius=0.04, inner_height=0.1))
BOTTLE = build_vessel(
    VesselSpec(
        name="bottle",
        shape=ProfileShape(
            unit="m",
            inner=((0.0, 0.0), (0.03, 0.0), (0.03, 0.1), (0.012, 0.11), (0.012, 0.13)),
            wall=0.002,
            floor=0.002,
        ),
    )
)
CONE = build_vessel(
    VesselSpec(name="cone", shape=ProfileShape(unit="m", inner=((0.0, 0.0), (0.05, 0.1)), wall=0.003, floor=0.003))
)


@pytest.mark.parametrize(
    ("tilt", "millilitres"),
    [(50, 263.0), (55, 217.6), (60, 172.5), (65, 131.0), (70, 93.8), (75, 61.2), (80, 33.6), (85, 12.0), (89, 1.1)],
)
def test_tilted_cylinder_retains_what_the_table_says(tilt: float, millilitres: float) -> None:
    assert retained_volume(CUP, math.radians(tilt)) == pytest.approx(millilitres * 1e-6, abs=0.005 * CUP.capacity)


@pytest.mark.parametrize("tilt", [0, 10, 25, 40, 55])
def test_tilted_cone_retains_the_integral_over_its_sections(tilt: float) -> None:
    # Sections at constant z are discs cut by a chord x > (z cos θ − s) / sin θ with the spill height s.
    theta = math.radians(tilt)
    z = (np.arange(20_000) + 0.5) * 0.1 / 20_000
    r = 0.5 * z
    spill = 0.1 * math.cos(theta) - 0.05 * math.sin(theta)
    cut = np.clip((z * math.cos(theta) - spill) / max(math.sin(theta), 1e-12) / r, -1.0, 1.0)
    area = r**2 * (np.arccos(cut) - cut * np.sqrt(1.0 - cut**2))
    expected = area.sum() * 0.1 / 20_000
    assert retained_volume(CONE, theta) == pytest.approx(expected, abs=0.005 * CONE.capacity)


@pytest.mark.parametrize("vessel", [CUP, CONE], ids=["cup", "cone"])
def test_upright_vessel_retains_its_capacity_and_an_overturned_one_nothing(vessel) -> None:  # type: ignore[no-untyped-def]
    assert retained_volume(vessel, 0.0) == pytest.approx(vessel.capacity)
    assert retained_volume(vessel, math.radians(100)) == 0.0
    assert retained_volume(vessel, math.pi) == 0.0


def test_bottle_past_the_horizontal_keeps_liquid_in_its_shoulder() -> None:
    # At 100° the pool lies between the wall and the neck's inner corner, which stands higher than the lip.
    kept = retained_volume(BOTTLE, math.radians(100))
    assert 20e-6 < kept < retained_volume(BOTTLE, math.radians(85))
    assert retained_volume(BOTTLE, math.radians(175)) < 1e-6


@settings(max_examples=examples(40), deadline=None)
@given(st.floats(0.0, math.pi), st.floats(0.0, math.pi), st.sampled_from([CUP, CONE]))
def test_more_tilt_never_retains_more(first: float, second: float, vessel) -> None:  # type: ignore[no-untyped-def]
    low, high = sorted((first, second))
    assert retained_volume(vessel, high) <= retained_volume(vessel, low) + 0.001 * vessel.capacity


def test_tilting_the_other_way_retains_as_much() -> None:
    assert retained_volume(CUP, -1.0) == pytest.approx(retained_volume(CUP, 1.0), abs=0.002 * CUP.capacity)


def test_level_in_an_upright_cylinder_is_volume_over_area() -> None:
    depth = 200e-6 / (math.pi * 0.04**2)
    assert level(CUP, 200e-6, 0.0) == pytest.approx(depth - 0.1, abs=1e-3)


def test_level_reaches_the_lip_where_pouring_begins() -> None:
    start = math.radians(56.9)  # 200 mL in this cup
    assert level(CUP, 200e-6, start) == pytest.approx(0.0, abs=5e-4)
    assert level(CUP, 200e-6, start - 0.1) < 0.0 < level(CUP, 200e-6, start + 0.1)


@pytest.mark.parametrize(
    ("volume", "tilt", "message"),
    [
        (-1e-6, 0.1, "holds between"),
        (1e-3, 0.1, "holds between"),
        (1e-4, 4.0, "between −180° and 180°"),
        (1e-4, math.nan, "nan"),
    ],
)
def test_impossible_levels_are_refused(volume: float, tilt: float, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        level(CUP, volume, tilt)


def ramp(speed: float, largest: float):  # type: ignore[no-untyped-def]
    return lambda t: np.minimum(math.radians(speed) * np.asarray(t), math.radians(largest))


def test_outflow_follows_particle_solvers() -> None:
    # Two published position-based and pressure solvers, 200 mL, 30 °/s to 120° about the lip; they agree to 1.6 points.
    at = np.array([1.9, 2.1, 2.3, 2.5, 2.7, 2.9, 3.1, 3.3, 3.5])
    kept = np.array([1.0, 0.985, 0.92, 0.80, 0.64, 0.46, 0.29, 0.14, 0.04])
    times = np.linspace(0.0, 6.0, 601)
    poured = tilting_cup_outflow(CUP, 200e-6, times, ramp(30, 120)(times), discharge=0.7) / 200e-6
    assert np.abs(1.0 - np.interp(at, times, poured) - kept).max() < 0.03
    textbook = tilting_cup_outflow(CUP, 200e-6, times, ramp(30, 120)(times)) / 200e-6
    assert np.abs(1.0 - np.interp(at, times, textbook) - kept).max() < 0.06


def test_slow_tilt_pours_down_to_what_the_vessel_retains() -> None:
    times = np.linspace(0.0, 150.0, 1500)
    poured = tilting_cup_outflow(CUP, 200e-6, times, ramp(0.6, 70)(times))
    assert 200e-6 - poured[-1] == pytest.approx(retained_volume(CUP, math.radians(70)), abs=0.005 * CUP.capacity)


@settings(max_examples=examples(25), deadline=None)
@given(
    st.floats(0.05, 1.0),
    st.floats(5.0, 300.0),
    st.floats(5.0, 175.0),
    st.sampled_from([CUP, CONE, BOTTLE]),
)
def test_outflow_never_runs_backwards_nor_pours_more_than_there_is(fill, speed, largest, vessel) -> None:  # type: ignore[no-untyped-def]
    times = np.linspace(0.0, 8.0, 200)
    volume = fill * vessel.capacity
    poured = tilting_cup_outflow(vessel, volume, times, ramp(speed, largest)(times))
    assert np.all(np.diff(poured) >= 0.0)
    assert poured[0] == 0.0
    assert poured[-1] <= volume * (1.0 + 1e-9)


def test_flow_ends_soon_after_a_full_tilt_and_never_begins_below_the_pouring_angle() -> None:
    end = predicted_end_of_flow(CUP, 200e-6, ramp(30, 120), 10.0)
    assert 3.3 < end < 5.0
    assert predicted_end_of_flow(CUP, 200e-6, ramp(30, 50), 10.0) == 0.0


def test_flow_that_goes_on_is_reported_as_the_end_of_the_look() -> None:
    assert predicted_end_of_flow(CUP, 200e-6, ramp(30, 120), 2.5) == 2.5


def test_faster_tilts_end_their_flow_earlier() -> None:
    ends = [predicted_end_of_flow(CUP, 200e-6, ramp(speed, 120), 30.0) for speed in (10, 20, 40, 80, 160)]
    assert ends == sorted(ends, reverse=True)


def test_nothing_flows_from_an_empty_vessel() -> None:
    assert predicted_end_of_flow(CUP, 0.0, ramp(60, 170), 5.0) == 0.0
