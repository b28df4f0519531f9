"""What a run writes and shows."""

from __future__ import annotations

import asyncio
import io
import json
import re
from collections import Counter
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

from rich.console import Console

from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.daemon.state.event_feed import PASSING as PASSED_BY
from orchestrator.daemon.state.event_feed import event_json
from orchestrator.records.events import Event, PourProgressed, StrategyProgressed
from orchestrator.records.journal import JOURNAL_NAME, JournalReader
from orchestrator.reports.console_progress import ProgressDisplay
from orchestrator.reports.console_view import summary_table
from orchestrator.reports.publishing import publish
from orchestrator.runs.run_engine import run_campaign
from tests.golden.golden import ROOT, Golden, compact, line, normalised
from tests.golden.world import FormulaLaboratory

QUICKSTART, TWIN = ROOT / "configs/campaigns/quickstart.yaml", ROOT / "configs/laboratories/twin.yaml"

PASSING = {"time", "t", "seconds", "cpu_s", "pid", "created"}
PASSING |= {"pool_busy", "arm_longest_wait_s", "arm_mean_wait_s"}
PASSING |= {"began_at", "ended_at", "cost", "occupancy", "settings"}
"""Keys of what depends on the day, the machine and the process."""


def timeless(value: Any) -> Any:
    """A JSON-ready value without what depends on the day, the machine and the process."""
    if isinstance(value, dict):
        return {key: None if key in PASSING else timeless(one) for key, one in value.items()}
    return [timeless(one) for one in value] if isinstance(value, list) else value


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
    kept = [*passing, *(event for event in events if not isinstance(event, PASSED_BY) and not event.internal)]
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
