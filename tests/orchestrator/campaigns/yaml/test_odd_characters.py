"""`odd_characters`: YAML as people paste and share it: merge keys, and characters that look like a space or a quote.

Public reports behind the cases:

- pre-commit/pre-commit-hooks#468, pycontribs/ruyaml#43: two '<<' in one mapping, a duplicate key for readers
- r-lib/yaml#58: keys of the mapping itself have priority, wherever '<<' stands
- chyh1990/yaml-rust#82, emmatyping/ryaml#21: '<<' taken for a key, or left out
- syntaxfm/website#2179: no-break spaces in an indentation, reported elsewhere as "could not find expected ':'"
- AtomLinter/linter-js-yaml#147: curly quotes copied from a web page
"""

from __future__ import annotations

from pathlib import Path

import pytest

from orchestrator.campaigns.file_loading import load_campaign
from tests.support.campaign_files import CAMPAIGN, DEPLOYED, report, write

FLOW = "motion: {max_angle: 110 deg, x_offset: 84 mm, height: 90 mm}"
BLOCK = "motion:\n  max_angle: 110 deg\n  x_offset: 84 mm\n  height: 90 mm"
ANCHORED = DEPLOYED.replace(FLOW, FLOW.replace("motion:", "motion: &motion"))

MERGES = {
    "inline": CAMPAIGN.replace(FLOW, "motion:\n  <<: {max_angle: 110 deg, x_offset: 84 mm}\n  height: 70 mm"),
    "alias": ANCHORED + "  motion: {<<: *motion, height: 70 mm}\n",
    "own key first": ANCHORED + "  motion: {height: 70 mm, <<: *motion}\n",
    "several": ANCHORED + "  motion:\n    <<: [{height: 70 mm}, *motion]\n",
    "merge in a merge": ANCHORED + "  motion: {<<: {<<: *motion, height: 70 mm}}\n",
}


@pytest.mark.parametrize("case", MERGES, ids=lambda case: case.replace(" ", "-"))
def test_merged_keys_count_and_own_keys_have_priority(case: str, folder: Path) -> None:
    plan = load_campaign(write(folder, "good.yaml", MERGES[case]))
    stage = plan.deployment.scenes[0] if plan.deployment is not None else plan.calibration and plan.calibration.scene
    assert stage
    assert stage.fixed["height"] == pytest.approx(0.07)
    assert stage.fixed["x_offset"] == pytest.approx(0.084)


def test_an_error_in_merged_keys_is_reported_once_where_they_are_written(folder: Path) -> None:
    text = (ANCHORED + "  motion: {<<: *motion, height: 70 mm}\n").replace("110 deg", "110")
    told = report(write(folder, "bad.yaml", text))
    assert told.startswith("bad.yaml:6:29: motion.max_angle: 110 has no unit")
    assert told.count("bad.yaml:") == 1


BAD_MERGES = {
    "twice": (
        CAMPAIGN.replace(FLOW, f"{FLOW.replace('motion:', 'motion: &m')}").replace(
            "  pours:", "  motion:\n    <<: *m\n    <<: {height: 1 mm}\n  pours:"
        ),
        "bad.yaml:14:5: calibration.motion: '<<' stands in line 13 already; write one list: '<<: [*first, *second]'",
    ),
    "a number": (
        CAMPAIGN.replace(FLOW, "motion:\n  <<: 5\n  x_offset: 84 mm"),
        "bad.yaml:7:7: motion: '<<' needs a mapping or a list of mappings",
    ),
    "itself": (CAMPAIGN.replace(FLOW, "motion: &m\n  <<: *m\n  x_offset: 84 mm"), "an anchor that contains itself"),
    "by the billion": (
        "a0: &a0 {b: 1}\n" + "".join(f"a{i}: &a{i} {{<<: [{', '.join([f'*a{i - 1}'] * 9)}]}}\n" for i in range(1, 9)),
        "more than 20000 values",
    ),
    "in quotes": (CAMPAIGN.replace(FLOW, FLOW.replace("{", '{"<<": {}, ')), "motion.<<: unknown key"),
}


@pytest.mark.parametrize("case", BAD_MERGES, ids=lambda case: case.replace(" ", "-"))
def test_a_bad_merge_is_refused_with_one_error(case: str, folder: Path) -> None:
    text, expected = BAD_MERGES[case]
    told = report(write(folder, "bad.yaml", text))
    assert expected in told
    assert told.count("bad.yaml:") == 1


NBSP = "a no-break space (U+00A0) where a space belongs; write a space"
PASTED = {
    "after a colon": (
        CAMPAIGN.replace(FLOW, BLOCK),
        "max_angle: ",
        "max_angle:\u00a0",
        f"bad.yaml:7:13: not YAML: {NBSP}",
    ),
    "in the last line": (
        CAMPAIGN.replace(FLOW, BLOCK),
        "height: ",
        "height:\u00a0",
        f"bad.yaml:9:10: not YAML: {NBSP}",
    ),
    "in braces": (CAMPAIGN, "height: 90", "height:\u00a090", f"bad.yaml:6:54: motion: {NBSP}"),
    "in the indentation": (
        CAMPAIGN.replace(FLOW, BLOCK),
        "  x_offset",
        "\u00a0\u00a0x_offset",
        f"bad.yaml:8:1: not YAML: {NBSP}",
    ),
    "before a number": (CAMPAIGN, "count: 8", "count: \u00a08", f"bad.yaml:12:18: calibration.pours.count: {NBSP}"),
    "before a colon": (CAMPAIGN, "count: 8", "count\u00a0: 8", f"bad.yaml:12:16: calibration.pours: {NBSP}"),
    "after a dash": (
        CAMPAIGN,
        "[0 N/m, 0.1 N/m]",
        "\n      -\u00a00 N/m\n      - 0.1 N/m",
        f"bad.yaml:10:8: simulator.parameters.cohesion: {NBSP}",
    ),
    "thin space": (CAMPAIGN, "name: test", "name:\u2009test", "bad.yaml:1:6: not YAML: a thin space (U+2009) where"),
    "wide space": (CAMPAIGN, "name: test", "name:\u3000test", "bad.yaml:1:6: not YAML: an ideographic space (U+3000)"),
    "zero width in a key": (
        CAMPAIGN,
        "count",
        "cou\u200bnt",
        "bad.yaml:12:14: calibration.pours: a zero width space (U+200B)",
    ),
    "zero width in a value": (
        CAMPAIGN,
        "110 deg",
        "110\u200b deg",
        "bad.yaml:6:24: motion.max_angle: a zero width space",
    ),
    "byte order mark inside": (CAMPAIGN, "name: test", "name: \ufefftest", "bad.yaml:1:7: name: a zero width no-break"),
    "line separator": (CAMPAIGN, "name: test", "name: te\u2028st", "bad.yaml:1:9: name: a line separator (U+2028)"),
    "curly quotes": (
        CAMPAIGN,
        "200 g",
        "“200 g”",
        "liquid.mass: a left double quotation mark (U+201C): curly quotes do",
    ),
    "German quotes": (CAMPAIGN, "name: test", "name: „test“", "bad.yaml:1:7: name: a double low-9 quotation mark"),
    "quotes around a comma": (
        CAMPAIGN,
        "name: water",
        "name: “water, hot: 1”",
        "bad.yaml:3:16: liquid.name: a left double quotation",
    ),
    "tab after a colon": (
        CAMPAIGN,
        "name: test",
        "name:\ttest",
        "bad.yaml:1:6: not YAML: a tab after the colon; write",
    ),
    "wide colon": (
        CAMPAIGN,
        "name: test",
        "name：test",
        "bad.yaml:1:5: not YAML: a fullwidth colon (U+FF1A); write ':'",
    ),
}


@pytest.mark.parametrize("case", PASTED, ids=lambda case: case.replace(" ", "-"))
def test_a_character_that_only_looks_right_is_named_where_it_stands(case: str, folder: Path) -> None:
    good, old, new, expected = PASTED[case]
    assert old in good
    told = report(write(folder, "bad.yaml", good.replace(old, new, 1)))
    assert expected in told
    assert told.count("bad.yaml:") == 1, "one cause, one message"


@pytest.mark.parametrize(
    ("old", "new"),
    [
        ("200 g", "200\u00a0g"),  # as typography wants it
        ("200 g", '"200\u202fg"'),
        ("84 mm", "\u201384 mm"),  # a dash that a word processor made of a minus
        ("name: test", "name: test #\u00a0note:\u00a0“x”\u200b"),
    ],
)
def test_the_same_characters_do_no_harm_between_number_and_unit_and_in_comments(
    old: str, new: str, folder: Path
) -> None:
    load_campaign(write(folder, "good.yaml", CAMPAIGN.replace(old, new)))


def test_source_lines_are_those_of_an_editor_behind_an_odd_line_separator(folder: Path) -> None:
    told = report(
        write(folder, "bad.yaml", CAMPAIGN.replace("name: test", 'name: "te\u2028st"').replace("84 mm", "84"))
    )
    assert "bad.yaml:6:40: motion.x_offset: 84 has no unit" in told
    assert "    6 | motion: {" in told
