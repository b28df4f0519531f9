"""`file_access`: files that are not files, or far too much of one: refused at once, with the place and the limit."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign, load_vessel
from orchestrator.campaigns.yaml.file_access import SIZE_LIMIT
from orchestrator.campaigns.yaml.yaml_errors import PROBLEMS_SHOWN, ConfigError, Problem
from orchestrator.campaigns.yaml.yaml_source import Document
from tests.support.campaign_files import CAMPAIGN, CSV, RECORDED, report, write
from tests.support.counted_calls import counted_calls

MOST_CALLS = 15_000_000
"""Function calls that refusing may take, for any of them: about twice what the longest takes."""

TEXTS = {
    "maps in maps": ("a: " + "{a: " * 600 + "1" + "}" * 600, "bad.yaml:1:117: is nested more than 30 deep"),
    "indented maps": ("".join(f"{' ' * i}k:\n" for i in range(600)), "bad.yaml:30:30: is nested more than 30 deep"),
    "lists in lists": ("a: " + "[" * 5000 + "]" * 5000, "bad.yaml:1:33: is nested more than 30 deep"),
    "brackets never closed": ("a: " + "[" * 100_000, "is nested more than 30 deep; is a bracket not closed"),
    "keys in keys": ("? " * 5000 + "a", "is nested more than 30 deep"),
    "aliases in aliases": (
        "x0: &x0 [1]\n" + "".join(f"x{i}: &x{i} [*x{i - 1}]\n" for i in range(1, 700)),
        "is nested more than 30 deep",
    ),
    "aliases by the billion": (
        "a0: &a0 [1]\n" + "".join(f"a{i}: &a{i} [{', '.join([f'*a{i - 1}'] * 9)}]\n" for i in range(1, 9)),
        "more than 20000 values",
    ),
    "millions of comments": ("#\n" * 2_500_000 + CAMPAIGN, "bad.yaml: is too large: 5 MB, and 0.5 MB are read at most"),
    "as many comments as may be": (
        "#\n" * 240_000 + CAMPAIGN.replace("pours:", "puors:"),
        "bad.yaml:240012:3: calibration.puors: unknown key; did you mean 'pours'?",
    ),
    "a long list": ("a: [" + "1, " * 3_300_000 + "1]", "bad.yaml: is too large: 9.9 MB"),
    "a long list within the limit": ("a: [" + "1, " * 100_000 + "1]", "bad.yaml:1:59996: more than 20000"),
}


@pytest.mark.slow
@pytest.mark.parametrize("case", TEXTS, ids=lambda case: case.replace(" ", "-"))
def test_too_much_of_a_file_is_refused_in_time_with_the_limit(case: str, folder: Path) -> None:
    text, expected = TEXTS[case]
    path = write(folder, "bad.yaml", text)
    with counted_calls() as calls:
        told = report(path)
    assert calls.count < MOST_CALLS
    assert expected in told
    assert len(told.splitlines()) <= 3 * (PROBLEMS_SHOWN + 1)


def test_the_largest_posterior_that_calibration_writes_is_far_from_the_limit(folder: Path) -> None:
    theta = "{particles: 1234.567890123456, cohesion: 0.01234567890123456, xsph_rate: 12.34567890123456}"
    rows = "".join(f"- {{theta: {theta}, weight: 0.02}}\n" for _ in range(100))
    assert len(rows) < SIZE_LIMIT / 10
    assert len(Document.read(write(folder, "theta.yaml", f"posterior:\n{rows}")).data["posterior"]) == 100


def _pipe(path: Path) -> None:
    os.mkfifo(path)


def _circle(path: Path) -> None:
    path.symlink_to(path.name)


NO_FILES: dict[str, tuple[Callable[[Path], None], str]] = {
    "pipe": (_pipe, "is a pipe, which is not waited for; name a file"),
    "circle": (_circle, "is a link that leads back to itself"),
    "folder": (Path.mkdir, "is a directory; name a file in it"),
}
NAMED = {
    "cup.yaml": "bad.yaml:5:11: receiver: ",
    "pours.csv": "bad.yaml:12:17: calibration.pours.from: ",
    "mug.stl": "cup.yaml:2:7: mesh: ",
}


@pytest.mark.parametrize("kind", NO_FILES)
@pytest.mark.parametrize("name", ["bad.yaml", *NAMED])
def test_what_is_no_file_is_refused_where_it_is_named(kind: str, name: str, folder: Path) -> None:
    make, expected = NO_FILES[kind]
    path = folder / name
    if name == "mug.stl":
        write(folder, "cup.yaml", "name: mug\nmesh: mug.stl\nunit: mm\n")
    if name != "bad.yaml":
        write(folder, "bad.yaml", RECORDED)
    path.unlink(missing_ok=True)
    make(path)
    told = report(folder / "bad.yaml")
    assert expected in told
    assert told.startswith(NAMED.get(name, "bad.yaml: ") if name != "mug.stl" else NAMED[name])


def test_devices_are_not_read(folder: Path) -> None:
    for read in (load_campaign, load_vessel):
        with pytest.raises(ConfigError, match="/dev/zero: is a device or a socket; name a file"):
            read(Path("/dev/zero"))


def test_a_name_that_no_file_can_have_is_refused(folder: Path) -> None:
    for name, expected in (("x" * 300 + ".yaml", "can't be read: File name too long"), ('"a\\0.yaml"', "no file can")):
        assert expected in report(write(folder, "bad.yaml", CAMPAIGN.replace("cup.yaml", name)))


BAD_TABLES = {
    "megabytes": (CSV + "80,100,95,8,5,train\n" * 230_000, "pours.csv: is too large: 4.6 MB"),
    "thousands of pours": (
        CSV + "".join(f"80,100,{190 + i / 1000},4,{10 - i / 1000},train\n" for i in range(2_500)),
        "pours.csv:2002:1: has more than 2000 pours, which no calibration can use",
    ),
    "an open quote": (CSV.replace("80,120", '"80,120') + "5,5,5,5,5,train\n" * 20_000, "is not CSV: field larger than"),
    "a quote that is never closed": (
        CSV.replace("80,120", '"80,120'),
        "pours.csv:4:1: has 1 cell, the header 6; is a quote still open?",
    ),
    "zero bytes": (
        CSV.replace("80,120", "80\0,120"),
        "pours.csv:4:1: angular_velocity_deg_s: '80\\x00' is not a number",
    ),
    "the same pour again and again": (
        CSV.splitlines()[0] + "\n" + "80,100,195.3,8.1,4.7,train\n" * 30,
        "pours.csv:3:1: the same pour stands in 30 lines; pours that were really made differ in the last digit",
    ),
    "less than nothing spilled": (
        CSV.replace("180,4,20", "180,-0.4,20"),
        "pours.csv:2:11: spilled_g: -0.4 g is less than nothing, by more than a balance's noise of 0.3 g",
    ),
    "underscores": (CSV.replace("180,4,20", "1_80.0,4,20"), "poured_g: '1_80.0' is not a number; write it like 12.5"),
    "underscores in the header": (CSV.replace("poured_g", "poured__g"), "poured__g: unknown unit"),
}


@pytest.mark.parametrize("case", BAD_TABLES, ids=lambda case: case.replace(" ", "-"))
def test_a_table_that_nobody_weighed_is_refused_in_time(case: str, folder: Path) -> None:
    text, expected = BAD_TABLES[case]
    write(folder, "pours.csv", text)
    path = write(folder, "bad.yaml", RECORDED)
    with counted_calls() as calls:
        told = report(path)
    assert calls.count < MOST_CALLS / 5
    assert expected in told


def test_the_noise_of_a_balance_around_nothing_is_no_mistake(folder: Path) -> None:
    lines = CSV.replace("180,4,20", "180.2,-0.2,20").splitlines()
    write(folder, "pours.csv", "\n".join([*lines, *[lines[1]] * 3]))
    load_campaign(write(folder, "good.yaml", RECORDED))


def test_only_the_part_of_a_long_line_that_is_meant_is_shown() -> None:
    line = "x" * 5000 + "HERE" + "y" * 5000
    shown = str(Problem(Path("a.yaml"), 1, 5001, "where", "text " * 1000, line)).splitlines()
    assert len(shown[0]) < 2000
    assert shown[1][shown[2].index("^") :].startswith("HERE")
    assert len(shown[1]) < 250


def test_the_first_of_very_many_problems_are_shown_and_the_others_counted() -> None:
    many = ConfigError(Problem(Path("a.yaml"), i, 1, "", "wrong") for i in range(1, 5001))
    lines = str(many).splitlines()
    assert (len(lines), lines[-1]) == (PROBLEMS_SHOWN + 1, "… and 4980 more problems; mend these first")
    assert len(many.problems) == 5000
