"""What the pages say must be so: commands parse, named files exist, tables are the code's (`make docs`: links)."""

from __future__ import annotations

import importlib.util
import json
import re
import shlex
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any

import pytest
from ruamel.yaml import YAML

from actors.runtime.child_process import child_environment
from orchestrator.campaigns.campaign_file import CampaignFile
from orchestrator.campaigns.file_loading import load_campaign, load_vessel
from orchestrator.campaigns.file_references import VesselFile
from orchestrator.campaigns.search_ranges import EXAMPLES
from orchestrator.campaigns.yaml.section_validation import RENAMED, sections_in
from orchestrator.cli import console as common
from orchestrator.daemon.state.daemon_settings import DaemonFile
from orchestrator.records.journal import Kind
from orchestrator.runs.resume import OperatorNeededError
from orchestrator.study.study_file import StudyFile
from sim_engine import model_validity as regimes
from sim_engine.action import ACTION_DIMENSIONS
from sim_engine.lip_flow import EDGE
from sim_engine.settings.model import Settings
from tests.support.cli_inputs import command_tree

ROOT = Path(__file__).parent.parent
PAGES = sorted([*ROOT.glob("*.md"), *(ROOT / "docs").rglob("*.md"), *(ROOT / "configs").rglob("*.md")])
GENERATED = ("CHANGELOG.md", "command-line.md")
"""Pages that show old commands, or placeholders."""
FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)

each_page = pytest.mark.parametrize("page", [page for page in PAGES if page.name not in GENERATED], ids=str)


def text_of(page: Path) -> str:
    return page.read_text(encoding="utf-8")


def chapter_of(page: str, heading: str) -> str:
    return text_of(ROOT / "docs" / page).partition(heading)[2].partition("\n## ")[0]


def prose_of(page: Path) -> str:
    return FENCE.sub("", text_of(page))


def commands_of(page: Path) -> list[str]:
    """Every `decant …` that a reader could copy."""
    blocks = [line for _, block in FENCE.findall(text_of(page)) for line in block.splitlines()]
    spans = re.findall(r"`([^`\n]+)`", prose_of(page))
    known = (re.sub(r"^(\.venv/bin/)", "", line.strip()) for line in [*blocks, *spans])
    return [line for line in known if line.startswith("decant ") and not line.startswith("decant …")]


@pytest.fixture(scope="module")
def tables() -> ModuleType:
    sys.path.insert(0, str(ROOT / "docs"))  # as when the script is run
    spec = importlib.util.spec_from_file_location("make_tables", ROOT / "docs" / "make_tables.py")
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    return module


def test_pages_show_commands_to_check() -> None:
    verbs = {command.split()[1] for page in PAGES for command in commands_of(page)}
    assert set(command_tree().commands) <= verbs


@each_page
def test_shown_commands_are_understood(page: Path) -> None:
    verbs = command_tree().commands
    for line in commands_of(page):
        _, verb, *arguments = shlex.split(line, comments=True)
        if verb.startswith("--"):
            continue  # an option of the program
        assert verb in verbs, line
        command = verbs[verb]
        while arguments and arguments[0] in getattr(command, "commands", {}):
            command = command.commands[arguments.pop(0)]
        assert arguments[:1] in ([], ["…"]) or not getattr(command, "commands", {}) or verb == "runs", line
        if not arguments or arguments == ["…"]:
            continue  # a verb that is only mentioned
        try:
            command.make_context(verb, list(arguments)).close()  # raises on what the command does not know
        except Exception as error:
            mentioned = all(word.startswith("-") for word in arguments)  # an option, which then needs no campaign
            if not mentioned or type(error).__name__ != "MissingParameter":
                raise
        for argument in arguments:
            if argument.startswith("configs/"):
                assert (ROOT / argument).exists(), line


@each_page
def test_named_files_exist(page: Path) -> None:
    floors = r"`((?:orchestrator|actors|sim_engine|tests|docs|configs)/[\w./-]*)`"
    for path in re.findall(floors, text_of(page)):
        assert (ROOT / path).exists(), path


def test_tables_are_what_the_code_declares(tables: ModuleType) -> None:
    pages = tables.pages()
    assert {page.name for page in pages} >= {"campaign.md", "laboratory.md", "liquids.md", "learning.md"}
    for page in pages:
        assert tables.render(text_of(page), page) == text_of(page), "run: python docs/make_tables.py"


def test_every_table_stands_on_some_page(tables: ModuleType) -> None:
    used = {name for page in tables.pages() for _, name, _ in tables.MARKED.findall(text_of(page))}
    assert used >= set(tables.TABLES)


def test_every_package_is_on_the_architecture_page_and_every_file_named_there_exists() -> None:
    page = text_of(ROOT / "docs" / "explanation" / "architecture.md")
    for layer in ("sim_engine", "actors", "orchestrator"):
        for package in sorted(path.parent for path in (ROOT / layer).glob("*/__init__.py")):
            assert f"`{package.relative_to(ROOT)}`" in page, f"{package} is not in docs/explanation/architecture.md"
    for name in re.findall(r"`((?:sim_engine|actors|orchestrator|decant|tests)/[\w/]+\.(?:py|js))`", page):
        assert (ROOT / name).is_file(), f"docs/explanation/architecture.md names {name}, which does not exist"


def test_journal_kinds_are_the_journal_s() -> None:
    chapter = chapter_of("explanation/architecture.md", "## The journal")
    rows = re.findall(r"^\| (`.+?) \|", chapter, re.MULTILINE)
    assert {word for row in rows for word in re.findall(r"`([\w.]+)`", row)} == {str(kind) for kind in Kind}


def test_exit_codes_are_the_commands() -> None:
    chapter = (
        text_of(ROOT / "docs" / "experiments" / "interrupt-and-resume.md")
        .partition("## Exit codes")[2]
        .partition("\n## ")[0]
    )
    codes = {int(code) for code in re.findall(r"^\| (\d+) \|", chapter, re.MULTILINE)}
    assert codes == {
        0,
        common.FAILED,
        common.BAD_INPUT,
        OperatorNeededError.exit_code,
        common.NOT_COMPLETE,
        common.INTERRUPTED,
    }


def test_vessel_shown_in_the_guide_is_one(tmp_path: Path) -> None:
    shown = [
        block
        for kind, block in FENCE.findall(text_of(ROOT / "docs" / "reference" / "vessel.md"))
        if "profile:" in block
    ]
    assert len(shown) == 1
    path = tmp_path / "vessel.yaml"
    path.write_text(shown[0], encoding="utf-8")
    assert load_vessel(path) == load_vessel(ROOT / "configs" / "vessels" / "narrow.yaml")


def test_numbers_of_the_solver_are_the_code_s() -> None:
    sources = "".join(text_of(ROOT / "sim_engine" / "fluid" / f"{name}.py") for name in ("step", "tension"))
    names = ("CFL", "PACE", "SHORTEST_STEP", "LONGEST_STEP", "WARM", "TOLERANCE")
    cfl, pace, shortest, longest, warm, tolerance = (
        float(re.findall(rf"^{name} = (\S+)$", sources, re.MULTILINE)[0]) for name in names
    )
    page = " ".join(prose_of(ROOT / "docs" / "explanation" / "simulator.md").split())
    assert f"{1e3 * shortest:g} to {1e3 * longest:g} ms: at most {cfl:g} spacings for the fastest particle" in page
    assert f"at most {pace:g} √(d/g)" in page
    assert f"until the mean compression is below {100 * tolerance:g} %" in page
    assert (warm, "Three tenths of the multipliers are kept" in page) == (0.3, True)


def test_limits_of_what_is_simulated_are_the_code_s() -> None:
    page = chapter_of("explanation/simulator.md", "## Model validity")
    for limit in (
        f"| We < {regimes.DRIBBLING_WEBER:g} at the rim |",
        f"| Bo < {regimes.WETTING_BOND:g} of the film |",
        f"| Re < {regimes.VISCOUS_REYNOLDS:g} at the rim |",
        f"stream thinner than {regimes.PARTICLES_ACROSS:g} particles",
        f"| ρgR²/σ < {regimes.AIRTIGHT_BOND:g} |",
        f"more than {100 * EDGE:g} % of the liquid",
    ):
        assert limit in page


def test_quickstart_is_what_the_tutorial_says() -> None:
    plan = load_campaign(ROOT / "configs" / "campaigns" / "quickstart.yaml")
    calibration, deployment = plan.calibration, plan.deployment
    assert calibration is not None
    assert deployment is not None
    page = " ".join(text_of(ROOT / "docs" / "tutorials" / "first-pour.md").split())
    assert (calibration.pour_count, deployment.pours) == (12, 6)
    assert "weighs twelve pours into a tumbler" in page
    assert (calibration.settings.model_dump()["simulations"], "simulations: auto" in page) == ("auto", True)
    assert f"{deployment.settings.simulations_before} simulations first, then at most six pours" in page


def keys_of(model: type[Settings]) -> set[str]:
    """Keys of settings and of those within them."""
    found, left = set[str](), [model]
    seen: set[type[Settings]] = set()
    while left:
        one = left.pop()
        if one not in seen:
            seen.add(one)
            found |= set(one.written_keys())
            left += [inner for info in one.model_fields.values() for inner in sections_in(info.annotation)]
    return found


def test_blocks_of_yaml_have_only_keys_that_exist() -> None:
    known = keys_of(CampaignFile) | keys_of(StudyFile) | keys_of(DaemonFile) | keys_of(VesselFile)
    known |= (
        set(EXAMPLES) | set(ACTION_DIMENSIONS) | {"constraints", "cone", "max_hold_time", "pivot", "rough", "fastest"}
    )
    for page in PAGES:
        for kind, block in FENCE.findall(text_of(page)):
            for part in re.split(r"^(?=liquid:)", block, flags=re.MULTILINE) if kind == "yaml" else []:
                found = YAML(typ="safe").load(part)
                assert set(words_of(found)) <= known, f"{page}: {set(words_of(found)) - known}"


def words_of(value: Any, within: str = "") -> Iterator[str]:
    if isinstance(value, dict) and within != "wanted":  # below are names of cups and liquids
        for key, inner in value.items():
            if within not in ("rigs", "columns"):
                yield str(key)
            yield from words_of(inner, str(key))
    elif isinstance(value, list):
        for inner in value:
            yield from words_of(inner)


def test_claims_name_tests_and_pages_that_exist() -> None:
    page = text_of(ROOT / "docs" / "evidence" / "claims.md")
    named = re.findall(r"`(tests/[\w/]+\.py)(?:::(\w+))?`", page)
    assert len(named) >= 20
    for path, test in named:
        assert (ROOT / path).is_file(), path
        assert not test or f"def {test}(" in text_of(ROOT / path), f"{path}::{test}"
    claims = re.findall(r"^\| (?!claim|statement)(.+) \|$", page, re.MULTILINE)
    assert len(claims) >= 40
    assert [claim for claim in claims if ".md" not in claim] == []


def criteria_of(chapters: str) -> tuple[int, int]:
    """How many criteria are met there, and how many there are."""
    counts = re.findall(r"(?<=\| )(?:\*\*)?(\d+) of (\d+)(?:\*\*)?(?= \|)", chapters)
    met, judged = (sum(map(int, column)) for column in zip(*counts, strict=True))
    return met, judged


def test_counts_of_physical_criteria_are_those_of_the_validation_page() -> None:
    page = text_of(ROOT / "docs" / "evidence" / "validation.md")
    met, judged = criteria_of(page)
    assert f"{met} of {judged} criteria are met" in page
    assert f"| {met} of {judged} physical criteria are met |" in text_of(ROOT / "docs" / "evidence" / "claims.md")
    met, judged = criteria_of(page[page.index("| [floor]") :])
    liquids = " ".join(text_of(ROOT / "docs" / "experiments" / "liquids.md").split())
    assert f"of {judged} criteria for thick liquids and contact angles, {met} are met" in liquids


def evidence_of(page: str) -> str:
    return " ".join(text_of(ROOT / "docs" / "evidence" / f"{page}.md").split())


def data_of(name: str) -> Any:
    return json.loads(text_of(ROOT / "docs" / "data" / f"{name}.json"))


def test_the_figures_of_the_overview_and_of_the_first_sentences_are_the_measured_ones() -> None:
    results, dosing = data_of("results"), data_of("dosing")["groups"]["spout, water, lag 0.1 to 0.5 s"]["particles"]
    first = next(row for row in results["first-pours"]["rows"] if row[:3] == ["with evidence", "all", "first"])
    column = results["learning"]["head"].index("mean of 15 pours")
    learning = {row[0]: 100.0 * float(row[column].split()[0]) for row in results["learning"]["rows"]}
    particles = [row["mean"] for name, row in data_of("dosing-particles")["rows"].items() if "moved" not in name]
    pours = [record["result"] for name, record in data_of("performance").items() if name.startswith("pour-")]
    fast, whole = ([row["ratio"] for row in rows] for rows in (pours, [row["whole"] for row in pours]))
    met, judged = criteria_of(text_of(ROOT / "docs" / "evidence" / "validation.md"))
    scored = evidence_of("calibration").partition("Mean |r")[2]
    worlds = dict(re.findall(r"(uncalibrated|C4|D2|D3) (\d+\.\d)", scored))
    (cases,) = re.findall(r"(\d+) cases were run, 0 ended otherwise", evidence_of("reliability"))
    for page, figure in (
        ("calibration", f"from {worlds['uncalibrated']} to {worlds['C4']} points"),
        ("first-pours", f"{first[5]} % of the load"),
        ("index", f"{first[8]} of first pours are in their 90 % intervals"),
        ("learning", f"{learning['D3']:.1f} % of a load in the mean of 15 pours"),
        ("index", f"learning by pours alone loses {learning['D2']:.0f} %"),
        ("index", f"D3 loses {worlds['D3']} % of a load in a pour, D2 {worlds['D2']} %"),
        ("index", f"{dosing['mean']:.1f} g in the mean and {dosing['p95']:.1f} g in 95 %"),
        ("index", f"{min(particles):.1f} to {max(particles):.1f} g when particles are poured"),
        ("dosing", f"{min(particles):.1f} to {max(particles):.1f} g"),
        ("performance", f"{min(fast):.0f} to {max(fast):.0f} times as"),
        ("performance", f"{min(whole):.0f} to {max(whole):.0f} times as"),
        ("index", f"| {pours[0]['cpu_s']:.1f} s of one core"),
        ("validation", f"{met} of {judged} criteria"),
        ("reliability", f"{int(cases):,}"),
    ):
        assert figure in evidence_of("index"), f"index: {figure}"
        assert figure in evidence_of(page), f"{page}: {figure}"


def hand_written(page: Path) -> int:
    """Words of a page without code and generated tables."""
    generated = r"<!-- (?:table|measured|study|vessel sources|timing)\b.*?<!-- end of [\w ]+ -->"
    return len(re.sub(generated, "", prose_of(page), flags=re.DOTALL).split())


BUDGETS = {"experiments": 4_300, "explanation": 9_000, "extend": 1_800, "laboratory": 9_650, "tutorials": 3_850}
"""Words of each folder of hand-written pages; the reference is generated, and notes are no part of the site."""


def test_no_folder_of_pages_grows() -> None:
    words: dict[str, int] = {}
    for page in sorted((ROOT / "docs").rglob("*.md")):
        folder = page.relative_to(ROOT / "docs").parts[0]
        if folder in BUDGETS:
            words[folder] = words.get(folder, 0) + hand_written(page)
    assert all(words.get(folder, 0) <= most for folder, most in BUDGETS.items()), words


@pytest.mark.parametrize("folder", ["experiments", "extend", "laboratory", "tutorials"])
def test_a_guide_is_read_in_ten_minutes(folder: str) -> None:
    words = {
        page.name: sum(re.search(r"\w", word) is not None for word in text_of(page).split())
        for page in (ROOT / "docs" / folder).glob("*.md")
    }
    assert {name: count for name, count in words.items() if count > 1_200} == {}


def test_the_evidence_is_short_with_its_tables() -> None:
    words = {page.stem: len(text_of(page).split()) for page in (ROOT / "docs" / "evidence").glob("*.md")}
    assert words.pop("index") <= 900
    assert words.pop("claims") <= 800
    assert sum(words.values()) <= 11_000, words


def test_the_overview_of_the_evidence_names_no_seed_and_no_version_and_leads_to_every_page() -> None:
    folder = ROOT / "docs" / "evidence"
    overview = text_of(folder / "index.md")
    assert not re.search(r"\b(seeds?|versions?|goals?|\d+\.dev\d+)\b", overview, re.IGNORECASE)
    for page in folder.glob("*.md"):
        assert page.name == "index.md" or f"({page.name})" in overview, page.name


def test_changelog_has_every_version_that_was_released() -> None:
    """The version comes from the tag, so that a tag needs its chapter before the next change."""
    tags = subprocess.run(
        ["git", "tag", "--list", "v*"], cwd=ROOT, capture_output=True, text=True, check=True, env=child_environment()
    ).stdout
    headings = set(re.findall(r"^## \[([^\]]+)\]", text_of(ROOT / "CHANGELOG.md"), re.MULTILINE))
    assert {tag.removeprefix("v") for tag in tags.split()} <= headings
    assert "Unreleased" in headings


def test_a_section_of_the_changelog_is_short_and_has_every_renamed_key() -> None:
    """What a user has to do, what is new and what is gone; steps between two releases are in git."""
    sections = re.split(r"^## ", text_of(ROOT / "CHANGELOG.md"), flags=re.MULTILINE)[1:]
    words = {section.splitlines()[0]: len(section.split()) for section in sections}
    assert max(words.values()) <= 2_000, words
    (section,) = (text for text in sections if re.match(r"\[?0\.3\.0", text))
    rows = re.findall(r"^\|(.+)\|(.+)\|$", section, re.MULTILINE)
    for key, now in RENAMED.items():
        assert any(re.search(rf"\b{key}\b", before) and f"`{now}`" in after for before, after in rows), key
