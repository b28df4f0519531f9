"""Writes a taught place into a laboratory file, whose comments, order and other values stay as they are."""

from __future__ import annotations

import os
from io import StringIO
from pathlib import Path

from ruamel.yaml import YAML
from ruamel.yaml.comments import CommentedMap, CommentedSeq
from ruamel.yaml.error import YAMLError

from actors.arm_geometry import Pose
from actors.places import PlaceSettings
from sim_engine.errors import DecantError


def write_place(path: Path, place: PlaceSettings) -> None:
    """Write a place into the section `places` of a laboratory file: a new entry, or new values of the one of its name.

    Args:
        path: of the file.
        place: pose, tool and use are written.

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
    text = StringIO()
    yaml.dump(document, text)
    written = path.with_name(f".{path.name}.written")
    written.write_text(text.getvalue(), encoding="utf-8")
    os.replace(written, path)  # noqa: PTH105 - atomic


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
