"""Units that balances print, in kilograms."""

from __future__ import annotations

KILOGRAMS = {
    "kg": 1.0,
    "g": 1e-3,
    "mg": 1e-6,
    "ug": 1e-9,
    "ct": 2e-4,
    "lb": 0.45359237,
    "oz": 0.028349523125,
    "ozt": 0.0311034768,
    "dwt": 0.00155517384,
    "gn": 6.479891e-5,
}
"""Mass of one unit [kg], by its name in lower case: pounds and ounces avoirdupois, `ozt` the troy ounce, `gn` the
grain, `dwt` the pennyweight, `ct` the metric carat. Exact by definition. No tonne: a
damaged `ct` must not become one."""


def kilograms(unit: str) -> float | None:
    """Mass of one unit [kg]; None where it is not a mass (pcs, %), or no single one (taels differ between cities).

    Args:
        unit: as a balance prints it, in any case.
    """
    return KILOGRAMS.get(unit.lower().replace("µ", "u"))
