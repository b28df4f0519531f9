"""`publishing`: a fraction is what its name says, wherever it is published: it is compared with the masses beside
it.
"""

from __future__ import annotations

import asyncio
import json
from collections.abc import Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

import decant
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.catalogue.run_reading import TABLES, read_run
from orchestrator.daemon.state.event_feed import event_json
from orchestrator.learning.strategy_registry import OBJECTIVES
from orchestrator.records.events import Event
from orchestrator.records.run_registry import VARIABLE
from orchestrator.reports.publishing import publish
from orchestrator.runs.run_engine import run_campaign
from sim_engine.outcome import MINIMUM_POURED, PourMeasurement
from tests.golden.golden import ROOT
from tests.golden.world import FormulaLaboratory
from tests.support import example_run

MASSES = ("loaded_g", "spilled_g", "retained_g")

SCHEMAS = [*sorted((ROOT / "configs" / "schema").glob("*.json")), ROOT / "docs" / "openapi.json"]


def ratios(pour: Mapping[str, Any]) -> dict[str, float | None]:
    """Every fraction that is published, by its name, from the masses of a pour."""
    loaded, spilled, retained = (pour[name] for name in MASSES)
    poured = loaded - retained
    enough = poured >= MINIMUM_POURED * loaded
    return {
        "spillage": spilled / poured if enough else None,
        "poured": poured / loaded,
        "spilled": spilled / loaded,
        "retained": retained / loaded,
    }


def fractions_in(
    data: Any, pour: Mapping[str, Any] | None = None
) -> Iterator[tuple[str, Any, Mapping[str, Any] | None]]:
    """Name and value of every fraction in a document, with the row of masses that it stands in or below."""
    if isinstance(data, Mapping):
        inside = data if data.get("spilled_g") is not None and set(MASSES) <= data.keys() else pour
        for name, value in data.items():
            if name in ("spillage", "poured", "spilled", "retained") and not isinstance(value, Mapping):
                yield name, value, inside
            else:
                yield from fractions_in(value, inside)
    elif isinstance(data, list | tuple):
        for value in data:
            yield from fractions_in(value, pour)


def wrong_in(data: Any) -> tuple[int, list[str]]:
    """Number of fractions with masses beside them, and those that are not the ratio of these masses."""
    count, wrong = 0, []
    for name, value, pour in fractions_in(data):
        if pour is not None:
            count, right = count + 1, ratios(pour)[name]
            if value != right and value != pytest.approx(right):
                wrong.append(f"{name} is {value}, and the masses beside it give {right}")
    return count, wrong


@pytest.fixture(
    scope="module", params=["configs/campaigns/quickstart.yaml", "tests/golden/data/campaigns/objective.yaml"]
)
def run(request: Any, tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[decant.Run, list[Event]]]:
    """A run in a world whose outcomes are formulas: some liquid is spilled, and some stays in the pourer."""
    folder = tmp_path_factory.mktemp("runs") / "run"
    folder.mkdir()
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv(VARIABLE, str(folder.parent / "state"))
        plan = load_campaign(ROOT / request.param, ROOT / "configs/laboratories/twin.yaml")
        changes = {"directory": str(folder.parent), "recording": False, "figures": False}
        plan = replace(plan, outputs=plan.outputs.model_copy(update=changes))
        events: list[Event] = []
        result = asyncio.run(run_campaign(plan, FormulaLaboratory(), folder, subscribers=[events.append]))
        yield decant.Run(plan, result, publish(plan, result)), events


def test_fractions_of_a_run_are_the_ratios_of_the_masses_beside_them(run: Any, tmp_path: Path) -> None:
    published, events = run
    folder = published.directory
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    pours = read_run(folder).pours
    tables = {
        "pours of summary.json": summary["outcome"]["pours_made"],
        "receivers of summary.json": summary["outcome"]["receivers"],
        "results of summary.json": summary["results"],
        "catalogue": pours,
        "pours of the library": published.pours.to_dict("records"),
        "events": [event_json(event) for event in events],
    }
    for name, data in tables.items():
        count, wrong = wrong_in(data)
        assert (count > 0, wrong) == (True, []), name
    # The pours of a calibration have no masses in its result; they are those of the catalogue with the same number.
    made = {(pour["stage"], pour["number"]): pour for pour in pours}
    for pour in summary["results"].get("pours", {"pours": []})["pours"]:
        assert wrong_in({**{name: made["pours", pour["number"]][name] for name in MASSES}, **pour}) == (2, [])
    for row in published.simulations.to_dict("records"):
        assert row["spillage"] == pytest.approx(row["spilled"] / row["poured"])
        assert row["poured"] + row["retained"] == pytest.approx(1.0)


def properties(schema: Any) -> Iterator[tuple[str, str, Mapping[str, Any]]]:
    """Name and description of every property in a schema, and the properties beside it."""
    if isinstance(schema, Mapping):
        beside = schema.get("properties")
        if isinstance(beside, Mapping):
            for name, value in beside.items():
                if isinstance(value, Mapping):
                    yield name, " ".join(str(value.get("description", "")).split()), beside
        for value in schema.values():
            yield from properties(value)
    elif isinstance(schema, list):
        for value in schema:
            yield from properties(value)


def misnamed(name: str, meaning: str) -> str:
    """What is wrong with the name of a quantity, by its description; '' if nothing is."""
    if "spillage" in name and "spilled / poured" not in meaning:
        return f"{name} is '{meaning}'; a spillage is spilled / poured"
    if name == "spilled_of_poured" or ("loaded" in meaning and "spilled /" in meaning and "spillage" in name):
        return f"{name} is '{meaning}'"
    return ""


@pytest.mark.parametrize("path", SCHEMAS, ids=lambda path: path.name)
def test_every_schema_calls_spilled_over_poured_the_spillage(path: Path) -> None:
    found = list(properties(json.loads(path.read_text(encoding="utf-8"))))
    assert found
    assert [text for name, meaning, _ in found if (text := misnamed(name, meaning))] == []
    # A fraction of a weighed pour stands beside the masses that it is the ratio of, or beside the poured fraction.
    alone = [beside.keys() for name, _, beside in found if name == "spillage" and not {*MASSES} <= beside.keys()]
    assert [keys for keys in alone if not {"theta", "poured", "made"} & keys] == []


def test_every_column_and_objective_has_the_name_of_its_quantity() -> None:
    columns = [column for table in TABLES.values() for column in table]
    assert [text for column in columns if (text := misnamed(column.name, column.meaning))] == []
    fractions = PourMeasurement(loaded=0.2, spilled=0.01, retained=0.1).fractions
    scene = example_run.NARROW
    for name, kind in OBJECTIVES.all.items():
        if name in ("spilled", "retained", "poured"):
            assert kind().cost(fractions, example_run.ACTION, scene) == getattr(fractions, name)
        assert "spillage" not in name, "an objective is a fraction of the load"
    assert (fractions.spillage, fractions.spilled) == (pytest.approx(0.1), pytest.approx(0.05))
