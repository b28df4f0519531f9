"""Quantities with units: '15 deg/s' → 0.2618 rad/s.

`parse_quantity` and the pydantic annotation `Quantity` require a unit in files, because confusing degrees with radians
can break equipment. Angle is a separate dimension here: in pint's default registry it is a pure number, so that '15 Hz'
would be accepted as an angular velocity.

`typed_quantity` and `typed_number` read what a person types. They accept decimal commas, and refuse a number with two
meanings: '1,234 g' and '1.234 g' are 1.234 g, or 1234 g where that sign separates thousands. In files, and in requests
of programs, a point is always the decimal sign. `finite_number` takes the numbers that a program passes.
"""

from __future__ import annotations

import math
import re
from dataclasses import dataclass
from decimal import Decimal
from functools import cache
from typing import TYPE_CHECKING, Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler, ValidationInfo
from pydantic_core import CoreSchema, PydanticCustomError, core_schema

from sim_engine.errors import did_you_mean

if TYPE_CHECKING:
    import pint

UNITS = """
micro- = 1e-6 = µ- = u-
milli- = 1e-3 = m-
centi- = 1e-2 = c-
kilo- = 1e3 = k-
mega- = 1e6 = M-
giga- = 1e9 = G-
meter = [length] = m = metre
second = [time] = s = sec
gram = [mass] = g
radian = [angle] = rad
byte = [information] = B
celsius = [celsius] = degC
degree = 0.017453292519943295 * radian = deg = °
revolution = 6.283185307179586 * radian = rev = turn
minute = 60 * second = min
hour = 3600 * second = h
day = 86400 * second
rpm = revolution / minute
hertz = 1 / second = Hz
newton = kilogram * meter / second ** 2 = N
pascal = newton / meter ** 2 = Pa
poise = 0.1 * pascal * second = P
inch = 0.0254 * meter = in
pound = 0.45359237 * kilogram = lb
ounce = pound / 16 = oz
fluid_ounce = 2.95735295625e-5 * meter ** 3 = floz
liter = 1e-3 * meter ** 3 = l = L
percent = 0.01 = %
"""
"""Units of a pouring laboratory; a short list loads in milliseconds and has no unexpected members.

Pound and ounce are avoirdupois, the fluid ounce is that of the United States (NIST Handbook 44, appendix C)."""

_FLUID_OUNCE = re.compile(r"\bfl(?:uid|\.)?\s*(?:ounces?\b|oz\b\.?)")
"""Spellings with a space, which the parser would read as a product."""

FAMILIAR_UNITS = ("mm", "cm", "m", "in", "deg", "rad", "deg/s", "rad/s", "rpm", "deg/s^2", "rad/s^2", "s", "min", "ms",
                  "mL", "fl oz", "g", "kg", "mg", "oz", "lb", "g/s", "kg/m^3", "g/cm^3", "N/m", "mN/m", "Pa*s", "mPa*s",
                  "cP", "1/s", "Hz", "degC", "MB")  # fmt: skip

KINDS = {
    "m": "a length",
    "rad": "an angle",
    "rad/s": "an angular velocity",
    "rad/s^2": "an angular acceleration",
    "s": "a time",
    "kg": "a mass",
    "kg/s": "a mass per time",
    "kg/m^3": "a density",
    "N/m": "a surface tension",
    "Pa*s": "a dynamic viscosity",
    "1/s": "a rate",
    "MB": "an amount of memory",
    "degC": "a temperature in degrees Celsius",
    "1": "a plain number",
    "m/s": "a velocity",
    "m^3": "a volume",
    "m^3/s": "a volume per time",
    "m^2": "an area",
    "N": "a force",
}

LONGEST = 80
"""Longest text of a quantity [characters]: longer texts are not parsed."""

_QUANTITY = re.compile(r"\s*([-+−–]?(?:[0-9][0-9_]*\.?[0-9]*|\.[0-9]+)(?:[eE][-+]?[0-9]+)?)\s*(.*?)\s*\Z", re.DOTALL)

_TERM = r"(?:[^\W\d_]+|[°%]|1)(?:\s*(?:\^|\*\*)\s*-?\d)?"
_UNIT = re.compile(rf"{_TERM}(?:\s*[*/·\s]\s*{_TERM})*")
"""Products of units with exponents of one digit: the parser would evaluate '9**9**9' first."""


LARGEST = {"kg": 20.0, "m": 2.0, "s": 3600.0, "m^3": 0.02}
"""Largest quantity that can be meant at a pouring bench, by its SI unit; no arm of a bench carries a larger mass."""

_POINT = re.compile(r"[-+]?([0-9]+\.?[0-9]*|\.[0-9]+)([eE][-+]?[0-9]+)?")
_COMMA = re.compile(r"[-+]?[0-9]*,[0-9]+([eE][-+]?[0-9]+)?")
_IN_THOUSANDS = {
    ",": re.compile(r"[-+]?[1-9][0-9]{0,2}(,[0-9]{3})+(\.[0-9]*)?"),
    ".": re.compile(r"[-+]?[1-9][0-9]{0,2}(\.[0-9]{3})+(,[0-9]*)?"),
}
_SPACED = re.compile(r"[-+]?[1-9][0-9]{0,2}([ \u00a0\u2009\u202f'’][0-9]{3})+([.,][0-9]*)?")
"""Groups of three digits that a space or an apostrophe separates, as in France and Switzerland."""

_TYPED = re.compile(
    r"\s*([-+−–]?\s*[0-9.,](?:[ \u00a0\u2009\u202f'’]?[0-9.,])*(?:[eE][-+]?[0-9]+)?)\s*(.*?)\s*", re.DOTALL
)


class QuantityError(ValueError):
    """A text is not the required quantity; the message gives a valid example."""


def decimals_of(text: str) -> str:
    """',' or '.': the decimal sign that a number shows; with '?' if it may separate thousands; '' if it has none.

    'spaced' for a number in groups of three digits.
    """
    if _SPACED.fullmatch(text):
        return "spaced"
    for sign, other, pattern in ((",", ".", _COMMA), (".", ",", _POINT)):
        if sign not in text:
            continue
        if _IN_THOUSANDS[sign].fullmatch(text):
            if other in text or text.count(sign) > 1:
                return other  # 1,234.5 and 1,234,567 have decimal points
            return f"{sign}?"
        if pattern.fullmatch(text):
            return sign
    return ""


def plain_number(text: str, *, decimal_comma: bool = False) -> str:
    """A number without separators of thousands, and with a decimal point; '' if the text is not a number.

    Args:
        decimal_comma: whether a comma is the decimal sign; else it separates thousands.
    """
    if _SPACED.fullmatch(text):
        text = re.sub(r"[^-+0-9.,]", "", text).replace(",", ".")
    elif decimal_comma:
        grouped = _IN_THOUSANDS["."].fullmatch(text)
        text = (text.replace(".", "") if grouped else text).replace(",", ".") if "," in text or grouped else text
    elif _IN_THOUSANDS[","].fullmatch(text):
        text = text.replace(",", "")
    return text if _POINT.fullmatch(text) else ""


def number_readings(text: str) -> tuple[str, ...]:
    """The numbers that a text may stand for, with decimal points: none, one, or two (first the one with decimals)."""
    kind = decimals_of(text)
    if kind.endswith("?"):
        return text.replace(kind[0], "."), text.replace(kind[0], "")
    return tuple(filter(None, [plain_number(text, decimal_comma=kind == ",")]))


_SMALLER = {"g": "mg", "kg": "g", "mg": "ug", "m": "mm", "s": "ms", "l": "mL"}
"""Units of a thousandth, of units in small letters."""


def typed_number(text: str, unit: str = "", *, largest: float = math.inf) -> Decimal:
    """The number that a person typed, with its digits.

    Args:
        text: with a decimal point or comma; thousands may be separated.
        unit: as typed, for messages.
        largest: possible magnitude in that unit; a reading beyond it can't be meant.

    Raises:
        QuantityError: it is not a number, too large, or has two possible meanings; the message shows both.
    """
    unit = f" {unit}" if unit else ""
    readings = number_readings(re.sub(r"^([-+])\s+", r"\1", re.sub("[−–]", "-", text.strip())))
    possible = [reading for reading in readings if abs(Decimal(reading)) <= largest]
    if len(possible) == 1:
        return Decimal(possible[0])
    if not readings:
        raise QuantityError(f"'{text}' is not a number; type it like 12.5{unit}")
    if not possible:
        raise QuantityError(f"'{text}{unit}' is too much: at most {largest:g}{unit} is possible. Is the unit right?")
    fine, coarse = possible
    # with a smaller unit or an exponent, so that no digit is added that nobody read
    smaller = _SMALLER.get(unit.strip().lower())
    whole = f"{Decimal(fine).scaleb(3):f}" + (f" {smaller}" if smaller else f"e-3{unit}")
    raise QuantityError(f"'{text}{unit}' may be {fine}{unit} or {coarse}{unit}; type '{whole}' or '{coarse}{unit}'")


def split_typed(text: str) -> tuple[str, str]:
    """Number and unit of a typed quantity, not yet checked; ('', '') if it does not begin with a number."""
    match = _TYPED.fullmatch(text)
    return ("", "") if match is None or len(text) > LONGEST else (match[1], match[2])


def typed_quantity(text: str, unit: str, example: str) -> float:
    """Magnitude of '12,5 g' in a unit, as a person types it.

    Args:
        text: a number and a unit.
        unit: SI unit of the result. A magnitude above that of `LARGEST` is refused.
        example: a valid quantity, for messages; its unit is the suggested one.

    Raises:
        QuantityError: as `parse_quantity` and `typed_number`.
    """
    number, written = split_typed(text)
    if not number or not written:
        return parse_quantity(text, unit, example)
    factor = _converted(1.0, written, repr(text), unit, example)
    return float(typed_number(number, written, largest=LARGEST.get(unit, math.inf) / factor)) * factor


def finite_number(value: Any, name: str) -> float:
    """A number that a program passes: of Python, numpy or pandas, also an array without dimensions.

    Raises:
        QuantityError: it is not a number, or not finite; the message begins with the name.
    """
    kind = type(value).__name__
    if getattr(value, "shape", ()) != ():
        raise QuantityError(f"{name}: should be one number, and is a {kind} of shape {value.shape}")
    if value is None or isinstance(value, str | bytes) or kind in ("bool", "bool_"):
        raise QuantityError(f"{name}: should be a number such as 12.5, and is {value!r}")
    try:
        number = float(value)
    except (TypeError, ValueError):
        raise QuantityError(f"{name}: should be a number such as 12.5, and is {value!r}") from None
    if not math.isfinite(number):
        raise QuantityError(f"{name}: {number} is not a finite number; is a value missing?")
    return number


@cache
def registry() -> pint.UnitRegistry[Any]:
    """The laboratory's units (pint is imported at the first quantity)."""
    import pint

    return pint.UnitRegistry(UNITS.strip().splitlines())


def parse_quantity(value: Any, unit: str, example: str) -> float:
    """Magnitude of '40 deg/s' in a unit.

    Args:
        value: as written in the file: text, or a bare number (an error unless `unit` is '1').
        unit: SI unit of the result.
        example: a valid quantity, for messages; its unit is the suggested one.

    Raises:
        QuantityError: no unit, unknown unit, another dimension, or no number at all.
    """
    preferred = example.split(" ", 1)[1] if " " in example else ""
    kind = KINDS.get(unit, f"a quantity in {unit}")
    if isinstance(value, bool) or not isinstance(value, (int, float, str)):
        raise QuantityError(f"should be {kind}, for example '{example}'")
    if isinstance(value, str) and len(value) > LONGEST:
        raise QuantityError(
            f"a text of {len(value)} characters is not a quantity; should be {kind}, such as '{example}'"
        )
    match = _QUANTITY.match(value) if isinstance(value, str) else None
    if isinstance(value, str) and match is None:
        raise QuantityError(f"{value!r} is not a quantity; should be {kind}, for example '{example}'")
    number = float(match[1].replace("−", "-").replace("–", "-").replace("_", "")) if match else float(value)
    text = match[2] if match else ""
    if not math.isfinite(number):
        raise QuantityError(f"{value} is not finite; should be {kind}, for example '{example}'")
    typed, written = split_typed(str(value))
    if match and len(typed) > len(match[1]) and (readings := number_readings(typed)):
        corrected = " or ".join(repr(f"{reading} {written or preferred}".strip()) for reading in readings)
        doubt = (
            "has two meanings" if len(readings) > 1 else f"has {'a decimal comma' if ',' in typed else 'separators'}"
        )
        raise QuantityError(f"{value!r} {doubt}; write {corrected}")
    if unit == "1" and not text:
        return number
    if not text:
        raise QuantityError(f"{value} has no unit; write '{value} {preferred}' if that is what is meant")
    if text == unit:
        return number
    return _converted(number, text, repr(value), unit, example)


def parse_unit(text: str, unit: str, example: str) -> float:
    """Value of a unit, such as one in the header of a table, in the SI unit of its kind.

    Args:
        text: the unit as written, for example 'rad/s'.
        unit: SI unit of the result.
        example: a valid quantity, for messages.

    Raises:
        QuantityError: an unknown unit, or one of another dimension.
    """
    if len(text) > LONGEST:
        raise QuantityError(f"a text of {len(text)} characters is not a unit")
    return _converted(1.0, text, f"the unit '{text}'", unit, example)


def _converted(number: float, text: str, subject: str, unit: str, example: str) -> float:
    """A number of a unit in another one; `what` begins the message about another dimension."""
    kind = KINDS.get(unit, f"a quantity in {unit}")
    source, target = _unit(text, kind, example), registry().parse_units(unit if unit != "1" else "")
    if source.dimensionality != target.dimensionality:
        dimension = _kind_of(source)
        ounces = "; a fluid ounce is written 'fl oz'" if (dimension, unit) == ("a mass", "m^3") and "oz" in text else ""
        raise QuantityError(f"{subject} is {dimension}; should be {kind}, for example '{example}'{ounces}")
    return float(registry().convert(number, source, target))


def _unit(text: str, kind: str, example: str) -> Any:
    try:
        plain = _FLUID_OUNCE.sub("floz", text)
        if not _UNIT.fullmatch(plain.replace("(", "").replace(")", "")):
            raise ValueError(text)
        return registry().parse_units(plain)
    except Exception:  # the parser evaluates units as Python expressions, and raises any of their errors
        guess = did_you_mean(text, FAMILIAR_UNITS)
        meant = f"did you mean '{guess}'?" if guess else f"should be {kind}, for example '{example}'"
        raise QuantityError(f"unknown unit {text!r}; {meant}") from None


def _kind_of(source: Any) -> str:
    for unit, kind in KINDS.items():
        if source.dimensionality == registry().parse_units(unit if unit != "1" else "").dimensionality:
            return kind
    return f"of another kind ({source.dimensionality})"


def format_quantity(value: float, unit: str, display: str) -> str:
    """A quantity as text, with all digits if the short text would not give the same float."""
    if unit == "1":
        return repr(value)
    factor = float(registry().convert(1.0, registry().parse_units(display), registry().parse_units(unit)))
    for digits in (6, 9, 12, 15):
        text = f"{value / factor:.{digits}g} {display}"
        if parse_quantity(text, unit, text) == value:
            return text
    return f"{value!r} {unit}"


FROM_FILE: dict[str, Any] = {"from": "file"}
"""Validation context of values that users wrote."""


@dataclass(frozen=True)
class Quantity:
    """Pydantic annotation: a quantity with a unit, kept as a float in `unit`.

    In a file (validated with `FROM_FILE`) the unit must be written; a program may also give the bare SI number.

    Attributes:
        unit: SI unit of the value; '1' for a plain number.
        example: a valid quantity; its unit is the one that messages suggest.
        lower, upper: inclusive bounds in `unit`.
        positive: the value must be above 0.
        whole: it must be a whole number.
        words: allowed instead of a quantity, and kept unchanged.
    """

    unit: str
    example: str
    lower: float = -math.inf
    upper: float = math.inf
    positive: bool = False
    whole: bool = False
    words: tuple[str, ...] = ()

    @property
    def display(self) -> str:
        """Unit that users write."""
        return self.example.split(" ", 1)[1] if " " in self.example else self.unit

    def parse(self, value: Any) -> float | str:
        """The value in `unit`, or one of the words.

        Raises:
            QuantityError: it is neither of them, or out of bounds.
        """
        if isinstance(value, str) and value.strip() in self.words:
            return value.strip()
        try:
            number = parse_quantity(value, self.unit, self.example)
        except QuantityError as error:
            alternatives = "".join(f" or '{word}'" for word in self.words)
            raise QuantityError(f"{error}{alternatives}") from None
        if self.positive and number <= 0.0:
            raise QuantityError(f"{value} should be above 0")
        if self.whole and number != round(number):
            raise QuantityError(f"{value} should be a whole number")
        tolerance = 1e-9 * max(abs(bound) for bound in (self.lower, self.upper, 1.0) if math.isfinite(bound))
        if not self.lower - tolerance <= number <= self.upper + tolerance:
            raise QuantityError(f"{value} is outside {self.bounds()}")
        return min(max(number, self.lower), self.upper)

    def bounds(self) -> str:
        """The bounds in the unit that users write."""
        factor = 1.0
        unit = "" if self.display == "1" else f" {self.display}"
        if unit:
            si = "" if self.unit == "1" else self.unit
            factor = float(registry().convert(1.0, registry().parse_units(self.display), si))
        if math.isinf(self.upper):
            return f"{self.lower / factor:g}{unit} and more"
        if math.isinf(self.lower):
            return f"{self.upper / factor:g}{unit} and less"
        return f"{self.lower / factor:g} … {self.upper / factor:g}{unit}"

    def _validate(self, value: Any, info: ValidationInfo) -> float | str:
        if info.context is not FROM_FILE and isinstance(value, int | float) and not isinstance(value, bool):
            value = f"{value!r} {self.unit}" if self.unit != "1" else value
        try:
            return self.parse(value)
        except QuantityError as error:
            raise PydanticCustomError("quantity", "{text}", {"text": str(error)}) from None

    def __get_pydantic_core_schema__(self, source: Any, handler: GetCoreSchemaHandler) -> CoreSchema:
        return core_schema.with_info_plain_validator_function(self._validate)

    def __get_pydantic_json_schema__(self, schema: CoreSchema, handler: GetJsonSchemaHandler) -> dict[str, Any]:
        kind = KINDS.get(self.unit, self.unit)
        if self.unit == "1":
            bounds = {"minimum": self.lower, "maximum": self.upper}
            number: dict[str, Any] = {"type": "integer" if self.whole else "number"} | {
                key: bound for key, bound in bounds.items() if math.isfinite(bound)
            }
            if self.display == "1":
                return number
            share = {"type": "string", "pattern": r"^\s*(\d[\d_]*\.?\d*|\.\d+)\s*%\s*$", "examples": [self.example]}
            return {"anyOf": [number, share]}
        form: dict[str, Any] = {
            "type": "string",
            "pattern": r"^\s*[-+]?(\d[\d_]*\.?\d*|\.\d+)([eE][-+]?\d+)?\s*\S+",
            "examples": [self.example],
            "description": f"{kind} with its unit",
        }
        return {"anyOf": [form, {"enum": list(self.words)}]} if self.words else form
