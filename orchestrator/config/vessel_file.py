"""File sections of vessels and liquids, and their conversion."""

from __future__ import annotations

import inspect
import math
from typing import Annotated, Any, ClassVar, Literal

from pydantic import Field, create_model

from orchestrator.config.yaml.file_access import missing_file, resolved
from orchestrator.config.yaml.yaml_source import Place, Report
from sim_engine.errors import did_you_mean
from sim_engine.liquids import KNOWN, NEUTRAL, ROOM, Liquid, Properties, find, look_up, split_share
from sim_engine.settings.model import MADE, FilePath, Name, Number, Settings, Text
from sim_engine.settings.quantity import Quantity, parse_quantity
from sim_engine.vessel.shapes import VESSELS, LengthUnit, MeshShape, ProfileShape, Shape, VesselSpec

MESH_SUFFIXES = (".stl", ".obj", ".ply", ".glb")

Thickness = Annotated[float, Quantity("m", "4 mm", lower=2e-4, upper=0.1)]

Point = Annotated[tuple[Number, Number], Field(description="[r, z]")]


class ProfileSection(Settings):
    """A surface of revolution."""

    required: ClassVar[dict[str, str]] = {
        "unit": "mm",
        "inner": "[[0, 0], [40, 0], [40, 100]]",
        "wall": "4 mm",
        "floor": "4 mm",
    }

    unit: LengthUnit | None = None
    """Unit of the numbers in `inner`."""

    inner: tuple[Point, ...] | None = None
    """The inner surface as [r, z] points, from the axis at the inner floor to the rim."""

    wall: Thickness | None = None
    """Thickness of the wall, outwards."""

    floor: Thickness | None = None
    """Thickness of the floor, downwards."""

    radius_deviations: tuple[tuple[Number, ...], ...] | None = None
    """Uncertainty of the shape: a row for each independent deviation, with the outward displacement of each point of
    `inner` at one standard deviation. Predictions of spillage use shapes drawn from it."""

    height_deviation: Annotated[float, Quantity("m", "0.3 mm", lower=0.0, upper=0.02)] | None = None
    """Uncertainty of the rim's height, one standard deviation; all points move in proportion."""


class VesselBase(Settings):
    """A vessel: a profile of [r, z] points, a mesh of its solid, or a source that an installed package adds."""

    required: ClassVar[dict[str, str]] = {"name": "beaker"}

    name: Name | None = None
    """Its name in figures and journals."""

    profile: ProfileSection | None = None
    """A surface of revolution; or give `mesh`."""

    mesh: FilePath | None = None
    """A closed mesh of the vessel's solid: path of an STL, OBJ, PLY or GLB file; or give `profile`."""

    unit: LengthUnit | None = None
    """Unit of the mesh's coordinates."""

    up: Literal["x", "y", "z", "-x", "-y", "-z"] | None = None
    """Axis of the mesh that points out of the opening; z unless given."""


def further_sources() -> dict[str, type[Settings]]:
    """Sources of vessels that packages add, by their keys in a vessel's file."""
    own = VesselBase.model_fields.keys()
    return {kind: shape for kind, shape in VESSELS.all.items() if kind not in own and issubclass(shape, Settings)}


def _vessel_file() -> type[VesselBase]:
    """The section with one key per source of vessels."""
    fields: Any = {
        kind: (shape | None, Field(default=None, description=inspect.getdoc(shape)))
        for kind, shape in further_sources().items()
    }
    model: type[VesselBase] = create_model(
        "VesselFile", __base__=VesselBase, __doc__=VesselBase.__doc__, __cls_kwargs__=MADE, **fields
    )
    return model


VesselFile: Any = _vessel_file()


class LiquidFile(Settings):
    """The liquid, given by its name if it is in the [table](liquids.md#the-table), or by its properties."""

    name: Text = "water"
    """A name in the table: 'ethanol', 'glycerol 80 %', 'sugar syrup 60 %', 'rapeseed oil' … Any other name needs
    `density` and `viscosity` as well."""

    temperature: Annotated[float, Quantity("degC", "20 degC", lower=0.0, upper=100.0)] | None = None
    """Temperature at which the table is read; 20 °C unless given."""

    mass: Annotated[float, Quantity("kg", "200 g", lower=1e-4, upper=20.0)] | None = None
    """Mass that is loaded into the pourer; or give `volume`."""

    volume: Annotated[float, Quantity("m^3", "200 mL", lower=1e-7, upper=0.02)] | None = None
    """Volume that is loaded, from which the mass follows; or give `mass`, which is more accurate with a balance."""

    density: Annotated[float, Quantity("kg/m^3", "998 kg/m^3", lower=101.0, upper=19_999.0)] | None = None
    """Density; the table's unless given. Required for a liquid that is not in the table."""

    surface_tension: Annotated[float, Quantity("N/m", "72.8 mN/m", lower=1e-3, upper=1.0)] | None = None
    """Surface tension against air; the table's unless given, water's 72.8 mN/m for a liquid that is not in the table.
    Liquids above 5 mm²/s are simulated with it; for thinner ones set the simulation parameter `cohesion`."""

    viscosity: Annotated[float, Quantity("Pa*s", "1 mPa*s", lower=1e-5, upper=1e3)] | None = None
    """Dynamic viscosity; the table's unless given. Required for a liquid that is not in the table. Above 5 mm²/s
    (viscosity over density) it is simulated, and the liquid sticks to walls; for thinner ones set the simulation
    parameter `viscosity`."""

    contact_angle: Annotated[float, Quantity("rad", "40 deg", lower=0.0, upper=math.pi)] = NEUTRAL
    """Contact angle on the vessels' walls. It agrees with theory if particles are finer than the capillary length (1.9
    mm for oil, 2.7 mm for water). At the usual particle spacing it has an effect, which is not validated."""


def resolve_vessel(section: VesselBase, place: Place, report: Report) -> VesselSpec | None:
    """The vessel of a file; None after a problem, which is added to the report."""
    before = len(report.problems)
    shape: Shape | None = None
    kinds = ("profile", "mesh", *further_sources())
    given = [key for key in kinds if section.value(key) is not None]
    if len(given) > 1:
        first = given[0]
        text = f"the vessel has a {first} already; keep one of '{first}' and '{given[1]}'"
        report.add(place.at(given[1]), text, key=True)
    elif section.profile is not None:
        for key in ("unit", "up"):
            if section.value(key) is not None:
                report.add(place.at(key), "belongs to a mesh; a profile has its own 'unit' inside", key=True)
        shape = _profile(section.profile, place.at("profile"), report)
    elif section.mesh is not None:
        shape = _mesh(section, place, report)
    elif given:
        shape = section.value(given[0])
    elif not any(report.is_broken(place.at(key)) for key in kinds):
        others = "".join(f", or '{key}:'" for key in kinds[2:])
        text = f"has no shape; add 'profile:' with [r, z] points, or 'mesh:' with the path of a file{others}"
        report.add(place, text)
    if shape is None or section.name is None or len(report.problems) > before:
        return None
    return VesselSpec(name=section.name, shape=shape)


def _profile(section: ProfileSection, place: Place, report: Report) -> ProfileShape | None:
    if section.unit is None or section.inner is None or section.wall is None or section.floor is None:
        return None
    points = tuple(
        (parse_quantity(f"{r} {section.unit}", "m", "40 mm"), parse_quantity(f"{z} {section.unit}", "m", "40 mm"))
        for r, z in section.inner
    )
    inner = place.at("inner")
    before = len(report.problems)
    if len(points) < 2:
        report.add(inner, "needs at least two [r, z] points: from the axis at the floor to the rim")
        return None
    if points[0] != (0.0, 0.0):
        report.add(inner.at(0), "the first point is the inner floor on the axis and should be [0, 0]")
    for i, (r, _) in enumerate(points):
        if i > 0 and r <= 0.0:
            report.add(
                inner.at(i), f"r = {section.inner[i][0]:g} should be above 0; only the first point is on the axis"
            )
        if i > 0 and points[i] == points[i - 1]:
            report.add(inner.at(i), "is the same point as the one before; remove it")
    if points[-1][1] <= max(z for _, z in points[:-1]):
        report.add(inner.at(len(points) - 1), "the last point is the rim and should be higher than all others")
    largest = max(max(r, z) for r, z in points)
    if not 0.005 <= largest <= 1.0:
        report.add(
            place.at("unit"),
            f"in {section.unit} the vessel would be {largest * 1e3:g} mm large; vessels are 5 mm … 1 m. Is it right?",
        )
    scale = parse_quantity(f"1 {section.unit}", "m", "1 mm")
    rows = section.radius_deviations or ()
    for i, row in enumerate(rows):
        if len(row) != len(points):
            report.add(
                place.at("radius_deviations").at(i),
                f"has {len(row)} number(s); should have one for each of the {len(points)} points of 'inner'",
            )
    if len(report.problems) > before:
        return None
    return ProfileShape(
        inner=points,
        wall=section.wall,
        floor=section.floor,
        radius_deviations=tuple(tuple(scale * x for x in row) for row in rows),
        height_deviation=section.height_deviation or 0.0,
    )


def _mesh(section: VesselBase, place: Place, report: Report) -> MeshShape | None:
    path = resolved(place.directory / str(section.mesh))
    if path.suffix.lower() not in MESH_SUFFIXES:
        report.add(
            place.at("mesh"), f"{path.suffix or 'a file without suffix'} is not a mesh; use STL, OBJ, PLY or GLB"
        )
        return None
    if (missing := missing_file(path)) is not None:
        report.add(place.at("mesh"), missing)
        return None
    return MeshShape(path=path, unit=section.unit, up=section.up or "z")


def resolve_liquid(section: LiquidFile, place: Place, report: Report) -> Liquid | None:
    """The liquid of a file; None after a problem, which is added to the report."""
    if section.mass is not None and section.volume is not None:
        report.add(place.at("volume"), "the load has a mass already; keep one of 'mass' and 'volume'", key=True)
        return None
    if section.mass is None and section.volume is None:
        if not any(report.is_broken(place.at(key)) for key in ("mass", "volume")):
            text = "key 'mass' is missing; add for example 'mass: 200 g', or 'volume: 200 mL'"
            report.add(place, text, key=True)
        return None
    known = _known(section, place, report)
    if known is None:
        return None
    density = _first(section.density, known.density)
    mass = section.mass
    if mass is None:
        assert section.volume is not None
        mass = section.volume * density
    return Liquid(
        name=section.name,
        mass=mass,
        density=density,
        surface_tension=_first(section.surface_tension, known.surface_tension),
        dynamic_viscosity=_first(section.viscosity, known.dynamic_viscosity),
        contact_angle=section.contact_angle,
    )


def _first(given: float | None, known: float) -> float:
    return known if given is None else given


PLAIN_WATER = Properties(density=998.0, dynamic_viscosity=1.0e-3, surface_tension=0.0728)
"""Properties of water without a temperature; its surface tension is also the default of liquids outside the table."""


def _known(section: LiquidFile, place: Place, report: Report) -> Properties | None:
    """Properties from the table; a liquid that is not in it gives its own density and viscosity."""
    if section.name == "water" and section.temperature is None:
        return PLAIN_WATER
    try:
        in_table = find(section.name) is not None
    except ValueError as problem:
        report.add(place.at("name"), str(problem))
        return None
    if in_table:
        try:
            return look_up(section.name, ROOM if section.temperature is None else section.temperature)
        except ValueError as problem:
            report.add(place.at("temperature"), str(problem))
            return None
    missing = [key for key in ("density", "viscosity") if section.value(key) is None]
    if any(report.is_broken(place.at(key)) for key in missing):
        return None
    if missing:
        wanted = " and ".join(f"'{key}'" for key in missing)
        report.add(place.at("name"), f"{_not_in_table(section.name)} To pour it, give its {wanted} as well")
        return None
    if section.temperature is not None:
        report.add(place.at("temperature"), f"has no effect: {_not_in_table(section.name)} Remove the temperature")
        return None
    return PLAIN_WATER


def _not_in_table(name: str) -> str:
    plain, share = split_share(name)
    meant = did_you_mean(plain, [one.name for one in KNOWN])
    if meant is not None:
        solution = next(one.share for one in KNOWN if one.name == meant) is not None
        guess = f" Did you mean '{meant}{f' {60.0 if share is None else share:g} %' if solution else ''}'?"
    else:
        guess = ""
    names = ", ".join(f"'{one.name}{' 60 %' if one.share else ''}'" for one in KNOWN)
    return f"'{name}' is not in the table of liquids.{guess} The table has {names}."
