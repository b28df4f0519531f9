"""`mesh_shape`: vessels from mesh files: measured right, and refused with the reason when they can't hold a liquid."""

from __future__ import annotations

import math
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from sim_engine import resources as cache
from sim_engine.hydrostatics import retained_volume
from sim_engine.vessel import mesh as mesh_module
from sim_engine.vessel.mesh_distance import closest_points
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import ProfileShape, VesselError, VesselSpec
from sim_engine.vessel.vessel import Vessel, build_vessel

MUG = Path(__file__).parents[3] / "configs" / "vessels" / "meshes" / "mug.stl"
Make = Callable[..., Vessel]


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "cache"))


def cup(*, radius: float = 30.0, height: float = 60.0, wall: float = 4.0, hole: float = 0.0) -> trimesh.Trimesh:
    """A straight cup [mm], with a hole of that radius in its floor."""
    section = [
        (hole, 0.0), (radius + wall, 0.0), (radius + wall, height + wall),
        (radius, height + wall), (radius, wall), (hole, wall),
    ]  # fmt: skip
    if hole:
        section.append(section[0])
    return trimesh.creation.revolve(np.array(section), sections=48)


@pytest.fixture
def build(tmp_path: Path) -> Make:
    def make(mesh: trimesh.Trimesh, suffix: str = "stl", **options: object) -> Vessel:
        path = tmp_path / f"vessel.{suffix}"
        mesh.export(path)
        shape = MeshShape.model_validate({"path": path, "unit": "mm", **options})
        return build_vessel(VesselSpec(name="meshed", shape=shape))

    return make


@pytest.fixture(scope="module")
def mug() -> Vessel:
    return build_vessel(VesselSpec(name="mug", shape=MeshShape(path=MUG, unit="mm")), use_cache=False)


@pytest.mark.slow
def test_mug_with_a_handle_is_centred_on_its_opening_and_measured_like_its_profile(mug: Vessel) -> None:
    # the inner profile of make_meshes.py, from the floor to the crest of the rim
    inner = [
        (0, 6),
        (28, 6.5),
        (32.5, 8),
        (35.5, 11),
        (37, 17),
        (37.5, 30),
        (37.5, 86),
        (37.65, 87),
        (38.2, 87.8),
        (39, 88),
    ]
    r, z = np.array(inner).T * 1e-3
    volume = math.pi / 3.0 * np.sum(np.diff(z) * (r[1:] ** 2 + r[1:] * r[:-1] + r[:-1] ** 2))
    assert mug.capacity == pytest.approx(volume, rel=0.005)
    assert mug.rim_height == pytest.approx(0.088, abs=2e-5)
    assert mug.inner_floor == pytest.approx(0.006, abs=2e-4)
    assert mug.opening_radius == pytest.approx(0.0375, abs=2e-4)
    assert mug.wall_thickness == pytest.approx(0.003, abs=2e-4)
    assert mug.outer_radius == pytest.approx(0.0695, abs=1e-3)
    assert mug.lip_point(0.0) == pytest.approx([0.0388, 0.0, 0.088], abs=4e-4)


@pytest.mark.slow
def test_mug_retains_what_the_vessel_of_its_profile_retains(mug: Vessel) -> None:
    inner = [
        (0, 0),
        (28, 0.5),
        (32.5, 2),
        (35.5, 5),
        (37, 11),
        (37.5, 24),
        (37.5, 80),
        (37.65, 81),
        (38.2, 81.8),
        (39, 82),
    ]
    points = tuple((r * 1e-3, z * 1e-3) for r, z in inner)
    twin = build_vessel(VesselSpec(name="twin", shape=ProfileShape(unit="m", inner=points, wall=0.003, floor=0.006)))
    for tilt in (20, 40, 60, 70, 80, 95):
        kept = retained_volume(mug, math.radians(tilt))
        assert kept == pytest.approx(retained_volume(twin, math.radians(tilt)), abs=0.005 * mug.capacity)


@pytest.mark.slow
def test_handle_is_solid_and_its_loop_is_not(mug: Vessel) -> None:
    points = np.array([[-0.065, 0.0, 0.046], [-0.05, 0.0, 0.046], [0.0, 0.0, 0.046], [0.039, 0.0, 0.046]])
    assert np.sign(mug.grid.sample(points)).tolist() == [-1.0, 1.0, 1.0, -1.0]


@pytest.mark.slow
def test_overlap_of_two_bodies_is_solid(mug: Vessel) -> None:
    # where the handle's ends are sunk into the wall
    ends = np.array([[-0.0397, 0.0, 0.022], [-0.0397, 0.002, 0.070], [-0.0397, -0.002, 0.071]])
    assert mug.grid.sample(ends).max() < 0.0


@pytest.mark.parametrize("distance", [120.0, 76.0])
def test_two_vessels_in_one_file_are_refused(build: Make, distance: float) -> None:
    other = cup().apply_translation([distance, 0.0, 0.0])
    with pytest.raises(
        VesselError, match=r"vessel\.stl: 2 bodies that don't touch \(\d+ × \d+ × 6\d mm, .* save it alone"
    ):
        build(trimesh.util.concatenate([cup(), other]))


def test_a_file_of_gigabytes_is_refused_before_it_is_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "huge.stl"
    with path.open("wb") as file:
        file.truncate(3_000_000_000)
    monkeypatch.setattr(Path, "read_bytes", lambda path: pytest.fail("it was read"))
    with pytest.raises(VesselError, match=r"huge\.stl: 3000 MB; simplify it to at most 1,000,000 triangles"):
        build_vessel(VesselSpec(name="huge", shape=MeshShape(path=path, unit="mm")))


@pytest.mark.slow
def test_a_handle_of_its_own_that_touches_the_wall_belongs_to_the_vessel(build: Make) -> None:
    handle = trimesh.creation.box((20.0, 8.0, 30.0)).apply_translation([44.0, 0.0, 30.0])  # 0.1 mm off the facets
    alone, both = build(cup()), build(trimesh.util.concatenate([cup(), handle]))
    assert both.capacity == pytest.approx(alone.capacity, rel=0.01)


def test_distance_of_a_mesh_is_the_distance_to_its_nearest_triangle(build: Make) -> None:
    vessel = build(cup())
    rng = np.random.default_rng(1)
    nodes = np.column_stack([rng.integers(0, n, 300) for n in vessel.grid.shape])
    corners = vessel.solid_vertices[vessel.solid_faces]
    points = vessel.grid.origin + vessel.grid.spacing * nodes
    nearest = np.full(len(points), np.inf)
    for a, b, c in corners:
        foot = closest_points(points, *(np.broadcast_to(p, points.shape) for p in (a, b, c)))
        nearest = np.minimum(nearest, np.linalg.norm(points - foot, axis=1))
    found = np.abs(vessel.grid.values[tuple(nodes.T)])
    near = nearest < 1.9 * vessel.grid.spacing
    np.testing.assert_allclose(found[near], nearest[near], atol=1e-6)
    middle = nearest < 7.0 * vessel.grid.spacing
    np.testing.assert_allclose(found[middle], nearest[middle], atol=0.25 * vessel.grid.spacing)
    np.testing.assert_allclose(found, nearest, atol=vessel.grid.spacing)
    assert np.all(found >= nearest - 1e-6)


def test_sign_of_a_mesh_is_that_of_the_same_profile(build: Make) -> None:
    meshed = build(cup())
    shape = ProfileShape(unit="m", inner=((0.0, 0.0), (0.03, 0.0), (0.03, 0.06)), wall=0.004, floor=0.004)
    turned = build_vessel(VesselSpec(name="profile", shape=shape))
    points = np.random.default_rng(2).uniform([-0.05, -0.05, -0.01], [0.05, 0.05, 0.08], (4000, 3))
    a, b = meshed.grid.sample(points), turned.grid.sample(points)
    clear = np.abs(b) > meshed.grid.spacing
    np.testing.assert_array_equal(np.sign(a[clear]), np.sign(b[clear]))
    assert np.abs(a - b).max() < meshed.grid.spacing


@pytest.mark.slow
@pytest.mark.parametrize("suffix", ["stl", "obj", "ply", "glb"])
def test_every_format_gives_the_same_vessel(build: Make, suffix: str) -> None:
    vessel = build(cup(), suffix)
    assert vessel.capacity == pytest.approx(math.pi * 0.03**2 * 0.06, rel=0.01)
    assert vessel.rim_height == pytest.approx(0.064, abs=1e-5)


@pytest.mark.parametrize(
    ("up", "turn"),
    [
        ("y", (1, 0, 0)),
        pytest.param("-x", (0, 1, 0), marks=pytest.mark.slow),
        pytest.param("-z", (1, 0, 0), marks=pytest.mark.slow),
        pytest.param("x", (0, 1, 0), marks=pytest.mark.slow),
    ],
)
def test_up_axis_of_the_mesh_becomes_the_axis_of_the_vessel(build: Make, up: str, turn: tuple[int, int, int]) -> None:
    angle = {"y": -90.0, "-z": 180.0, "x": 90.0, "-x": -90.0}[up]
    mesh = cup()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(math.radians(angle), turn))
    vessel = build(mesh, up=up)
    assert vessel.rim_height == pytest.approx(0.064, abs=1e-5)
    assert vessel.capacity == pytest.approx(math.pi * 0.03**2 * 0.06, rel=0.01)
    # a rotation, not a mirror image: the triangles still face outwards
    a, b, c = (vessel.solid_vertices[vessel.solid_faces[:, i]] for i in range(3))
    assert np.einsum("ij,ij->", a, np.cross(b, c)) > 0.0


@pytest.mark.slow
def test_mesh_turned_inside_out_is_turned_back(build: Make) -> None:
    mesh = cup()
    mesh.invert()
    assert build(mesh).capacity == pytest.approx(math.pi * 0.03**2 * 0.06, rel=0.01)


def test_cup_with_a_notch_in_its_rim_holds_only_up_to_the_notch(build: Make) -> None:
    # a square cup of five boxes that touch at their edges, one wall 10 mm lower
    def box(low: tuple[float, float, float], high: tuple[float, float, float]) -> trimesh.Trimesh:
        return trimesh.creation.box(bounds=[low, high])

    parts = [
        box((-30, -30, 0), (30, 30, 4)), box((-30, -30, 0), (-26, 30, 50)), box((26, -30, 0), (30, 30, 40)),
        box((-30, -30, 0), (30, -26, 50)), box((-30, 26, 0), (30, 30, 50)),
    ]  # fmt: skip
    vessel = build(trimesh.util.concatenate(parts))
    assert vessel.rim_height == pytest.approx(0.040, abs=1e-4)
    assert vessel.capacity == pytest.approx(0.052 * 0.052 * 0.036, rel=0.01)


@pytest.mark.parametrize(
    ("mesh", "message"),
    [
        (trimesh.creation.cylinder(radius=30, height=80), "no cavity: the mesh is one closed skin"),
        (cup(hole=6.0), "runs out 0 mm above the underside; close the hole"),
        (cup().apply_transform(np.diag([1.0, -1.0, -1.0, 1.0])), "if '-z' is, it holds 16[0-9] mL. State 'up: -z'"),
    ],
    ids=["scanned skin", "hole in the floor", "upside down"],
)
def test_mesh_that_holds_nothing_is_refused_with_the_reason(build: Make, mesh: trimesh.Trimesh, message: str) -> None:
    with pytest.raises(VesselError, match=message):
        build(mesh)


def test_closed_box_with_a_void_has_no_opening(build: Make) -> None:
    void = trimesh.creation.icosphere(subdivisions=3, radius=30)
    void.invert()
    with pytest.raises(VesselError, match=r"no opening: a cavity of 11\d mL is closed on all sides"):
        build(trimesh.util.concatenate([trimesh.creation.icosphere(subdivisions=3, radius=35), void]))


def test_open_sheet_is_refused_as_not_watertight(build: Make) -> None:
    sheet = cup()
    sheet.update_faces(np.arange(len(sheet.faces)) > 0)
    with pytest.raises(VesselError, match=r"not watertight: 3 edge\(s\) belong to an odd number"):
        build(sheet)


@pytest.mark.parametrize(
    ("unit", "scale", "message"),
    [
        (None, 1.0, r"largest extent would be 68 m.*State its unit: 'mm' \(68 mm\)"),
        ("m", 1.0, r"largest extent of 68 m is not a vessel's size.*'mm'"),
        ("mm", 1e-3, r"largest extent of 0.068 mm is not a vessel's size.*'m'"),
    ],
)
def test_implausible_size_names_the_likely_unit(build: Make, unit: str | None, scale: float, message: str) -> None:
    with pytest.raises(VesselError, match=message):
        build(cup().apply_scale(scale), unit=unit)


@pytest.mark.slow
def test_metres_need_no_unit(build: Make) -> None:
    assert build(cup().apply_scale(1e-3), unit=None).rim_height == pytest.approx(0.064, abs=1e-5)


@pytest.mark.parametrize(
    ("name", "content", "message"),
    [
        ("cup.step", b"ISO-10303-21;", "use stl, obj, ply, glb"),
        ("cup.stl", b"ISO-10303-21;\nHEADER;\n", "is a STEP file, a CAD model without triangles: export it as STL"),
        ("cup.stl", b"\n<!DOCTYPE html>\n<html>", "is a web page: download the mesh itself, on GitHub with 'Raw'"),
        ("cup.stl", b"glTF\2\0\0\0", "is a GLB file: name it .glb"),
        ("cup.stl", b"PK\3\4" + bytes(26) + b"cup.step", r"is an archive \(ZIP\): unpack it"),
        # RuoyuChen10/Deep3DFaceReconstruction, issue 1, and microsoft/Deep3DFaceReconstruction, issue 152
        (
            "cup.obj",
            b"v 0 0 0\nv nan nan nan nan nan nan\nv 0 1 0\nf 1 2 3\n",
            r"cup.obj:2: a vertex is not a finite number \(v nan nan nan nan nan nan\); export",
        ),
        ("cup.glb", b"glTF but not really", "not a readable GLB file"),
        ("cup.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n", "no triangles|not a readable"),
        (
            "cup.stl",
            b"version https://git-lfs.github.com/spec/v1\noid sha256:aa\nsize 1234567\n",
            "a pointer of Git LFS, .* fetch the mesh itself with 'git lfs pull'",
        ),
        ("cup.stl", bytes(80) + b"\x00\x03\0\0" + bytes(50), "is cut off: it has 134 bytes, and its 768 triangles"),
    ],
)
def test_file_that_is_no_mesh_is_refused(tmp_path: Path, name: str, content: bytes, message: str) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    with pytest.raises(VesselError, match=message):
        build_vessel(VesselSpec(name="broken", shape=MeshShape(path=path)))


@pytest.mark.parametrize(("suffix", "up", "true"), [("glb", "y", "z"), ("stl", "x", "z"), ("stl", "-z", "z")])
def test_a_wrong_axis_is_named_with_the_right_one(build: Make, suffix: str, up: str, true: str) -> None:
    """mikedh/trimesh, issue 1759: GLB files of one model with different axes up."""
    with pytest.raises(VesselError, match=f"holds nothing if '{up}' is up; if '{true}' is, it holds 16[0-9] mL"):
        build(cup(), suffix=suffix, up=up)


def test_a_home_that_can_not_be_written_costs_the_cache_and_no_run(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """A file in the place of the folder stops every user, the superuser too."""
    (tmp_path / "home").touch()
    (tmp_path / "tmp").mkdir()
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "home" / "cache"))
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "tmp"))
    directory = cache.cache_directory()
    assert directory == cache.cache_directory()
    assert directory.parent == tmp_path / "tmp"
    assert directory.stat().st_mode & 0o777 == 0o700
    (logged,) = caplog.messages
    assert f"{tmp_path / 'home' / 'cache'} can't be written" in logged
    assert "Not a directory" in logged
    assert "Set $DECANT_CACHE_DIR to a folder that you can write" in logged
    assert cache.store_arrays("some", {"x": np.ones(3)})
    assert cache.load_arrays("some") is not None

    directory.chmod(0o777)  # what anybody may have put there must not be executed
    with pytest.raises(OSError, match="belongs to another user"):
        cache.cache_directory()


def test_missing_file_says_which(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError, match=r"nowhere\.stl"):
        build_vessel(VesselSpec(name="missing", shape=MeshShape(path=tmp_path / "nowhere.stl")))


def test_known_mesh_comes_from_the_cache_and_a_damaged_cache_is_rebuilt(
    build: Make, monkeypatch: pytest.MonkeyPatch
) -> None:
    measure = mesh_module._measure
    measured: list[Vessel] = []

    def once(*arguments: Any) -> Vessel:
        """The first measurement; later ones of the same mesh would come to the same, seconds later."""
        measured.append(measured[0] if measured else measure(*arguments))
        return measured[0]

    monkeypatch.setattr("sim_engine.vessel.mesh._measure", once)
    first = build(cup())
    (stored,) = cache.cache_directory().glob("*.npz")
    content = stored.read_bytes()
    for damaged in (content[: len(content) // 2], b"", b"PK\x03\x04 nonsense"):
        stored.write_bytes(damaged)
        before = len(measured)
        rebuilt = build(cup())
        assert len(measured) == before + 1
        np.testing.assert_array_equal(rebuilt.grid.values, first.grid.values)
        assert len(stored.read_bytes()) == len(content)

    np.savez(stored, scalars=np.zeros(7))  # readable, but not a vessel
    assert build(cup()).capacity == first.capacity

    def never(*_: object) -> None:
        raise AssertionError("measured again")

    monkeypatch.setattr("sim_engine.vessel.mesh._measure", never)
    again = build(cup())
    np.testing.assert_array_equal(again.grid.cavity, first.grid.cavity)
    np.testing.assert_array_equal(again.solid_faces, first.solid_faces)
    assert (again.capacity, again.lip_point(1.0).tolist()) == (first.capacity, first.lip_point(1.0).tolist())
    with pytest.raises(AssertionError, match="measured again"):
        build(cup(radius=31.0))


def test_cache_that_cannot_be_written_costs_no_vessel(
    build: Make, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    (tmp_path / "file").write_text("in the way")
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "file" / "below"))
    assert build(cup()).capacity > 0.0


@pytest.mark.slow
def test_thin_walls_of_a_mesh_stay_closed(build: Make) -> None:
    vessel = build(cup(wall=1.0, radius=15.0, height=25.0))
    assert vessel.wall_thickness == pytest.approx(0.001, abs=5e-5)
    angle, z = np.meshgrid(np.linspace(0.0, 2.0 * np.pi, 200), np.linspace(0.002, 0.025, 60))
    middle = 0.0155 * math.cos(math.pi / 48)  # between the corners the polygon lies further in
    points = np.stack([middle * np.cos(angle), middle * np.sin(angle), z], axis=-1).reshape(-1, 3)
    assert vessel.grid.sample(points).max() < 0.0
