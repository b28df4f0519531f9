"""What a run writes and shows, and what a version that did not write a run makes of its folder.

`tests/data/old_runs` has folders of real runs: one that finished (C4, then D3), a calibration on a table of weighed
pours, and one that died while a pour was under way.
"""

from __future__ import annotations

import asyncio
import io
import json
import re
import shutil
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest
from rich.console import Console
from typer.testing import CliRunner

import decant
from orchestrator.cli.app import app
from orchestrator.config.file_loading import load_campaign, recorded_campaign
from orchestrator.daemon.event_feed import PASSING as PASSED_BY
from orchestrator.daemon.event_feed import event_json
from orchestrator.journal.codec import encode_request, first_difference
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader
from orchestrator.journal.run_record import read_result
from orchestrator.progress.console_progress import ProgressDisplay
from orchestrator.requests import Request
from orchestrator.results.console_view import summary_table
from orchestrator.results.publishing import publish
from orchestrator.results.stage_views import deployments_of
from orchestrator.runs.events import Event, PourProgressed, StrategyProgressed
from orchestrator.runs.fingerprint import fingerprint
from orchestrator.runs.resume import ToldStep, read_history
from orchestrator.runs.run_engine import run_campaign
from orchestrator.runs.stages import stages_of
from orchestrator.strategies.deployment.real_pours import PredictionCheck
from orchestrator.strategies.stage_result import StageResult
from tests.golden import old_runs
from tests.golden.golden import ROOT, Golden, agree, compact, line, normalised
from tests.golden.world import FormulaLaboratory

RUNS = ("learnt", "weighed", "unknown")

QUICKSTART, TWIN = ROOT / "configs/campaigns/quickstart.yaml", ROOT / "configs/laboratories/twin.yaml"

PASSING = {"time", "t", "seconds", "cpu_s", "pid", "created"}
PASSING |= {"pool_busy", "pool_useful", "arm_longest_wait_s", "arm_mean_wait_s"}
PASSING |= {"began_at", "ended_at", "cost", "occupancy", "settings"}
"""Keys of what depends on the day, the machine and the process."""

UNPORTABLE = (
    (re.compile(r"<svg.*?</svg>", re.DOTALL), "<svg/>"),
    (re.compile(r"<style.*?</style>", re.DOTALL), "<style/>"),
    (re.compile(r"data:[\w/+;]+,[\w+/=%]+"), "<data>"),
    (re.compile(r"(?<=>)(?=<(?:p|h\d|li|tr|dt|section|figure|div|ul|table|details|summary)\b)"), "\n"),
)
"""Pictures differ between versions of matplotlib and fonts. Tags of blocks begin a line."""


@pytest.fixture(scope="session", autouse=True)
def rewritten(request: pytest.FixtureRequest) -> None:
    """Make the folders of old runs anew, where that is asked for."""
    if request.config.getoption("--rewrite-runs", default=False):
        old_runs.make()


@pytest.fixture
def runs(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Copies of the old runs, in a folder that commands are given in."""
    folder = tmp_path / "here"
    shutil.copytree(old_runs.KEPT, folder / "runs")
    (folder / "pours.csv").write_text(old_runs.TABLE, encoding="utf-8")
    for path in folder.glob("runs/*/resolved.json"):
        moved = path.read_text(encoding="utf-8").replace(str(old_runs.HERE), str(folder))
        path.write_text(moved, encoding="utf-8")
    monkeypatch.chdir(folder)
    return folder


def typed(folder: Path, *arguments: str) -> str:
    """What a command prints, and its exit code."""
    result = CliRunner().invoke(app, list(arguments))
    if result.exception is not None and not isinstance(result.exception, SystemExit):
        raise result.exception
    printed = normalised(f"{result.stdout}{result.stderr}", [(str(folder), "<here>")])
    return f"$ decant {' '.join(arguments)}\n{printed}exit {result.exit_code}\n\n"


def page_of(path: Path, folder: Path) -> str:
    """A report without pictures."""
    text = path.read_text(encoding="utf-8")
    for pattern, new in UNPORTABLE:
        text = pattern.sub(new, text)
    return normalised(text, [(str(folder), "<here>")])


def timeless(value: Any) -> Any:
    """A JSON-ready value without what depends on the day, the machine and the process."""
    if isinstance(value, dict):
        return {key: None if key in PASSING else timeless(one) for key, one in value.items()}
    return [timeless(one) for one in value] if isinstance(value, list) else value


# -- runs of this version ----------------------------------------------------------------------------------------------


def test_a_run_writes_and_shows_the_same(golden: Golden, tmp_path: Path) -> None:
    plan = load_campaign(QUICKSTART, TWIN)
    folder = tmp_path / "quickstart-20300131-1"
    folder.mkdir()
    plan = replace(
        plan, outputs=plan.outputs.model_copy(update={"directory": str(tmp_path), "recording": False, "figures": False})
    )
    events: list[Event] = []
    display = ProgressDisplay(plan, quiet=True)
    work = run_campaign(plan, FormulaLaboratory(), folder, subscribers=[events.append, display])
    result = replace(asyncio.run(work), seconds=12.0)

    passing = [
        next(event for event in events if isinstance(event, kind)) for kind in (PourProgressed, StrategyProgressed)
    ]
    kept = [*passing, *(event for event in events if not isinstance(event, PASSED_BY))]
    told = [timeless(compact(event_json(event))) for event in kept]
    # How many of the passing ones come depends on the clock; of each kind the first one is kept.
    golden.check("one_run/events.jsonl", normalised("\n".join(map(line, _first_in_full(told, "type")))))
    with JournalReader(folder / JOURNAL_NAME) as journal:
        entries = [
            {"stage": entry.stage, "kind": str(entry.kind), "body": timeless(compact(entry.body))}
            for entry in journal.entries()
        ]
    golden.check("one_run/journal.jsonl", normalised("\n".join(map(line, _first_in_full(entries, "kind")))))

    published = publish(plan, result)
    places = [(str(tmp_path), "<here>")]
    summary = json.loads((folder / "summary.json").read_text(encoding="utf-8"))
    golden.check("one_run/summary.json", normalised(_indented(timeless(compact(summary))), places))
    theta = json.loads((folder / "theta.json").read_text(encoding="utf-8"))
    golden.check("one_run/theta.json", normalised(_indented(compact(theta)), places))
    golden.check("one_run/files.txt", "\n".join(sorted(path.name for path in folder.iterdir())))
    console = Console(file=io.StringIO(), width=120, no_color=True)
    console.print(summary_table(published.summary))
    shown = re.sub(r"pool .* at most", "<how busy the pool was>", console.file.getvalue())
    golden.check("one_run/console.txt", normalised(shown, places))  # type: ignore[attr-defined]


FULL = 3
"""Rows of a kind that are kept in full, of each type of request."""


def _first_in_full(rows: list[dict[str, Any]], key: str) -> Iterator[dict[str, Any]]:
    """The first rows of each kind as they are; of the others, requests, outcomes and results by their type alone.

    `test_campaigns.py` has every request.
    """
    seen: Counter[str] = Counter()
    for row in rows:
        body = row.get("body", row)
        kind = f"{row[key]} {_type(body.get('request'))} {_type(body.get('outcome'))}"
        seen[kind] += 1
        short = {name: _type(body[name]) for name in ("request", "outcome", "result") if name in body}
        if seen[kind] <= FULL:
            yield row
        else:
            yield {**row, "body": {**body, **short}} if "body" in row else {**row, **short}


def _type(value: Any) -> Any:
    return value.get("type", value.get("kind")) if isinstance(value, dict) else None


def _indented(value: Any) -> str:
    return json.dumps(value, indent=1, ensure_ascii=False)


# -- runs of former versions -------------------------------------------------------------------------------------------


def test_old_runs_are_found(runs: Path, golden: Golden) -> None:
    pages = [typed(runs, "runs", "add", "runs")]
    pages += [typed(runs, "runs", "list"), typed(runs, "runs", "list", "--json"), typed(runs, "runs", "pours")]
    pages += [typed(runs, "runs", "show", name) for name in RUNS]
    pages += [typed(runs, "runs", "show", name, "--json") for name in RUNS]
    pages.append(typed(runs, "runs", "compare", "learnt", "weighed"))
    golden.check("old_runs/found.txt", "".join(pages))


@pytest.mark.parametrize("name", RUNS)
def test_old_run_is_reported(name: str, runs: Path, golden: Golden) -> None:
    printed = typed(runs, "report", f"runs/{name}", "-o", "page.html", "--json")
    golden.check(f"old_runs/{name}-report.html", page_of(runs / "page.html", runs))
    golden.check(f"old_runs/{name}-report.txt", printed)


@pytest.mark.parametrize("name", RUNS)
def test_old_run_has_the_same_tables(name: str, runs: Path, golden: Golden) -> None:
    run = decant.open_run(runs / "runs" / name)
    tables = {
        table: compact(json.loads(getattr(run, table).to_json(orient="records", double_precision=15)))
        for table in ("pours", "simulations", "decisions", "curves", "outflows")
    }
    found = {
        "state": str(run.result.state),
        "counts": [run.result.simulations, run.result.pours],
        "recommended": {key: compact(one.model_dump(mode="json")) for key, one in run.recommended.items()},
        **tables,
    }
    golden.check(f"old_runs/{name}-tables.json", normalised(_indented(found)))


@pytest.mark.parametrize("name", ["learnt", "weighed"])
def test_old_run_is_published_again_as_it_was(name: str, runs: Path, golden: Golden) -> None:
    folder = runs / "runs" / name
    plan = recorded_campaign(folder / "resolved.json")
    result = read_result(folder)
    published = publish(plan, result)
    console = Console(file=io.StringIO(), width=120, no_color=True)
    console.print(summary_table(published.summary))
    places = [(str(runs), "<here>")]
    golden.check(f"old_runs/{name}-console.txt", normalised(console.file.getvalue(), places))  # type: ignore[attr-defined]
    for file in ("summary.json", "theta.json"):
        again = json.loads((folder / file).read_text(encoding="utf-8"))
        golden.check(f"old_runs/{name}-{file}", normalised(_indented(timeless(compact(again))), places))


def test_old_run_with_a_model_that_is_retired_is_listed_and_reported_but_not_resumed(runs: Path) -> None:
    """D3 with `model: pooled` and `trust: {policy: widen}`, as version 0.2 made it."""
    folder = runs / "runs" / "pooled"
    shutil.copytree(ROOT / "tests" / "data" / "retired_runs" / "pooled", folder)
    assert "pooled" in typed(runs, "runs", "add", "runs") + typed(runs, "runs", "list")
    assert typed(runs, "report", "runs/pooled", "-o", "page.html").endswith("exit 0\n\n")
    page = page_of(runs / "page.html", runs)
    assert "reduced" not in page
    assert "pooled" in page, "the page says what the run was, though this version has no such model"
    run = decant.open_run(folder)
    assert (run.result.state, run.result.pours, len(run.pours)) == ("finished", 4, 4)
    (found,) = deployments_of(run.result.results).values()
    assert isinstance(found.model_check, PredictionCheck)
    (runs / "pooled.yaml").write_text((folder / "resolved.json").read_text(encoding="utf-8"), encoding="utf-8")
    refused = typed(runs, "run", "pooled.yaml", "--resume")
    assert refused.endswith("exit 2\n\n")
    assert re.search(r"pooled\.yaml:\d+:\d+: deployment\.model: 'pooled' was retired; write 'adaptive'", refused)
    assert re.search(r"pooled\.yaml:\d+:\d+: deployment\.trust: was retired; remove it", refused)


def _numbers(result: StageResult) -> str:
    """A result without the words about the simulator, which a later version may choose differently.

    The regression of the training pours has three digits: rounding moves the maximum of its flat likelihood.
    """
    data = result.model_dump(mode="json")
    if isinstance(errors := data.get("regression"), dict):
        data["regression"] = {split: error and float(f"{error:.3g}") for split, error in errors.items()}
    if isinstance(check := data.get("model_check"), dict):
        check.pop("text", None)
    return _sorted(data)


@pytest.mark.parametrize("name", RUNS)
def test_old_run_is_replayed(name: str, runs: Path) -> None:
    """Strategies that are told what the journal has ask again for what it has.

    D3 makes other prior simulations since version 0.3; a run of 0.2, which has no hash chain, is not resumed anyway.
    """
    folder = runs / "runs" / name
    plan = recorded_campaign(folder / "resolved.json")
    asked = 0
    with JournalReader(folder / JOURNAL_NAME) as journal:
        results: dict[str, StageResult] = {}
        for stage in stages_of(plan):
            history = read_history(journal, stage.name)
            if history.seed is None or (name == "learnt" and stage.name.startswith("deployment")):
                break
            strategy, open_ = stage.build(results, history.seed), dict[int, Request]()
            for step in history.steps:
                if isinstance(step, ToldStep):
                    strategy.tell(open_.pop(step.id), history.outcomes[step.id])
                    continue
                requests = strategy.ask(step.slots)
                assert len(requests) == len(step.ids)
                for key, request in zip(step.ids, requests, strict=True):
                    before, now = _sorted(encode_request(history.request(key))), _sorted(encode_request(request))
                    assert agree(before, now), f"stage {stage.name}, request {key}:\n- {before}\n+ {now}"
                    open_[key], asked = request, asked + 1
            if history.result is not None:
                before, now = (_numbers(one) for one in (history.result, strategy.result()))
                assert agree(before, now)
                results[stage.name] = history.result
    assert asked > 0


@pytest.mark.parametrize("name", RUNS)
def test_old_run_has_the_fingerprint_of_its_campaign(name: str, runs: Path) -> None:
    """So that it can be resumed: of D3's settings those that are retired are left out on both sides."""
    folder = runs / "runs" / name
    with JournalReader(folder / JOURNAL_NAME) as journal:
        written = journal.header.fingerprint
    assert first_difference(written, fingerprint(recorded_campaign(folder / "resolved.json"))) is None


def _sorted(value: Any) -> str:
    return json.dumps(compact(value), ensure_ascii=False, sort_keys=True)


def test_an_old_pour_of_unknown_outcome_needs_a_person(runs: Path, golden: Golden) -> None:
    campaign = old_runs.CAMPAIGNS["unknown"][0]
    for name, text in (("beaker", old_runs.BEAKER), ("narrow", old_runs.NARROW), ("unknown", campaign)):
        (runs / f"{name}.yaml").write_text(text, encoding="utf-8")
    printed = typed(runs, "run", "unknown.yaml", "--resume", "--run", "unknown", "--in-process", "--quiet")
    golden.check("old_runs/unknown-resumed.txt", printed)
