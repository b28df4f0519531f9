"""`model_validity`: dimensionless numbers of planned pours: that they scale as they must, and on which side of a
limit one is warned.
"""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine import lip_flow as lip
from sim_engine.action import DEG, Action
from sim_engine.hydrostatics import GRAVITY
from sim_engine.lip_flow import FlowNumbers, bond, capillary_length
from sim_engine.liquids import Liquid
from sim_engine.model_validity import DRIBBLING_WEBER, VISCOUS_REYNOLDS, WETTING_BOND, ModelValidity, regimes
from sim_engine.motion import plan_motion
from sim_engine.scene import Pivot, SampledMotion, Scene
from sim_engine.vessel.shapes import ProfileShape, VesselSpec, cylinder
from sim_engine.vessel.vessel import build_vessel
from tests.support.hypothesis_examples import examples

CUP = cylinder("cup", inner_radius=0.04, inner_height=0.1)
GLASS = cylinder("glass", inner_radius=0.045, inner_height=0.09)
WATER = Liquid(mass=0.1996)  # 200 mL
SCENE = Scene("scene", CUP, GLASS, WATER)
STANDARD = Action(angular_velocity=30 * DEG, max_angle=120 * DEG, x_offset=0.1, height=0.1)
FINE = 1e-3
"""Spacing at which every stream here has enough particles across [m]."""

NUMBERS = ("velocity", "thickness", "reynolds", "weber", "bond")


def necked(radius: float) -> VesselSpec:
    """A bottle of 60 mm with a neck."""
    inner = ((0.0, 0.0), (0.03, 0.0), (0.03, 0.1), (radius, 0.11), (radius, 0.13))
    return VesselSpec(name="bottle", shape=ProfileShape(unit="m", inner=inner, wall=0.002, floor=0.002))


def planned(scene: Scene = SCENE, action: Action = STANDARD, spacing: float = FINE) -> ModelValidity:
    return regimes(scene, action, build_vessel(scene.pourer), build_vessel(scene.receiver), spacing=spacing)


def of_liquid(action: Action = STANDARD, **changes: float) -> ModelValidity:
    """The standard pour, or another one, of 200 mL of another liquid."""
    liquid = WATER.model_copy(update=changes)
    return planned(replace(SCENE, liquid=liquid.model_copy(update={"mass": WATER.volume * liquid.density})), action)


def kinds(found: ModelValidity) -> set[str]:
    return {one.kind for one in found.not_covered}


def ratio(first: FlowNumbers | None, second: FlowNumbers | None) -> dict[str, tuple[float, float]]:
    """The ratio of every number of two flows: smallest by smallest, largest by largest."""
    assert first is not None
    assert second is not None
    pairs = {name: (getattr(first, name), getattr(second, name)) for name in NUMBERS}
    return {name: (a.smallest / b.smallest, a.largest / b.largest) for name, (a, b) in pairs.items()}


def test_water_in_the_standard_pour_has_the_numbers_of_its_flow() -> None:
    """200 mL leave within about 1.3 s over a lip 70 mm wide, and fall 100 mm."""
    found = planned()
    assert found.lip is not None
    assert found.stream is not None
    assert found.poured == pytest.approx(1.0, abs=0.01)
    flow = found.lip.velocity.largest * found.lip.thickness.largest * 0.07
    assert 150e-6 < flow < 250e-6
    assert found.stream.velocity.smallest == pytest.approx(math.sqrt(2 * GRAVITY * 0.1), rel=0.05)
    assert 50.0 < found.stream.weber.smallest < found.stream.weber.largest < 500.0
    assert found.lip.reynolds.smallest > 500.0
    assert kinds(found) == set()


factors = st.floats(0.2, 5.0)


@settings(max_examples=examples(15), deadline=None)
@given(factors, factors, factors)
def test_liquids_of_one_volume_flow_alike_and_only_their_numbers_scale(
    heavier: float, tenser: float, thicker: float
) -> None:
    other = of_liquid(density=998.0 * heavier, surface_tension=0.0728 * tenser, dynamic_viscosity=1e-3 * thicker)
    water = planned()
    expected = {"velocity": 1.0, "thickness": 1.0, "reynolds": heavier / thicker}
    expected |= {"weber": heavier / tenser, "bond": heavier / tenser}
    for place in ("lip", "stream"):
        for name, found in ratio(getattr(other, place), getattr(water, place)).items():
            assert found == pytest.approx((expected[name],) * 2, rel=1e-6), (place, name)


@pytest.mark.parametrize("scale", [0.4, 2.5])
def test_a_scene_enlarged_with_its_time_has_larger_numbers_by_froude(scale: float) -> None:
    """All lengths times λ, all times times √λ: velocities grow by √λ, so Re by λ^1.5, We and Bo by λ²."""
    large = Scene(
        "large",
        cylinder("cup", inner_radius=0.04 * scale, inner_height=0.1 * scale),
        cylinder("glass", inner_radius=0.045 * scale, inner_height=0.09 * scale),
        Liquid(mass=WATER.mass * scale**3),
    )
    pace = math.sqrt(scale)
    action = Action(
        angular_velocity=30 * DEG / pace,
        angular_acceleration=600 * DEG / scale,
        max_angle=120 * DEG,
        x_offset=0.1 * scale,
        height=0.1 * scale,
    )
    expected = {"velocity": pace, "thickness": scale, "reynolds": scale**1.5, "weber": scale**2, "bond": scale**2}
    found, plain = planned(large, action), planned()
    for place in ("lip", "stream"):
        for name, quotient in ratio(getattr(found, place), getattr(plain, place)).items():
            assert quotient == pytest.approx((expected[name],) * 2, rel=0.08), (place, name)


def test_bond_number_is_thickness_over_capillary_length_squared() -> None:
    assert capillary_length(WATER) == pytest.approx(2.727e-3, rel=1e-3)
    assert float(bond(WATER, 3 * capillary_length(WATER))) == pytest.approx(9.0)


def test_a_longer_fall_makes_the_stream_faster_and_thinner_and_changes_nothing_at_the_lip() -> None:
    low, high = planned(action=STANDARD.with_values(height=0.05)), planned(action=STANDARD.with_values(height=0.2))
    assert low.lip == high.lip
    assert low.lip is not None
    assert low.stream is not None
    assert high.stream is not None
    assert high.stream.thickness.largest < low.stream.thickness.largest
    for found, fall in ((low, 0.05), (high, 0.2)):
        assert found.stream is not None
        at_lip, below = low.lip.velocity.largest, found.stream.velocity.largest
        assert below**2 == pytest.approx(at_lip**2 + 2 * GRAVITY * fall, rel=1e-6)


def test_film_and_stream_carry_what_leaves() -> None:
    cup, glass = build_vessel(CUP), build_vessel(GLASS)
    course = lip.flow_course(plan_motion(SCENE, STANDARD, cup, glass), WATER, cup, glass)
    assert course is not None
    flow = course.stream_velocity * math.pi * course.diameter**2 / 4.0
    assert course.volume[:-1] == pytest.approx(0.01 * flow[:-1], rel=0.02)
    assert course.volume.sum() == pytest.approx(WATER.volume, rel=0.01)


def test_what_an_arm_did_is_judged_as_it_was_done() -> None:
    cup, glass = build_vessel(CUP), build_vessel(GLASS)
    motion = plan_motion(SCENE, STANDARD, cup, glass)
    times = np.linspace(0.0, motion.duration, 400)
    done = SampledMotion(times, motion.sample(times))
    found = regimes(SCENE, STANDARD, cup, glass, spacing=FINE, motion=done)
    for place in ("lip", "stream"):
        for name, quotient in ratio(getattr(found, place), getattr(planned(), place)).items():
            assert quotient == pytest.approx((1.0, 1.0), rel=0.02), (place, name)


def test_a_pour_that_pours_nothing_is_warned_of_nothing() -> None:
    found = planned(action=STANDARD.with_values(max_angle=20 * DEG), spacing=0.01)
    assert (found.poured, found.lip, found.stream, found.not_covered) == (0.0, None, None, ())


@pytest.mark.parametrize(
    ("kind", "name", "limit", "scaled"),
    [
        ("dribbling", "weber", DRIBBLING_WEBER, "surface_tension"),
        ("wetting", "bond", WETTING_BOND, "surface_tension"),
    ],
)
def test_one_is_warned_below_the_limit_and_not_above(kind: str, name: str, limit: float, scaled: str) -> None:
    """The liquid is chosen so that the smallest number of the pour lies 10 % below the limit, and 10 % above."""
    water = planned().lip
    assert water is not None
    at_limit = getattr(WATER, scaled) * getattr(water, name).smallest / limit
    below, above = of_liquid(**{scaled: at_limit / 0.9}), of_liquid(**{scaled: at_limit / 1.1})
    assert below.lip is not None
    assert getattr(below.lip, name).smallest == pytest.approx(0.9 * limit, rel=1e-6)
    assert kind in kinds(below)
    assert kind not in kinds(above)


def test_a_trickle_from_a_cup_that_is_hardly_tilted_dribbles_and_a_quick_pour_does_not() -> None:
    trickle = planned(action=STANDARD.with_values(angular_velocity=10 * DEG, max_angle=62 * DEG))
    assert {"dribbling", "wetting"} <= kinds(trickle)
    (told,) = (one for one in trickle.not_covered if one.kind == "dribbling")
    assert told.share > 0.5
    assert f"{100 * told.share:.0f} % of what is poured" in told.text
    assert "Weber number below 2" in told.text
    assert kinds(planned(action=STANDARD.with_values(angular_velocity=90 * DEG))) == set()


def test_a_thick_liquid_dribbles_by_the_film_that_viscosity_leaves_it() -> None:
    """Of a flow q a width of the lip a vertical film is (3νq/g)^(1/3) thick, which slows glycerol down at the lip."""
    slow = STANDARD.with_values(angular_velocity=15 * DEG)
    glycerol = {"density": 1260.0, "surface_tension": 0.063}
    thick, thin = (of_liquid(slow, **glycerol, dynamic_viscosity=mu) for mu in (1.41, 1e-3))
    assert "dribbling" in kinds(thick)
    assert "dribbling" not in kinds(thin)
    assert thick.lip is not None
    assert thin.lip is not None
    flux = thick.lip.velocity.largest * thick.lip.thickness.largest
    assert flux == pytest.approx(thin.lip.velocity.largest * thin.lip.thickness.largest, rel=0.01)
    assert thick.lip.thickness.largest == pytest.approx((3 * 1.41 / 1260 * flux / GRAVITY) ** (1 / 3), rel=1e-6)


def test_thick_liquids_are_simulated_and_told_only_beyond_what_was_checked() -> None:
    assert kinds(of_liquid(density=1260.0, dynamic_viscosity=1.41, surface_tension=0.063)) == set()
    oil = Liquid(mass=WATER.volume * 915.0, density=915.0, dynamic_viscosity=0.0788, surface_tension=0.0335)
    (told,) = planned(replace(SCENE, liquid=oil), spacing=0.0055).not_covered
    assert told.kind == "viscous"
    assert told.share == 1.0
    assert "(86.1 mm^2/s); the simulator adds about 91 mm^2/s at this number of particles" in told.text
    assert kinds(planned(replace(SCENE, liquid=oil), spacing=0.004)) == set()
    honey = of_liquid(density=1400.0, dynamic_viscosity=9.0, surface_tension=0.08)
    (told,) = (one for one in honey.not_covered if one.kind == "viscous")
    assert told.share == 1.0
    assert "9 Pa*s" in told.text


def test_a_thin_liquid_from_a_small_cup_is_slowed_by_a_viscosity_that_is_not_simulated() -> None:
    small = Scene(
        "small",
        cylinder("cup", inner_radius=0.01, inner_height=0.025),
        cylinder("glass", inner_radius=0.02, inner_height=0.03),
        Liquid(mass=0.003, dynamic_viscosity=4.5e-3, surface_tension=1e-3),
    )
    found = planned(small, STANDARD.with_values(x_offset=0.05, height=0.05))
    assert found.lip is not None
    assert found.lip.reynolds.smallest < VISCOUS_REYNOLDS
    (told,) = (one for one in found.not_covered if one.kind == "viscous")
    assert "(4.5 mPa*s)" in told.text


def test_a_stream_of_too_few_particles_is_told_with_the_number_that_would_do() -> None:
    coarse = planned(spacing=(WATER.volume / 500) ** (1 / 3))
    (told,) = coarse.not_covered
    assert told.kind == "thin_stream"
    enough = int(told.text.partition("approximate; ")[2].partition(" particles")[0].replace(" ", ""))
    assert 500 < enough < 5_000
    assert kinds(planned(spacing=(WATER.volume / enough) ** (1 / 3))) == set()


def test_a_bottle_turned_over_glugs_and_one_that_is_tilted_slowly_breathes() -> None:
    bottle = replace(SCENE, pourer=necked(0.012))
    over = planned(bottle, STANDARD.with_values(angular_velocity=90 * DEG, max_angle=150 * DEG))
    assert "glugging" in kinds(over)
    (told,) = (one for one in over.not_covered if one.kind == "glugging")
    assert told.share > 0.5
    slowly = planned(bottle, STANDARD.with_values(angular_velocity=2 * DEG, max_angle=80 * DEG))
    assert not {"glugging", "airtight"} & kinds(slowly)


def test_a_brimful_cup_tilted_a_little_lets_air_in_over_its_upper_rim() -> None:
    full = Liquid(mass=0.999 * build_vessel(CUP).capacity * 998.0)
    assert "glugging" not in kinds(planned(replace(SCENE, liquid=full), STANDARD.with_values(max_angle=60 * DEG)))


def test_air_does_not_get_into_an_opening_narrower_than_bretherton_s() -> None:
    """0.918 capillary lengths of radius: 2.5 mm for water."""
    vial = replace(SCENE, pourer=necked(0.0024), liquid=Liquid(mass=0.05))
    wider = replace(vial, pourer=necked(0.0027))
    over = STANDARD.with_values(max_angle=150 * DEG, hold_time=3.0)
    assert "airtight" in kinds(planned(vial, over))
    assert "airtight" not in kinds(planned(wider, over))


def test_a_pivot_far_from_the_lip_lets_the_lip_come_down_and_shortens_the_fall() -> None:
    about_base = replace(SCENE, pivot=Pivot("point", 0.0, 0.0))
    lowered, fixed = planned(about_base).stream, planned().stream
    assert lowered is not None
    assert fixed is not None
    assert lowered.velocity.largest < fixed.velocity.largest
