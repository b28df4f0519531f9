"""What goes with what: tasks, features and ways to run, each with each, as docs/reference/combinations.md lists them.

python -m tests.end_to_end.combinations --write    # a few seconds: checks all pairs, and writes the page

- `FEATURES` change a small campaign; `WAYS` run one.
- `verdict` checks a pair as `decant validate` does: it works, it is refused with a text, or it has no meaning.
- `RUNS` are short runs. Each contains several features and ways; every pair that works is in one of them.
  `tests/end_to_end/test_combinations.py` makes them.
"""

from __future__ import annotations

import argparse
import functools
import itertools
import re
import tempfile
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import yaml

from decant import ConfigError, check, load_campaign

ROOT = Path(__file__).parents[2]
PAGE = ROOT / "docs" / "reference" / "combinations.md"
LABORATORIES = ROOT / "configs" / "laboratories"

File = dict[str, Any]

ACTIONS = {"angular_velocity": ["40 deg/s", "140 deg/s"], "x_offset": ["95 mm", "135 mm"]}

DEPLOYMENTS: dict[str, File] = {
    "D1": {"strategy": "D1", "iterations": 3, "initial_samples": 2, "pours": 1},
    "D2": {"strategy": "D2", "pours": 2},
    "D3": {"strategy": "D3", "prior_simulations": 4, "pours": 2, "simulations_per_pour": 2},
}


def _cup(name: str, radius: int, mass: int) -> File:
    profile = {"unit": "mm", "inner": [[0, 0], [radius, 0], [radius, 100]], "wall": "4 mm", "floor": "4 mm"}
    return {"name": name, "profile": profile, "grip": {"mass": f"{mass} g"}}


def _base() -> File:
    return {
        "name": "pair",
        "seed": 3,
        "laboratory": {"name": "pair", "simulators": 2, "bench": {"liquid": {"particles": 400}, "time_scale": 0}},
        "liquid": {"name": "water", "mass": "200 g"},
        "pourer": _cup("beaker", 40, 312),
        "receiver": _cup("tumbler", 32, 186),
        "motion": {"hold_time": "1 s", "max_angle": "115 deg", "height": "100 mm"},
        "simulator": {"parameters": {"particles": 300}},
        "on_unknown": "repeat",
        "outputs": {"directory": "runs", "figures": False, "recording": False},
    }


def _calibrates(file: File) -> None:
    file["simulator"]["parameters"]["cohesion"] = ["0 N/m", "0.1 N/m"]
    pours = {"count": 3, "holdout": 1, "design": "stratified"}
    file["calibration"] = {"strategy": "C4", "actions": ACTIONS, "pours": pours, "simulations": 6, "initial_samples": 3}


def _doses(file: File) -> None:
    motion = {"x_offset": "90 mm", "max_angle": "110 deg", "hold_time": "until_flow_ends"}
    file["dispense"] = {"doses": [{"amount": "50 g"}], "motion": motion}


def _mixtures(file: File) -> None:
    liquids = [{"name": "water", "liquid": {"name": "water", "mass": "250 g"}}]
    motion = {"x_offset": "90 mm", "max_angle": "110 deg", "hold_time": "until_flow_ends"}
    file["mixtures"] = {
        "liquids": liquids,
        "wanted": {name: {"water": "40 g"} for name in ("A1", "A3")},
        "motion": motion,
    }
    if not {"deployment", "calibration", "dispense"} & set(file):
        del file["liquid"]  # each liquid is described by itself


def _in(laboratory: str) -> Callable[[File], None]:
    text = (LABORATORIES / laboratory).read_text(encoding="utf-8")
    return lambda file: file.update(laboratory=yaml.safe_load(text) | {"simulators": 2})


def _records(file: File) -> None:
    file["outputs"]["pour_recordings"] = True
    if "deployment" in file or "calibration" in file:  # a simulated bench records doses alone
        _in("virtual.yaml")(file)


def _places(file: File) -> None:
    _in("rack.yaml" if "mixtures" in file else "night.yaml")(file)
    if "dispense" in file or "mixtures" in file:
        file["on_unknown"] = "ask"  # vessels of places keep what is in them, so that a dose is not repeated


def _unattended(file: File) -> None:
    _places(file)
    file["unattended"] = {"pours": 9, "until": "23:59"}


def _joins(file: File) -> None:
    file["laboratory"]["ray"] = {"address": "127.0.0.1:1"}


def _under(section: str, **keys: Any) -> Callable[[File], None]:
    return lambda file: file[section].update(keys)


def _nothing(file: File) -> None:
    """No change: the deployment is enough."""


@dataclass(frozen=True)
class Feature:
    """Something that a user may want with a campaign.

    Attributes:
        keys: where a user writes it.
        change: what it changes in the file of a campaign that has its deployment already.
        deployments: strategies that it may be used with, the usual one first; none if it needs no deployment.
    """

    keys: str
    change: Callable[[File], None]
    deployments: Sequence[str] = ()


FEATURES = {
    "calibration": Feature("`calibration`", _calibrates),
    "D1": Feature("`deployment: {strategy: D1}`, `decant plan`", _nothing, ("D1",)),
    "D2": Feature("`deployment: {strategy: D2}`", _nothing, ("D2",)),
    "D3": Feature("`deployment: {strategy: D3}`", _nothing, ("D3",)),
    "doses": Feature("`dispense`, `decant dose`", _doses),
    "mixtures": Feature("`mixtures`", _mixtures),
    "objective": Feature(
        "`deployment: {objective: {…}}`",
        _under("deployment", objective={"name": "spilled"}),
        ("D2", "D1", "D3"),
    ),
    "risk limit": Feature("`deployment: {risk_limit: {…}}`", _under("deployment", risk_limit={}), ("D3",)),
    "prior": Feature("`prior: catalogue`", lambda file: file.update(prior="catalogue"), ("D3", "D1")),
    "recordings": Feature("`outputs: {pour_recordings: true}`", _records, ("D2", "D3", "D1")),
    "places": Feature("`gripper` and `places` of the laboratory", _places, ("D2", "D3", "D1")),
    "unattended": Feature("`unattended`", _unattended, ("D2", "D3", "D1")),
    "cluster": Feature("`ray: {address: …}` of the laboratory", _joins, ("D2", "D3", "D1")),
}
"""Features of a campaign or of its laboratory."""


def campaign(names: Sequence[str]) -> File:
    """A small campaign with some features, in any order."""
    features = [feature for name, feature in FEATURES.items() if name in names]
    file = _base()
    has_task = any(name in ("calibration", "doses", "mixtures", *DEPLOYMENTS) for name in names)
    needed = [feature for feature in features if feature.deployments]
    if needed and (not has_task or any("deployment" in each.keys or "prior" in each.keys for each in needed)):
        common = [name for name in needed[0].deployments if all(name in each.deployments for each in needed)]
        strategy = common[0] if common else min((each.deployments for each in needed), key=len)[0]
        if not (set(names) <= {"calibration", "doses", "mixtures", "prior"} and has_task):
            file["deployment"] = {**DEPLOYMENTS[strategy], "actions": ACTIONS}
    for feature in features:
        feature.change(file)
    return file


WAYS = {
    "Quadrants": "`DECANT_ENGINE=quadrants`; Taichi otherwise",
    "Ray": "`decant run`, `decant.run(…, in_process=False)`",
    "in process": "`--in-process`, `decant.run(…)`",
    "command line": "`decant run`, `decant queue`",
    "daemon": "`decant server start`",
    "library": "`import decant`",
}
"""Ways to run a campaign, with how a user chooses each."""

ALTERNATIVES = {
    frozenset(pair)
    for group in (("D1", "D2", "D3"), ("Ray", "in process"), ("library", "command line"), ("library", "daemon"))
    for pair in itertools.combinations(group, 2)
}
"""Pairs without a meaning: a run has one of the two."""

JOINED = frozenset({"in process", "daemon"})
"""Ways that use their own simulators, not those of a laboratory's cluster."""


@dataclass(frozen=True)
class Run:
    """A short run with several features.

    Attributes:
        features: names in `FEATURES`.
        ways: names in `WAYS`.
    """

    features: Sequence[str]
    ways: Sequence[str]

    @property
    def name(self) -> str:
        """For the test."""
        return "+".join((*self.features, *self.ways)).replace(" ", "-")

    def pairs(self) -> Iterator[frozenset[str]]:
        """The pairs that it shows."""
        return map(frozenset, itertools.combinations((*self.features, *self.ways), 2))

    def pours(self) -> int:
        """Number of pours and doses that it makes."""
        file = campaign(self.features)
        planned: int = file.get("deployment", {}).get("pours", 0)
        planned += file["calibration"]["pours"]["count"] if "calibration" in file else 0
        planned += len(file["dispense"]["doses"]) if "dispense" in file else 0
        return planned + sum(len(row) for row in file.get("mixtures", {"wanted": {}})["wanted"].values())


TOGETHER = (
    ("calibration", "D3", "doses", "risk limit", "prior"),
    ("calibration", "D1", "doses", "prior"),
    ("D2", "objective", "recordings", "places", "unattended"),
    ("calibration", "D3", "mixtures", "objective", "risk limit"),
)
"""Campaigns that have every feature between them: each is run in every way."""

RUNS = [
    Run(features, ways)
    for features in TOGETHER
    for ways in (
        ("in process", "library"),
        ("in process", "command line", "Quadrants"),
        ("Ray", "library", "Quadrants"),
        ("Ray", "command line"),
        ("in process", "daemon", "command line"),
        ("Ray", "daemon", "command line", "Quadrants"),
    )
] + [
    Run(features, ("in process", "library"))
    for features in (
        ("calibration", "D3", "objective", "risk limit", "prior", "recordings", "places", "unattended"),
        ("calibration", "D1", "prior", "recordings", "places", "unattended"),
        ("calibration", "D2", "objective", "recordings", "places", "unattended"),
        ("D1", "objective", "recordings", "places", "unattended"),
        ("calibration", "D2", "doses", "objective"),
        ("D1", "objective", "doses"),
        ("D3", "objective", "doses"),
        ("doses", "recordings", "places", "unattended"),
        ("calibration", "D1", "mixtures"),
        ("D2", "mixtures"),
        ("mixtures", "recordings", "places", "unattended"),
    )
]
RUNS += [Run(("D2", "cluster"), (way, "command line")) for way in sorted(JOINED)]


def verdict(one: str, other: str) -> str:
    """Whether a pair works.

    Returns:
        'works', 'checked' if the files are valid and no run is made, 'alternatives' if the pair has no meaning, else
        the text with which `decant validate` refuses it.
    """
    if frozenset((one, other)) in ALTERNATIVES:
        return "alternatives"
    features = tuple(name for name in (one, other) if name in FEATURES)
    if features and (refused := refusal(features)):
        return refused
    return "checked" if "cluster" in features and other not in JOINED else "works"


@functools.cache
def refusal(features: Sequence[str]) -> str:
    """The text with which `decant validate` refuses a campaign with these features; empty if it is valid."""
    with tempfile.TemporaryDirectory() as folder:
        path = write_campaign(Path(folder), features)
        try:
            problems: Sequence[object] = check(load_campaign(path)).problems
        except ConfigError as error:
            problems = error.problems
    lines = [str(problem).splitlines()[0] for problem in problems]
    return "; ".join(re.sub(r"^.*pair\.yaml:\d+:\d+: ([\w.]+):", r"`\1`:", line) for line in lines)


def write_campaign(folder: Path, features: Sequence[str]) -> Path:
    """Write a campaign with some features; returns its file."""
    path = folder / "pair.yaml"
    path.write_text(yaml.safe_dump(campaign(features), sort_keys=False), encoding="utf-8")
    return path


def pairs() -> Iterator[tuple[str, str]]:
    """All pairs of different features and ways."""
    return itertools.combinations((*FEATURES, *WAYS), 2)


def shown(pair: tuple[str, str]) -> bool:
    """Whether a run shows the pair."""
    return any(frozenset(pair) in run.pairs() for run in RUNS)


BEGIN, END = "<!-- table: combinations -->\n", "<!-- end of table -->"
CELLS = {"works": "yes", "checked": "(yes)", "alternatives": "–"}


def table() -> str:
    """The table of all pairs, with the texts of those that are refused."""
    names = [*FEATURES, *WAYS]
    texts: dict[str, int] = {}
    cells: dict[tuple[str, str], str] = {}
    for pair in pairs():
        result = verdict(*pair)
        cells[pair] = CELLS.get(result) or f"no {texts.setdefault(result, len(texts) + 1)}"
    lines = ["| | " + " | ".join(names[:-1]) + " |", "|---" * len(names) + "|"]
    for row, name in enumerate(names[1:], start=1):
        columns = [cells.get((other, name), "") if i < row else "" for i, other in enumerate(names[:-1])]
        lines.append(f"| {name} | " + " | ".join(columns) + " |")
    lines += ["", "Refused with:", "", *(f"{number}. {text}" for text, number in texts.items())]
    keys = {name: feature.keys for name, feature in FEATURES.items()} | WAYS
    lines += ["", "| name | how you choose it |", "|---|---|", *(f"| {name} | {keys[name]} |" for name in names)]
    return "\n".join(lines) + "\n"


def page() -> str:
    """The page with its table as the program behaves now."""
    head, _, rest = PAGE.read_text(encoding="utf-8").partition(BEGIN)
    return head + BEGIN + table() + END + rest.partition(END)[2]


def main() -> None:
    """Write the page, or print whether it is true."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--write", action="store_true")
    if parser.parse_args().write:
        PAGE.write_text(page(), encoding="utf-8")
    else:
        print("true" if page() == PAGE.read_text(encoding="utf-8") else "not true: --write writes it")


if __name__ == "__main__":
    main()
