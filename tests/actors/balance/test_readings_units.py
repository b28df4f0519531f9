"""`readings`: units of balances and of people who type."""

from __future__ import annotations

from decimal import Decimal

import pytest

from actors.balance.readings import Reading, ReadingStatus, typed_weight


@pytest.mark.parametrize(
    ("value", "unit", "grams"),
    [
        ("12.34", "g", 12.34),
        ("0.01234", "kg", 12.34),
        ("12340", "mg", 12.34),
        ("1", "ct", 0.2),
        ("1", "oz", 28.349523125),
        ("1", "lb", 453.59237),
        ("1", "ozt", 31.1034768),
        ("1.000", "KG", 1000.0),
    ],
)
def test_weights_are_converted_by_the_definitions_of_their_units(value, unit, grams):
    assert Reading(ReadingStatus.STABLE, Decimal(value), unit).mass() == pytest.approx(grams / 1e3, rel=1e-12)


@pytest.mark.parametrize("unit", ["pcs", "%", "tl", "N"])
def test_what_is_no_mass_is_not_made_one(unit):
    assert Reading(ReadingStatus.STABLE, Decimal("12"), unit).mass() is None


def test_step_of_the_display_is_one_of_the_last_digit_sent():
    assert Reading(ReadingStatus.STABLE, Decimal("12.30"), "g").step() == pytest.approx(1e-5)
    assert Reading(ReadingStatus.STABLE, Decimal("12"), "kg").step() == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "mass", "step"),
    [
        ("203.4 g", 0.2034, 1e-4),
        (" 203,40g ", 0.2034, 1e-5),
        ("0.2034 kg", 0.2034, 1e-4),
        ("−1.5 g", -1.5e-3, 1e-4),
        ("1,234.5 g", 1.2345, 1e-4),
        ("1.234,5 g", 1.2345, 1e-4),
        ("1 234,5 g", 1.2345, 1e-4),
        ("1'234 g", 1.234, 1e-3),
        ("1.2340 g", 1.234e-3, 1e-7),
        ("312.345 g", 0.312345, 1e-6),
        ("1,234 kg", 1.234, 1e-3),
    ],
)
def test_typed_weights_are_understood_as_people_type_them(text, mass, step):
    typed = typed_weight(text)
    assert typed.mass == pytest.approx(mass)
    assert typed.step == pytest.approx(step)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("203.4", "has no unit; type '203.4 g'"),
        ("about 200 g", "not a weight; type a number and a unit"),
        ("", "not a weight"),
        ("200 pcs", "'pcs' is not a unit of mass"),
        ("1.234.5 g", "not a number"),
        ("1,234 g", "'1,234 g' may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'"),
        ("1.234 g", "'1.234 g' may be 1.234 g or 1234 g; type '1234 mg' or '1234 g'"),
        ("1,250 g", "may be 1.250 g or 1250 g"),
        ("12.345 G", "type '12345 mg' or '12345 G'"),  # no form adds a digit that nobody read
        ("12.345 mg", "type '12345 ug' or '12345 mg'"),
        ("12.345 ct", "type '12345e-3 ct' or '12345 ct'"),
        ("100000 kg", "'100000 kg' is too much: at most 20 kg is possible"),
    ],
)
def test_a_typed_weight_that_could_be_misread_is_asked_for_again(text, said):
    with pytest.raises(ValueError, match=said):
        typed_weight(text)
