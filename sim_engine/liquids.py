"""Liquids, and the parameters of the simulator.

- `Liquid` is a load of liquid in SI units; `LiquidSettings` describe it in files.
- `SimulationParameters` are the parameters that calibration may change: θ_s, and nuisances of the bench.
- `look_up` returns density, viscosity and surface tension of common laboratory liquids by name and temperature, from
  published data.

Names: water, ethanol, isopropanol, rapeseed oil, 'ethanol 70 %', 'glycerol 80 %' and 'sugar syrup 60 %' (percent by
mass). If a value is uncertain by more than a few percent, `Source` states it. Tensions of solutions are less accurate
than their viscosities and less important. Contact angles depend on the vessel more than on the liquid, and are not in
the table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable, Collection
from dataclasses import dataclass
from typing import Annotated, Any

from pydantic import BaseModel, ConfigDict, Field

from sim_engine.errors import did_you_mean
from sim_engine.settings.model import Problems, Settings, Text
from sim_engine.settings.quantity import Quantity

LARGEST_RIM_CORRECTION = 1.0

THIN = 5e-6
"""Largest kinematic viscosity at which the solver treats a liquid like water [m²/s]. Its boundary layers √(πνt), a
millimetre or two during a pour, are thinner than half a spacing of a usual simulation."""

NEUTRAL = 0.5 * math.pi
"""Contact angle of a wall that neither attracts nor repels the liquid: the solver's default [rad]."""

FARTHEST_TILT = math.radians(5.0)

SHOWN = {"mm": 1e-3, "deg": math.pi / 180.0}
"""Display units that replace SI units, and their values in SI."""


def _nuisance(unit: str, shown: str, tolerance: float) -> dict[str, Any]:
    """A nuisance's declaration besides default, bounds and meaning; `tolerance` is a standard deviation."""
    return {"unit": unit, "shown": shown, "tolerance": tolerance}


@dataclass(frozen=True)
class ParameterInfo:
    """A simulation parameter for forms, schema and plots (its bounds are those of the model field).

    Attributes:
        unit: SI; '1' for a plain number.
        shown: display unit.
        tolerance: of a bench's nuisance: its standard deviation before any measurement, in SI; 0 for parameters of the
            solver.
        default: in SI.
    """

    name: str
    unit: str
    lower: float
    upper: float
    integer: bool
    meaning: str
    shown: str
    tolerance: float
    default: float

    @property
    def factor(self) -> float:
        """One shown unit in SI."""
        return SHOWN.get(self.shown, 1.0)

    @property
    def example(self) -> str:
        """A valid value as files write it: the default."""
        return f"{self.default / self.factor:g}" + ("" if self.shown == "1" else f" {self.shown}")

    @property
    def quantity(self) -> Quantity:
        """Annotation of a field that holds the parameter."""
        return Quantity(self.unit, self.example, self.lower, self.upper, whole=self.integer)

    @property
    def nuisance(self) -> bool:
        """Whether it describes the difference between bench and command, instead of the solver."""
        return self.tolerance > 0.0


class Liquid(BaseModel):
    """A load of liquid.

    Attributes:
        name: for display.
        mass: loaded mass [kg].
        density: [kg/m³].
        surface_tension: against air [N/m].
        dynamic_viscosity: [Pa s].
        contact_angle: of the liquid on the vessels [rad].

    A liquid above `THIN` is simulated with this viscosity and this tension, and sticks to walls. For a liquid as thin
    as water these values have no effect: θ's `xsph_rate` and `cohesion` are used, and it slips. Together with the
    planned flow they determine the effects that a simulation does not cover, see `sim_engine.model_validity`. The
    defaults are water's at 20 °C.
    """

    model_config = ConfigDict(frozen=True, extra="forbid")

    name: str = "water"
    mass: float = Field(gt=0.0, le=20.0)
    density: float = Field(default=998.0, gt=100.0, lt=20_000.0)
    surface_tension: float = Field(default=0.0728, ge=1e-3, le=1.0)
    dynamic_viscosity: float = Field(default=1.0e-3, ge=1e-5, le=1e3)
    contact_angle: float = Field(default=NEUTRAL, ge=0.0, le=math.pi)

    @property
    def volume(self) -> float:
        """Loaded volume [m³]."""
        return self.mass / self.density

    @property
    def kinematic_viscosity(self) -> float:
        """ν = μ/ρ [m²/s]: water's is 1e-6."""
        return self.dynamic_viscosity / self.density

    @property
    def is_thick(self) -> bool:
        """Whether its viscosity is simulated in SI."""
        return self.kinematic_viscosity > THIN

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request of this liquid: a simulation of a thin liquid does not use them."""
        free = set() if self.is_thick else {"surface_tension", "dynamic_viscosity"}
        return frozenset(free | ({"contact_angle"} if self.contact_angle == NEUTRAL else set()))

    def millilitres(self, mass: float) -> float:
        """Volume of a part of it [mL]; mass in [kg]."""
        return 1e6 * mass / self.density


class SimulationParameters(BaseModel):
    """Parameters that calibration may change: θ_s and nuisances of the bench.

    Names follow FleX if it has one; the meanings are Decant's.

    Nuisances describe constant differences of a bench from the commanded pour: the receiver's position, the grip of the
    pourer, the speed of the arm. The simulator applies them in one place (`PourTask.placement`).
    """

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True)

    particles: int = Field(default=2_000, ge=200, le=50_000)
    """Number of particles at fixed liquid volume; sets the spacing d = (V/N)^(1/3)."""

    cohesion: float = Field(default=0.02, ge=0.0, le=0.2, json_schema_extra={"unit": "N/m"})
    """Surface tension [N/m], the same at any spacing: drops oscillate at Rayleigh's frequency. If the spacing exceeds
    about one capillary length (2.7 mm for water), it only affects drips."""

    xsph_rate: float = Field(default=3.0, ge=0.0, le=60.0, json_schema_extra={"unit": "1/s"})
    """Rate at which a particle's velocity relaxes to its neighbours' mean (XSPH) [1/s], independent of the time step.
    For liquids as thin as water."""

    viscosity_factor: float = Field(default=1.0, ge=0.1, le=10.0, json_schema_extra={"unit": "1"})
    """True viscosity divided by that of the scene's liquid, for liquids above 5 mm²/s. A degree of temperature changes
    it by 2 to 9 %, a point of water in glycerol by 10 %."""

    smagorinsky_constant: float = Field(default=0.17, ge=0.0, le=0.3, json_schema_extra={"unit": "1"})
    """Smagorinsky's constant C: motion finer than a spacing has the viscosity (C d)² |S|. The value 0.17 follows from
    theory, and keeps streams of few particles as narrow as those of many. At 0 shear makes particles climb over each
    other and widens the stream, as in solvers without such a viscosity."""

    friction: float = Field(default=0.0, ge=0.0, le=1.0, json_schema_extra={"unit": "1"})
    """Coulomb coefficient between particles and vessel walls. Water slips along cups: 0.05 already delays the standard
    pour by more than the differences between other solvers."""

    wall_distance: float = Field(default=0.5, ge=0.3, le=1.5, json_schema_extra={"unit": "1"})
    """Distance from a wall at which particles come to rest, in spacings (FleX: collision distance). At 0.5 a vessel
    holds its true volume; a larger value narrows vessels and raises lips, as walls made of particles do."""

    rim_correction: float = Field(default=0.5, ge=0.0, le=LARGEST_RIM_CORRECTION, json_schema_extra={"unit": "1"})
    """Rims are lower by so many spacings for particles at rest, by less for faster particles, and not at all above the
    speed √(g d). A layer of particles cannot be thinner than a spacing: at 0.5 its middle passes a lip with the head
    that a true film needs. At 0 a lip holds back more, as in solvers that do not correct their lips."""

    receiver_x: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.005))
    """Displacement of the receiver away from the pourer."""

    receiver_y: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.003))
    """Sideways displacement of the receiver."""

    receiver_z: float = Field(default=0.0, ge=-0.03, le=0.03, json_schema_extra=_nuisance("m", "mm", 0.003))
    """Upward displacement of the receiver: the liquid falls less far."""

    tilt_zero: float = Field(
        default=0.0, ge=-FARTHEST_TILT, le=FARTHEST_TILT, json_schema_extra=_nuisance("rad", "deg", math.radians(0.7))
    )
    """Additional tilt of the pourer beyond the command."""

    speed_factor: float = Field(default=1.0, ge=0.8, le=1.25, json_schema_extra=_nuisance("1", "1", 0.02))
    """Executed over commanded angular velocity."""

    lip_adhesion: float = Field(default=0.0, ge=0.0, le=5.0, json_schema_extra={"unit": "1"})
    """Adhesion of the film at the lip: below the Weber number lip_adhesion · (1 + cos of the contact angle) it runs
    down the outside of the pourer (teapot effect). 1 for a sharp edge at a right angle, more for round edges; 0: no
    liquid dribbles."""

    @classmethod
    def info(cls) -> dict[str, ParameterInfo]:
        """Name, unit, bounds and meaning of every parameter."""
        table = {}
        for name, field in cls.model_fields.items():
            lower = next(m.ge for m in field.metadata if hasattr(m, "ge"))
            upper = next(m.le for m in field.metadata if hasattr(m, "le"))
            extra: dict[str, Any] = field.json_schema_extra if isinstance(field.json_schema_extra, dict) else {}
            unit = str(extra.get("unit", "1"))
            table[name] = ParameterInfo(
                name,
                unit,
                float(lower),
                float(upper),
                field.annotation is int,
                field.description or "",
                str(extra.get("shown", unit)),
                float(extra.get("tolerance", 0.0)),
                field.default,
            )
        return table

    def free_fields(self) -> frozenset[str]:
        """Fields that do not affect any request: an adhesion of zero, which runs of earlier versions lack."""
        return frozenset({"lip_adhesion"} if self.lip_adhesion == 0.0 else ())

    def fixed_values(self, searched: Collection[str]) -> dict[str, float]:
        """Values by name of the parameters that a calibration does not search, without `free_fields`.

        Args:
            searched: names of parameters.
        """
        omitted = self.free_fields().union(searched)
        return {name: float(value) for name, value in self.model_dump().items() if name not in omitted}

    @classmethod
    def nuisances(cls) -> dict[str, ParameterInfo]:
        """The parameters of the bench."""
        return {name: info for name, info in cls.info().items() if info.nuisance}

    def of_the_solver(self) -> dict[str, float]:
        """Values of the solver's parameters, without those of the bench."""
        return self.model_dump(exclude=set(self.nuisances()))

    @classmethod
    def from_values(cls, values: dict[str, float]) -> SimulationParameters:
        """From a searched point; whole numbers are rounded. Parameters not named keep their defaults."""
        rounded = {k: round(v) if cls.model_fields[k].annotation is int else v for k, v in values.items()}
        return cls.model_validate(rounded)


ROOM = 20.0
"""Default temperature [°C]."""


@dataclass(frozen=True)
class Properties:
    """Properties of a liquid at a temperature.

    Attributes:
        density: [kg/m³].
        dynamic_viscosity: [Pa s].
        surface_tension: against air [N/m].
    """

    density: float
    dynamic_viscosity: float
    surface_tension: float


@dataclass(frozen=True)
class KnownLiquid:
    """A row of the table.

    Attributes:
        name: without the share.
        share: smallest and largest percent by mass; None if it is not a solution.
        temperatures: range of the data [°C].
        uncertainty: relative standard deviation of the viscosity, from the data and from one degree of temperature.
        source: of the data.
        at: properties at a temperature [°C] and a share [%].
    """

    name: str
    share: tuple[float, float] | None
    temperatures: tuple[float, float]
    uncertainty: float
    source: str
    at: Callable[[float, float], Properties]


def _between(x: float, table: tuple[tuple[float, float], ...]) -> float:
    """Linear between a table's points, and beyond its ends."""
    k = max(i for i in range(len(table) - 1) if i == 0 or x >= table[i][0])
    (x0, y0), (x1, y1) = table[k], table[k + 1]
    return y0 + (y1 - y0) * (x - x0) / (x1 - x0)


def _arrhenius(t: float, table: tuple[tuple[float, float], ...]) -> float:
    """Parabola of the logarithm in 1/T through the three nearest points (Lagrange)."""
    near = sorted(sorted(table, key=lambda point: abs(point[0] - t))[:3])
    x = 1.0 / (t + 273.15)
    places = [1.0 / (point[0] + 273.15) for point in near]
    total = 0.0
    for i, (_, value) in enumerate(near):
        weight = math.prod((x - places[j]) / (places[i] - places[j]) for j in range(3) if j != i)
        total += weight * math.log(value)
    return math.exp(total)


def _water(t: float, _: float) -> Properties:
    density = 999.97 * (1.0 - (t + 288.9414) * (t - 3.9863) ** 2 / (508929.2 * (t + 68.12963)))
    viscosity = 2.414e-5 * 10.0 ** (247.8 / (t + 133.15))
    tau = 1.0 - (t + 273.15) / 647.096
    return Properties(density, viscosity, 0.2358 * tau**1.256 * (1.0 - 0.625 * tau))


ETHANOL = ((0.0, 1.786e-3), (25.0, 1.074e-3), (50.0, 0.694e-3), (75.0, 0.476e-3))
ISOPROPANOL = ((0.0, 4.619e-3), (25.0, 2.038e-3), (50.0, 1.028e-3), (75.0, 0.576e-3))


def _ethanol(t: float, _: float) -> Properties:
    return Properties(789.3 - 0.85 * (t - 20.0), _arrhenius(t, ETHANOL), 1e-3 * (24.05 - 0.0832 * t))


# percent by mass; density [kg/m³] and tension [mN/m] at 20 °C; viscosity [mPa s] at 10, 20, 30 and 40 °C
SPIRIT = (
    (0.0, 998.2, 72.75, 1.308, 1.005, 0.801, 0.656), (10.0, 981.9, 48.14, 2.179, 1.538, 1.160, 0.907),
    (20.0, 968.6, 38.56, 3.165, 2.183, 1.553, 1.160), (30.0, 953.8, 33.53, 4.05, 2.71, 1.87, 1.368),
    (40.0, 935.2, 30.69, 4.39, 2.91, 2.02, 1.482), (50.0, 913.8, 28.51, 4.18, 2.87, 2.02, 1.499),
    (60.0, 891.1, 26.72, 3.77, 2.67, 1.93, 1.447), (70.0, 867.7, 25.48, 3.268, 2.370, 1.767, 1.344),
    (80.0, 843.4, 24.32, 2.710, 2.008, 1.531, 1.203), (90.0, 818.0, 23.23, 2.101, 1.610, 1.279, 1.035),
    (100.0, 789.3, 22.31, 1.466, 1.200, 1.003, 0.834),
)  # fmt: skip


def _spirit(t: float, percent: float) -> Properties:
    density, tension, *viscosities = (
        _between(percent, tuple((row[0], row[k]) for row in SPIRIT)) for k in range(1, len(SPIRIT[0]))
    )
    slope = _between(percent, ((0.0, -0.21), (20.0, -0.45), (40.0, -0.74), (60.0, -0.84), (100.0, -0.85)))
    viscosity = 1e-3 * _arrhenius(t, tuple(zip((10.0, 20.0, 30.0, 40.0), viscosities, strict=True)))
    return Properties(density + slope * (t - 20.0), viscosity, 1e-3 * (tension - 0.11 * (t - 20.0)))


def _isopropanol(t: float, _: float) -> Properties:
    return Properties(785.5 - 0.82 * (t - 20.0), _arrhenius(t, ISOPROPANOL), 1e-3 * (22.90 - 0.0789 * t))


def _glycerol(t: float, percent: float) -> Properties:
    c = percent / 100.0
    water = 1.790e-3 * math.exp((-1230.0 - t) * t / (36100.0 + 360.0 * t))
    pure = 12.1 * math.exp((-1233.0 + t) * t / (9900.0 + 70.0 * t))
    a = 0.705 - 0.0017 * t
    b = (4.9 + 0.036 * t) * a**2.5
    alpha = 1.0 - c + a * b * c * (1.0 - c) / (a * c + b * (1.0 - c))
    density = (1277.0 - 0.654 * t) * c + 1000.0 * (1.0 - abs((t - 4.0) / 622.0) ** 1.7) * (1.0 - c)
    tension = c * 0.0634 + (1.0 - c) * _water(t, 0.0).surface_tension
    return Properties(density, water**alpha * pure ** (1.0 - alpha), tension)


SUCROSE = ((0.0, 998.2), (20.0, 1081.0), (40.0, 1176.4), (50.0, 1229.6), (60.0, 1286.5), (70.0, 1347.2), (80.0, 1411.7))


def _syrup(t: float, percent: float) -> Properties:
    x = percent / (1900.0 - 18.0 * percent)
    logarithm = 22.46 * x - 0.114 + (30.0 - t) / (91.0 + t) * (1.1 + 43.1 * x**1.25)
    density = _between(percent, SUCROSE) - 0.45 * (t - 20.0)
    return Properties(density, 1e-3 * 10.0**logarithm, 0.0728 + 5e-5 * percent)


RAPESEED = ((35.0, 42.49e-3), (50.0, 25.79e-3), (65.0, 17.21e-3), (80.0, 12.14e-3))


def _rapeseed(t: float, _: float) -> Properties:
    return Properties(915.0 - 0.65 * (t - 20.0), _arrhenius(t, RAPESEED), 1e-3 * (33.5 - 0.07 * (t - 20.0)))


_JASPER = "Jasper 1972 (J. Phys. Chem. Ref. Data 1, 841)"
_OIL = (
    "viscosity: Fasina and Colley 2008 (Int. J. Food Prop. 11, 738) from 35 °C on, below it their curve continued; "
    "density and tension: typical values, Gunstone 2011 (Vegetable Oils in Food Technology)"
)

KNOWN: tuple[KnownLiquid, ...] = (
    KnownLiquid(
        "water",
        None,
        (0.0, 95.0),
        0.03,
        "density: Tanaka et al. 2001 (Metrologia 38, 301); viscosity: 2.414e-5 · 10^(247.8/(T − 140)) Pa s within "
        "2.5 % (Al-Shemmeri 2012); tension: IAPWS R1-76 (2014)",
        _water,
    ),
    KnownLiquid(
        "ethanol",
        None,
        (0.0, 75.0),
        0.03,
        f"density, viscosity: CRC Handbook of Chemistry and Physics; tension: {_JASPER}",
        _ethanol,
    ),
    KnownLiquid(
        "ethanol",
        (0.0, 100.0),
        (10.0, 40.0),
        0.05,
        "in water, percent by mass ('70 %' by volume are 62.4 % by mass); density: OIML R 22; viscosity: Bingham and "
        "Jackson 1918 (Bull. Bur. Stand. 14, 59); tension: Vázquez et al. 1995 (J. Chem. Eng. Data 40, 611)",
        _spirit,
    ),
    KnownLiquid(
        "isopropanol",
        None,
        (0.0, 75.0),
        0.04,
        f"density, viscosity: CRC Handbook of Chemistry and Physics; tension: {_JASPER}",
        _isopropanol,
    ),
    KnownLiquid(
        "glycerol",
        (0.0, 100.0),
        (0.0, 100.0),
        0.10,
        "density, viscosity: Cheng 2008 (Ind. Eng. Chem. Res. 47, 3285); tension: between water's and 63.4 mN/m, "
        "linear in mass",
        _glycerol,
    ),
    KnownLiquid("rapeseed oil", None, (10.0, 80.0), 0.15, _OIL, _rapeseed),
    KnownLiquid(
        "sugar syrup",
        (0.0, 78.0),
        (0.0, 80.0),
        0.15,
        "sucrose in water; viscosity: Génotelle 1978 (Ind. Alim. Agric. 95, 747); density at 20 °C: NBS Circular C440, "
        "its slope with temperature: typical; tension: typical",
        _syrup,
    ),
)

_SHARE = re.compile(r"^(?P<name>.*?)\s+(?P<share>\d+(?:\.\d+)?)\s*%$")


def split_share(name: str) -> tuple[str, float | None]:
    """'glycerol 80 %' → ('glycerol', 80.0); the share [%] is None if the name has none."""
    match = _SHARE.match(name.strip())
    return (match["name"], float(match["share"])) if match else (name.strip(), None)


def find(name: str) -> tuple[KnownLiquid, float] | None:
    """The table's liquid of a name and the share in it [%]; None if the name is unknown.

    Raises:
        ValueError: a solution without a share, or with one outside the data.
    """
    plain, share = split_share(name)
    for liquid in sorted(KNOWN, key=lambda known: (known.share is None) != (share is None)):
        if liquid.name == plain.lower():
            if liquid.share is None:
                return (liquid, 0.0) if share is None else None  # its solutions have other properties
            if share is None:
                raise ValueError(f"how much {liquid.name}? Write for example '{liquid.name} 60 %' (by mass)")
            if not liquid.share[0] <= share <= liquid.share[1]:
                raise ValueError(f"{liquid.name} is known from {liquid.share[0]:g} to {liquid.share[1]:g} %")
            return liquid, share
    return None


def look_up(name: str, temperature: float = ROOM) -> Properties | None:
    """Properties of a liquid by its name.

    Args:
        name: 'ethanol', 'glycerol 80 %', …
        temperature: [°C].

    Returns:
        None if the table has no such liquid.

    Raises:
        ValueError: a share or a temperature outside the data; the text gives the valid range.
    """
    known = find(name)
    if known is None:
        return None
    liquid, share = known
    low, high = liquid.temperatures
    if not low <= temperature <= high:
        raise ValueError(f"{liquid.name} is known from {low:g} to {high:g} °C, not at {temperature:g} °C")
    return liquid.at(temperature, share)


PLAIN_WATER = Properties(density=998.0, dynamic_viscosity=1.0e-3, surface_tension=0.0728)
"""Properties of water without a temperature; its surface tension is also the default of liquids outside the table."""


class LiquidSettings(Settings):
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
    parameter `xsph_rate`."""

    contact_angle: Annotated[float, Quantity("rad", "40 deg", lower=0.0, upper=math.pi)] = NEUTRAL
    """Contact angle on the vessels' walls. It agrees with theory if particles are finer than the capillary length (1.9
    mm for oil, 2.7 mm for water). At the usual particle spacing it has an effect, which is not validated."""

    def check_values(self, problems: Problems) -> None:
        """Check that the load is given once, and that the liquid's properties are known."""
        if self.mass is not None and self.volume is not None:
            problems.add("the load has a mass already; keep one of 'mass' and 'volume'", "volume", key=True)
        elif self.mass is None and self.volume is None and problems.valid("mass", "volume"):
            problems.add("key 'mass' is missing; add for example 'mass: 200 g', or 'volume: 200 mL'", key=True)
        try:
            known = find(self.name) is not None
        except ValueError as error:
            problems.add(str(error), "name")
            return
        missing = [key for key in ("density", "viscosity") if self.value(key) is None]
        if known:
            try:
                look_up(self.name, ROOM if self.temperature is None else self.temperature)
            except ValueError as error:
                problems.add(str(error), "temperature")
        elif missing and problems.valid(*missing):
            wanted = " and ".join(f"'{key}'" for key in missing)
            problems.add(f"{_not_in_table(self.name)} To pour it, give its {wanted} as well", "name")
        elif not missing and self.temperature is not None:
            problems.add(f"has no effect: {_not_in_table(self.name)} Remove the temperature", "temperature")

    def load(self) -> Liquid:
        """The liquid, with the table's values of properties that are not given."""
        plain = self.name == "water" and self.temperature is None
        known = None if plain else look_up(self.name, ROOM if self.temperature is None else self.temperature)
        known = known or PLAIN_WATER
        density = known.density if self.density is None else self.density
        return Liquid(
            name=self.name,
            mass=(self.volume or 0.0) * density if self.mass is None else self.mass,
            density=density,
            surface_tension=known.surface_tension if self.surface_tension is None else self.surface_tension,
            dynamic_viscosity=known.dynamic_viscosity if self.viscosity is None else self.viscosity,
            contact_angle=self.contact_angle,
        )


def _not_in_table(name: str) -> str:
    plain, share = split_share(name)
    meant = did_you_mean(plain, [liquid.name for liquid in KNOWN])
    if meant is not None:
        solution = next(liquid.share for liquid in KNOWN if liquid.name == meant) is not None
        guess = f" Did you mean '{meant}{f' {60.0 if share is None else share:g} %' if solution else ''}'?"
    else:
        guess = ""
    names = ", ".join(f"'{liquid.name}{' 60 %' if liquid.share else ''}'" for liquid in KNOWN)
    return f"'{name}' is not in the table of liquids.{guess} The table has {names}."
