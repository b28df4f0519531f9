"""The commands `decant vessel ...`: each makes a vessel file from one kind of source.

`profile` fits a turned vessel to the sizes and tables that are given (`Sizes`); `mesh` repairs a mesh and uses it.
Tables are read in `vessel_tables`; the fits are in `sim_engine.vessel_acquisition`.
"""

from __future__ import annotations

import json
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, cast

import typer

from orchestrator.cli.command_options import add_group, grouped
from orchestrator.cli.console import RefusalError, print_note, print_warning, waiting_for

if TYPE_CHECKING:
    from sim_engine.vessel.mesh_shape import Axis
    from sim_engine.vessel.shapes import LengthUnit
    from sim_engine.vessel_acquisition.mesh_repair import MissingWallError
    from sim_engine.vessel_acquisition.outline_fit import Evidence, FittedOutline

CALLIPERS = 2e-4
"""Standard deviation of a radius measured with callipers [m]."""

HEIGHT = 3e-4
"""Standard deviation of the rim's height [m]."""

RULER, BALANCE, ANGLE = 5e-4, 5e-4, 0.005
"""Standard deviations of a level [m], of a mass [kg] and of a tilt [rad] in tables."""

DOUBTFUL = 3.0
"""Number of standard deviations above which a check fails."""

UNTARED = 4.0
"""Gain of a fit's log likelihood from which the masses of tables are taken for those of an untared balance. With 80 g
too much it is 4.5 to 16 for the shipped vessels, a hemisphere, a paraboloid and a flask; at most 1 for tared masses."""

SMALLEST_TARE = 0.05
"""Smallest mass that counts as a missing tare, as a share of a table's largest."""

LEVEL = 2.0
"""Angle of a rim from which it counts as not level [deg]."""

BAND = 2.0
"""Standard deviations that the band shows to either side."""

Out = Annotated[Path, typer.Argument(help="Vessel file to write (YAML).", metavar="OUT")]
Unit = Annotated[str | None, typer.Option(help="Unit of the file: m, cm, mm, in; default: by its extent.")]
Wall = Annotated[str | None, typer.Option(help="Thickness of the wall: '3 mm'.")]


@dataclass(frozen=True)
class Sizes:
    """Options of all turned vessels."""

    height: Annotated[str | None, typer.Option(help="Depth inside, from floor to rim: '95 mm'.")] = None
    diameters: Annotated[
        str | None, typer.Option(help="Inner diameters by height above the inner floor: '5 mm: 60 mm, 95 mm: 72 mm'.")
    ] = None
    fill: Annotated[Path | None, typer.Option(help="Table of levels and masses: level_mm, mass_g.")] = None
    tilt: Annotated[Path | None, typer.Option(help="Table of tilts and retained masses: tilt_deg, mass_g.")] = None
    tare: Annotated[
        str | None, typer.Option(help="Mass of the empty vessel that the tables' masses contain; '0 g' for none.")
    ] = None
    wall: Wall = None
    floor: Annotated[str | None, typer.Option(help="Thickness of the floor; default: as the wall.")] = None

    def lengths(self) -> tuple[float | None, float | None, float | None]:
        """Wall, floor and height [m]."""
        return (
            _quantity(self.wall, "--wall", "m", "3 mm"),
            _quantity(self.floor, "--floor", "m", "4 mm"),
            _quantity(self.height, "--height", "m", "95 mm"),
        )


@dataclass(frozen=True)
class Vessel:
    """Options of all vessels."""

    brimful: Annotated[str | None, typer.Option(help="Weighed mass when full to the brim: '322 g'; a check.")] = None
    density: Annotated[str, typer.Option(help="Density of the weighed liquid.")] = "998 kg/m^3"
    name: Annotated[str | None, typer.Option(help="Name of the vessel; default: the file's name.")] = None

    def volume(self, mass: float) -> float:
        """Volume of a weighed mass [m³]."""
        density = _quantity(self.density, "--density", "kg/m^3", "998 kg/m^3")
        assert density is not None
        return mass / density

    def brimful_volume(self) -> float | None:
        """Volume of the vessel as weighed [m³]."""
        mass = _quantity(self.brimful, "--brimful", "kg", "322 g")
        return None if mass is None else self.volume(mass)


@dataclass(frozen=True)
class Made:
    """A vessel that was made.

    Attributes:
        capacity, deviation: volume to the brim and its standard deviation [m³].
        picture: path of the picture.
        notes, doubts: messages for the user.
    """

    capacity: float
    deviation: float
    picture: Path
    notes: list[str]
    doubts: list[str]


# -- commands ----------------------------------------------------------------------------------------------------------


@grouped
def profile(out: Out, sizes: Sizes, vessel: Vessel) -> None:
    """Make the file of a turned vessel from its sizes: callipers, a fill table, a tilt table.

    Give `--height`, `--wall`, and at least one of `--diameters`, `--fill` and `--tilt`. Several are combined, each
    weighted by its uncertainty. A picture with the section, its uncertainty and the measurements is written next to
    the file.
    """
    _make(out, vessel, lambda notes: _turned(out, sizes, vessel, notes))


@grouped
def mesh(
    file: Annotated[Path, typer.Argument(help="Mesh: STL, OBJ, PLY or GLB.", metavar="MESH")],
    out: Out,
    unit: Unit = None,
    up: Annotated[str | None, typer.Option(help="Axis out of the opening; default: y of a GLB, z of others.")] = None,
    drop_bodies: Annotated[
        bool, typer.Option("--drop-bodies", help="Leave out separate bodies in the cavity, such as the liquid.")
    ] = False,
    wall: Wall = None,
    *,
    vessel: Vessel,
) -> None:
    """Make a vessel file from a mesh, for spouts and handles; the mesh is repaired if necessary.

    The repaired mesh is written next to the file. Every repair is printed. A sheet without thickness needs `--wall`.
    """

    def work(notes: list[str]) -> Made:
        from sim_engine.resources import require
        from sim_engine.vessel.mesh_shape import usual_up
        from sim_engine.vessel_acquisition.mesh_repair import MissingWallError, mended

        require("manifold3d", "the repair of a mesh")
        thick, axis = _quantity(wall, "--wall", "m", "3 mm"), _axis(up) if up else usual_up(file)
        try:
            result = mended(file, unit=_unit(unit), wall=thick, up=axis, drop_bodies=drop_bodies)
        except MissingWallError as error:
            picture = _draw_missing(file.name, error, out.with_suffix(".png"))
            raise MissingWallError(f"{error}. Picture: {picture}", error.corners, error.holes) from None
        notes += result.notes
        return _written_mesh(out, vessel, result.vertices, result.faces, notes, result.warnings, up=axis, given=file)

    _make(out, vessel, work)


def _make(out: Path, vessel: Vessel, work: Callable[[list[str]], Made]) -> None:
    """Make a vessel, and print what was made. Nothing is written over."""
    from sim_engine.settings.quantity import QuantityError

    if not (vessel.name or out.stem).isprintable():  # such as bytes that are not UTF-8
        raise RefusalError(f"--name {vessel.name or out.stem!r}: should be text in UTF-8, as in --name 'glass 3'")
    if out.suffix not in (".yaml", ".yml"):
        raise RefusalError(f"{out}: a vessel file is YAML; write {out.with_suffix('.yaml')}")
    if not out.parent.is_dir():
        raise RefusalError(f"{out}: the folder {out.parent} does not exist; make it first")
    if out.exists():
        raise RefusalError(f"{out}: exists already; choose another name, or remove it first")
    try:
        with waiting_for(lambda: "measuring the vessel"):
            fitted = work([])
    except QuantityError as error:
        raise RefusalError(str(error)) from None
    except OSError as error:
        raise RefusalError(f"{error.filename}: {error.strerror}") from None
    for note in fitted.notes:
        print_note(f"note: {note}")
    for doubt in fitted.doubts:
        print_warning(doubt)
    print_note(
        f"{out} holds {1e6 * fitted.capacity:.0f} ± {1e6 * fitted.deviation:.1f} mL; its picture: {fitted.picture}"
    )


def _quantity(text: str | None, subject: str, unit: str, example: str) -> float | None:
    if text is None:
        return None
    from sim_engine.settings.quantity import QuantityError, typed_quantity

    try:
        return typed_quantity(text, unit, example)
    except QuantityError as error:
        raise RefusalError(f"{subject} {text!r}: {error}") from None


# -- turned vessels ----------------------------------------------------------------------------------------------------


def _turned(out: Path, sizes: Sizes, vessel: Vessel, notes: list[str]) -> Made:
    """Make a surface of revolution from all measurements."""
    import numpy as np

    from sim_engine.vessel.shapes import VesselSpec
    from sim_engine.vessel.vessel import build_vessel
    from sim_engine.vessel_acquisition.outline_fit import find_outline
    from sim_engine.vessel_acquisition.wall_thickening import RESERVE, fits_grid, least_wall

    wall, floor, height = sizes.lengths()
    if wall is None:
        raise RefusalError("how thick is the wall? Say it with --wall, for example --wall '3 mm'")
    floor = wall if floor is None else floor
    if height is None:
        raise RefusalError(
            "how deep is it inside, from floor to rim? Say it with --height, for example --height '95 mm'"
        )
    evidence = _measured(sizes, vessel, height)

    def fitted(measurements: Sequence[Evidence]) -> FittedOutline:
        return find_outline(height, measurements, wall, floor, height_deviation=HEIGHT)

    outline = fitted(evidence)
    if sizes.tare is None:
        _check_tared(sizes, vessel, evidence, outline, fitted)
    width = 2.0 * (float(outline.radii.max()) + wall)
    extent = np.array([width, width, height + floor])
    if not fits_grid(extent, min(wall, floor)):
        least = RESERVE * least_wall(extent)
        notes.append(
            f"a wall of {1e3 * wall:.2g} mm and a floor of {1e3 * floor:.2g} mm are too thin for the simulator's grid; "
            f"they were thickened outwards to {1e3 * max(wall, least):.2g} and {1e3 * max(floor, least):.2g} mm"
        )
        outline = replace(outline, wall=max(wall, least), floor=max(floor, least))
    name = vessel.name or out.stem
    build_vessel(VesselSpec(name=name, shape=outline.shape()))
    doubts = _doubts(outline, vessel)
    used = [f"{fit.count} from the {fit.name}, off by {fit.rms:.1f} standard deviations (rms)" for fit in outline.fits]
    picture = _draw_outline(name, outline, evidence, out.with_suffix(".png"))
    out.write_text(_profile_file(name, outline, used, doubts))
    return Made(outline.capacity, outline.capacity_deviation, picture, notes + used, doubts)


def _measured(sizes: Sizes, vessel: Vessel, height: float) -> list[Evidence]:
    """Read callipers and tables."""
    import numpy as np

    from orchestrator.extra_commands.vessel_tables import read_diameters, read_fill_table, read_tilt_table
    from sim_engine.vessel_acquisition.measurements import FillTable, Radii, TiltTable

    evidence: list[Evidence] = []
    if sizes.diameters is not None:
        heights, widths = read_diameters(sizes.diameters, height)
        evidence.append(Radii("callipers", heights, widths / 2.0, np.full(len(heights), CALLIPERS)))
    volume_error = vessel.volume(BALANCE)
    tare = 1e3 * (_quantity(sizes.tare, "--tare", "kg", "104 g") or 0.0)
    if sizes.fill is not None:
        levels, masses = read_fill_table(
            sizes.fill,
            height=1e3 * height,
            density=1e-6 * BALANCE / volume_error,
            ruler=1e3 * RULER,
            balance=1e3 * BALANCE,
            tare=tare,
        )
        volumes = np.array([vessel.volume(mass) for mass in masses / 1e3])
        radius = float(np.sqrt(volumes.max() / (np.pi * levels.max() / 1e3)))
        evidence.append(FillTable(levels / 1e3, volumes, RULER, volume_error, radius))
    if sizes.tilt is not None:
        tilts, masses = read_tilt_table(sizes.tilt, angle=float(np.degrees(ANGLE)), balance=1e3 * BALANCE, tare=tare)
        volumes = np.array([vessel.volume(mass) for mass in masses / 1e3])
        evidence.append(TiltTable(np.radians(tilts), volumes, ANGLE, volume_error))
    return evidence


def _check_tared(
    sizes: Sizes,
    vessel: Vessel,
    evidence: Sequence[Evidence],
    outline: FittedOutline,
    fitted: Callable[[Sequence[Evidence]], FittedOutline],
) -> None:
    """Refuse tables whose masses seem to contain the empty vessel: without a constant they fit far better."""
    from scipy.optimize import minimize_scalar

    from sim_engine.vessel_acquisition.measurements import FillTable, TiltTable

    volumes = [volume for piece in evidence if isinstance(piece, FillTable | TiltTable) for volume in piece.observed]
    least, most = min(volumes, default=0.0), max(volumes, default=0.0)

    def without(offset: float) -> FittedOutline:
        return fitted(
            [
                replace(piece, observed=piece.observed - offset) if isinstance(piece, FillTable | TiltTable) else piece
                for piece in evidence
            ]
        )

    # a search takes ten fits: only if the likelihood rises
    if least < SMALLEST_TARE * most or without(0.2 * least).likelihood <= outline.likelihood:
        return
    search = minimize_scalar(
        lambda offset: -without(float(offset)).likelihood,
        bounds=(0.0, 0.999 * least),
        method="bounded",
        options={"xatol": 0.01 * least, "maxiter": 15},
    )
    offset, corrected = float(search.x), without(float(search.x))
    if offset < SMALLEST_TARE * most or corrected.likelihood - outline.likelihood < UNTARED:
        return
    raise RefusalError(
        f"{sizes.fill or sizes.tilt}: all masses seem to contain about {1e3 * offset / vessel.volume(1.0):.0f} g that "
        "are not liquid, as on a balance that was not tared with the empty vessel: without them the vessel holds "
        f"{1e6 * corrected.capacity:.0f} mL, with them {1e6 * outline.capacity:.0f} mL. Weigh the empty vessel and say "
        "its mass, for example --tare '104 g'; if the masses are of the liquid alone, say --tare '0 g'"
    )


def _doubts(outline: FittedOutline, vessel: Vessel) -> list[str]:
    """Describe inconsistencies between the measurements."""
    import numpy as np

    doubts = [
        f"the {fit.name} and the rest disagree ({fit.rms:.0f} times their own deviations): look at the picture"
        for fit in outline.fits
        if fit.rms > DOUBTFUL
    ]
    if (held := vessel.brimful_volume()) is not None:
        apart = (held - outline.capacity) / float(np.hypot(outline.capacity_deviation, 1e-6 + 0.003 * held))
        if abs(apart) > DOUBTFUL:
            doubts.append(
                f"brimful it held {1e6 * held:.0f} mL, and the shape has {1e6 * outline.capacity:.0f} ± "
                f"{1e6 * outline.capacity_deviation:.1f} mL: check the wall's thickness and the scale"
            )
    return doubts


def _unit(text: str | None) -> LengthUnit | None:
    if text not in (None, "m", "cm", "mm", "in"):
        raise RefusalError(f"--unit {text!r}: should be m, cm, mm or in")
    return cast("LengthUnit | None", text)


def _axis(text: str) -> Axis:
    if text not in ("x", "y", "z", "-x", "-y", "-z"):
        raise RefusalError(f"--up {text!r}: should be x, y or z, or one of them with a minus")
    return cast("Axis", text)


def _profile_file(name: str, outline: FittedOutline, used: Sequence[str], doubts: Sequence[str]) -> str:
    shape = outline.shape()
    points = ", ".join(f"[{1e3 * r:.4g}, {1e3 * z:.4g}]" for r, z in shape.inner)
    lines = [
        f"# Measured: {'; '.join(used)}.",
        f"# It holds {1e6 * outline.capacity:.0f} ± {1e6 * outline.capacity_deviation:.1f} mL; its inner radius is "
        f"known to ± {1e3 * outline.radius_deviation:.2f} mm (one standard deviation).",
        *(f"# Doubtful: {doubt}." for doubt in doubts),
        f"name: {json.dumps(name, ensure_ascii=False)}",  # without quotes, YAML reads "12" and "no" as other types
        "profile:",
        "  unit: mm",
        f"  inner: [{points}]",
        f"  wall: {1e3 * shape.wall:.4g} mm",
        f"  floor: {1e3 * shape.floor:.4g} mm",
        f"  height_deviation: {1e3 * shape.height_deviation:.3g} mm",
        "  radius_deviations:",
        *(f"    - [{', '.join(f'{1e3 * x:.3g}' for x in row)}]" for row in shape.radius_deviations),
    ]
    return "\n".join(lines) + "\n"


def _draw_outline(name: str, outline: FittedOutline, evidence: Sequence[Evidence], path: Path) -> Path:
    """The section of a turned vessel with its band, and the radii and levels that were measured."""
    import numpy as np

    from orchestrator.reports import figure_style
    from sim_engine.vessel.profile import outer_profile
    from sim_engine.vessel_acquisition.measurements import FillTable, Radii

    figure, axes = figure_style.new_figure(size=(6.0, 5.0))
    shape = outline.shape()
    inner = np.array(shape.inner)
    outer = outer_profile(inner, shape.wall, shape.floor)
    solid = 1e3 * np.vstack([inner, outer[::-1], [0.0, -shape.floor]])
    for side in (1.0, -1.0):
        axes.fill(side * solid[:, 0], solid[:, 1], color=figure_style.PALE, lw=0, zorder=1)
    z, r, sd = 1e3 * outline.heights, 1e3 * outline.radii, 1e3 * BAND * outline.deviations
    for side in (1.0, -1.0):
        axes.fill_betweenx(
            z, side * (r - sd), side * (r + sd), color=figure_style.PREDICTED, alpha=0.35, lw=0, zorder=2
        )
        axes.plot(side * r, z, color=figure_style.INK, lw=1.6, zorder=3)
    axes.plot([-r[0], r[0]], [0.0, 0.0], color=figure_style.INK, lw=1.6, zorder=3)
    axes.fill([], [], color=figure_style.PREDICTED, alpha=0.35, label=f"± {BAND:g} standard deviations of the radius")
    marks = iter(("o", "s", "^"))
    for piece in evidence:
        if isinstance(piece, Radii):
            axes.plot(
                1e3 * piece.observed,
                1e3 * piece.heights,
                next(marks),
                color=figure_style.MEASURED,
                ms=4 if len(piece.observed) < 15 else 2.5,
                label=piece.name,
                zorder=4,
            )
        elif isinstance(piece, FillTable):
            levels = 1e3 * piece.levels
            axes.plot(
                0.0 * levels, levels, "_", color=figure_style.MEASURED, ms=12, label=f"levels of the {piece.name}"
            )
    title = f"{name}: {1e6 * outline.capacity:.0f} ± {1e6 * outline.capacity_deviation:.1f} mL"
    figure_style.dress(axes, title=title, x="distance from the axis [mm]", y="height above the inner floor [mm]")
    axes.set_aspect("equal")
    axes.margins(0.08)
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False, fontsize=8)
    return figure_style.save(figure, path)


# -- meshes ------------------------------------------------------------------------------------------------------------


def _written_mesh(
    out: Path,
    vessel: Vessel,
    vertices: Any,
    faces: Any,
    notes: list[str],
    doubts: Sequence[str] = (),
    *,
    up: Axis = "z",
    given: Path,
) -> Made:
    """Write a mesh in millimetres next to the vessel's file, after checking that it holds liquid.

    The mesh has the name of the vessel's file; if that is the mesh `given`, '-repaired' is added.
    """
    import trimesh

    from orchestrator.reports import figure_style
    from orchestrator.reports.pour_figures import draw_solid
    from sim_engine.scene import MIRRORED_FROM
    from sim_engine.simulator import why_whole
    from sim_engine.vessel.mesh import rim_tilt
    from sim_engine.vessel.mesh_shape import MeshShape
    from sim_engine.vessel.shapes import VesselError, VesselSpec
    from sim_engine.vessel.vessel import build_vessel

    name, path = vessel.name or out.stem, out.with_suffix(".stl")
    if path.exists() and path.samefile(given):
        path = out.with_name(f"{out.stem}-repaired.stl")
    if path.exists():
        raise RefusalError(
            f"{path}: exists already, and the repaired mesh would be written there; name {out} otherwise"
        )
    trimesh.Trimesh(1e3 * vertices, faces, process=False).export(path)
    try:
        built = build_vessel(VesselSpec(name=name, shape=MeshShape(path=path, unit="mm", up=up)))
    except VesselError as error:
        path.unlink()
        raise VesselError(str(error).replace(path.name, given.name)) from None
    doubts = list(doubts)
    if (tilt := math.degrees(rim_tilt(built))) > LEVEL:
        doubts.append(
            f"its rim is {tilt:.1f}° off level, and the capacity is that to its lowest point: turn the mesh so that "
            "the vessel stands upright"
        )
    if why := why_whole(built, built.capacity, MIRRORED_FROM):
        notes.append(why)
    held, deviation = vessel.brimful_volume(), 0.01 * built.capacity
    if held is not None and abs(held - built.capacity) > DOUBTFUL * deviation:
        doubts.append(
            f"brimful it held {1e6 * held:.0f} mL, and the mesh has {1e6 * built.capacity:.0f} "
            "mL: check its unit, and whether its inside was seen"
        )
    picture = figure_style.save(draw_solid(name, built), out.with_suffix(".png"))
    lines = [f"# {note}." for note in (*notes, *doubts)]
    lines += [f"name: {json.dumps(name, ensure_ascii=False)}", f"mesh: {path.name}", "unit: mm", f"up: {up}"]
    out.write_text("\n".join(lines) + "\n")
    return Made(built.capacity, deviation, picture, notes, doubts)


def _draw_missing(name: str, error: MissingWallError, path: Path) -> Path:
    """The wall unrolled: corners that are there, and the boundaries of the holes."""
    import numpy as np

    from orchestrator.reports import figure_style

    middle = 0.5 * (error.corners.min(axis=0) + error.corners.max(axis=0))[:2]
    bottom = float(error.corners[:, 2].min())

    def unrolled(points: Any) -> tuple[Any, Any]:
        around = np.degrees(np.arctan2(points[:, 1] - middle[1], points[:, 0] - middle[0])) % 360.0
        return around, 1e3 * (points[:, 2] - bottom)

    figure, axes = figure_style.new_figure(size=(6.0, 4.0))
    axes.plot(*unrolled(error.corners), ".", color=figure_style.INK, ms=2, label="corners of the mesh")
    for k, hole in enumerate(error.holes):
        label = "edge of what is missing" if k == 0 else None
        axes.plot(*unrolled(hole), "o", color=figure_style.MEASURED, ms=4, label=label)
    figure_style.dress(axes, title=f"{name}: wall, unrolled", x="angle around the axis [deg]", y="height [mm]")
    axes.legend(loc="upper center", bbox_to_anchor=(0.5, -0.14), ncols=2, frameon=False, fontsize=8)
    return figure_style.save(figure, path)


def register(app: typer.Typer) -> None:
    """Add the commands, if the fits are installed."""
    if find_spec("sim_engine.vessel_acquisition") is None:
        return
    add = add_group(
        app,
        "vessel",
        "Make a vessel file from measurements; one command for each kind of source. It states its uncertainty.",
        "decant vessel profile cup.yaml --height '95 mm' --diameters '5 mm: 60 mm, 95 mm: 72 mm' --wall '3 mm'",
        "decant vessel mesh scan.stl mug.yaml --unit mm",
        quiet=True,
    )
    add(
        profile,
        "decant vessel profile cup.yaml --height '95 mm' --diameters '5 mm: 60 mm, 95 mm: 72 mm' --wall '3 mm'",
        "decant vessel profile cup.yaml --height '95 mm' --fill fill.csv --tare '104 g' --wall '3 mm'",
    )
    add(
        mesh,
        "decant vessel mesh scan.stl mug.yaml --unit mm --wall '3 mm'",
        "decant vessel mesh cup.stl cup.yaml --drop-bodies --brimful '322 g'",
    )
