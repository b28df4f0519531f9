"""`wall_correction`: how solid walls look from inside: flat walls, corners, edges."""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
import pytest

from benchmarks.validation.container_runs import box, holed_cup
from sim_engine.vessel import wall_correction as corners
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel
from sim_engine.vessel.wall_correction import equivalent_distance, half_space, inside_mask

CUP = build_vessel(cylinder("cup", inner_radius=0.04, inner_height=0.1))
MASK = inside_mask(CUP.grid)


def at(field: np.ndarray[tuple[int, ...], np.dtype[np.float32]], r: float, z: float) -> float:
    """Trilinear at radius r along x and height z above the inner floor."""
    grid = CUP.grid
    other = type(grid)(grid.origin, grid.spacing, field, grid.cavity)
    return float(other.sample(np.array([[r, 0.0, CUP.inner_floor + z]]))[0])


def test_half_space_is_a_share_of_the_kernel() -> None:
    q = np.linspace(-1.0, 1.0, 201)
    share = half_space(q)
    assert share[0] == pytest.approx(1.0)
    assert share[100] == pytest.approx(0.5)
    assert share[-1] == pytest.approx(0.0)
    assert np.all(np.diff(share) <= 0.0)
    np.testing.assert_allclose(share + share[::-1], 1.0, atol=1e-12)


@pytest.mark.parametrize("support", [0.006, 0.0102])
def test_flat_walls_stay_where_they_are(support: float) -> None:
    plane = equivalent_distance(CUP.grid, MASK, CUP.rim_height, support)
    for z in (0.002, 0.003):
        assert at(plane, 0.01, z) == pytest.approx(at(CUP.grid.values, 0.01, z), abs=2.5e-4)
    # a wall that curves inwards is a little more solid than a flat one
    assert 0.0 <= 0.003 - at(plane, 0.037, 0.03) < 4e-4


def test_a_corner_is_more_solid_than_its_nearest_wall() -> None:
    plane = equivalent_distance(CUP.grid, MASK, CUP.rim_height, 0.0102)
    distance = CUP.grid.values
    assert at(plane, 0.037, 0.003) < at(distance, 0.037, 0.003) - 0.0007
    # no jump where the nearer of the two walls changes
    along = np.array([at(plane, 0.04 - s, 0.0045) for s in np.linspace(0.0025, 0.0065, 17)])
    slopes = np.diff(along) / 0.00025
    assert np.max(np.abs(np.diff(slopes))) < 0.35


def test_a_hole_s_edge_is_less_solid_than_its_wall() -> None:
    cup = holed_cup(0.04, 0.1, 0.01, 0.003, 0.001)
    plane = cup.plane(0.007)
    grid = type(cup.grid)(cup.grid.origin, cup.grid.spacing, plane, cup.grid.cavity)
    above_the_edge = np.array([[0.0095, 0.0, 0.0005]])
    assert grid.sample(above_the_edge)[0] > cup.grid.sample(above_the_edge)[0] + 0.0007


def test_near_the_rim_and_outside_nothing_changes() -> None:
    support = 0.0102
    plane = equivalent_distance(CUP.grid, MASK, CUP.rim_height, support)
    z = CUP.grid.axes()[2]
    high = z > CUP.rim_height - support
    np.testing.assert_array_equal(plane[:, :, high], CUP.grid.values[:, :, high])
    assert at(plane, 0.0465, 0.05) == pytest.approx(at(CUP.grid.values, 0.0465, 0.05), abs=1e-4)


def test_a_box_s_corner_counts_three_walls() -> None:
    tank = box(0.05, 0.05, 0.05, 0.001)
    plane = tank.plane(0.008)
    grid = type(tank.grid)(tank.grid.origin, tank.grid.spacing, plane, tank.grid.cavity)
    wall, edge, corner = grid.sample(np.array([[0.025, 0.0, 0.003], [0.003, 0.0, 0.003], [0.003, -0.022, 0.003]]))
    assert corner < edge < wall


def test_what_is_inside_is_kept_and_a_damaged_file_made_anew(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))
    np.testing.assert_array_equal(inside_mask(CUP.grid), MASK)
    (kept,) = tmp_path.glob("inside-*.npz")
    with monkeypatch.context() as without:
        without.setitem(sys.modules, "scipy", None)
        np.testing.assert_array_equal(inside_mask(CUP.grid), MASK)
        kept.write_bytes(kept.read_bytes()[:100])
        with pytest.raises(ImportError):
            inside_mask(CUP.grid)
    np.testing.assert_array_equal(inside_mask(CUP.grid), MASK)


def test_planes_are_kept_by_what_they_depend_on(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The same to the bit from disk; another support, or a damaged file, and they are worked out anew."""
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))
    monkeypatch.setattr(corners, "PLACES", 1)  # all of them at the same place
    cup = build_vessel(cylinder("cup", inner_radius=0.02, inner_height=0.04))
    inside = inside_mask(cup.grid)

    def planes(support: float) -> bytes:
        return equivalent_distance(cup.grid, inside, cup.rim_height, support).tobytes()

    first, other = planes(0.005), planes(0.006)
    assert first != other
    monkeypatch.setattr(corners, "_planes", None)
    assert planes(0.006) == other
    monkeypatch.undo()
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path))
    (kept,) = tmp_path.glob("plane-00.npz")
    kept.write_bytes(kept.read_bytes()[:1000])
    monkeypatch.setattr(corners, "PLACES", 1)
    assert planes(0.005) == first
