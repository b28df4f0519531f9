"""`quantity`: quantities, values of the command line and parameter files mean what they say."""

from __future__ import annotations

import math
import re
from decimal import Decimal
from pathlib import Path

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from orchestrator.campaigns.action_assignments import assigned_action, set_action
from orchestrator.campaigns.file_loading import load_campaign, load_parameters
from sim_engine.action import DEG
from sim_engine.liquids import SimulationParameters
from sim_engine.settings.quantity import QuantityError, format_quantity, parse_quantity, typed_number, typed_quantity

CONFIGS = Path(__file__).parents[3] / "configs"


@pytest.mark.parametrize(
    ("text", "unit", "value"),
    [
        ("180 deg", "rad", math.pi),
        ("60rpm", "rad/s", 2.0 * math.pi),
        ("1.5 cm", "m", 0.015),
        ("0.2 kg", "kg", 0.2),
        ("1 g/cm³", "kg/m^3", 1000.0),
        ("72 mN/m", "N/m", 0.072),
        ("84 mPa*s", "Pa*s", 0.084),
        ("84 cP", "Pa*s", 0.084),
        ("1.4 Pa s", "Pa*s", 1.4),
        ("3 1/s", "1/s", 3.0),
        ("3 Hz", "1/s", 3.0),
        ("-5 mm", "m", -0.005),
        ("1e2 mm", "m", 0.1),
        ("−5 °", "rad", -5.0 * DEG),
        ("–5 mm", "m", -0.005),  # a dash, as word processors write
        ("8 oz", "kg", 0.226796185),
        ("1 lb", "kg", 0.45359237),
        ("2 lbs", "kg", 0.90718474),
        ("8 fl oz", "m^3", 236.5882365e-6),  # of the United States; the imperial one has 28.4131 mL
        ("8 fl. oz.", "m^3", 236.5882365e-6),
        ("8 floz", "m^3", 236.5882365e-6),
        ("2 fluid ounces", "m^3", 59.147059125e-6),
    ],
)
def test_quantity_means(text: str, unit: str, value: float) -> None:
    assert parse_quantity(text, unit, "1 mm") == pytest.approx(value, rel=1e-12)


def test_an_ounce_is_a_mass_and_a_fluid_ounce_a_volume() -> None:
    with pytest.raises(QuantityError, match=r"'8 oz' is a mass; should be a volume.* a fluid ounce is written 'fl oz'"):
        parse_quantity("8 oz", "m^3", "200 mL")
    with pytest.raises(QuantityError, match="'8 fl oz' is a volume; should be a mass, for example '200 g'"):
        parse_quantity("8 fl oz", "kg", "200 g")
    with pytest.raises(QuantityError, match="unknown unit 'OZ'; did you mean 'oz'"):
        parse_quantity("8 OZ", "kg", "200 g")


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("12,5 g", "'12,5 g' has a decimal comma; write '12.5 g'"),
        ("12,5", "'12,5' has a decimal comma; write '12.5 g'"),
        ("1,234 g", "'1,234 g' has two meanings; write '1.234 g' or '1234 g'"),
        ("1.234,5 g", "'1.234,5 g' has a decimal comma; write '1234.5 g'"),
        ("1 234 g", "'1 234 g' has separators; write '1234 g'"),
    ],
)
def test_a_file_has_decimal_points_and_no_separators(text: str, said: str) -> None:
    with pytest.raises(QuantityError) as refusal:
        parse_quantity(text, "kg", "200 g")
    assert str(refusal.value) == said
    assert parse_quantity("1.234 kg", "kg", "200 g") == 1.234
    assert parse_quantity("1_000 g", "kg", "200 g") == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("text", "value"),
    [
        ("65,5 g", 0.0655),  # LiamMorrow/LiftLog#518 took 65
        ("93,5 g", 0.0935),  # oliexdev/openScale#589 took 935
        ("1,23 kg", 1.23),  # ing-bank/lion#1731 took 123
        ("1.000.000 mg", 1.0),  # ambassify/parse-js#42 took 1000
        ("1,000,000 mg", 1.0),
        ("- 5 g", -0.005),
        ("1.971,13 g", 1.97113),
    ],
)
def test_a_typed_quantity_means(text: str, value: float) -> None:
    assert typed_quantity(text, "kg", "200 g") == pytest.approx(value)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("1.234 g", "'1.234 g' may be 1.234 g or 1234 g"),  # dm4t2/vue-currency-input#102 took the first in Germany
        ("145.1.4.2,4.124 g", "is not a number"),  # foodcoopshop/foodcoopshop#540 left out all points
        ("1,23,456 g", "is not a number"),
        ("21 kg", "is too much"),
        ("about 5 g", "is not a quantity"),
        ("5 mm", "is a length"),
    ],
)
def test_a_typed_quantity_that_could_be_misread_is_refused(text: str, said: str) -> None:
    with pytest.raises(QuantityError, match=said):
        typed_quantity(text, "kg", "200 g")


@given(
    number=st.decimals(0, 10**7, places=None, allow_nan=False, allow_infinity=False),
    places=st.integers(0, 5),
    groups=st.sampled_from(["", ",", ".", " ", "'", "\u202f"]),
    comma=st.booleans(),
)
def test_a_number_is_read_as_it_was_meant_or_refused_in_every_country(
    number: Decimal, places: int, groups: str, comma: bool
) -> None:
    sign = "," if comma else "."
    assume(groups != sign)
    whole, _, decimals = f"{number:,.{places}f}".partition(".")
    text = whole.replace(",", groups) + (sign + decimals if decimals else "")
    meant = Decimal(f"{number:.{places}f}")
    try:
        readings = [typed_number(text)]
    except QuantityError as error:
        readings = [Decimal(reading) for reading in re.findall(r"'([0-9.e-]+)'", str(error).partition("; type ")[2])]
    assert meant in readings


def test_formatted_quantity_reads_back_to_the_same_float() -> None:
    for value in (0.1, 1.0 / 3.0, 40.0 * DEG, 0.084, 2.0**-40):
        for unit, display in (("m", "mm"), ("rad/s", "deg/s"), ("kg", "g"), ("rad", "deg")):
            assert parse_quantity(format_quantity(value, unit, display), unit, "1 x") == value


def test_bare_numbers_on_the_command_line_are_in_the_unit_that_is_shown() -> None:
    values = set_action(["angular_velocity=40", "x_offset=9 cm", "height = 60", "hold_time=until_flow_ends"])
    assert values["angular_velocity"] == pytest.approx(40.0 * DEG)
    assert values["x_offset"] == pytest.approx(0.09)
    assert values["height"] == pytest.approx(0.06)
    assert values["hold_time"] is None


def test_command_line_values_stand_over_the_scene_and_ask_for_the_rest() -> None:
    plan = load_campaign(CONFIGS / "campaigns" / "quickstart.yaml")
    assert plan.deployment is not None
    scene = plan.deployment.scenes[0]
    action = assigned_action(
        ["angular_velocity=40", "x_offset=90", "height=70"], fixed=scene.fixed, space=plan.deployment.actions
    )
    assert action.height == pytest.approx(0.07)
    assert action.max_angle == pytest.approx(120.0 * DEG)
    with pytest.raises(ValueError, match="x_offset has no value"):
        assigned_action(["angular_velocity=40"], fixed=scene.fixed, space=plan.deployment.actions)


@pytest.mark.parametrize(
    "text",
    [
        '{"theta": {"particles": 1500, "cohesion": 0.03, "xsph_rate": 2.5}, "train_discrepancy": 0.02, "other": null}',
        "particles: 1500\ncohesion: 30 mN/m\nxsph_rate: 2.5 1/s\n",
        "parameters: {particles: 1500, cohesion: 0.03 N/m, xsph_rate: 2.5}",
    ],
)
def test_parameters_as_a_program_or_a_person_writes_them(text: str, tmp_path: Path) -> None:
    (tmp_path / "theta.json").write_text(text)
    base = SimulationParameters(friction=0.2)
    loaded = load_parameters(tmp_path / "theta.json", base)
    expected = base.model_copy(update={"particles": 1500, "cohesion": 0.03, "xsph_rate": 2.5})
    assert loaded.model_dump() == pytest.approx(expected.model_dump())
