"""`vessel`: vessels of revolution: what a user who describes a profile relies on."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sim_engine.vessel.distance_grid import MARGIN, MAXIMUM_NODES
from sim_engine.vessel.shapes import ProfileShape, VesselError, VesselSpec, cylinder
from sim_engine.vessel.vessel import Vessel, build_vessel, check_holds
from tests.support.hypothesis_examples import examples

BEAKER = build_vessel(cylinder("beaker", inner_radius=0.04, inner_height=0.1))


def vessel_of(*inner: tuple[float, float], wall: float = 0.003, floor: float = 0.003, name: str = "cup") -> Vessel:
    return build_vessel(VesselSpec(name=name, shape=ProfileShape(unit="m", inner=inner, wall=wall, floor=floor)))


@st.composite
def profiles(draw: st.DrawFn) -> VesselSpec:
    """Cups, cones, bellied and waisted vessels that widen and narrow as they like."""
    radii = draw(st.lists(st.floats(0.012, 0.05), min_size=2, max_size=6))
    rises = draw(st.lists(st.floats(0.012, 0.03), min_size=len(radii) - 1, max_size=len(radii) - 1))
    heights = np.concatenate([[0.0], np.cumsum(rises)])
    inner = ((0.0, 0.0), *((r, float(z)) for r, z in zip(radii, heights, strict=True)))
    wall, floor = draw(st.floats(0.002, 0.006)), draw(st.floats(0.002, 0.01))
    return VesselSpec(name="drawn", shape=ProfileShape(unit="m", inner=inner, wall=wall, floor=floor))


def mesh_volume(vessel: Vessel) -> float:
    a, b, c = (vessel.solid_vertices[vessel.solid_faces[:, i]] for i in range(3))
    return float(np.einsum("ij,ij->", a, np.cross(b, c)) / 6.0)


def test_cylinder_has_the_dimensions_of_its_spec() -> None:
    assert BEAKER.inner_floor == pytest.approx(0.004)
    assert BEAKER.rim_height == pytest.approx(0.104)
    assert BEAKER.opening_radius == pytest.approx(0.04)
    assert BEAKER.outer_radius == pytest.approx(0.044, abs=1e-5)
    assert BEAKER.capacity == pytest.approx(math.pi * 0.04**2 * 0.1)
    assert BEAKER.wall_thickness == 0.004
    solid = math.pi * (0.044**2 * 0.104 - 0.04**2 * 0.1)
    assert mesh_volume(BEAKER) == pytest.approx(solid, rel=2e-3)  # a circle of 96 corners lacks 0.07 % of its area


def test_shapes_that_a_measured_vessel_may_have_scatter_as_it_was_measured() -> None:
    rows = ((0.0, 3e-4, 3e-4, 0.0), (0.0, 0.0, 2e-4, 4e-4))
    inner = ((0.0, 0.0), (0.03, 0.0), (0.03, 0.05), (0.03, 0.1))
    shape = ProfileShape(unit="m", inner=inner, wall=0.003, floor=0.003, radius_deviations=rows, height_deviation=5e-4)
    cup = VesselSpec(name="cup", shape=shape)
    drawn = [cup.drawn(seed) for seed in range(2_000)]
    points = np.array([one.shape.outline().inner for one in drawn])  # type: ignore[union-attr]
    np.testing.assert_allclose(points.mean(axis=0), inner, atol=5e-5)
    np.testing.assert_allclose(points[:, 1:, 0].std(axis=0), np.hypot(*rows)[1:], rtol=0.05)
    assert np.corrcoef(points[:, 1, 0], points[:, 3, 0])[0, 1] == pytest.approx(0.0, abs=0.06), "rows are independent"
    assert points[:, 3, 1].std() == pytest.approx(5e-4, rel=0.05)
    assert cup.drawn(7) == drawn[7], "a seed is a shape"
    assert not drawn[7].uncertain
    assert build_vessel(drawn[7]).capacity != build_vessel(cup).capacity


def test_a_vessel_of_which_nobody_says_how_far_it_may_be_off_is_drawn_as_it_is() -> None:
    assert BEAKER.spec.drawn(3) is BEAKER.spec


def test_lip_lies_on_the_inner_edge_in_the_direction_of_the_pour() -> None:
    for direction in (0.0, 0.4, 3.0, -1.3, 7.0):
        expected = [0.04 * math.cos(direction), 0.04 * math.sin(direction), 0.104]
        np.testing.assert_allclose(BEAKER.lip_point(direction), expected, atol=1e-9)


def test_distance_of_a_cylinder_is_that_of_its_walls() -> None:
    points = np.array([[0.0, 0.0, 0.05], [0.041, 0.0, 0.05], [0.0, 0.0, 0.003], [0.05, 0.0, 0.05], [0.042, 0.0, 0.11]])
    expected = [0.04, -0.001, -0.001, 0.006, 0.006]
    np.testing.assert_allclose(BEAKER.grid.sample(points), expected, atol=2e-4)


def test_distance_goes_on_growing_beyond_the_grid() -> None:
    far = np.array([[0.5, 0.0, 0.05]])
    assert BEAKER.grid.sample(far)[0] == pytest.approx(0.5 - 0.044, abs=2e-4)


def test_gradient_points_away_from_the_wall() -> None:
    inside, outside = BEAKER.grid.gradient(np.array([[0.03, 0.0, 0.06], [0.05, 0.0, 0.06]]))
    np.testing.assert_allclose(inside, [-1.0, 0.0, 0.0], atol=0.05)
    np.testing.assert_allclose(outside, [1.0, 0.0, 0.0], atol=0.05)


def test_wall_of_a_cone_keeps_its_thickness_along_the_normal() -> None:
    cone = vessel_of((0.0, 0.0), (0.01, 0.0), (0.06, 0.05), wall=0.004)
    assert cone.outer_radius == pytest.approx(
        0.06 + 0.004 * math.sqrt(2), abs=1e-5
    )  # cut flat, not thinner, at the rim
    # a point of the wall's middle surface, by its normal (1, −1)/√2, half a wall from the inner surface
    middle = np.array([[0.035 + 0.002 / math.sqrt(2), 0.0, 0.003 + 0.025 - 0.002 / math.sqrt(2)]])
    h = cone.grid.spacing
    assert cone.grid.sample(middle)[0] == pytest.approx(-0.002, abs=h / 2)  # the kink there is rounded by up to h/2
    surfaces = middle + np.array([[1.0], [-1.0]]) * 0.002 * np.array([1.0, 0.0, -1.0]) / math.sqrt(2)
    np.testing.assert_allclose(cone.grid.sample(surfaces), 0.0, atol=0.1 * h)


@pytest.mark.parametrize("wall", [0.001, 0.002, 0.004])
def test_walls_have_no_hole_in_the_interpolated_distance(wall: float) -> None:
    vessel = vessel_of((0.0, 0.0), (0.025, 0.0), (0.04, 0.1), wall=wall, floor=wall)
    t, angle = np.meshgrid(np.linspace(0.02, 0.98, 150), np.linspace(0.0, 2.0 * np.pi, 90))
    normal = np.array([0.1, -0.015]) / math.hypot(0.1, 0.015)
    r, z = 0.025 + 0.015 * t + normal[0] * wall / 2, wall + 0.1 * t + normal[1] * wall / 2
    points = np.stack([r * np.cos(angle), r * np.sin(angle), z], axis=-1).reshape(-1, 3)
    assert vessel.grid.sample(points).max() < 0.0
    assert vessel.grid.values.size <= MAXIMUM_NODES


def test_grid_leaves_room_around_the_solid() -> None:
    low, high = BEAKER.solid_vertices.min(axis=0), BEAKER.solid_vertices.max(axis=0)
    assert np.all(BEAKER.grid.origin <= low - MARGIN + 1e-9)
    assert np.all(BEAKER.grid.upper >= high + MARGIN - 1e-9)


@settings(max_examples=examples(15), deadline=None)
@given(spec=profiles())
def test_any_profile_gives_a_sound_vessel(spec: VesselSpec) -> None:
    vessel = build_vessel(spec)
    # the solid is closed and right side out, and its surface is where the distance vanishes
    assert mesh_volume(vessel) > 0.0
    on_surface = vessel.grid.sample(vessel.surface_points(500))
    assert np.abs(on_surface).max() < 0.75 * vessel.grid.spacing  # at sharp edges
    assert np.median(np.abs(on_surface)) < 0.25 * vessel.grid.spacing
    # distance grows no faster than the way
    values, h = vessel.grid.values, vessel.grid.spacing
    for axis in range(3):
        assert np.abs(np.diff(values, axis=axis)).max() <= h * 1.001
    # the cavity's nodes are free and make up the volume of the cone frustums
    assert values[vessel.grid.cavity > 0].min() > 0.0
    counted = np.count_nonzero(vessel.grid.cavity) * h**3
    shell = 2.0 * np.pi * vessel.outer_radius * (vessel.rim_height + vessel.outer_radius) * h
    assert abs(counted - vessel.capacity) < shell
    points, each = vessel.cavity_points()
    assert len(points) * each == pytest.approx(vessel.capacity)
    assert vessel.grid.sample(points).min() > -0.6 * h  # in acute corners
    assert points[:, 2].max() < vessel.rim_height


def test_quadrature_finds_the_height_of_the_centre_of_mass_of_a_cone() -> None:
    cone = vessel_of((0.0, 0.0), (0.05, 0.08))
    points, _ = cone.cavity_points()
    assert points[:, 2].mean() - cone.inner_floor == pytest.approx(0.06, rel=2e-3)  # 3/4 of the height
    np.testing.assert_allclose(points[:, :2].mean(axis=0), 0.0, atol=1e-9)


def test_surface_points_lie_on_the_surface_and_crowd_at_the_rim() -> None:
    points = BEAKER.surface_points(3000)
    assert points.shape == (3000, 3)
    at_rim = np.abs(points[:, 2] - BEAKER.rim_height) < 1e-6
    assert np.count_nonzero(at_rim) > 500
    np.testing.assert_array_equal(points, BEAKER.surface_points(3000))


def test_load_that_would_overflow_is_refused_with_both_volumes() -> None:
    check_holds(BEAKER, 500e-6)
    with pytest.raises(VesselError, match=r"beaker holds 502.7 mL to the brim, 2000 mL asked for"):
        check_holds(BEAKER, 2000e-6)


@pytest.mark.parametrize(
    ("inner", "wall", "message"),
    [
        (((0.0, 0.0),), 0.003, "needs at least"),
        (((0.01, 0.0), (0.03, 0.1)), 0.003, "must start on the axis"),
        (((0.0, 0.0), (-0.03, 0.0), (-0.03, 0.1)), 0.003, "negative radius"),
        (((0.0, 0.0), (0.03, -0.01), (0.03, 0.1)), 0.003, "lowest point is at z = -10 mm"),
        (((0.0, 0.0), (0.03, 0.0), (0.03, 0.1), (0.04, 0.09)), 0.003, "must end at the rim"),
        (((0.0, 0.0), (0.03, 0.0), (0.0, 0.05), (0.03, 0.1)), 0.003, "comes back to the axis"),
        (((0.0, 0.0), (0.03, 0.06), (0.03, 0.02), (0.01, 0.05), (0.04, 0.1)), 0.003, "crosses itself"),
        (((0.0, 0.0), (0.03, 0.0), (0.03, 0.0), (0.03, 0.1)), 0.003, "twice in a row"),
        (((0.0, 0.0), (0.03, 0.0), (0.03, 0.1)), 0.0, "outside 0.2 … 100 mm"),
        (((0.0, 0.0), (30.0, 0.0), (30.0, 100.0)), 0.003, "in millimetres"),
        (((0.0, 0.0), (3e-5, 0.0), (3e-5, 1e-4)), 2.5e-4, "check the units"),
        (((0.0, 0.0), (0.03, 0.0), (0.03, 0.05), (0.001, 0.1)), 0.003, "opening has a radius of 1 mm"),
        (((0.0, 0.0), (0.03, 0.0), (0.03, float("nan"))), 0.003, "finite"),
        (((0.0, 0.0), (0.25, 0.0), (0.25, 0.5)), 0.0005, "too thin"),
    ],
)
def test_profile_that_is_no_vessel_is_refused_with_the_reason(
    inner: tuple[tuple[float, float], ...], wall: float, message: str
) -> None:
    with pytest.raises(ValueError, match=message):
        vessel_of(*inner, wall=wall)


def test_bottle_has_shoulder_and_neck() -> None:
    bottle = vessel_of((0.0, 0.0), (0.03, 0.0), (0.03, 0.1), (0.012, 0.12), (0.012, 0.15), wall=0.002, floor=0.002)
    assert bottle.opening_radius == pytest.approx(0.012)
    assert bottle.outer_radius == pytest.approx(0.032, abs=1e-5)
    neck = np.array([[0.013, 0.0, 0.145], [0.02, 0.0, 0.145], [0.0, 0.0, 0.145]])
    assert np.sign(bottle.grid.sample(neck)).tolist() == [-1.0, 1.0, 1.0]


def test_the_width_for_a_gripper_is_that_of_the_outside_at_its_height() -> None:
    cup = build_vessel(cylinder("cup", inner_radius=0.04, inner_height=0.1, wall=0.004, floor=0.004))
    assert cup.width_at(0.06) == pytest.approx(0.088, abs=1e-4)
    flared = ProfileShape(unit="mm", inner=((0, 0), (40, 0), (47, 80)), wall=0.004, floor=0.004)
    cone = build_vessel(VesselSpec(name="cone", shape=flared))
    # 40 mm and 7/80 of the height above the inner floor, and the wall across its slope of 5°
    expected = 2.0 * (0.040 + 7.0 / 80.0 * 0.046 + 0.004 / np.cos(np.arctan(7.0 / 80.0)))
    assert cone.width_at(0.05) == pytest.approx(expected, abs=1e-4)
    assert cone.width_at(0.2) == 0.0
