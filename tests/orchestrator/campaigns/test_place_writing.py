"""`place_writing`: racks are taught position by position, or read from labware definitions, and comments stay."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from typer.testing import CliRunner

from actors.arm.arm_settings import arm_kind
from actors.arm_geometry import Pose
from actors.interfaces import InvalidActionError
from actors.places import PlaceSettings, RackSettings, rack_problem, rows_behind_others
from orchestrator.campaigns.file_loading import load_laboratory
from orchestrator.campaigns.place_writing import labware_rack, write_place
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.cli.app import app
from sim_engine.errors import DecantError
from sim_engine.vessel.shapes import cylinder
from sim_engine.vessel.vessel import build_vessel

NIGHT = Path(__file__).parents[3] / "configs" / "laboratories" / "night.yaml"

TURN = (1.2092, 1.2092, 1.2092)

Labware = dict[str, Any]


def tubes(schema: int = 2) -> Labware:
    """A rack of 2 × 3 tubes with the structure and the lengths of opentrons_6_tuberack_falcon_50ml_conical. In schema 3
    the origin is the back left corner: y is negative."""
    shift = 0.0 if schema == 2 else -85.48
    wells = {
        f"{'AB'[row]}{column + 1}": {"x": 35.5 + 35 * column, "y": shift + 60.24 - 35 * row, "z": 8.22, "depth": 113.78}
        for column in range(3)
        for row in range(2)
    }
    meta = {"displayCategory": "tubeRack", "displayName": "six tubes"}
    return {"schemaVersion": schema, "metadata": meta, "parameters": {"isTiprack": False}, "wells": wells}


def labware(folder: Path, value: Any) -> Path:
    path = folder / "labware.json"
    path.write_text(value if isinstance(value, str) else json.dumps(value), encoding="utf-8")
    return path


@pytest.mark.parametrize("schema", [2, 3])
def test_a_rack_of_tubes_is_read_with_its_pitch_and_the_height_of_a_tube(schema: int, tmp_path: Path) -> None:
    rack, lift = labware_rack(labware(tmp_path, tubes(schema)))
    assert (rack.rows, rack.columns) == (2, 3)
    assert (rack.row_pitch, rack.column_pitch) == (pytest.approx(0.035), pytest.approx(0.035))
    assert lift > 0.11378  # out of the rack before it moves sideways


def _of(**meta: Any) -> Labware:
    return {**tubes(), "metadata": {**tubes()["metadata"], **meta}}


def _well(name: str, **values: float) -> Labware:
    definition = tubes()
    definition["wells"][name].update(values)
    return definition


def _without(name: str) -> Labware:
    definition = tubes()
    del definition["wells"][name]
    return definition


def _mirrored(axis: str) -> Labware:
    """Rows counted from the front, as Opentrons' users number their own racks, or columns from the right."""
    definition = tubes()
    for well in definition["wells"].values():
        well[axis] = 100.0 - well[axis]
    return definition


def _apart(factor: float, **values: float) -> Labware:
    definition = tubes()
    for well in definition["wells"].values():
        well.update({"x": well["x"] * factor, "y": well["y"] * factor, **values})
    return definition


def _block() -> Labware:
    """As opentrons_96_aluminumblock_biorad_wellplate_200ul: its category is that of the block, not of the plate."""
    wells = {
        f"{'ABCDEFGH'[row]}{column + 1}": {"x": 14.38 + 9 * column, "y": 74.24 - 9 * row, "z": 4.0, "depth": 14.81}
        for column in range(12)
        for row in range(8)
    }
    return _of(displayCategory="aluminumBlock", displayName="a plate in a block") | {"wells": wells}


# shared-data/labware/definitions/2: x and y of A1, pitch of columns and of rows, rows, columns, z, depth [mm]
RACKS = {
    "opentrons_15_tuberack_falcon_15ml_conical": (13.88, 67.74, 25.0, 25.0, 3, 5, 7.78, 117.98),
    "opentrons_24_tuberack_eppendorf_2ml_safelock_snapcap": (18.21, 75.43, 19.89, 19.28, 4, 6, 41.27, 39.1),
    "opentrons_24_tuberack_eppendorf_2ml_safelock_snapcap_acrylic": (15.28, 72.4, 19.5, 19.5, 4, 6, 13.42, 38.58),
}


@pytest.mark.parametrize("name", RACKS)
def test_public_racks_are_read(name: str, tmp_path: Path) -> None:
    x, y, across, down, rows, columns, z, depth = RACKS[name]
    wells = {
        f"{'ABCD'[row]}{column + 1}": {"x": x + across * column, "y": y - down * row, "z": z, "depth": depth}
        for column in range(columns)
        for row in range(rows)
    }
    rack, lift = labware_rack(labware(tmp_path, _of(displayName=name) | {"wells": wells}))
    assert (rack.rows, rack.columns) == (rows, columns)
    assert (rack.row_pitch, rack.column_pitch) == (pytest.approx(1e-3 * down), pytest.approx(1e-3 * across))
    assert lift == pytest.approx(1e-3 * depth, abs=0.02)


@pytest.mark.parametrize(
    ("value", "message"),
    [
        (_of(displayCategory="wellPlate"), "'six tubes' has the displayCategory wellPlate: its wells are part"),
        # holders of vials from the Labware Creator: machineagency/science-jubilee, septavialrev1_44_holder_2000ul
        (_of(displayCategory="wellPlate"), "if vessels do stand in it, change that in the file"),
        (_of(displayCategory="reservoir"), "has the displayCategory reservoir: its wells are part of it"),
        ({**tubes(), "parameters": {"isTiprack": True}}, "its wells are part of it"),
        # opentrons_10_tuberack_falcon_4x50ml_6x15ml_conical: columns 3 and 4 are wider apart than 1 and 2
        (_well("A3", x=116.1), "not one regular grid: with the pitch of A1, A2 and B1, A3 is 10.6 mm beside it"),
        (_well("B2", z=20.0), "B2 is 11.8 mm beside it"),
        (_without("B3"), "B3 is missing"),
        (
            _block(),
            "the positions of 'a plate in a block' are 9 mm apart, as those of a plate or of strips: no fingers",
        ),
        (_without("A1"), "should have names such as A1; they are B1, A2"),
        ({**tubes(), "schemaVersion": 1}, "has schemaVersion 1; 2 and 3 can be read"),
        ({"ordering": []}, "should be a labware definition of Opentrons with 'schemaVersion'"),
        (_well("A1", depth="deep"), "each with x, y, z and depth"),  # type: ignore[arg-type]
        (_well("A1", depth=None), r"depth of A1 is null"),  # type: ignore[arg-type]
        ("{", "should be a labware definition of Opentrons"),
        (_mirrored("y"), "the rows of 'six tubes' are counted from the wrong side: seen from above, A1 is at the back"),
        (_mirrored("x"), "the columns of 'six tubes' are counted from the wrong side"),
        (_apart(30.0), "'six tubes' row_pitch: "),  # in another unit than mm
        (_apart(1.0, depth=600.0), "'six tubes' approach: "),
        (_well("A2", x=float("nan")), "a length is no number"),
        (_apart(1.0, depth=float("inf")), "a length is no number"),
        (_well("A2", depth=-43.9), "the depth of A2 of 'six tubes' is not more than 1 mm"),
        # Opentrons/opentrons, shared-data/labware/definitions: 1/12-well-plate, 2/opentrons_aluminum_flat_bottom_plate,
        # 2/opentrons_calibrationblock_short_side_left
        (
            {"metadata": {"name": "12-well-plate"}, "ordering": [], "wells": {}},
            "is a labware definition of schema 1; 2",
        ),
        ({**tubes(), "wells": {}}, "'six tubes' has no wells, so that nothing stands in it"),
        (_well("A1", depth=0.0), "the depth of A1 of 'six tubes' is not more than 1 mm, as that of a mark"),
        (_well("A1", depth=0.5), "of 'six tubes' is not more than 1 mm"),  # hardware-testing/…/dial_indicator_1
        ({**tubes(), "parameters": None}, "should be a labware definition of Opentrons"),
        ([tubes()], "should be a labware definition of Opentrons"),
    ],
)
def test_labware_whose_vessels_cannot_be_taken_out_is_refused(value: Any, message: str, tmp_path: Path) -> None:
    with pytest.raises(DecantError) as refused:
        labware_rack(labware(tmp_path, value))
    assert message in str(refused.value)
    assert "labware.json: " in str(refused.value)


def test_corners_of_a_rack_are_written_one_by_one_and_go_when_the_first_is_taught_again(tmp_path: Path) -> None:
    path = tmp_path / "night.yaml"
    path.write_text(NIGHT.read_text(encoding="utf-8"), encoding="utf-8")
    grid = RackSettings(rows=2, columns=1, row_pitch=0.13, column_pitch=0.1, row_rise=0.13, direction=1.5708)
    first = Pose.of(0.58, 0.37, 0.08, *TURN)
    rack = PlaceSettings(name="rack", pose=first, tool=Pose(z=0.17), holds=("receiver",), approach=0.14, rack=grid)
    write_place(path, rack)
    assert load_laboratory(path).places[-1] == rack.with_values(
        rack=grid.with_values(direction=pytest.approx(grid.direction, abs=1e-4))
    )
    corner = Pose.of(0.711, 0.37, 0.21, *TURN)
    write_place(path, rack.with_values(rack=grid.with_values(last_row=corner)))
    taught = load_laboratory(path).places[-1].rack
    assert taught is not None
    assert taught.last_row == corner
    assert "# under the outlet of the pump" in path.read_text(encoding="utf-8")
    write_place(path, rack)
    assert load_laboratory(path).places[-1].rack == taught.with_values(last_row=None)


Says = Callable[..., str]


@pytest.fixture
def teach(tmp_path: Path) -> Says:
    """Teaches in a copy of the shipped night; the virtual arm stands at home."""
    path = tmp_path / "lab.yaml"
    path.write_text(NIGHT.read_text(encoding="utf-8"), encoding="utf-8")

    def command(*arguments: str) -> str:
        result = CliRunner().invoke(app, ["robot", "teach", str(path), *arguments])
        return f"{result.exit_code} {result.output}"

    return command


def test_a_rack_is_taught_at_its_corners_alone(teach: Says, tmp_path: Path) -> None:
    assert "'shelf' is no rack in the file, and has no position A1" in teach("shelf", "A1")
    grid = "rows: 2, columns: 3, row_pitch: 100 mm, column_pitch: 100 mm, row_rise: 120 mm, direction: 90 deg"
    assert "--rack: columns:" in teach("shelf", "A1", "--rack", "rows: 2, columns: two")
    assert "is taught at A1, B1, A3: name one" in teach("shelf", "--rack", grid)
    assert "is taught at A1, B1, A3: not B3" in teach("shelf", "B3", "--rack", grid)
    said = teach("shelf", "A1", "--rack", grid)
    assert said.startswith("0 ")
    assert "residual of the taught positions: 0.00 mm; still to be taught: B1, A3" in said
    rack = load_laboratory(tmp_path / "lab.yaml").places[-1]
    assert (rack.name, rack.holds) == ("shelf", ("receiver",))
    assert "only row" not in said  # its rows rise
    # the arm has not moved: the corner would be at A1, 100 mm beside its place
    said = teach("shelf", "B1")
    assert said.startswith("2 ")
    assert "nothing is written: the taught positions of 'shelf' are up to 50.0 mm away from a grid" in said
    assert load_laboratory(tmp_path / "lab.yaml").places[-1] == rack


def test_a_flat_rack_is_called_so_when_it_is_taught(teach: Says, tmp_path: Path) -> None:
    said = teach("tubes", "A1", "--labware", str(labware(tmp_path, tubes())))
    assert said.startswith("0 ")
    said = " ".join(said.split())
    # the tool reaches along the base's x, and so do the columns of a rack whose direction is 0
    assert "with vessels everywhere only column 1 can be used" in said
    assert "Put vessels into one column at a time" in said


@pytest.mark.parametrize("name", ["a rack", "x" * 61, "shelf/left/top"])
def test_a_name_that_no_place_can_have_is_refused_before_the_arm_is_read(name: str, teach: Says) -> None:
    assert teach(name).startswith("2 ")
    assert "place name: " in teach(name)


def _rack(reach: Pose, **values: Any) -> PlaceSettings:
    grid = {"rows": 3, "columns": 2, "row_pitch": 0.12, "column_pitch": 0.1, "direction": 1.5708, **values}
    return PlaceSettings(name="rack", pose=reach, tool=Pose(z=0.17), rack=RackSettings(**grid))


FORWARDS, BACKWARDS, DOWN = (
    Pose.of(0.55, 0.25, 0.08, *turn) for turn in (TURN, (1.2092, -1.2092, -1.2092), (3.1416, 0.0, 0.0))
)


@pytest.mark.parametrize(
    ("place", "only"),
    [
        (_rack(FORWARDS), "row A can be used, since the tool would pass through the vessels before B, C"),
        (_rack(BACKWARDS), "row C can be used, since the tool would pass through the vessels before B, A"),
        (_rack(FORWARDS, direction=0.0), "column 1 can be used"),
        (_rack(FORWARDS, row_rise=0.12), ""),
        (_rack(FORWARDS, rows=1), ""),
        (_rack(DOWN), ""),
    ],
)
def test_rows_behind_others_are_those_in_the_direction_in_which_the_tool_reaches(
    place: PlaceSettings, only: str
) -> None:
    text = rows_behind_others(place)
    assert only in text
    assert bool(only) == bool(text)


def test_what_is_said_about_a_flat_rack_is_what_the_ways_to_it_show() -> None:
    lab = load_laboratory(NIGHT.with_name("rack.yaml"))
    shipped = next(place for place in lab.places if place.rack is not None)
    assert shipped.rack is not None
    assert lab.expected_arm is not None
    flat = shipped.with_values(holds=("cup",), rack=shipped.rack.with_values(rows=2, columns=1, row_rise=0.0))
    assert "only row A can be used" in rows_behind_others(flat)
    cup, kind = (
        build_vessel(cylinder("cup", inner_radius=0.028, inner_height=0.08, wall=0.003)),
        arm_kind(lab.expected_arm),
    )
    front, behind = flat.each
    kind.way(front, flat.each, {"cup": cup})
    with pytest.raises(InvalidActionError, match="a vessel at 'rack/A1'"):
        kind.way(behind, flat.each, {"cup": cup})
    kind.way(behind, (behind,), {"cup": cup})  # one row at a time


@pytest.mark.parametrize("degrees", [0.0, 9.0, 11.0, 20.0, 90.0, 180.0])
def test_a_corner_that_is_taught_with_the_tool_turned_is_refused_with_the_angle(degrees: float) -> None:
    pose = Pose.of(0.55, 0.25, 0.08, 0.0, 0.0, 0.0)
    turned = Pose.of(0.55, 0.35, 0.08, 0.0, 0.0, math.radians(degrees))
    place = _rack(pose, rows=1, last_column=turned)
    text = f"at A2 of 'rack' the tool was turned by {degrees:.0f} deg from where it was at A1, and 10 deg are allowed"
    assert rack_problem(place).startswith(text) == (degrees > 10.0)


def test_a_file_whose_corners_are_turned_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "rack.yaml"
    turned = "rx: 2.7800 rad, ry: 1.2092 rad, rz: 1.2092 rad"
    corner = f", last_column: {{x: 550 mm, y: 750 mm, z: 80 mm, {turned}}}, direction: 90 deg}}"
    text = NIGHT.with_name("rack.yaml").read_text(encoding="utf-8")
    path.write_text(text.replace(", direction: 90 deg}", corner), encoding="utf-8")
    with pytest.raises(ConfigError, match=r"at A6 of 'rack' the tool was turned by \d\d deg"):
        load_laboratory(path)
