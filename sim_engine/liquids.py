"""Liquids that laboratories pour, by name and temperature: density, viscosity, surface tension, from published data.

Names: water, ethanol, isopropanol, rapeseed oil, 'glycerol 80 %' and 'sugar syrup 60 %' (percent by
mass). What is not known to a few percent says so in `Source`. Tensions of solutions are rougher than their viscosities
and matter less; contact angles depend on the vessel more than on the liquid, and are not in the table.
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass

ROOM = 20.0
"""Temperature unless one is given [°C]."""


@dataclass(frozen=True)
class Properties:
    """What a liquid is like at a temperature.

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
        share: smallest and largest percent by mass; None: it is not a solution.
        temperatures: for which the data are good [°C].
        uncertainty: of the viscosity, a standard deviation over it: data, and a degree of temperature.
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
    """The logarithm's parabola in 1/T through the three points that are nearest (Lagrange)."""
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
    """The table's liquid of a name and the share in it [%]; None if there is none of that name.

    Raises:
        ValueError: it is a solution and says no share, or one that is outside the data.
    """
    plain, share = split_share(name)
    for liquid in KNOWN:
        if liquid.name == plain.lower():
            if liquid.share is None:
                if share is None:
                    return liquid, 0.0
                raise ValueError(f"{liquid.name} is not a solution: write '{liquid.name}'")
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
        ValueError: a share or a temperature outside the data, with what would be right.
    """
    found = find(name)
    if found is None:
        return None
    liquid, share = found
    low, high = liquid.temperatures
    if not low <= temperature <= high:
        raise ValueError(f"{liquid.name} is known from {low:g} to {high:g} °C, not at {temperature:g} °C")
    return liquid.at(temperature, share)
