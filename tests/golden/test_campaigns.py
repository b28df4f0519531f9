"""What every shipped campaign asks for and decides, in a world whose pours and answers are formulas.

Outcomes are functions of action, θ and seed, answers of the optimiser are functions of the question, both in plain
arithmetic that is the same on any machine. The optimiser itself has golden answers of its own (`test_optimizer.py`).
"""

from __future__ import annotations

import dataclasses
import hashlib
import importlib.util
import json
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from orchestrator.campaigns.file_loading import load_campaign, load_laboratory, load_vessel
from orchestrator.campaigns.fingerprint import deciding, fingerprint
from orchestrator.learning.campaign_plan import CampaignPlan
from orchestrator.learning.requests import Failed, Pour, Request, Simulate, Slots, Suggest
from orchestrator.learning.stage_result import StageResult
from orchestrator.learning.strategy import Strategy
from orchestrator.records.codec import encode_request, to_json
from orchestrator.runs.stages import prediction_stages, stage_seed, stages_of
from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import cells_of, study_fingerprint
from tests.golden.golden import DATA, ROOT, Changes, Golden, columns, compact, normalised
from tests.golden.world import outcome_of

CAMPAIGNS = ROOT / "configs" / "campaigns"
VARIANTS = DATA / "campaigns"
"""Campaigns with strategies and settings that no shipped campaign has."""

SEEDS = (0, 1, 2)
"""Added to the campaign's own seed. Of the first one the first requests are kept one by one, of the others sums."""

PREDICTION_SEEDS = 3


# -- playing -----------------------------------------------------------------------------------------------------------


def played(plan: CampaignPlan) -> Iterator[dict[str, Any]]:
    """A campaign's stages from the first to the last: requests, outcomes, decisions, results, one after the other."""
    stages = [*stages_of(plan), *([] if plan.deployment is None else prediction_stages(
        plan, plan.deployment, PREDICTION_SEEDS))]  # fmt: skip
    results: dict[str, StageResult] = {}
    for stage in stages:
        seed = stage_seed(plan.seed, stage.name)
        yield {"stage": stage.name, "seed": seed, "pours": stage.pours}
        strategy = stage.build(results, seed)
        yield from _stage(strategy, plan.parallel_simulations)
        results[stage.name] = strategy.result()
        yield {"result": compact(strategy.result().model_dump(mode="json"))}


def _stage(strategy: Strategy, slots: int) -> Iterator[dict[str, Any]]:
    changes, waiting, known, asked = Changes(), list[tuple[int, Request]](), 0, 0
    for _ in range(20_000):
        if strategy.finished and not waiting:
            return
        free = slots - sum(isinstance(request, Simulate) for _, request in waiting)
        arm = 1 - sum(isinstance(request, Pour) for _, request in waiting)
        for request in strategy.ask(Slots(free, arm)):
            asked += 1
            waiting.append((asked, request))
            body = encode_request(request)
            yield {"ask": asked, body["type"]: changes(body.pop("type"), body)}
        decisions = getattr(strategy, "decisions", [])
        for decision in decisions[known:]:
            yield {"decision": decision.text, "values": compact(decision.values), "urgent": decision.urgent}
        known = len(decisions)
        if not waiting:
            assert strategy.finished, "asks for nothing, waits for nothing, is not finished"
            return
        # Questions are answered first. A pour takes as long as three simulations.
        order = {Suggest: 0, Simulate: 1, Pour: 2 if asked % 4 else 1}
        number, request = min(waiting, key=lambda one: (order[type(one[1])], one[0]))
        waiting.remove((number, request))
        outcome = outcome_of(request)
        if not isinstance(request, Suggest):
            yield {"tell": number, **({"failed": outcome.kind} if isinstance(outcome, Failed) else {})}
        strategy.tell(request, outcome)
    raise AssertionError("not finished after 20,000 steps")


KEPT = 20
"""Requests of a kind in a stage that are kept one by one, where any are."""


def abridged(rows: Iterable[Mapping[str, Any]], kept: int = KEPT) -> Iterator[dict[str, Any]]:
    """The first requests of each kind in each stage one by one, the others as sums; decisions likewise as a hash."""
    requests: dict[str, list[Mapping[str, Any]]] = {}
    for row in rows:
        if "stage" in row:
            requests = {}
        elif "result" in row:
            for kind, found in sorted(requests.items()):
                if kind == "decision":
                    texts = "\n".join(one["decision"] for one in found)
                    yield {"decisions": len(found), "sha256": hashlib.sha256(texts.encode()).hexdigest()}
                elif len(found) > kept:
                    yield {"further": kind, **columns(found[kept:])}
        else:
            kind = next(iter(set(row) - {"ask", "failed", "values", "urgent"}))
            requests.setdefault(kind, []).append(row)
            if len(requests[kind]) > (4 * kept if kind == "decision" else kept):
                continue
        yield dict(row)


# -- the tests ---------------------------------------------------------------------------------------------------------

PLAYED = sorted(path.stem for path in CAMPAIGNS.glob("*.yaml"))
FURTHER = sorted(path.stem for path in VARIANTS.glob("*.yaml"))


@pytest.mark.parametrize(
    ("name", "further"),
    [
        pytest.param(name, seed, id=f"{name}-{seed}", marks=[pytest.mark.slow] * (seed > 0))
        for name in PLAYED
        for seed in SEEDS
    ],
)
def test_shipped_campaign_makes_the_same_requests_and_decisions(name: str, further: int, golden: Golden) -> None:
    plan = load_campaign(CAMPAIGNS / f"{name}.yaml")
    rows = played(replace(plan, seed=plan.seed + further))
    golden.check_lines(f"campaigns/played/{name}-{further}.jsonl", abridged(rows, 0 if further else KEPT))


@pytest.mark.parametrize("name", FURTHER)
def test_further_settings_make_the_same_requests_and_decisions(name: str, golden: Golden) -> None:
    plan = load_campaign(VARIANTS / f"{name}.yaml")
    golden.check_lines(f"campaigns/played/{name}.jsonl", abridged(played(plan)))


def test_no_shipped_campaign_is_left_out() -> None:
    files = {path.stem.rpartition("-")[0] for path in (VARIANTS / "played").glob("*-[0-9].jsonl")}
    assert files == set(PLAYED)


# -- files -------------------------------------------------------------------------------------------------------------

SHIPPED = sorted(
    path.relative_to(ROOT / "configs").as_posix()
    for folder in ("campaigns", "laboratories", "studies", "vessels")
    for path in (ROOT / "configs" / folder).glob("*.yaml")
    if path.stem != "franka" or importlib.util.find_spec("franky_sim") is not None  # of an extra
)


def read(path: Path) -> tuple[Any, Any]:
    """What a file says with everything filled in, and what of it decides requests; both JSON-ready."""
    match path.parent.name:
        case "campaigns":
            plan = load_campaign(path)
            return plan.resolved, fingerprint(plan)
        case "laboratories":
            laboratory = load_laboratory(path)
            return to_json(laboratory, type(laboratory)), deciding(laboratory)
        case "studies":
            study = load_study(path)
            cells = [dataclasses.asdict(cell) for cell in cells_of(study)]
            return {"base": study.base.resolved, "cells": columns(cells)}, study_fingerprint(study)
        case _:
            vessel = load_vessel(path)
            return to_json(vessel, type(vessel)), deciding(vessel)


@pytest.mark.parametrize("name", SHIPPED)
def test_shipped_file_means_the_same(name: str, golden: Golden) -> None:
    resolved, decides = read(ROOT / "configs" / name)
    text = json.dumps({"resolved": resolved, "fingerprint": decides}, indent=1, ensure_ascii=False, sort_keys=True)
    golden.check(f"files/{name.replace('.yaml', '.json')}", normalised(text))
