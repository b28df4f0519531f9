"""`vessel_command`: `decant vessel`: shipped cups, measured with the errors of real tools, through every door."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import trimesh

from orchestrator.campaigns.file_loading import load_vessel
from orchestrator.extra_commands.vessel_tables import read_fill_table, read_tilt_table
from sim_engine.errors import DecantError
from sim_engine.vessel.profile import volume
from sim_engine.vessel.vessel import build_vessel
from tests.support.measured_vessel import MeasuredVessel, vessel

VESSELS = Path("configs/vessels")


def measured(name: str) -> MeasuredVessel:
    return MeasuredVessel(load_vessel(VESSELS / f"{name}.yaml"))


def made(tmp_path: Path, sources: dict[str, Any]) -> float:
    """Capacity of what is made, from its file [m³]."""
    out = tmp_path / "made.yaml"
    vessel(out, **sources)
    assert out.with_suffix(".png").stat().st_size > 10_000
    return build_vessel(load_vessel(out), use_cache=False).capacity


Door = Callable[[MeasuredVessel, Path], dict[str, Any]]


def callipers(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    return {"height": f"{of.height} m", "diameters": of.diameters(), "wall": f"{of.shape.wall} m"}


def fill(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    return {"height": f"{of.height} m", "fill": of.fill(folder / "fill.csv"), "wall": "3 mm"}


def tilt(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    return {"height": f"{of.height} m", "tilt": of.tilt(folder / "tilt.csv"), "wall": "3 mm"}


def mesh(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    of.solid().export(folder / "scan.stl")
    return {"mesh": folder / "scan.stl"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["tumbler", pytest.param("cone", marks=pytest.mark.slow)])
@pytest.mark.parametrize(
    "door",
    [callipers, fill, tilt, mesh],
)
def test_a_cup_comes_out_as_it_is_through_every_door(tmp_path: Path, name: str, door: Door) -> None:
    of = measured(name)
    assert made(tmp_path, door(of, tmp_path)) == pytest.approx(of.vessel.capacity, rel=0.015)


@pytest.mark.slow
def test_sources_that_are_joined_know_more_than_each_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:

    of, deviations = measured("bowl"), []
    for number, sources in enumerate(
        (
            fill(of, tmp_path),
            tilt(of, tmp_path),
            {
                "height": f"{of.height} m",
                "fill": of.fill(tmp_path / "f.csv"),
                "tilt": of.tilt(tmp_path / "t.csv"),
                "diameters": of.diameters(),
                "wall": "3 mm",
            },
        )
    ):
        vessel(tmp_path / f"{number}.yaml", **sources)
        (told,) = re.findall(r"holds (\d+) ± ([\d.]+) mL", capsys.readouterr().err)
        capacity, deviation = map(float, told)
        deviations.append(deviation)
        assert abs(capacity - 1e6 * of.vessel.capacity) < 3.0 * deviation + 0.5
    assert deviations[2] < min(deviations[:2])


@pytest.mark.slow
@pytest.mark.parametrize("door", [callipers, fill])
def test_the_file_says_how_far_the_shape_may_be_off(tmp_path: Path, door: Door) -> None:
    made(tmp_path, door(measured("cone"), tmp_path))
    told = float((tmp_path / "made.yaml").read_text().partition("±")[2].split()[0])
    found = load_vessel(tmp_path / "made.yaml")
    capacities = [volume(np.array(found.drawn(seed).shape.outline().inner)) for seed in range(200)]  # type: ignore[attr-defined]
    assert 1e6 * np.std(capacities) == pytest.approx(told, rel=0.25)


CALLIPERS = "5 mm: 64.4 mm, 50 mm: 67.4 mm, 95 mm: 70.4 mm"


@pytest.mark.parametrize("diameters", [None, pytest.param(CALLIPERS, marks=pytest.mark.slow)])
def test_a_fill_table_of_a_balance_that_was_not_tared_is_refused_with_both_capacities(
    tmp_path: Path, diameters: str | None
) -> None:
    table = tmp_path / "fill.csv"
    table.write_text("level_mm,mass_g\n10,131.2\n30,196.0\n60,300.1\n90,412.4\n")  # of a cup of 332 mL, 100 g too much
    sources: dict[str, Any] = {"height": "95 mm", "fill": table, "wall": "3 mm", "diameters": diameters}
    with pytest.raises(DecantError, match=r"fill\.csv: .* not tared with the empty vessel") as refusal:
        vessel(tmp_path / "cup.yaml", **sources)
    assert not (tmp_path / "cup.yaml").exists()
    (mass,) = re.findall(r"about (\d+) g", str(refusal.value))
    (capacity,) = re.findall(r"without them the vessel holds (\d+) mL", str(refusal.value))
    assert float(mass) == pytest.approx(100.0, abs=6.0)
    assert float(capacity) == pytest.approx(332.0, abs=6.0)
    assert "--tare '0 g'" in str(refusal.value)
    assert 1e6 * made(tmp_path, {**sources, "tare": "100 g"}) == pytest.approx(332.0, rel=0.01)


def test_the_masses_of_a_table_contain_the_tare(tmp_path: Path) -> None:
    table = tmp_path / "fill.csv"
    table.write_text("level_mm,mass_g\n10,131.2\n30,196.0\n60,300.1\n")
    with pytest.raises(DecantError, match=r"fill\.csv:2: mass_g is 131.2; should be at least the 150 g of --tare"):
        vessel(tmp_path / "cup.yaml", height="95 mm", fill=table, wall="3 mm", tare="150 g")


@pytest.mark.parametrize("name", ["narrow", *(pytest.param(each, marks=pytest.mark.slow) for each in ("bowl", "cone"))])
def test_tared_fill_tables_of_the_shipped_vessels_are_read_without_a_question(tmp_path: Path, name: str) -> None:
    of = measured(name)
    assert made(tmp_path, fill(of, tmp_path)) == pytest.approx(of.vessel.capacity, rel=0.02)


def test_a_brimful_cup_that_weighs_otherwise_is_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    of = measured("tumbler")
    sources = callipers(of, tmp_path)
    vessel(tmp_path / "right.yaml", **(sources | {"brimful": "321 g"}))
    assert "warning" not in capsys.readouterr().err
    vessel(tmp_path / "wrong.yaml", **(sources | {"brimful": "280 g"}))
    assert "brimful it held 281 mL, and the shape has 322" in capsys.readouterr().err
    assert "# Doubtful: brimful" in (tmp_path / "wrong.yaml").read_text()


@pytest.mark.slow
def test_a_sheet_is_thickened_and_holes_are_closed(tmp_path: Path) -> None:
    of = measured("bowl")
    sheet = trimesh.creation.revolve(1e3 * of.inner, sections=64)
    sheet.update_faces(sheet.nondegenerate_faces())
    keep = np.ones(len(sheet.faces), bool)
    keep[len(keep) // 2 : len(keep) // 2 + 3] = False
    sheet.update_faces(keep)
    sheet.export(tmp_path / "sheet.stl")
    with pytest.raises(DecantError, match=r"a sheet without thickness.*--wall 3mm"):
        made(tmp_path, {"mesh": tmp_path / "sheet.stl"})
    capacity = made(tmp_path, {"mesh": tmp_path / "sheet.stl", "wall": "3 mm"})
    assert capacity == pytest.approx(of.vessel.capacity, rel=0.02)


def two_cups(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    other = of.solid().apply_translation([300.0, 0.0, 0.0])
    trimesh.util.concatenate([of.solid(), other]).export(folder / "two.stl")
    return {"mesh": folder / "two.stl", "unit": "mm"}


def tiny(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
    of.solid().apply_scale(1e-6).export(folder / "tiny.stl")
    return {"mesh": folder / "tiny.stl"}


def written(text: str) -> Door:
    def door(of: MeasuredVessel, folder: Path) -> dict[str, Any]:
        (folder / "fill.csv").write_text(text)
        return {"height": "100 mm", "fill": folder / "fill.csv", "wall": "3 mm"}

    return door


@pytest.mark.slow
@pytest.mark.parametrize(
    ("door", "said"),
    [
        (two_cups, r"2 bodies.*a vessel is one"),
        (tiny, r"is a vessel's in no unit"),
        (lambda of, folder: {"height": "95 mm", "wall": "3 mm"}, r"nothing says how wide"),
        (lambda of, folder: {"diameters": "5 mm: 60 mm", "wall": "3 mm"}, r"how deep is it inside.*--height"),
        (lambda of, folder: {"height": "95 mm", "diameters": "5 mm: 60 mm"}, r"how thick is the wall"),
        (lambda of, folder: {"height": "95", "diameters": "5 mm: 60 mm", "wall": "3 mm"}, r"--height '95'.*no unit"),
        (
            lambda of, folder: {"height": "95 mm", "diameters": "120 mm: 60 mm", "wall": "3 mm"},
            r"not between the inner",
        ),
        (lambda of, folder: {"height": "95 mm", "diameters": "60", "wall": "3 mm"}, r"a height and a diameter"),
        (written("mass_g\n2\n"), r"fill.csv:1: the column 'level_mm' is missing"),
        (written("level,mass\n1,2\n"), r"fill.csv:1:1: level: has no unit; write 'level_mm' or 'level \[mm\]'"),
        (
            written("level [g],mass [g]\n1,2\n"),
            r"fill.csv:1:1: level \[g\]: the unit 'g' is a mass; should be a length",
        ),
        (written("level_mm,mass_g\n10,20\n20,x\n"), r"fill.csv:3: should be two numbers"),
        (written("level_mm,mass_g\n10,20\n200,30\n"), r"fill.csv:3: level_mm is 200; should be .* at most 100"),
        (written("level_mm,mass_g\n10,20\n"), r"at least 3"),
        (written("level_mm,mass_g\n50,20\n50,30\n50,40\n"), r"fill.csv: has 1 different value"),
        (written("level_mm,mass_g\n10,90\n40,60\n80,30\n"), r"fill.csv:3: mass_g is 60 at 40, and 90 at 10 \(line 2\)"),
        (written("level_mm,mass_g\n10,20\n50,90\n50,300\n90,400\n"), r"fill.csv:4: mass_g is 300 at 50, and 90 at 50"),
        (written("level_mm,mass_g\n10,0\n40,0\n80,0\n"), r"fill.csv:2: 0 g below 10 mm make a vessel of 0 mm"),
        (written("level_mm,mass_g\n10,9e4\n40,9.1e4\n80,9.2e4\n"), r"fill.csv:2: .* should be 4 to 1000 mm"),
        (
            lambda of, folder: (
                written("tilt_deg,mass_g\n10,5\n50,60\n90,200\n")(of, folder)
                | {"fill": None, "tilt": folder / "fill.csv"}
            ),
            r"fill.csv:3: mass_g is 60 at 50, and 5 at 10 \(line 2\); a vessel that is tilted further holds less",
        ),
    ],
)
def test_what_makes_no_vessel_is_refused_and_nothing_is_written(tmp_path: Path, door: Door, said: str) -> None:
    with pytest.raises(DecantError, match=said) as refused:
        vessel(tmp_path / "cup.yaml", **door(measured("tumbler"), tmp_path))
    assert refused.value.exit_code == 2
    assert not (tmp_path / "cup.yaml").exists()
    assert not (tmp_path / "cup.stl").exists()


def test_a_mesh_that_holds_nothing_is_named_by_its_own_file(tmp_path: Path) -> None:
    trimesh.creation.cylinder(radius=30, height=80).export(tmp_path / "scan.stl")
    with pytest.raises(DecantError, match=r"^scan.stl: no cavity"):
        made(tmp_path, {"mesh": tmp_path / "scan.stl", "unit": "mm"})


def test_no_file_is_written_over(tmp_path: Path) -> None:
    (tmp_path / "cup.yaml").write_text("name: cup\n")
    with pytest.raises(DecantError, match="exists already"):
        vessel(tmp_path / "cup.yaml")


@pytest.mark.parametrize("name", ["12", "no"])
def test_a_file_that_is_called_a_number_can_be_read(tmp_path: Path, name: str) -> None:
    out = tmp_path / f"{name}.yaml"
    vessel(out, **callipers(measured("tumbler"), tmp_path))
    assert load_vessel(out).name == name


def test_fill_tables_are_read_in_the_forms_that_spreadsheets_save(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def table(text: str) -> list[list[float]]:
        (tmp_path / "fill.csv").write_text(text, encoding="utf-8")
        found = read_fill_table(tmp_path / "fill.csv", height=100.0, density=1e-3, ruler=0.5, balance=0.1)
        return [column.tolist() for column in found]

    plain = table("level_mm,mass_g\n10,30.5\n20,61\n30.5,92.25\n")
    assert capsys.readouterr().err == ""
    european = table("# cup 7\n;Level [cm];mass (oz)\n" + "0;1,0;1,0758\n1;2,0;2,15169\n2;3,05;3,25402\n")
    assert european == [pytest.approx(column, rel=1e-3) for column in plain]
    assert "semicolons between cells, 1 comment line left out" in capsys.readouterr().err


def test_a_first_row_upright_or_empty_is_left_out_with_a_note(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    table = tmp_path / "table.csv"
    table.write_text("tilt_deg,mass_g\n0,200\n30,150\n50,90\n70,20\n", encoding="utf-8")
    tilts, _ = read_tilt_table(table, angle=0.5, balance=0.1)
    assert list(tilts) == [30.0, 50.0, 70.0]
    table.write_text("level_mm,mass_g\n0,0\n20,40\n50,100\n90,200\n", encoding="utf-8")
    levels, _ = read_fill_table(table, height=100.0, density=1e-3, ruler=0.5, balance=0.1)
    assert levels[0] == 20.0
    assert "tilt_deg 0 is left out" in capsys.readouterr().err
