"""Options and help text of `decant vessel`. The work is done in `vessel_measurement`."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from orchestrator.cli.command_options import Json, Quiet, call, examples, given


def vessel(
    out: Annotated[Path, typer.Argument(help="Vessel file to write (YAML).", metavar="OUT", show_default=False)],
    height: Annotated[str | None, typer.Option(help="Depth inside, from floor to rim: '95 mm'.")] = None,
    diameters: Annotated[
        str | None,
        typer.Option(help="Inner diameters by height above the inner floor: '5 mm: 60 mm, 95 mm: 72 mm'."),
    ] = None,
    photo: Annotated[Path | None, typer.Option(help="Photograph from the side, on a plain background.")] = None,
    known_height: Annotated[str | None, typer.Option(help="Outer height, for the scale of the photograph.")] = None,
    known_width: Annotated[str | None, typer.Option(help="Largest outer width, for the scale.")] = None,
    points: Annotated[Path | None, typer.Option(help="Points of the surface: PLY, XYZ, or CSV with x, y, z.")] = None,
    depth: Annotated[Path | None, typer.Option(help="Depth image from the side: PNG of 16 bits, or NPY.")] = None,
    focal: Annotated[float | None, typer.Option(help="Focal length of the depth camera [pixels].", min=1.0)] = None,
    centre: Annotated[
        str | None, typer.Option(help="Column and row of the axis: '318.2, 241.5'; default: the image's centre.")
    ] = None,
    mesh: Annotated[Path | None, typer.Option(help="Mesh to repair: STL, OBJ, PLY or GLB.")] = None,
    unit: Annotated[
        str | None, typer.Option(help="Unit of points, mesh or depths: m, cm, mm, in; default for depths: mm.")
    ] = None,
    up: Annotated[str, typer.Option(help="Axis of points or mesh that points out of the opening.")] = "z",
    fill: Annotated[Path | None, typer.Option(help="CSV of levels and masses: level_mm, mass_g.")] = None,
    tilt: Annotated[Path | None, typer.Option(help="CSV of tilts and retained masses: tilt_deg, mass_g.")] = None,
    brimful: Annotated[str | None, typer.Option(help="Weighed mass when full to the brim: '322 g'; a check.")] = None,
    density: Annotated[str, typer.Option(help="Density of the weighed liquid.")] = "998 kg/m^3",
    wall: Annotated[str | None, typer.Option(help="Thickness of the wall: '3 mm'.")] = None,
    floor: Annotated[str | None, typer.Option(help="Thickness of the floor; default: as the wall.")] = None,
    name: Annotated[str | None, typer.Option(help="Name of the vessel; default: the file's name.")] = None,
    as_json: Json = False,
    quiet: Quiet = False,
) -> None:
    """Make a vessel file from measurements: callipers, photograph, points, depth image, a mesh, fill or tilt tables.

    Several sources of a turned vessel can be combined; each is weighted by its uncertainty. A picture with the section,
    its uncertainty and the measurements is written next to the file. The measurements are summarised in the file.
    """
    sources = given(locals(), "out", "name", "as_json")
    from orchestrator.cli import vessel_measurement as verb

    call(verb.vessel, out, verb.Sources(**sources), name=name, as_json=as_json)


EXAMPLES = examples(
    "decant vessel cup.yaml --height '95 mm' --diameters '5 mm: 60 mm, 95 mm: 72 mm' --wall '3 mm'",
    "decant vessel cup.yaml --photo side.png --known-height '99 mm' --wall '3 mm' --fill fill.csv --brimful '322 g'",
    "decant vessel mug.yaml --mesh scan.stl --wall '3 mm'",
)


def register(app: typer.Typer) -> None:
    """Add the command to the application."""
    app.command(epilog=EXAMPLES)(vessel)
