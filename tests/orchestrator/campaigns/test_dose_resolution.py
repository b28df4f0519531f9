"""`dose_resolution`: mixtures as people write them, inline and in tables, and what is wrong with them."""

from __future__ import annotations

import dataclasses
import json
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from actors.bench.night_consent import NightConsent
from actors.interfaces import Notice
from actors.places import ContainerSettings
from decant import build_campaign
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.shipped import shipped
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from orchestrator.learning.campaign_plan import DispensePlan

CAMPAIGN = """\
name: mix
laboratory: {name: bench, mode: virtual, bench: {liquid: {particles: 400}, time_scale: 0}}
pourer: {name: beaker, profile: {unit: mm, inner: [[0, 0], [40, 0], [40, 100]], wall: 4 mm, floor: 4 mm}}
receiver: {name: cup, profile: {unit: mm, inner: [[0, 0], [25, 0], [25, 60]], wall: 3 mm, floor: 3 mm}}
motion: {x_offset: 90 mm, height: 100 mm}
mixtures:
  liquids:
    - {name: water, liquid: {name: water, mass: 300 g}, tolerance: 0.8 g}
    - {name: ethanol, liquid: {name: ethanol, mass: 250 g}, stands: [source/ethanol-1, source/ethanol-2]}
  wanted:
    A1: {water: 40 g, ethanol: 15 g}
    B2: {ethanol: 50 mL, water: 20 g}
"""

INLINE = CAMPAIGN[CAMPAIGN.index("  wanted:") :]


def load(folder: Path, text: str = CAMPAIGN, old: str = "", new: str = "", key: str = "") -> DispensePlan:
    assert old in text
    text = text.replace("mixtures:\n", f"mixtures:\n  {key}\n") if key else text
    path = folder / "mix.yaml"
    path.write_text(text.replace(old, new, 1) if old else text, encoding="utf-8")
    plan = load_campaign(path).dispense
    assert plan is not None
    return plan


def from_table(folder: Path, table: str, extra: str = "") -> DispensePlan:
    (folder / "mix.csv").write_text(table, encoding="utf-8")
    return load(folder, CAMPAIGN, INLINE, f"  from: mix.csv\n{extra}")


def amounts(plan: DispensePlan) -> dict[str, dict[str, float]]:
    assert plan.mixtures is not None
    return {
        cup: {liquid: round(1e3 * dose.amount, 6) for liquid, dose in row.items()}
        for cup, row in plan.mixtures.cups.items()
    }


def problems(error: ConfigError) -> str:
    return "\n".join(f"{p.path.name}:{p.line}:{p.column}: {p.where}: {p.message}" for p in error.problems)


def refused(folder: Path, old: str, new: str, key: str = "") -> str:
    with pytest.raises(ConfigError) as caught:
        load(folder, CAMPAIGN, old, new, key)
    return problems(caught.value)


def test_amounts_are_masses_and_the_smallest_of_a_cup_is_poured_first(tmp_path: Path) -> None:
    plan = load(tmp_path)
    assert amounts(plan) == {"rack/A1": {"ethanol": 15.0, "water": 40.0}, "rack/B2": {"water": 20.0, "ethanol": 39.465}}
    assert [(dose.position, dose.liquid) for dose in plan.doses] == [
        ("rack/A1", "ethanol"), ("rack/A1", "water"), ("rack/B2", "water"), ("rack/B2", "ethanol")
    ]  # fmt: skip
    assert {dose.liquid: dose.limit for dose in plan.doses} == {"water": 0.8e-3, "ethanol": 1e-3}


def test_each_stand_is_a_source_of_its_liquid(tmp_path: Path) -> None:
    plan = load(tmp_path)
    assert plan.sources == ("source/water", "source/ethanol-1", "source/ethanol-2")
    assert plan.sources_of(plan.doses[0]) == ("source/ethanol-1", "source/ethanol-2")
    assert {scene.liquid.name: scene.liquid.mass for scene in plan.scenes} == {"water": 0.3, "ethanol": 0.25}


def test_a_person_can_fix_the_order_of_the_liquids(tmp_path: Path) -> None:
    plan = load(tmp_path, CAMPAIGN, "  wanted:", "  order: [water, ethanol]\n  wanted:")
    assert [dose.liquid for dose in plan.doses] == ["water", "ethanol"] * 2


def test_percentages_are_shares_of_the_total_by_mass(tmp_path: Path) -> None:
    plan = load(tmp_path, CAMPAIGN, "{water: 40 g, ethanol: 15 g}", "{water: 75 %, ethanol: 15 g}", "total: 60 g")
    assert amounts(plan)["rack/A1"] == {"ethanol": 15.0, "water": 45.0}


@pytest.mark.parametrize(
    "table",
    [
        "cup,water_g,ethanol_g\nA1,40,15\nB2,20,39.465\n",
        "Cup;water [g];ethanol [mL]\na1;40,0;19,0042\nB02;20,0;50,0\n",
        "position,water [kg],Ethanol (g)\nA1,0.04,15\nrack/B2,0.02,39.465\n",
        "well,water,ethanol\nA1,40 g,15 g\nB2,20 g,50 mL\n",
    ],
    ids=["plain", "semicolons and volumes", "other units", "units in the cells"],
)
def test_tables_as_people_save_them_are_the_same_mixtures(tmp_path: Path, table: str) -> None:
    assert amounts(from_table(tmp_path, table)) == {
        "rack/A1": {"ethanol": pytest.approx(15.0, abs=1e-3), "water": 40.0},
        "rack/B2": {"water": 20.0, "ethanol": pytest.approx(39.465, abs=1e-3)},
    }


def test_a_workbook_is_read_and_an_empty_cell_is_none_of_the_liquid(tmp_path: Path) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    book = openpyxl.Workbook()
    for row in (["cup", "water [%]", "ethanol [%]"], ["A1", 75, 25], ["A2", 100, None]):
        book.active.append(row)
    book.save(tmp_path / "mix.xlsx")
    plan = load(tmp_path, CAMPAIGN, INLINE, "  from: mix.xlsx\n  total: 60 g\n")
    assert amounts(plan) == {"rack/A1": {"ethanol": 15.0, "water": 45.0}, "rack/A2": {"water": 60.0}}


def test_the_record_of_a_run_has_the_amounts_of_the_table(tmp_path: Path) -> None:
    (tmp_path / "mix.csv").write_text("cup,water_g\nA1,40\n", encoding="utf-8")
    path = tmp_path / "mix.yaml"
    path.write_text(CAMPAIGN.replace(INLINE, "  from: mix.csv\n"), encoding="utf-8")
    plan = load_campaign(path)
    (tmp_path / "mix.csv").unlink()
    copy = tmp_path / "resolved.json"
    copy.write_text(json.dumps(plan.resolved), encoding="utf-8")
    assert dataclasses.replace(load_campaign(copy), source=plan.source) == plan


REFUSED = {
    "no unit": ("15 g", "15", "mix.yaml:11:32: mixtures.wanted.A1.ethanol: 15 has no unit; write '15 g', '15 mL' or"),
    "a time": ("15 g", "15 s", "'15 s' is a time; should be a mass"),
    "no source": ("ethanol: 15 g", "ethnaol: 15 g", "A1.ethnaol: no source holds 'ethnaol'; did you mean 'ethanol'?"),
    "cup named twice": ("    B2:", "    a01:", "12:5: mixtures.wanted.a01: 'a01' is 'A1', which is named before"),
    "within its tolerance": ("15 g", "0.9 g", "A1.ethanol: 0.9 g should be more than its tolerance, 1 g"),
    "more than a source holds": ("40 g", "299.5 g", "A1.water: a full source holds 300 g, and the dose, its tolerance"),
    "above the brim": ("40 g", "100 g", "11:5: mixtures.wanted.A1: with its tolerances the mixture has 121.3 mL, and"),
    "nothing": ("{water: 40 g, ethanol: 15 g}", "{water: 0 g}", "A1: has nothing to pour; name an amount, or remove"),
    "percentage of nothing": ("15 g", "25 %", "A1.ethanol: 25 % needs the mass of the mixture; add for example 'total"),
    "spare cups that nothing needs": (
        "  wanted:",
        "  cups: {spares: [D6]}\n  wanted:",
        "cups.spares: belongs to 'on_miss: repeat' or 'on_miss: ask'",
    ),
    "a spare that is filled": (
        "  wanted:",
        "  on_miss: repeat\n  cups: {spares: [a1]}\n  wanted:",
        "cups.spares[0]: 'a1' is named before; such a cup is empty",
    ),
    "a stand with two sources": ("ethanol-1, source", "ethanol-2, source", "stands[1]: another source is called 'sou"),
    "unknown liquid in the order": (
        "  wanted:",
        "  order: [oil]\n  wanted:",
        "order[0]: 'oil' is no liquid of the mixt",
    ),
    "incomplete order": (
        "  wanted:",
        "  order: [water]\n  wanted:",
        "order: lacks ethanol; name every liquid, or remove",
    ),
    "liquid of the campaign": (
        "name: mix",
        "name: mix\nliquid: {mass: 1 g}",
        "2:1: liquid: has no effect: each liquid of",
    ),
    "no table": (INLINE, "", "mixtures: needs 'wanted' (amounts by cup and liquid), or 'from' (a table of them)"),
}


@pytest.mark.parametrize(("old", "new", "message"), REFUSED.values(), ids=REFUSED)
def test_impossible_mixtures_are_refused_with_their_place(tmp_path: Path, old: str, new: str, message: str) -> None:
    assert message in refused(tmp_path, old, new)


def test_percentages_that_make_another_total_are_refused(tmp_path: Path) -> None:
    message = "A1: the amounts make 55 g, and 'total' is 60 g; which is meant?"
    assert message in refused(tmp_path, "15 g}", "25 %}", "total: 60 g")


def test_all_problems_of_a_table_are_reported_at_once(tmp_path: Path) -> None:
    table = "cup,water_g,ethanol,oil_g\nA1,40,15,\nA1,20,15 g,1\nB1,many,200 g,1\n,3,,\n"
    with pytest.raises(ConfigError) as caught:
        from_table(tmp_path, table)
    text = problems(caught.value)
    for message in (
        "mix.csv:1:21: oil_g: is no liquid of the mixtures: no source holds it; there are water, ethanol",
        "mix.csv:2:7: ethanol: 15 has no unit; write '15 g'",
        "mix.csv:3:1: cup: 'A1' is named in line 2, too; a cup is filled once",
        "mix.csv:4:4: water: 'many' is not a number",
        "mix.csv:4:1: B1: with its tolerances the mixture has 254.7 mL",
        "mix.csv:5:1: cup: is empty; every mixture needs a cup",
    ):
        assert message in text, text


def test_tables_of_other_programs_are_read_or_refused_with_what_is_missing(tmp_path: Path) -> None:
    """Headers as of a public protocol that reads one line a well, of a list of transfers, and of a design of runs."""
    wide = "Destination Well,Water Transfer Volume (ul),ethanol volume (mL)\nA1,40000,19.01\n"
    assert amounts(from_table(tmp_path, wide)) == {"rack/A1": {"ethanol": 15.004593, "water": 39.92}}
    for table, texts in (
        (
            "Source_Well,Destination_Well,Transfer_Volume\nA1,A2,15\n",
            ("1:1: Source_Well: is no liquid of the mixtures", "1:30: Transfer_Volume: is no liquid of the mixtures"),
        ),
        (
            ",water,ethanol,Yield\n0,0.3,0.7,\n",
            ("has no column 'cup'; it names the position of each mixture, in one line (cup,", "Yield: is no liquid"),
        ),
    ):
        with pytest.raises(ConfigError) as caught:
            from_table(tmp_path, table)
        assert all(text in problems(caught.value) for text in texts), problems(caught.value)


def test_a_campaign_without_mixtures_still_needs_its_liquid(tmp_path: Path) -> None:
    section = CAMPAIGN[CAMPAIGN.index("mixtures:") :]
    assert "key 'liquid' is missing; add for example" in refused(
        tmp_path, section, "dispense: {doses: [{amount: 9 g}]}"
    )


def test_doses_are_not_repeated_where_the_vessels_keep_what_is_in_them() -> None:
    document = YAML(typ="safe").load(shipped("campaigns/mixtures.yaml").read_text(encoding="utf-8"))
    rack = str(shipped("laboratories/rack.yaml"))
    assert build_campaign(document | {"laboratory": rack}).laboratory.vessels[0].name == "source/water"
    with pytest.raises(ConfigError, match="'repeat' would dose twice: the vessels of laboratory 'rack' keep what"):
        build_campaign(document | {"laboratory": rack, "on_unknown": "repeat"})


def test_every_cup_and_source_needs_a_place_in_a_laboratory_with_places() -> None:
    document = YAML(typ="safe").load(shipped("campaigns/mixtures.yaml").read_text(encoding="utf-8"))
    document["laboratory"] = str(shipped("laboratories/rack.yaml"))
    document["mixtures"]["wanted"]["E7"] = {"water": "20 g"}
    document["mixtures"]["liquids"][0]["stands"] = ["source/brine"]
    with pytest.raises(ConfigError) as caught:
        build_campaign(document)
    text = problems(caught.value)
    assert "mixtures.wanted.E7: laboratory 'rack' has no place 'rack/E7'; there are pan, source/water" in text
    assert "mixtures.liquids[0].stands[0]: laboratory 'rack' has no place 'source/brine'" in text


def test_the_consent_names_all_liquids_sources_and_cups_also_those_for_proposals() -> None:
    document = YAML(typ="safe").load(shipped("campaigns/mixtures.yaml").read_text(encoding="utf-8"))
    document["mixtures"]["cups"] = {"proposals": ["C1", "C2"]}
    unattended = {"unattended": {"pours": 40, "until": "07:00"}}
    rack = str(shipped("laboratories/rack.yaml"))
    spec = build_campaign(document | unattended | {"laboratory": rack}).laboratory
    assert spec.unattended is not None
    waste = spec.places[0].model_copy(
        update={"name": "waste", "container": ContainerSettings(diameter=0.2, height=0.1)}
    )
    told: list[Notice] = []
    consent = NightConsent(
        spec.unattended, spec.safeguard, "the arm", [*spec.places, waste], told.append, vessels=spec.vessels
    )
    question = consent.question()
    for text in (
        "up to 40 pours until 07:00",
        "from the sources source/water (water), source/ethanol (ethanol), source/oil (oil),",
        "into the cups rack/A1, rack/A2, rack/A3, rack/B1, rack/B2, rack/B3, rack/C1, rack/C2,",
        "also to empty cups at waste",
        "Safeguard: fence with an interlocked gate",
    ):
        assert text in question.text
