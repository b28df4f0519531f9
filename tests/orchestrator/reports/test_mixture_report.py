"""`mixture_report`: a poured rack as table, files and picture, out of a run and out of results alone."""

from __future__ import annotations

import contextlib
import csv
import json
import re
import shutil
import sqlite3
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import pytest
from typer.testing import CliRunner

import decant
from orchestrator.cli.app import app
from orchestrator.learning.dispense import Dispensed, Dose, MixedCup
from orchestrator.records.journal_file import Header
from orchestrator.records.run_record import RunState, read_record
from orchestrator.reports.mixture_report import draw_rack, mixture_lines, mixture_rows, mixture_table, mixtures_so_far
from tests.support import small_campaign

MIXTURES = """\
name: mix
seed: 3
laboratory: {name: small, bench: {liquid: {particles: 400}, time_scale: 0}}
pourer: beaker.yaml
receiver: narrow.yaml
motion: {x_offset: 70 mm, height: 60 mm}
mixtures:
  tolerance: 2 g
  liquids:
    - {name: water, liquid: {name: water, mass: 100 g}}
    - {name: ethanol, liquid: {name: ethanol, mass: 90 g}, batch: L-117}
  wanted:
    B2: {water: 30 g, ethanol: 20 g}
    A1: {water: 25 g}
outputs: {directory: runs, recording: false}
"""


@pytest.fixture(scope="module")
def run(tmp_path_factory: pytest.TempPathFactory) -> decant.Run:
    folder = tmp_path_factory.mktemp("mix")
    path = small_campaign.write_campaign(folder, MIXTURES)
    result = CliRunner().invoke(app, ["run", str(path), "--in-process"], catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return decant.open_run(next((folder / "runs").iterdir()))


def test_the_table_has_every_component_with_what_was_weighed(run: decant.Run) -> None:
    with (run.directory / "mixtures.csv").open(encoding="utf-8") as stream:
        rows = list(csv.DictReader(stream))
    assert [(row["cup"], row["liquid"], row["dose"]) for row in rows] == [
        ("rack/B2", "ethanol", "1"), ("rack/B2", "water", "2"), ("rack/A1", "water", "3")
    ]  # fmt: skip
    for row in rows:
        assert float(row["received_g"]) == pytest.approx(float(row["wanted_g"]), abs=2.0)
        assert 0.0 < float(row["half_interval_g"]) < 1.0
        assert re.fullmatch(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d[+-]\d{4}", row["time"])
        assert (row["source"], row["state"]) == (f"source/{row['liquid']}", "full")
        assert row["batch"] == {"ethanol": "L-117", "water": ""}[row["liquid"]]
    assert sum(float(row["share"]) for row in rows[:2]) == pytest.approx(1.0)


def test_json_workbook_and_library_have_the_same_table(run: decant.Run) -> None:
    openpyxl = pytest.importorskip("openpyxl")
    written = json.loads((run.directory / "mixtures.json").read_text(encoding="utf-8"))
    header, *lines = openpyxl.load_workbook(run.directory / "mixtures.xlsx").active.iter_rows(values_only=True)
    assert list(header) == list(written[0])
    for line, row in zip(lines, written, strict=True):
        assert list(line) == [
            pytest.approx(v) if isinstance(v, float) else None if v == "" else v for v in row.values()
        ]
    frame = run.mixtures
    assert list(frame["received_g"]) == [row["received_g"] for row in written]
    assert frame.attrs["units"]["wanted_g"] == "g"


def test_the_report_begins_with_the_rack_and_runs_show_lists_it(run: decant.Run) -> None:
    page = (run.directory / "report.html").read_text(encoding="utf-8")
    assert page.index('alt="rack: ') < page.index("<h2>Summary</h2>")
    assert "2 mixtures, 3 doses" in page
    assert "100 g of water (100 mL), 90 g of ethanol (114 mL)" in page
    shown = CliRunner().invoke(app, ["runs", "show", str(run.directory)], catch_exceptions=False).output
    assert re.search(r"rack/B2  full: ethanol [\d.]+ of 20 g, water [\d.]+ of 30 g", shown)


DOSES = (
    Dose(number=1, wanted_g=10.0, received_g=13.0, deviation_g=0.1, spilled_g=0.0, duration_s=9.0, end="late",
         outcome="missed", tolerance_g=1.0, position="rack/A1", source="source/oil", liquid="oil"),
    Dose(number=2, wanted_g=10.0, received_g=9.9, deviation_g=0.1, spilled_g=0.0, duration_s=9.0, end="reached",
         outcome="reached", tolerance_g=1.0, position="rack/C4", source="source/oil", liquid="oil"),
)  # fmt: skip
PARTLY = Dispensed(
    scene="mixtures-source/oil-cup",
    doses=DOSES,
    cups=(
        MixedCup(position="rack/A1", wanted_g={"oil": 10.0}, state="rejected"),
        MixedCup(position="rack/C4", wanted_g={"oil": 10.0}, state="full", replaces="rack/A1"),
        MixedCup(position="rack/A2", wanted_g={"oil": 10.0}, state="waiting"),
    ),
)


def test_the_picture_shows_the_cups_where_they_stand_and_their_differences() -> None:
    drawing = draw_rack(PARTLY, ["oil"])
    shown = {text.text: text.at for text in drawing.texts}
    assert {"A1", "C4", "A2", "13.0", "+3.00", "-0.10", "rejected", "done", "empty"} <= set(shown)
    assert shown["C4"][0] > shown["A2"][0] > shown["A1"][0]
    assert shown["C4"][1] > shown["A1"][1] == shown["A2"][1]
    assert {text.text for text in drawing.texts if text.bold} == {"+3.00", "rejected"}


def test_figure_and_svg_have_the_same_texts_in_the_same_places() -> None:
    drawing = draw_rack(PARTLY, ["oil"])
    of_figure = {text.get_text(): text.get_position() for text in drawing.figure().axes[0].texts}
    of_svg = {
        text.text: (float(text.get("x")) / 100, float(text.get("y")) / 100)
        for text in ElementTree.fromstring(drawing.svg()).iter("{http://www.w3.org/2000/svg}text")
    }
    assert of_figure.keys() == of_svg.keys() == {text.text for text in drawing.texts}
    for text, (x, y) in of_svg.items():
        assert (x, y) == pytest.approx(of_figure[text], abs=0.06)  # y is of the baseline


def test_no_text_of_a_rack_of_one_cup_is_cut_off() -> None:
    figure = draw_rack(PARTLY.model_copy(update={"cups": PARTLY.cups[:1]}), ["oil"]).figure()
    figure.canvas.draw()
    extents = {text.get_text(): text.get_window_extent() for text in figure.axes[0].texts}
    cut = [text for text, extent in extents.items() if extent.x0 < 0.0 or extent.x1 > figure.bbox.x1]
    assert cut == []


def test_a_cup_that_misses_a_tolerance_and_one_of_unknown_content_stand_out() -> None:
    missed = PARTLY.cups[0].model_copy(update={"state": "missed"})
    lost = DOSES[1].model_copy(update={"received_g": None, "outcome": "unknown"})
    unknown = PARTLY.cups[1].model_copy(update={"state": "unknown"})
    several = PARTLY.model_copy(update={"doses": (DOSES[0], lost), "cups": (missed, unknown)})
    drawing = draw_rack(several, ["oil"])
    assert {text.text for text in drawing.texts if text.bold} == {"+3.00", "missed", "UNKNOWN"}
    assert "?" in {text.text for text in drawing.texts}
    rows = mixture_rows(several, RunState(Header("mix", {})))
    assert [(row["state"], row["outcome"], row["missed_by_g"], row["tolerance_g"]) for row in rows] == [
        ("missed", "missed", pytest.approx(2.0), 1.0),
        ("unknown", "unknown", None, 1.0),
    ]
    texts = [" ".join(row.cells) for row in mixture_table(several).rows]
    assert "missed by +2.00 g beyond its tolerance of 1 g" in texts[0]
    assert "UNKNOWN" in texts[1]


def test_a_dose_of_a_corrected_amount_has_not_missed() -> None:
    wanted = {"oil": 10.0, "water": 20.0}
    corrected = DOSES[1].model_copy(
        update={"wanted_g": 26.0, "received_g": 25.8, "liquid": "water", "position": "rack/A1"}
    )
    cup = MixedCup(position="rack/A1", wanted_g=wanted, state="missed")
    dispensed = PARTLY.model_copy(update={"doses": (DOSES[0], corrected), "cups": (cup,)})
    texts = {text.text: text.bold for text in draw_rack(dispensed, ["oil", "water"]).texts}
    assert texts["+3.00"]
    assert not texts["+5.80"]
    assert texts["missed, corrected"]


def test_a_line_for_each_cup_says_which_one_it_replaces(tmp_path: Path) -> None:
    rows = mixture_rows(PARTLY, RunState(Header("mix", {})))
    (tmp_path / "mixtures.json").write_text(json.dumps(rows), encoding="utf-8")
    assert mixture_lines(tmp_path) == [
        "rack/A1  rejected: oil 13.0 of 10 g",
        "rack/C4  full, instead of rack/A1: oil 9.9 of 10 g",
        "rack/A2  waiting: oil — of 10 g",
    ]


@pytest.mark.parametrize(
    ("kind", "states"),
    [("pour.finished", ["filling", "filling", "waiting"]), ("pour.started", ["unknown", "unknown", "waiting"])],
    ids=["between two doses", "in a dose"],
)
def test_a_run_that_has_stopped_shows_the_cups_so_far(
    run: decant.Run, tmp_path: Path, kind: str, states: list[str]
) -> None:
    folder = tmp_path / "stopped"
    shutil.copytree(run.directory, folder)
    with contextlib.closing(sqlite3.connect(folder / "journal.sqlite")) as journal, journal:
        events = "select seq from event where kind = ? order by seq"
        number = 0 if kind == "pour.finished" else 1
        last = journal.execute(events, (kind,)).fetchall()[number][0]
        for table in ("event", "chain"):
            journal.execute(f"drop trigger {table}_is_never_deleted")
            journal.execute(f"delete from {table} where seq > ?", (last,))
    for path in folder.glob("mixtures.*"):
        path.unlink()
    stopped = decant.open_run(folder)
    assert [*stopped.mixtures["state"]] == states
    stopped.report()
    assert [row["state"] for row in csv.DictReader((folder / "mixtures.csv").open(encoding="utf-8"))] == states


def test_a_cup_that_is_not_filled_has_no_share_and_a_replaced_one_is_marked() -> None:
    rejected, full, waiting = PARTLY.components()
    assert (rejected.share, full.share, waiting.share) == (None, 1.0, None)
    assert [row.look for row in mixture_table(PARTLY).rows] == ["bad", "", ""]


PROPOSING = MIXTURES.replace("  wanted:\n", "  cups: {proposals: [B1, C1]}\n  wanted:\n").replace(
    "name: mix\n", "name: loop\n"
)


def test_a_function_proposes_the_next_mixtures_within_one_run(tmp_path: Path) -> None:
    campaign = decant.load_campaign(small_campaign.write_campaign(tmp_path, PROPOSING))
    tables: list[Any] = []

    def propose(table: Any) -> list[dict[str, str]]:
        tables.append(table)
        if len(tables) == 1:
            raise RuntimeError("the optimiser is away")
        assert (table["state"] == "full").all()
        return [{"water": f"{24 + len(tables)} g"}]

    with pytest.raises(RuntimeError, match="is away"):
        decant.run(campaign, propose=propose)
    (folder,) = (tmp_path / "runs").iterdir()
    run = decant.run(campaign, propose=propose, resume=folder)
    assert [list(dict.fromkeys(table["cup"])) for table in tables] == [
        ["rack/B2", "rack/A1"], ["rack/B2", "rack/A1"], ["rack/B2", "rack/A1", "rack/B1"]
    ]  # fmt: skip
    assert list(run.mixtures["cup"]) == ["rack/B2", "rack/B2", "rack/A1", "rack/B1", "rack/C1"]
    assert list(run.mixtures["wanted_g"])[-2:] == pytest.approx([26.0, 27.0])
    assert list(run.mixtures["dose"]) == [1, 2, 3, 4, 5]  # nothing was poured again
    assert len(list((tmp_path / "runs").iterdir())) == 1
    plan, record = run.campaign, read_record(run.directory)
    so_far = mixtures_so_far(plan, record)
    assert so_far is not None
    assert so_far.components() == run.results["doses"].components()


def test_an_impossible_proposal_stops_the_run_with_the_reason(tmp_path: Path) -> None:
    campaign = decant.load_campaign(small_campaign.write_campaign(tmp_path, PROPOSING))
    with pytest.raises(decant.RunError, match="Refused: rack/B1: the table has no milk"):
        decant.run(campaign, propose=lambda table: [{"milk": "20 g"}])


def test_without_anybody_to_propose_the_run_stops_after_its_own_mixtures(tmp_path: Path) -> None:
    path = small_campaign.write_campaign(tmp_path, PROPOSING)
    result = CliRunner().invoke(app, ["run", str(path), "--in-process"], catch_exceptions=False)
    assert result.exit_code != 0
    assert "Which mixtures are poured next, into at most 2 cups (rack/B1, rack/C1)?" in result.output
    (folder,) = (tmp_path / "runs").iterdir()
    again = ["run", str(path), "--in-process", "--resume", "--run", folder.name, "--answer", "[]"]
    result = CliRunner().invoke(app, again, catch_exceptions=False)
    assert result.exit_code == 0, result.output
    assert len(decant.open_run(folder).mixtures) == 3


def test_a_cup_for_proposals_is_named_once(tmp_path: Path) -> None:
    path = small_campaign.write_campaign(tmp_path, PROPOSING.replace("[B1, C1]", "[B1, A1]"))
    with pytest.raises(decant.ConfigError, match="'A1' is named before; such a cup is empty"):
        decant.load_campaign(path)
