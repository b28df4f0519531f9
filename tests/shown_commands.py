"""Commands that the pages show: where they stand, which of them are marked, and a scratch folder to run them in.

A command that is not marked is executed as it stands, in a folder whose campaigns bear the shipped names and are small.
"""

from __future__ import annotations

import asyncio
import re
import shlex
import shutil
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))]

REASONS: Mapping[str, str] = {
    "hardware": "a robot or a balance",
    "cluster": "other machines",
    "network": "an index of packages, or another machine to log in to",
    "person": "somebody who types or looks: a terminal, a display",
    "checkout": "a checkout of Decant, whose own files it writes or checks",
    "minutes": "minutes or hours, and does nothing that a small form of it doesn't",
    "service": "a program beside it that runs until it is stopped",
}
"""What a command may need so that it is not executed by the test of the pages."""

TESTED = frozenset({"service"})
"""Reasons that go with a test elsewhere: <!-- needs: service, see tests/orchestrator/daemon/test_x.py -->"""

SHELLS = ("sh", "bash", "shell", "console")
PROGRAM = re.compile(r"(?:decant|python|make|pip|git|docker|curl|ssh|ls|export|systemctl|sudo|rerun)\b")
FENCE = re.compile(r"^( *)```(\w*)[^\n]*\n(.*?)^ *```", re.MULTILINE | re.DOTALL)
MARK = re.compile(r"<!-- needs: ([^,>]+?)(?:, see ([^>\s]+))? -->\s*\Z")


@dataclass(frozen=True)
class Block:
    """A fenced block of commands.

    Attributes:
        place: page and line.
        needs: the marks' reasons; empty where everything in it is executed.
        test: what tests it instead.
    """

    place: str
    commands: tuple[str, ...]
    needs: str = ""
    test: str = ""


def blocks_of(page: Path) -> Iterator[Block]:
    """Every block of commands on a page."""
    text = page.read_text(encoding="utf-8")
    for found in FENCE.finditer(text):
        lines = _lines(found[3])
        first = next((line for line in lines if not line.startswith("#")), "")
        if found[2] not in SHELLS and not (found[2] == "" and PROGRAM.match(first)):
            continue
        mark = MARK.search(text, 0, found.start())
        place = f"{page.relative_to(ROOT)}:{text.count(chr(10), 0, found.start()) + 1}"
        commands = tuple(line for line in lines if not line.startswith("#"))
        yield Block(place, commands, mark[1].strip() if mark else "", (mark[2] or "") if mark else "")


def _lines(block: str) -> list[str]:
    joined = re.sub(r"\\\n\s*", " ", block)
    lines = [line.strip() for line in joined.splitlines() if line.strip()]
    if any(line.startswith("$ ") for line in lines):  # with its output: only what is typed
        lines = [line[2:] for line in lines if line.startswith("$ ")]
    return lines


def arguments_of(command: str, run: str) -> list[str]:
    """What a shell makes of a `decant …`, without its name and its comment; cheaper where it only takes longer.

    Args:
        run: the folder's name that stands for ID.
    """
    words = shlex.split(command.replace("runs/ID", f"runs/{run}"), comments=True)
    return [word for word in words[1:] if word != "--full"]


def write_scratch(folder: Path) -> str:
    """Shipped files under their names, made small; a finished run and one that stands still. Returns the first's name.

    Laboratories wait for nothing and need no Ray; liquids are coarse; there are few pours and few simulations.
    """
    from orchestrator.campaigns.file_loading import load_campaign
    from orchestrator.reports.publishing import publish

    shutil.copytree(ROOT / "configs", folder / "configs")
    _change(folder / "configs/laboratories/twin.yaml", _small_laboratory)
    _change(folder / "configs/laboratories/planning.yaml", lambda lab: lab.update(in_process=True))
    _change(folder / "configs/laboratories/virtual-dosing.yaml", lambda lab: lab["bench"].update(doses="formula"))
    _change(folder / "configs/campaigns/quickstart.yaml", _small_quickstart)
    _change(folder / "configs/campaigns/recorded.yaml", _small_recorded)
    for table in (folder / "configs/data").glob("*/*.csv"):
        _shorten(table)
    for name in ("quick", "paper", "figure-6"):
        _change(folder / f"configs/studies/{name}.yaml", _small_study)
    plan = load_campaign(folder / "configs/campaigns/quickstart.yaml")
    finished, paused = folder / "runs" / "quickstart-20300131-1", folder / "runs" / "quickstart-20300131-2"
    publish(plan, asyncio.run(_played(plan, finished, None)))
    asyncio.run(_played(plan, paused, pours=5))
    return finished.name


async def _played(plan: Any, directory: Path, pours: int | None) -> Any:
    """The campaign in a world whose spillage is a formula; paused after so many pours."""
    from actors.optimizer_actor import Proposer
    from orchestrator.runs.run_engine import run_campaign
    from tests.support.toy_campaign import ToyBench, ToyLaboratory

    class Optimizer:
        async def suggest(self, problem: Any) -> Any:
            return Proposer().suggest(problem)

    directory.mkdir(parents=True)
    bench = ToyBench()
    task = asyncio.ensure_future(run_campaign(plan, ToyLaboratory(bench=bench, optimizer=Optimizer()), directory))  # type: ignore[arg-type]
    if pours is not None:
        bench.fails = lambda seed: task.cancel() and None if len(bench.poured) == pours - 1 else None  # type: ignore[func-returns-value]
        await asyncio.wait([task])
        return None
    return await task


def _change(path: Path, change: Any) -> None:
    yaml = YAML()
    content = yaml.load(path)
    change(content)
    yaml.dump(content, path)


def _small_laboratory(lab: Any) -> None:
    lab["in_process"] = True
    lab["bench"].update(time_scale=0, liquid={"particles": 250, "cohesion": "0.05 N/m"})


def _small_quickstart(campaign: Any) -> None:
    campaign["laboratory"] = "../laboratories/twin.yaml"
    campaign["motion"]["max_hold_time"] = "0.5 s"
    campaign["simulator"]["parameters"]["particles"] = 200
    campaign["calibration"].update(
        pours={"count": 3, "holdout": 1}, simulations=4, initial_samples=3, random_baseline=1
    )
    campaign["deployment"].update(prior_simulations=3, pours=2, simulations_per_pour=1)
    campaign["outputs"].update(recording=False, figures=False)


def _small_recorded(campaign: Any) -> None:
    campaign["simulator"]["parameters"] = {"particles": 200, "cohesion": ["0 N/m", "0.1 N/m"]}
    campaign["calibration"].update(simulations=5, initial_samples=3, random_baseline=1)
    campaign["outputs"].update(recording=False, figures=False)


def _small_study(study: Any) -> None:
    study["parameters"] = {"particles": 200, "cohesion": ["0 N/m", "0.1 N/m"]}
    study.update(search=["cohesion"], pours=3, holdout=1, mismatch=[study["mismatch"][0]], confirm=0)
    study["compared"] = study["mismatch"][0]["name"]
    study["mismatch"][0]["liquid"]["particles"] = 250
    study["calibration"] = {"C4": {"repetitions": 1, "simulations": 4, "initial_samples": 3}}
    study["deployment"] = {"D2": {"repetitions": 1, "pours": 2, "initial_samples": 2}}


def _shorten(table: Path, rows: int = 4) -> None:
    """The first rows of each split."""
    head, *lines = table.read_text(encoding="utf-8").splitlines()
    place = head.split(",").index("split") if "split" in head.split(",") else None
    kept: dict[str, list[str]] = {}
    for line in lines:
        kept.setdefault("" if place is None else line.split(",")[place], []).append(line)
    table.write_text("\n".join([head, *(line for some in kept.values() for line in some[:rows])]) + "\n", "utf-8")
