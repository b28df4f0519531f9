"""`model`: a settings class is what stands in a file, and the value that the program uses."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import pytest

from orchestrator.campaigns.yaml.section_validation import validate
from orchestrator.campaigns.yaml.yaml_source import Document, Place, Report
from sim_engine.settings.model import SET_BY_PROGRAM, Example, Name, Problems, SchemaGenerator, Settings
from sim_engine.settings.quantity import Quantity

Speed = Annotated[float, Quantity("rad/s", "40 deg/s", 0.0, 7.0, positive=True)]


class Wheel(Settings):
    """A wheel."""

    radius: Annotated[float, Quantity("m", "300 mm", 0.0, 1.0)]
    """Its radius."""


class Cart(Settings):
    """A cart."""

    name: Annotated[Name, Example("cart-1")]
    """Its name."""

    speed: Speed
    """How fast it goes."""

    limit: Speed = 1.0
    """How fast it may go."""

    drive: Literal["spring", "motor"] = "spring"
    """What drives it."""

    wheels: tuple[Wheel, ...] = ()
    """Its wheels."""

    hurry: Annotated[float, SET_BY_PROGRAM] = 1.0
    """How much faster time goes; no key."""

    def check_values(self, problems: Problems) -> None:
        if problems.valid("speed", "limit") and self.speed > self.limit:
            problems.add("is above the limit", "speed")
        for i, wheel in enumerate(self.wheels):
            if problems.within("wheels", i).valid("radius") and wheel.radius == 0.0:
                problems.within("wheels", i).add("does not turn", "radius")


def read(text: str) -> tuple[Cart | None, list[str]]:
    report = Report()
    cart = validate(Cart, Place(Document.parse(text, Path("cart.yaml"))), report)
    return cart, [f"{p.line}:{p.column}: {p.where}: {p.message}" for p in report.problems]


def test_a_file_gives_the_value_that_a_program_would_make() -> None:
    cart, problems = read("name: one\nspeed: 30 deg/s\nwheels: [{radius: 300 mm}]\n")
    assert problems == []
    assert cart == Cart(name="one", speed=0.5235987755982988, wheels=(Wheel(radius=0.3),))
    assert cart is not None
    assert cart.with_values(hurry=2.0).hurry == 2.0


def test_all_errors_are_found_at_once_each_with_its_place() -> None:
    text = "limit: 1 m\nwheels:\n  - {}\n  - {radius: 0 mm}\ndrive: horses\nhurry: 2\ncolour: red\n"
    assert sorted(read(text)[1]) == [
        "1:1: : key 'name' is missing; add for example 'name: cart-1'",
        "1:1: : key 'speed' is missing; add for example 'speed: 40 deg/s'",
        "1:8: limit: '1 m' is a length; should be an angular velocity, for example '40 deg/s'",
        "3:5: wheels[0]: key 'radius' is missing; add for example 'radius: 300 mm'",
        "4:14: wheels[1].radius: does not turn",
        "5:8: drive: 'horses' is not known here; should be 'spring' or 'motor'",
        "6:1: hurry: unknown key; known here: drive, limit, name, speed, wheels",
        "7:1: colour: unknown key; known here: drive, limit, name, speed, wheels",
    ]


def test_rules_between_keys_only_see_keys_that_are_valid_themselves() -> None:
    assert read("name: one\nspeed: 70 deg/s\n")[1] == ["2:8: speed: is above the limit"]
    assert len(read("name: one\nspeed: 70 deg/s\nlimit: fast\n")[1]) == 1


def test_a_program_cannot_leave_out_what_is_required() -> None:
    with pytest.raises(ValueError, match="Field required"):
        Cart(name="one")  # type: ignore[call-arg]


def test_the_schema_lists_required_keys_and_none_that_only_a_program_sets() -> None:
    schema = Cart.model_json_schema(schema_generator=SchemaGenerator)
    assert schema["required"] == ["name", "speed"]
    assert "hurry" not in schema["properties"]
