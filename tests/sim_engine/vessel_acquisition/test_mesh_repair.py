"""`mesh_repair`: meshes as scanners and CAD programs save them.

`tests/data/meshes` holds one cup (345 mL) in seven unusual forms, and a bowl of sheet metal (655 mL). Forms that are
made here follow public reports; each test names its own.
"""

from __future__ import annotations

import gzip
import itertools
import logging
import re
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest
import trimesh
from typer.testing import CliRunner

from orchestrator.campaigns.file_loading import load_vessel
from orchestrator.cli.app import app
from orchestrator.cli.file_commands import validate
from orchestrator.reports.pour_figures import section
from sim_engine.errors import DecantError
from sim_engine.vessel.exact_cavity import exact_cavity
from sim_engine.vessel.mesh_shape import MeshShape
from sim_engine.vessel.shapes import VesselError, VesselSpec
from sim_engine.vessel.vessel import build_vessel
from sim_engine.vessel_acquisition.mesh_repair import RepairedMesh, mended
from tests.support.measured_vessel import vessel

MESHES = Path(__file__).parents[2] / "data" / "meshes"
TRUTH = {"thin_bowl.stl": 655.0}
CUP = 345.0
"""Capacities [mL]."""


@pytest.fixture(autouse=True)
def _own_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("DECANT_CACHE_DIR", str(tmp_path / "cache"))


def unpacked(name: str, folder: Path) -> Path:
    path = folder / name
    path.write_bytes(gzip.decompress((MESHES / f"{name}.gz").read_bytes()))
    return path


def capacity(found: RepairedMesh) -> float:
    """By the triangles [mL]."""
    return 1e6 * exact_cavity(found.vertices, found.faces).volume


@pytest.mark.parametrize(
    ("name", "notes", "warnings", "drop"),
    [
        ("inner_faces.stl", ["192 inner face"], [], False),
        ("holes.stl", [r"27 hole\(s\) closed"], [], False),
        ("unmerged_0.1um.stl", ["corners less than 1 µm apart were joined"], [], False),
        ("noise_0.3mm.stl", ["noisy; the thinnest part of its walls has about 2.1 mm"], [], False),
        ("liquid_surface_sheet.stl", [], ["an open surface of 41.1 cm², 60 to 60 mm above the underside"], False),
        ("liquid_body.stl", ["was left out: it holds 130 mL with it and 345 mL without it"], [], True),
        ("cup_texture.ply", [], [], False),
        ("thin_bowl.stl", ["walls of 0.66 mm are too thin .* thickened outwards to 1.2 mm"], [], False),
    ],
)
def test_a_vessel_holds_what_it_holds_however_its_mesh_was_saved(
    tmp_path: Path, name: str, notes: list[str], warnings: list[str], drop: bool
) -> None:
    found = mended(unpacked(name, tmp_path), unit="mm", wall=None, drop_bodies=drop)
    assert capacity(found) == pytest.approx(TRUTH.get(name, CUP), rel=0.02 if "noise" in name else 0.005)
    for expected, said in ((notes, found.notes), (warnings, found.warnings)):
        assert len(said) == len(expected), said
        for pattern, text in zip(expected, said, strict=True):
            assert re.search(pattern, text), text


def padded_stl() -> tuple[str, bytes]:
    """Zeros after the last triangle, as in files that were copied in blocks."""
    return "cup.stl", bytes(cup().export(file_type="stl")) + bytes(37)


def relative_obj() -> tuple[str, bytes]:
    """Every triangle after its own corners, with indices that count back (mikedh/trimesh#2364)."""
    corners = cup().triangles
    blocks = ["".join(f"v {x:.6f} {y:.6f} {z:.6f}\n" for x, y, z in each) for each in corners]
    return "cup.obj", "".join(f"vn 0 0 1\n{each}f -3//-1 -2//-1 -1//-1\n" for each in blocks).encode()


def y_up_glb() -> tuple[str, bytes]:
    """As every program writes it that follows glTF: metres, y up."""
    mesh = cup()
    mesh.apply_transform(trimesh.transformations.rotation_matrix(-np.pi / 2.0, [1.0, 0.0, 0.0]))
    mesh.apply_scale(1e-3)
    return "cup.glb", bytes(mesh.export(file_type="glb"))


@pytest.mark.parametrize("form", [padded_stl, relative_obj, y_up_glb])
def test_a_vessel_is_read_as_its_format_is_defined(
    tmp_path: Path, form: Callable[[], tuple[str, bytes]], capfd: pytest.CaptureFixture[str]
) -> None:
    name, content = form()
    (tmp_path / name).write_bytes(content)
    out = tmp_path / "made.yaml"
    result = CliRunner().invoke(app, ["vessel", "mesh", str(tmp_path / name), str(out)])
    assert result.exit_code == 0, result.output
    assert 1e6 * build_vessel(load_vessel(out)).capacity == pytest.approx(CUP, rel=0.01)
    (tmp_path / "named.yaml").write_text(f"name: cup\nmesh: {name}\nunit: {'m' if name.endswith('glb') else 'mm'}\n")
    assert 1e6 * build_vessel(load_vessel(tmp_path / "named.yaml")).capacity == pytest.approx(CUP, rel=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("name", [path.stem for path in sorted(MESHES.glob("*.gz"))])
def test_what_is_simulated_and_drawn_is_the_repaired_vessel(
    tmp_path: Path, name: str, capfd: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "cup.yaml"
    vessel(out, mesh=unpacked(name, tmp_path), unit="mm", drop_bodies=True)
    assert out.with_suffix(".png").stat().st_size > 10_000
    shown = capfd.readouterr()
    assert "Traceback" not in shown.err
    built = build_vessel(load_vessel(out))
    assert 1e6 * built.capacity == pytest.approx(TRUTH.get(name, CUP), rel=0.02)
    if "noise" in name:
        assert built.wall_thickness == pytest.approx(2e-3, rel=0.2)
    # the picture's outlines enclose the solid whose distance is simulated
    drawn = np.vstack(section(built.solid_vertices, built.solid_faces))
    points = np.column_stack([drawn[:, 0], np.zeros(len(drawn)), drawn[:, 1]])
    assert np.abs(built.grid.sample(points)).max() < 0.5 * built.grid.spacing


@pytest.mark.slow
def test_a_body_in_the_cavity_is_kept_with_a_warning_unless_it_is_dropped(tmp_path: Path) -> None:
    found = mended(unpacked("liquid_body.stl", tmp_path), unit="mm", wall=None)
    assert capacity(found) == pytest.approx(129.0, rel=0.02)
    (warning,) = found.warnings
    assert "it holds 130 mL with it and 345 mL without it" in warning
    assert "--drop-bodies" in warning


def test_a_missing_texture_is_not_mentioned(
    tmp_path: Path, capfd: pytest.CaptureFixture[str], caplog: pytest.LogCaptureFixture
) -> None:
    path = unpacked("cup_texture.ply", tmp_path)
    with caplog.at_level(logging.INFO):
        mended(path, unit="mm", wall=None)
    assert capfd.readouterr() == ("", "")
    assert not caplog.records


def cup(parts: int = 48) -> trimesh.Trimesh:
    """The cup of the data [mm]."""
    outline = [(0, 0), (35, 0), (40, 90), (38, 90), (33, 3), (0, 3)]
    return trimesh.creation.revolve(np.array(outline, float), sections=parts)


def flipped() -> trimesh.Trimesh:
    """Faces whose order of corners says nothing (shapeways.com/tutorials/errors: face normals)."""
    mesh = cup()
    faces = np.array(mesh.faces)
    turned = np.random.default_rng(1).random(len(faces)) < 0.3
    faces[turned] = faces[turned][:, ::-1]
    return trimesh.Trimesh(mesh.vertices, faces, process=False)


def fins() -> trimesh.Trimesh:
    """Single triangles that stand on edges: edges of three faces (github.com/mikedh/trimesh/issues/122 and 1573)."""
    mesh = cup().subdivide().subdivide()
    rng = np.random.default_rng(2)
    chosen = rng.choice(len(mesh.faces), 40, replace=False)
    tips = mesh.triangles_center[chosen] + mesh.face_normals[chosen] * rng.uniform(-1.0, 1.0, (40, 1))
    new = np.column_stack([mesh.faces[chosen, 0], mesh.faces[chosen, 1], len(mesh.vertices) + np.arange(40)])
    return trimesh.Trimesh(np.vstack([mesh.vertices, tips]), np.vstack([mesh.faces, new]), process=False)


def solids_with_a_common_face() -> trimesh.Trimesh:
    """Wall and floor as two CAD solids whose contact is one set of faces (shapeways.com/tutorials/errors: internal)."""
    wall = trimesh.creation.revolve(
        np.array([(33, 3), (33, 0), (35, 0), (40, 90), (38, 90), (33, 3)], float), sections=48
    )
    floor = trimesh.creation.revolve(np.array([(0, 0), (33, 0), (33, 3), (0, 3)], float), sections=48)
    both = trimesh.util.concatenate([wall, floor])
    both.merge_vertices()
    both.update_faces(both.unique_faces())
    return both


def doubled() -> trimesh.Trimesh:
    """Every face twice, once for each side, as programs without back faces save them."""
    mesh = cup()
    return trimesh.Trimesh(mesh.vertices, np.vstack([mesh.faces, mesh.faces[:, ::-1]]), process=False)


@pytest.mark.parametrize("make", [flipped, solids_with_a_common_face, doubled])
def test_edges_of_several_faces_and_mixed_orientations_are_read(
    tmp_path: Path, make: Callable[[], trimesh.Trimesh]
) -> None:
    make().export(tmp_path / "cup.obj")
    found = mended(tmp_path / "cup.obj", unit="mm", wall=None)
    assert capacity(found) == pytest.approx(CUP, rel=0.01)
    assert not found.warnings


@pytest.mark.slow
def test_stem_and_foot_of_a_glass_without_thickness_are_kept(tmp_path: Path) -> None:
    """One sheet for the bowl, and below it an open one, as Blender's glasses are built (carosto/pouring_env)."""
    bowl, stem = [(0, 56), (5, 56), (28, 85), (34, 115), (30, 180)], [(5, 56), (5, 16), (31, 2), (31, 0)]
    sheets = [trimesh.creation.revolve(np.array(points, float), sections=48) for points in (bowl, stem)]
    trimesh.util.concatenate(sheets).export(tmp_path / "glass.stl")
    repaired = mended(tmp_path / "glass.stl", unit="mm", wall=2e-3)
    assert np.ptp(repaired.vertices[:, 2]) == pytest.approx(0.180, abs=5e-4)
    assert not repaired.warnings
    assert any("stem or foot, 56 mm high" in note for note in repaired.notes)
    (r0, z0), *others = np.array(bowl[1:], float)
    frustums = 0.0
    for r1, z1 in others:
        frustums += np.pi * (z1 - z0) * (r0**2 + r0 * r1 + r1**2) / 3.0
        r0, z0 = r1, z1
    assert capacity(repaired) == pytest.approx(1e-3 * frustums, rel=0.01)


def test_a_spoon_in_the_cup_is_a_warning_with_both_capacities(tmp_path: Path) -> None:
    spoon = trimesh.creation.box((12.0, 3.0, 110.0))  # it leans out of the cup
    spoon.apply_transform(trimesh.transformations.rotation_matrix(0.2, [0.0, 1.0, 0.0], [0.0, 0.0, 0.0]))
    spoon.apply_translation([15.0, 0.0, 56.0])
    trimesh.util.concatenate([cup(), spoon]).export(tmp_path / "cup.stl")
    repaired = mended(tmp_path / "cup.stl", unit="mm", wall=None)
    (warning,) = repaired.warnings
    with_it, without_it = map(float, re.findall(r"([\d.]+) mL with", warning))
    assert without_it == pytest.approx(CUP, rel=0.005)
    assert 2.0 <= without_it - with_it < 3.96  # of 3.96 mL, most is below the rim
    assert "a spoon, leave it out with --drop-bodies" in warning


def test_a_unit_that_makes_a_thimble_of_the_mesh_is_refused_with_all_capacities(tmp_path: Path) -> None:
    mesh = cup()
    mesh.apply_scale(1.26 / 90.0)
    mesh.export(tmp_path / "cup.obj")
    sizes = r"say which: .*--unit m \(1260 mm, .*--unit cm \(12.6 mm, .*--unit in \(32 mm, "
    with pytest.raises(VesselError, match=sizes) as refusal:
        mended(tmp_path / "cup.obj", unit=None, wall=None)
    inches = re.search(r"--unit in \(32 mm, ([\d.]+) mL\)", str(refusal.value))
    assert inches is not None
    assert float(inches[1]) == pytest.approx(CUP * (32.004 / 90.0) ** 3, rel=0.01)


def test_triangles_that_stand_on_the_surface_do_not_change_the_cavity(tmp_path: Path) -> None:
    fins().export(tmp_path / "cup.obj")
    assert capacity(mended(tmp_path / "cup.obj", unit="mm", wall=None)) == pytest.approx(CUP, rel=0.01)


@pytest.mark.slow
def test_an_inner_and_an_outer_surface_without_a_rim_become_a_wall(tmp_path: Path) -> None:
    mesh = cup()
    mesh.update_faces(~((mesh.face_normals[:, 2] > 0.9) & (mesh.triangles_center[:, 2] > 80.0)))
    mesh.export(tmp_path / "cup.stl")
    found = mended(tmp_path / "cup.stl", unit="mm", wall=None)
    assert capacity(found) == pytest.approx(CUP, rel=0.02)
    assert "a new surface was made" in found.warnings[0]


@pytest.mark.slow
def test_a_rim_that_is_not_level_is_a_warning_with_its_angle(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    for degrees in (1.0, 5.0):
        mesh = cup()
        mesh.apply_transform(trimesh.transformations.rotation_matrix(np.radians(degrees), [1.0, 0.0, 0.0]))
        mesh.export(tmp_path / f"{degrees:.0f}.stl")
        vessel(tmp_path / f"cup{degrees:.0f}.yaml", mesh=tmp_path / f"{degrees:.0f}.stl", unit="mm")
        said = capsys.readouterr().err
        assert ("warning: its rim is 5.0° off level" in said) == (degrees == 5.0), said


def test_a_mesh_in_metres_that_is_called_millimetres_is_refused_with_the_likely_unit(tmp_path: Path) -> None:
    cup().apply_scale(1e-3).export(tmp_path / "cup.stl")
    with pytest.raises(VesselError, match=r"cup\.stl: its largest extent of 0\.09 mm is not .*'m' \(90 mm\)"):
        mended(tmp_path / "cup.stl", unit="mm", wall=None)


def test_a_mesh_that_is_not_closed_is_refused_in_a_vessel_file_with_the_command_that_repairs_it(tmp_path: Path) -> None:
    path = unpacked("inner_faces.stl", tmp_path)
    with pytest.raises(VesselError, match=r"decant vessel mesh inner_faces\.stl NEW\.yaml"):
        build_vessel(VesselSpec(name="cup", shape=MeshShape(path=path, unit="mm")))


def with_liquid(kind: str) -> trimesh.Trimesh:
    """A cup with a thick wall, and its liquid as CAD assemblies save it: a body, or the surface with both sides.

    A body has faces in common with the cup if both have the same corners.
    """
    outline = [(0, 0), (40, 0), (46, 90), (38, 90), (35, 49), (32, 8), (0, 8)]
    mesh = trimesh.creation.revolve(np.array(outline, float), sections=16)
    if kind == "alone":
        return mesh
    if kind == "surface":
        disc = trimesh.creation.revolve(np.array([(0, 49), (30, 49)], float), sections=16)
        disc = trimesh.Trimesh(disc.vertices, np.vstack([disc.faces, disc.faces[:, ::-1]]), process=False)
        return trimesh.util.concatenate([mesh, disc])
    low, high = ((8.5, 31), (49.0, 34)) if kind == "body" else ((8.0, 32), (49.0, 35))
    liquid = trimesh.creation.revolve(np.array([(0, low[0]), low[::-1], high[::-1], (0, high[0])], float), sections=16)
    return trimesh.util.concatenate([mesh, liquid])


def vessel_file(folder: Path, kind: str) -> Path:
    with_liquid(kind).export(folder / "cup.stl")
    (folder / "cup.yaml").write_text("name: cup\nmesh: cup.stl\nunit: mm\n")
    return folder / "cup.yaml"


def test_a_quiet_command_prints_warnings(tmp_path: Path) -> None:
    result = CliRunner().invoke(app, ["validate", "--quiet", str(vessel_file(tmp_path, "body"))])
    assert result.exit_code == 0
    assert "fills a part of the cavity and counts as solid" in result.stderr


@pytest.mark.parametrize(
    ("kind", "warning"),
    [
        ("alone", None),
        (
            "body",
            r"a separate body of 68 × 68 × 40 mm fills .* holds (\d+) mL with it and (\d+) mL without it.*"
            r"decant vessel mesh cup\.stl NEW\.yaml --drop-bodies",
        ),
        ("body that touches", "faces are shared by two bodies, which both count as solid"),
    ],
)
def test_a_body_in_the_cavity_of_a_mesh_in_a_vessel_file_is_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, warning: str | None
) -> None:
    path = vessel_file(tmp_path, kind)
    for _ in range(2):  # computed, and from the cache
        validate([path])
        out, err = capsys.readouterr()
        assert "ok (vessel, holds" in out
        if warning is None:
            assert "warning" not in err
        else:
            found = re.search(f"warning: .*cup.yaml: .*{warning}", " ".join(err.split()))
            assert found, err
            assert [float(text) for text in found.groups()] == pytest.approx(
                [176.0, 312.0][: len(found.groups())], 0.03
            )


def test_a_surface_without_thickness_in_the_cavity_of_a_mesh_is_refused(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(DecantError) as refused:
        validate([vessel_file(tmp_path, "surface")])
    assert refused.value.exit_code == 2
    said = " ".join(capsys.readouterr().err.split())
    assert "bound no solid: a sheet without thickness" in said
    assert "decant vessel mesh cup.stl NEW.yaml" in said


def test_bodies_that_touch_along_an_edge_are_drawn() -> None:
    """Edges of four faces; their outlines meet there (github.com/mikedh/trimesh/issues/145)."""
    boxes = [trimesh.creation.box(bounds=[(x, -1, x), (x + 1, 1, x + 1)]) for x in (0.0, 1.0)]
    both = trimesh.util.concatenate(boxes)
    both.merge_vertices()
    outlines = section(np.asarray(both.vertices, float), np.asarray(both.faces, np.int64))
    area = sum(0.5 * np.sum(o[:, 0] * np.roll(o[:, 1], -1) - np.roll(o[:, 0], -1) * o[:, 1]) for o in outlines)
    assert abs(area) == pytest.approx(2.0)


def test_a_thin_wall_of_a_round_vessel_is_thickened_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    out = tmp_path / "bowl.yaml"
    vessel(out, height="50 mm", diameters="1 mm: 100 mm, 25 mm: 150 mm, 50 mm: 160 mm", wall="0.4 mm")
    assert "a wall of 0.4 mm and a floor of 0.4 mm are too thin" in capsys.readouterr().err
    assert "wall: 1.2" in out.read_text()


def glass(
    path: Path, *, missing: str = "", width: float = 60.0, slant: float = 0.0, chamber: bool = False, scale: float = 1.0
) -> Path:
    """A glass of 311 mL, perhaps without an arc of a wall [deg], slanted [mm], or with a closed chamber in it."""
    around = np.linspace(0.0, 2.0 * np.pi, 73)

    def surface(points: list[tuple[float, float]], keep: Callable[[float, float], bool]) -> list[list[np.ndarray]]:
        outline = [points[0]]
        for (r0, z0), (r1, z1) in itertools.pairwise(points):
            steps = max(1, int(np.hypot(r1 - r0, z1 - z0) / 5.0))
            outline += [(r0 + (r1 - r0) * k / steps, z0 + (z1 - z0) * k / steps) for k in range(1, steps + 1)]
        triangles = []
        for a, b in itertools.pairwise(around):
            for (r0, z0), (r1, z1) in itertools.pairwise(outline):
                if keep(np.degrees(a), min(z0, z1)):
                    p, q, s, t = (
                        np.array([r * np.cos(w), r * np.sin(w), z])
                        for r, z, w in ((r0, z0, a), (r0, z0, b), (r1, z1, b), (r1, z1, a))
                    )
                    triangles += [[p, q, s], [p, s, t]]
        return triangles

    def arc(angle: float, z: float) -> bool:
        return not (angle - 29.9) % 360.0 < width

    inner = [(0.0, 4.0), (30.0, 4.0), (33.0, 50.0), (36.0, 95.0)]
    outer = [(39.0, 95.0), (36.0, 50.0), (34.0, 0.0)]
    whole = [*inner, *outer, (0.0, 0.0)]
    if missing == "outer wall":
        triangles = surface([*inner, outer[0]], lambda angle, z: True) + surface(outer, arc)
        triangles += surface([outer[-1], (0.0, 0.0)], lambda angle, z: True)
    elif missing == "inner wall":
        triangles = surface(inner[:2], lambda angle, z: True) + surface(inner[1:], arc)
        triangles += surface([inner[-1], *outer, (0.0, 0.0)], lambda angle, z: True)
    elif missing in {"rim", "rim of a sheet"}:
        triangles = surface(whole if missing == "rim" else inner, lambda angle, z: z < 70.0 or arc(angle, z))
    else:
        triangles = surface(whole, lambda angle, z: True)
    if chamber:
        ring = [(34.5, 60.0), (35.5, 60.0), (36.0, 80.0), (35.3, 80.0), (34.5, 60.0)]
        triangles += [t[::-1] for t in surface(ring, lambda angle, z: True)]
    corners = scale * np.array(triangles)
    corners[..., 2] += slant * corners[..., 2] / 95.0 * corners[..., 0] / 78.0
    mesh = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(3 * len(corners)).reshape(-1, 3), process=False)
    mesh.merge_vertices()
    mesh.update_faces(mesh.nondegenerate_faces())
    mesh.export(path)
    return path


@pytest.mark.parametrize(
    ("missing", "width", "where"),
    [
        ("outer wall", 60.0, "60° around the axis (30° to 90° from x), 0 to 95 mm above the underside"),
        ("inner wall", 60.0, "60° around the axis (30° to 90° from x), 4 to 95 mm above the underside"),
        ("outer wall", 300.0, "300° around the axis (30° to 330° from x), 0 to 95 mm above the underside"),
        ("inner wall", 300.0, "300° around the axis (30° to 330° from x), 4 to 95 mm above the underside"),
        ("inner wall", 345.0, "345° around the axis (30° to 15° from x), 4 to 95 mm above the underside"),
        ("inner wall", 360.0, "all around the axis, 4 to 95 mm above the underside"),
        ("outer wall", 360.0, "all around the axis, 0 to 95 mm above the underside"),
        ("rim", 60.0, "60° around the axis (30° to 90° from x), 70 to 95 mm above the underside"),
        ("rim", 10.0, "10° around the axis (30° to 40° from x), 70 to 95 mm above the underside"),
        ("rim of a sheet", 60.0, "60° around the axis (30° to 90° from x), 66 to 91 mm above the underside"),
    ],
)
def test_a_wall_without_an_arc_is_refused_with_what_is_missing_and_a_picture(
    missing: str, width: float, where: str, tmp_path: Path
) -> None:
    scan = glass(tmp_path / "scan.stl", missing=missing, width=width)
    command = ["vessel", "mesh", str(scan), str(tmp_path / "v.yaml"), "--unit", "mm", "--wall", "2 mm"]
    ended = CliRunner().invoke(app, command)
    assert ended.exit_code == 2
    assert where in " ".join(ended.output.split())
    assert (tmp_path / "v.png").is_file()
    assert not (tmp_path / "v.yaml").exists()


def test_a_slanted_rim_of_a_sheet_is_no_gap(tmp_path: Path) -> None:
    scan = glass(tmp_path / "scoop.stl", missing="rim of a sheet", width=0.0, slant=30.0)
    assert capacity(mended(scan, unit="mm", wall=0.002)) == pytest.approx(311.0 * 81.0 / 95.0, rel=0.05)


def test_a_stated_unit_does_not_hide_an_implausible_size(tmp_path: Path) -> None:
    found = mended(glass(tmp_path / "unitless.stl", scale=0.01), unit="m", wall=None)
    (warning,) = [text for text in found.warnings if "no vessel on a bench" in text]
    assert "--unit cm (9.5 mm" in warning
    assert not mended(glass(tmp_path / "glass.stl"), unit="mm", wall=None).warnings


@pytest.mark.parametrize("drop", [False, True])
def test_a_chamber_in_the_wall_is_no_body_to_leave_out(drop: bool, tmp_path: Path) -> None:
    found = mended(glass(tmp_path / "double.stl", chamber=True), unit="mm", wall=None, drop_bodies=drop)
    assert not any("separate body" in text for text in (*found.notes, *found.warnings))
    assert capacity(found) == pytest.approx(311.0, rel=0.01)


def test_a_vessel_file_may_have_the_name_of_its_scan(tmp_path: Path) -> None:
    scan = glass(tmp_path / "glass.stl")
    before = scan.read_bytes()
    ended = CliRunner().invoke(app, ["vessel", "mesh", str(scan), str(tmp_path / "glass.yaml"), "--unit", "mm"])
    assert ended.exit_code == 0, ended.output
    assert scan.read_bytes() == before
    assert "mesh: glass-repaired.stl" in (tmp_path / "glass.yaml").read_text(encoding="utf-8")
