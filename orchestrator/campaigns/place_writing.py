"""Writes a taught place into a laboratory file, whose comments, order and other values stay as they are.

`labware_rack` reads a rack from a labware definition of Opentrons (JSON, schemas 2 and 3).
Source: github.com/Opentrons/opentrons, shared-data/labware/schemas; lengths in mm, y towards the back, z of a well is
that of its bottom.
"""

from __future__ import annotations

import json
import math
import os
import re
from dataclasses import dataclass
from io import StringIO
from itertools import chain
from pathlib import Path

from pydantic import ValidationError
from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from actors.arm_geometry import Pose
from actors.places import PlaceSettings, RackSettings, position_name
from sim_engine.errors import DecantError

FINGERS = 12.0
"""Smallest pitch of a rack whose vessels a gripper could take [mm]."""

RACKS = ("tubeRack", "aluminumBlock", "other")
"""Categories of labware out of which vessels may be taken."""

SHALLOW = 1.0
"""Largest depth of a mark to calibrate with, or of the tip of a gauge [mm]."""

ON_GRID = 0.5
"""Largest distance of a well from the grid of its rack [mm]."""

LEAST_APPROACH = 0.12
"""Height above a taught rack from which the tool comes down, unless its vessels stand deeper [m]."""

LIFT = 10e-3
"""Height above a rack to which a vessel is lifted at least before it moves sideways [m]."""


def write_place(path: Path, place: PlaceSettings) -> None:
    """Write a place into the section `places` of a laboratory file: a new entry, or new values of the one of its name.

    Args:
        path: of the file.
        place: pose, tool, use and rack are written.

    Raises:
        DecantError: the file is no mapping, or `places` is no list.
        OSError: it can't be read or written.
    """
    yaml = YAML()
    yaml.preserve_quotes = True
    yaml.width = 4096
    yaml.indent(mapping=2, sequence=4, offset=2)
    try:
        document = yaml.load(path.read_text(encoding="utf-8"))
    except YAMLError as error:
        raise DecantError(f"{path}: {error}") from None
    if not isinstance(document, CommentedMap):
        raise DecantError(f"{path}: should be a mapping of keys")
    places = document.setdefault("places", CommentedSeq())
    if not isinstance(places, CommentedSeq):
        raise DecantError(f"{path}: 'places' should be a list")
    entry = next((p for p in places if isinstance(p, CommentedMap) and p.get("name") == place.name), None)
    if entry is None:
        entry = CommentedMap(name=place.name)
        places.append(entry)
    entry["pose"], entry["tool"] = _pose(place.pose), _pose(place.tool)
    if place.use != "stand" or "use" in entry:
        entry["use"] = place.use
    if place.rack is not None:
        if "rack" not in entry:
            entry["holds"] = list(place.holds)
            entry["approach"] = f"{1e3 * place.approach:.0f} mm"
        _write_rack(entry.setdefault("rack", CommentedMap()), place.rack)
    text = StringIO()
    yaml.dump(document, text)
    written = path.with_name(f".{path.name}.written")
    written.write_text(text.getvalue(), encoding="utf-8")
    os.replace(written, path)  # noqa: PTH105 - atomic


def _write_rack(entry: CommentedMap, rack: RackSettings) -> None:
    entry["rows"], entry["columns"] = rack.rows, rack.columns
    for key in ("row_pitch", "column_pitch", "row_rise"):
        if (value := getattr(rack, key)) or key in entry:
            entry[key] = f"{1e3 * value:.2f} mm"
    if rack.direction or "direction" in entry:
        entry["direction"] = f"{math.degrees(rack.direction):.3f} deg"
    for key in ("last_row", "last_column"):
        entry.pop(key, None)
        if (pose := getattr(rack, key)) is not None:
            entry[key] = _pose(pose)


@dataclass(frozen=True)
class _Labware:
    """A labware definition.

    Attributes:
        wells: x, y, z and depth of each, by name [mm].
        tips: whether it is a rack of pipette tips.
    """

    path: Path
    name: str
    category: str
    wells: dict[str, tuple[float, ...]]
    tips: bool

    @classmethod
    def read(cls, path: Path) -> _Labware:
        """Read a file; raises as `labware_rack`."""
        try:
            labware = json.loads(path.read_text(encoding="utf-8"))
            if not {"wells", "metadata", "ordering"} - {*labware} and "schemaVersion" not in labware:
                raise DecantError(f"{path}: is a labware definition of schema 1; 2 and 3 can be read")
            schema, wells, meta = labware["schemaVersion"], labware["wells"], labware["metadata"]
            category, name = str(meta["displayCategory"]), str(meta["displayName"])
            values = {(key, axis): well[axis] for key, well in wells.items() for axis in ("x", "y", "z", "depth")}
            for (key, axis), value in values.items():
                if value is None:
                    raise ValueError(f"{axis} of {key} is null")
            cells = {key: tuple(float(values[key, axis]) for axis in ("x", "y", "z", "depth")) for key in wells}
            tips = bool(labware.get("parameters", {}).get("isTiprack"))
            if not all(map(math.isfinite, chain.from_iterable(cells.values()))):
                raise ValueError("a length is no number")
        except (ValueError, TypeError, KeyError, AttributeError) as error:
            reason = f"{error} is missing" if isinstance(error, KeyError) else str(error)
            raise DecantError(
                f"{path}: should be a labware definition of Opentrons with 'schemaVersion', 'metadata' and 'wells', "
                f"each with x, y, z and depth ({reason})"
            ) from None
        if schema not in (2, 3):
            raise DecantError(f"{path}: has schemaVersion {schema!r}; 2 and 3 can be read")
        return cls(path, name, category, cells, tips)

    def check_that_vessels_stand_in_it(self) -> None:
        """Raise DecantError if the wells are part of it, or hold nothing."""
        path, name = self.path, self.name
        if not self.wells:
            raise DecantError(f"{path}: '{name}' has no wells, so that nothing stands in it; a rack has some")
        if self.category not in RACKS or self.tips:
            raise DecantError(
                f"{path}: '{name}' has the displayCategory {self.category}: its wells are part of it, and no gripper "
                f"can grip them or take them out; a rack has the displayCategory {' or '.join(RACKS[:2])}: if vessels "
                "do stand in it, change that in the file"
            )
        if flat := [key for key, (*_, depth) in self.wells.items() if depth <= SHALLOW]:
            raise DecantError(
                f"{path}: the depth of {flat[0]} of '{name}' is not more than {SHALLOW:g} mm, as that of a mark to "
                "calibrate with: no vessel stands in it"
            )

    def grid(self) -> dict[str, float]:
        """Rows, columns and pitches of its wells [m].

        Raises:
            DecantError: they are no regular grid, are counted from another side, or are too close for fingers.
        """
        path, name, cells = self.path, self.name, self.wells
        positions = {key: re.fullmatch(r"([A-Z])([1-9]\d?)", key) for key in cells}
        if "A1" not in cells or None in positions.values():
            raise DecantError(
                f"{path}: the wells of '{name}' should have names such as A1; they are {', '.join(cells)}"
            )
        at = {key: (ord(match[1]) - ord("A"), int(match[2]) - 1) for key, match in positions.items() if match}
        rows, columns = (1 + max(index[k] for index in at.values()) for k in (0, 1))
        x, y, z, _ = cells["A1"]
        # with one row or column the other pitch is never used
        row_pitch = y - cells["B1"][1] if "B1" in cells else 100.0
        column_pitch = cells["A2"][0] - x if "A2" in cells else 100.0
        for key in (position_name(row, column) for row in range(rows) for column in range(columns)):
            row, column = at.get(key, (0, 0))
            expected = (x + column * column_pitch, y - row * row_pitch, z)
            if key not in cells or math.dist(cells[key][:3], expected) > ON_GRID:
                beside = f"is {math.dist(cells[key][:3], expected):.1f} mm beside it" if key in cells else "is missing"
                raise DecantError(
                    f"{path}: '{name}' is not one regular grid: with the pitch of A1, A2 and B1, {key} {beside}. Make "
                    "one place for each regular part"
                )
        for pitch, lines, second, where in (
            (row_pitch, "rows", "B1", "y of A1 should be larger than that of B1"),
            (column_pitch, "columns", "A2", "x of A2 should be larger than that of A1"),
        ):
            if pitch < 0.0:
                raise DecantError(
                    f"{path}: the {lines} of '{name}' are counted from the wrong side: seen from above, A1 is at the "
                    f"back left and {second} the next one, so that {where}. Name the wells so"
                )
        if (narrowest := min(abs(row_pitch), abs(column_pitch))) < FINGERS:
            raise DecantError(
                f"{path}: the positions of '{name}' are {narrowest:.3g} mm apart, as those of a plate or of strips: no "
                "fingers fit between them"
            )
        pitches = {"row_pitch": 1e-3 * row_pitch, "column_pitch": 1e-3 * column_pitch}
        return {"rows": rows, "columns": columns, **pitches}


def labware_rack(path: Path) -> tuple[RackSettings, float]:
    """The rack of a labware definition, and the height to which a vessel has to be lifted out of it [m].

    Raises:
        DecantError: it is no definition, its wells are no regular grid, or cannot be taken out; the text states why.
        OSError: it can't be read.
    """
    labware = _Labware.read(path)
    labware.check_that_vessels_stand_in_it()
    grid = labware.grid()
    lift = 1e-3 * labware.wells["A1"][3] + LIFT
    try:
        rack = RackSettings.model_validate(grid)
        PlaceSettings(name="rack", pose=Pose(), tool=Pose(), rack=rack, approach=max(lift, LEAST_APPROACH))
    except ValidationError as error:
        raise DecantError(f"{path}: '{labware.name}' {first_problem(error)}") from None
    return rack, lift


def first_problem(error: ValidationError) -> str:
    """The first problem of values of a place, with the name of its key."""
    first = error.errors()[0]
    return f"{'.'.join(map(str, first['loc']))}: {first['msg']}"


def _pose(pose: Pose) -> CommentedMap:
    """A pose as on the teach pendant: mm and rad, on one line."""
    names = ("x", "y", "z", "rx", "ry", "rz")
    shown = CommentedMap()
    for name, value in zip(names, pose.as_list, strict=True):
        text = f"{1e3 * value:.2f} mm" if len(name) == 1 else f"{value:.5f} rad"
        if float(text.split(maxsplit=1)[0]) != 0.0:
            shown[name] = text
    shown.fa.set_flow_style()
    return shown
