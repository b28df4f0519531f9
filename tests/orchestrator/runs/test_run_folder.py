"""`run_folder`: folders of runs: their names, which one is resumed, and what is kept in them."""

from __future__ import annotations

import asyncio
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from orchestrator.records.journal_file import JournalError
from orchestrator.runs.run_folder import create_run, find_run
from sim_engine.engine_package import ENGINES, engine_version
from tests.support.killed_runs import SMALL, die_at, run
from tests.support.toy_campaign import run_toy, toy_plan


def test_run_directories_count_up_and_the_newest_unfinished_one_is_resumed(tmp_path: Path) -> None:
    plan = toy_plan(tmp_path / "runs", on_unknown="repeat")
    with pytest.raises(JournalError, match="no unfinished run of campaign 'toy'"):
        find_run(plan)
    finished, older, newer = (create_run(plan) for _ in range(3))
    assert [p.name.rsplit("-", 1)[1] for p in (finished, older, newer)] == ["1", "2", "3"]
    for directory in (older, newer, finished):
        fork = os.fork()
        if fork == 0:
            if directory is not finished:
                die_at(20, after_commit=True)
            asyncio.run(run_toy(directory, plan=plan, stages=SMALL))
            os._exit(0)
        os.waitpid(fork, 0)
    assert find_run(plan) == newer
    assert find_run(plan, run_id=older.name) == older
    with pytest.raises(JournalError, match=r"no such run; known: toy-\d+-1, "):
        find_run(plan, run_id="nonsense")
    other = replace(plan, seed=8)
    assert find_run(other) == newer  # so that resuming it can say what differs
    asyncio.run(run_toy(newer, plan=plan, stages=SMALL, resume=True))
    assert find_run(plan) == older


def test_what_reproduces_a_run_is_kept_with_it(tmp_path: Path) -> None:
    import json

    run(tmp_path / "run", plan=toy_plan(tmp_path, resolved={"name": "toy", "seed": 7}))
    assert json.loads((tmp_path / "run" / "resolved.json").read_text()) == {"name": "toy", "seed": 7}
    versions = json.loads((tmp_path / "run" / "versions.json").read_text())
    assert versions["seed"] == 7
    assert versions["python"] == sys.version.split()[0]
    assert {"numpy", "taichi", "ray", "decant-pouring"} <= set(versions["packages"])
    assert versions["engine"] == engine_version()
    name, number = versions["engine"].split()
    assert (name in ENGINES, versions["packages"][name]) == (True, number)
