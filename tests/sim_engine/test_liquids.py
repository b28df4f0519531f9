"""`liquids`: the table of liquids, against values printed elsewhere than its formulas come from."""

from __future__ import annotations

import pytest

from sim_engine.liquids import KNOWN, LiquidSettings, look_up


@pytest.mark.parametrize(
    ("name", "temperature", "viscosity", "density"),
    [
        ("water", 20.0, 1.002e-3, 998.2),  # IAPWS
        ("water", 60.0, 0.466e-3, 983.2),
        ("ethanol", 20.0, 1.19e-3, 789.3),
        ("ethanol 70 %", 20.0, 2.37e-3, 867.7),
        ("ethanol 45 %", 20.0, 2.88e-3, 924.7),
        ("ethanol 40 %", 25.0, 2.35e-3, 931.5),
        ("ethanol 100 %", 20.0, 1.19e-3, 789.3),
        ("isopropanol", 20.0, 2.4e-3, 785.5),
        ("glycerol 50 %", 20.0, 6.0e-3, 1126.0),  # Glycerine Producers' Association 1963
        ("glycerol 80 %", 20.0, 60.1e-3, 1208.0),
        ("Glycerol 100 %", 20.0, 1.41, 1261.0),
        ("sugar syrup 60 %", 20.0, 58.5e-3, 1286.5),  # ICUMSA's tables
        ("rapeseed oil", 20.0, 78e-3, 915.0),
    ],
)
def test_the_table_is_what_handbooks_print(name: str, temperature: float, viscosity: float, density: float) -> None:
    found = look_up(name, temperature)
    assert found is not None
    assert found.dynamic_viscosity == pytest.approx(viscosity, rel=0.06)
    assert found.density == pytest.approx(density, rel=0.01)
    assert 0.02 < found.surface_tension < 0.08


@pytest.mark.parametrize("known", KNOWN, ids=lambda known: f"{known.name}{' in water' * (known.share is not None)}")
def test_every_liquid_is_thinner_and_lighter_when_it_is_warm(known) -> None:  # type: ignore[no-untyped-def]
    share = 0.0 if known.share is None else known.share[1]
    cold, warm = (known.at(t, share) for t in known.temperatures)
    assert warm.dynamic_viscosity < cold.dynamic_viscosity
    assert warm.density < cold.density
    assert warm.surface_tension < cold.surface_tension or known.name in ("glycerol", "sugar syrup")


@pytest.mark.parametrize(
    ("name", "temperature", "told"),
    [
        ("glycerol", 20.0, "how much glycerol? Write for example 'glycerol 60 %'"),
        ("sugar syrup 90 %", 20.0, "sugar syrup is known from 0 to 78 %"),
        ("ethanol 50 %", 60.0, "ethanol is known from 10 to 40 °C, not at 60 °C"),
        ("ethanol", 90.0, "ethanol is known from 0 to 75 °C, not at 90 °C"),
    ],
)
def test_what_the_table_does_not_know_is_refused(name: str, temperature: float, told: str) -> None:
    with pytest.raises(ValueError, match=told.replace("?", r"\?")):
        look_up(name, temperature)


def test_other_names_are_nobody_s_business() -> None:
    assert look_up("shampoo") is None


def test_a_solution_of_a_liquid_that_the_table_has_pure_is_poured_with_its_own_properties() -> None:
    liquid = LiquidSettings(name="ethanol 70 %", mass=0.3, density=868.0, viscosity=2.21e-3).load()
    assert (liquid.name, liquid.density, liquid.dynamic_viscosity) == ("ethanol 70 %", 868.0, 2.21e-3)
