"""`html_report`: the report of a run: everything on one page, nothing beside it, honest about what is not finished
or not known.
"""

from __future__ import annotations

import asyncio
import json
import re
import shlex
import shutil
from collections.abc import Callable
from dataclasses import replace
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, NamedTuple

import pytest
from typer.testing import CliRunner

from actors.interfaces import LaboratoryError
from actors.optimizer_actor import Proposer
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.cli.app import app
from orchestrator.cli.foreground_run import report_of_what_stands
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Failed
from orchestrator.learning.run_errors import RunError
from orchestrator.records.journal_check import JournalCheck
from orchestrator.records.run_record import CampaignResult, RecordedDecision, read_record
from orchestrator.reports import figure_style as style
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.html_report import run_page
from orchestrator.reports.publishing import Published, publish
from orchestrator.reports.run_summary import RunFiles, summary_json
from orchestrator.reports.summarise import summarise
from orchestrator.reports.wording import pour_tables
from orchestrator.runs.request_executor import FILM_RATE
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.run_folder import create_run
from orchestrator.runs.run_service import RunRequest, RunResources, RunService
from orchestrator.runs.stages import stages_of
from sim_engine.outcome import SimulatedPour
from sim_engine.scene import PourTask
from tests.support import example_run
from tests.support.example_results import changed, shown
from tests.support.small_campaign import CAMPAIGN, write_campaign
from tests.support.toy_campaign import ToyBench, ToyLaboratory, ToySimulators

SCRIPT = "<script>alert(1)</script>"


class Made(NamedTuple):
    """A campaign that was run in a world whose spillage is a formula."""

    plan: CampaignPlan
    result: CampaignResult
    published: Published

    @property
    def page(self) -> str:
        assert self.published.report is not None
        return self.published.report.read_text(encoding="utf-8")


class Asked:
    """The optimiser itself, in this process, until it is broken."""

    def __init__(self, broken: Callable[[], bool] = lambda: False) -> None:
        self.broken = broken

    async def suggest(self, problem: Any) -> Any:
        if self.broken():
            raise LaboratoryError("a cable came off <b>")
        return Proposer().suggest(problem)


class Filming(ToySimulators):
    """Simulators that keep frames of the recommended pour."""

    async def simulate(self, task: PourTask) -> SimulatedPour:
        found = await super().simulate(task)
        return replace(found, frames=example_run.frames()) if task.frame_rate == FILM_RATE else found


def laboratory(bench: ToyBench | None = None, optimizer: Asked | None = None) -> ToyLaboratory:
    return ToyLaboratory(Filming(), bench or ToyBench(), optimizer or Asked())  # type: ignore[arg-type]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Made:
    plan = load_campaign(write_campaign(tmp_path_factory.mktemp("report")))
    result = asyncio.run(run_campaign(plan, laboratory(), create_run(plan)))
    return Made(plan, result, publish(plan, result))


def texts(page: str) -> str:
    """What a reader sees."""
    import html

    body = re.sub(r"<(style|pre)>.*?</\1>", "", page, flags=re.DOTALL)
    return " ".join(html.unescape(re.sub(r"<[^>]+>", " ", body)).split())


def decant(command: str) -> Any:
    return CliRunner().invoke(app, shlex.split(command))


@pytest.mark.slow
def test_the_page_needs_nothing_beside_it(made: Made) -> None:
    assert made.page.startswith("<!doctype html>")
    assert not re.search(r'(?:src|href)="(?!data:)', made.page)
    assert not re.search(r"url\(|@import|<script|<link", made.page)
    assert made.page.count('src="data:image/svg+xml') == len(made.published.figures) > 3


@pytest.mark.slow
def test_every_figure_is_there_as_lines_for_print(made: Made) -> None:
    assert all(
        path.with_suffix(".svg").read_text("utf-8").count("<path") > 10 for path in made.published.figures.values()
    )


def test_the_same_figure_is_the_same_file(tmp_path: Path) -> None:
    def drawn(folder: Path) -> bytes:
        figure, axes = style.new_figure(size=(3.0, 2.0))
        axes.plot([0, 1], [1, 0], "o")
        style.save(figure, folder / "line.png", (".svg", ".pdf"))
        return b"".join((folder / f"line.{kind}").read_bytes() for kind in ("png", "svg", "pdf"))

    assert drawn(tmp_path / "first") == drawn(tmp_path / "second")


def test_it_says_what_to_do_what_to_expect_and_what_nobody_knows(made: Made) -> None:
    said, row = texts(made.page), next(iter(made.published.summary.outcome.receivers.values()))
    assert row.recommended is not None
    assert f"{row.recommended.action_si['x_offset'] * 1e3:.3g} mm" in said
    assert "To pour 100 g of water from beaker into narrow, use the recommended action." in said
    assert "The recommended action was not poured again" in said
    assert "The bench was VIRTUAL: no robot moved and no liquid was weighed." in said
    assert "θ* with its region" in said
    assert "5 begun, 5 weighed" in said


TABLE = """angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split,operator
60,80,98,2.1,2,train,Ada
75,95,98,3.0,2,train,Ada
90,110,98,4.2,2,train,Ada
105,85,98,5.1,2,train,Bo
120,100,98,45.0,2,train,Bo
150,90,98,7.1,2,train,Bo
165,105,98,8.3,2,train,Bo
80,100,98,3.6,2,test,Ada
135,95,98,6.4,2,test,Bo
"""


def test_a_calibration_from_a_table_lists_its_pours_and_begins_with_the_error_on_those_that_were_not_fitted(
    tmp_path: Path,
) -> None:
    (tmp_path / "pours.csv").write_text(TABLE, encoding="utf-8")
    text = CAMPAIGN.replace("pours: {count: 3, holdout: 1}", "pours: {from: pours.csv}")
    text = "\n".join(text.split("deployment:")[0].splitlines()) + "\noutputs: {directory: runs}\n"
    plan = load_campaign(write_campaign(tmp_path, text))
    result = asyncio.run(run_campaign(plan, laboratory(), create_run(plan)))
    made = Made(plan, result, publish(plan, result))
    said = texts(made.page)
    scores = made.published.summary.results["evaluation"]
    scored, gain = made.published.summary.learning.discrepancy["test"], scores.gain
    error, regression = 100 * scored[gain.recommended], 100 * scored["regression"]
    assert said.split(" Summary ")[1].startswith(
        f"On pours that were not fitted, the simulated spillage is off by {error:.2f} % on test pours (a regression of "
        f"the training pours, without a simulator: {regression:.2f} %) in the mean."
    )
    assert said.count(" is off by ") == 1
    assert "No pour" not in said
    assert "used as angular velocity [deg/s] max angle [deg] weighed simulated" in said
    table = said[said.index("9 weighed pours with their simulation by θ*") :]
    swapped = scores.pours[4]
    assert f"5 6 training 120 100 45.92 {100 * swapped.simulated:.2f} {100 * swapped.residual:.2f} " in table
    assert re.search(r"6 7 training 150 90 7\.24 .* Bo 7 8 training", table)

    unfit = [changed(pour, fits=pour.number != 5) for pour in scores.pours]
    summary = made.published.summary.model_copy(update={"results": {"evaluation": changed(scores, pours=unfit)}})
    (listed,) = pour_tables(summary)
    assert [row.cells[0] for row in listed.rows if row.look == "bad"] == ["5"]
    assert listed.rows[4].cells[-2:] == ["no", "Bo"]


def test_ranges_of_theta_have_the_unit_of_their_value(made: Made) -> None:
    searched = [one for one in made.published.summary.learning.parameters if one.searched != "not searched"]
    assert searched
    for one in searched:
        _, _, unit = one.value.partition(" ")
        assert one.searched.endswith(unit)
        assert one.region == "—" or one.region.removesuffix(", not determined").endswith(unit)
        assert f"{one.name} {one.value} {one.region} {one.searched}" in texts(made.page)
    assert {"cohesion": "N/m"}.items() <= {one.name: one.value.split(" ")[-1] for one in searched}.items()
    assert style.display_interval("receiver_x", -0.0244, -0.00273) == "-24.4 … -2.73 mm"


def test_pictures_come_first_and_parameters_that_were_not_searched_in_one_line(made: Made) -> None:
    first = made.page[: made.page.index("<h2>Summary</h2>")]
    assert re.findall(r'alt="(\w+ \w+)', first) == ["recommended pour", "loss against", "loss map"]
    shown = texts(made.page)
    table = shown[shown.index("θ* with its region") : shown.index("Not searched: ")]
    assert "not searched" not in table
    fixed = [
        f"{one.name} {one.value}"
        for one in made.published.summary.learning.parameters
        if one.searched == "not searched"
    ]
    assert fixed
    assert f"Not searched: {', '.join(fixed)}." in shown


def test_every_pour_stands_in_a_table_with_its_grams(made: Made) -> None:
    pours = read_record(made.result.directory).pours
    assert len(pours) == 5
    said = texts(made.page)
    for pour in pours:
        assert pour.measured is not None
        assert f" {1e3 * pour.measured.loaded:.1f} {1e3 * pour.measured.spilled:.1f} " in said
    grams = sum(1e3 * pour.measured.spilled for pour in pours if pour.measured is not None)
    assert f"{grams:.1f} g spilled" in said


def test_names_and_reasons_that_are_html_stay_text(made: Made) -> None:
    plan = replace(made.plan, name=SCRIPT, resolved={"name": SCRIPT})
    assert plan.deployment is not None
    named = {"name": SCRIPT}
    scenes = [
        replace(one, receiver=one.receiver.model_copy(update=named), liquid=one.liquid.model_copy(update=named))
        for one in plan.deployment.scenes
    ]
    plan = replace(plan, deployment=replace(plan.deployment, scenes=tuple(scenes)))
    record = read_record(made.result.directory)
    record.pours[0].state, record.pours[0].outcome = "failed", Failed("pour_failed", SCRIPT)
    record.notes.append((0.0, SCRIPT, None))
    record.decisions.append(RecordedDecision(0.0, SCRIPT, SCRIPT, {}, 0))
    summary = summarise(
        plan,
        made.result.results,
        record=record,
        run=SCRIPT,
        files=RunFiles(figures={f"loss map {SCRIPT}": made.published.figures["discrepancy map"]}),
        versions={"campaign": SCRIPT, "packages": {SCRIPT: SCRIPT}},
        check=JournalCheck(Path(SCRIPT), problems=(SCRIPT,)),
    )
    page = run_page(summary, plan.resolved)
    assert "WARNING: the records of this run are damaged or incomplete" in page
    assert "<script" not in page
    assert page.count("&lt;script&gt;") > 10


class Outline(HTMLParser):
    """Headings, pictures and tables as a screen reader meets them."""

    def __init__(self) -> None:
        super().__init__()
        self.levels: list[int] = []
        self.missing: list[str] = []
        self.tables = self.captions = 0

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        given = dict(attrs)
        if re.fullmatch(r"h[1-6]", tag):
            self.levels.append(int(tag[1]))
        if tag == "img" and len(given.get("alt") or "") < 20:
            self.missing.append(f"an alt text: {given.get('alt')}")
        if tag == "html" and given.get("lang") != "en":
            self.missing.append("the language")
        if tag == "th" and given.get("scope") not in ("col", "row"):
            self.missing.append("a scope")
        self.tables += tag == "table"
        self.captions += tag == "caption"


def test_a_screen_reader_finds_its_way(made: Made) -> None:
    outline = Outline()
    outline.feed(made.page)
    assert outline.missing == []
    assert outline.levels[0] == 1
    assert outline.levels.count(1) == 1
    assert all(after <= before + 1 for before, after in zip(outline.levels, outline.levels[1:], strict=False))
    assert outline.tables == outline.captions > 5


def stopped(folder: Path, bench: ToyBench, when: Callable[[], bool]) -> Path:
    """Folder of a run that was asked to stop twice, as soon as something is so: what is under way is given up."""
    plan = load_campaign(write_campaign(folder))
    directory = create_run(plan)

    async def run() -> None:
        task = asyncio.ensure_future(run_campaign(plan, laboratory(bench), directory))
        while not when() and not task.done():
            await asyncio.sleep(0.01)
        for _ in range(2):
            task.cancel()
            await asyncio.sleep(0.05)  # two interrupts, and not one
        with pytest.raises(asyncio.CancelledError):
            await task

    asyncio.run(run())
    return directory


def test_a_pour_that_nobody_knows_of_is_called_so_and_its_liquid_is_not_made_up(tmp_path: Path) -> None:
    begun: list[float] = []

    def pause() -> float:
        begun.append(60.0 if begun else 0.0)
        return begun[-1]

    directory = stopped(tmp_path, ToyBench(pause), lambda: len(begun) == 2)
    done = decant(f"report {directory}")
    assert done.exit_code == 0, done.output
    said = texts((directory / "report.html").read_text(encoding="utf-8"))
    assert "This run is not finished. Its state is 'unknown'" in said
    assert "Pour 2 of pours had begun, and its outcome is not known." in said
    assert "2 begun, 1 weighed, 1 of unknown outcome" in said
    assert f"--resume --run {directory.name}" in said
    assert "The software does not repeat it" in said


@pytest.mark.slow
def test_a_failed_run_says_why_and_what_stands(tmp_path: Path) -> None:
    plan = load_campaign(write_campaign(tmp_path))
    bench, directory = ToyBench(), create_run(plan)
    calls = iter(range(1, 100))
    bench.fails = lambda seed: LaboratoryError("the hose came off") if next(calls) == 4 else None
    opened = laboratory(bench, Asked(lambda: len(bench.poured) == 4))
    resources = RunResources(laboratory=lambda settings, pours: opened)
    handle = RunService().start(RunRequest(plan, stages_of(plan), directory), resources)
    with pytest.raises(RunError, match="cable"):
        asyncio.run(handle.wait())
    page = report_of_what_stands(handle)
    assert page is not None
    said = texts(page.read_text(encoding="utf-8"))
    assert "Its state is 'failed'" in said
    assert "a cable came off <b>" in said
    assert "failed: the hose came off" in said
    assert "The loss of the only pour so far is" in said
    assert "θ* with its region" in said, "calibration was closed before"


def test_a_run_of_another_campaign_is_not_reported_as_this_one(made: Made, tmp_path: Path) -> None:
    other = load_campaign(write_campaign(tmp_path, CAMPAIGN.replace("100 g", "90 g")))
    directory = made.result.directory
    request = RunRequest(other, stages_of(other), directory, resume=True)
    handle = RunService().start(request, RunResources(in_process=True))
    with pytest.raises(RunError, match="mass"):
        asyncio.run(handle.wait())
    assert report_of_what_stands(handle) is None


@pytest.mark.slow
def test_the_verb_writes_where_it_is_told_and_figures_for_latex(made: Made, tmp_path: Path) -> None:
    page = tmp_path / "meeting.html"
    done = decant(f"report {made.result.directory} --pdf -o {page}")
    assert done.exit_code == 0, done.output
    assert page.read_text(encoding="utf-8").startswith("<!doctype html>")
    for file in made.published.figures.values():
        assert file.with_suffix(".pdf").read_bytes().startswith(b"%PDF")


def test_a_summary_of_the_time_before_the_run_was_finished_is_written_again(made: Made, tmp_path: Path) -> None:
    folder = tmp_path / "run"
    shutil.copytree(made.result.directory, folder)
    finished = (folder / "summary.json").read_text(encoding="utf-8")
    interrupted = json.loads(finished) | {"state": "interrupted"}
    (folder / "summary.json").write_text(json.dumps(interrupted), encoding="utf-8")
    assert decant(f"report {shlex.quote(str(folder))}").exit_code == 0
    again = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    assert again["state"] == "finished"


@pytest.mark.parametrize(
    ("argument", "said"),
    [("nothing", "runs/nothing: no run is here"), ("{run} -o page.txt", "should end in .html")],
)
def test_the_verb_refuses_what_it_can_not_report_on(made: Made, argument: str, said: str) -> None:
    done = decant(f"report {argument.format(run=made.result.directory)}")
    assert done.exit_code == 2
    assert said in done.output


@pytest.mark.slow
def test_the_library_writes_it_too(made: Made, tmp_path: Path) -> None:
    import decant as library

    page = library.open_run(made.result.directory).report(tmp_path / "page.html")
    assert texts(page.read_text(encoding="utf-8")) == texts(made.page)


def test_console_page_json_and_library_show_one_text_for_each_result(made: Made) -> None:
    import html
    import json

    import decant as library

    console = " ".join(shown(summary_table(made.published.summary), width=400).split())
    page = " ".join(texts(made.page).split())
    data = json.loads(json.dumps(summary_json(library.open_run(made.result.directory).summary)))
    outcome = data["outcome"]
    (receiver,) = outcome["receivers"].values()
    (advice,) = outcome["advice"]
    everywhere = [*filter(None, receiver["texts"].values()), *advice["sentences"], *advice["open"]]
    everywhere += data["learning"]["theta_sentences"]
    assert len(everywhere) > 10
    for text in everywhere:
        assert text in console
        assert html.unescape(text) in page
    for pour in outcome["pours_made"]:
        assert pour["predicted"] in page
        assert pour["calibration"] or pour["measured"] in page
        assert f"{pour['spilled_g']:.1f}" in page
    assert all(use["text"] in console and use["text"] in page for use in data["occupancy"].values())
    assert all(text in page for text in (*data["cost"].values(), *outcome["open_questions"], *data["asked"].values()))
