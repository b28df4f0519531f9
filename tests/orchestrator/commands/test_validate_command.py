"""`decant validate`: every problem of every file, quickly, and nothing started."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.support.cli_inputs import RECORDED, ROOT, invoke, process


def test_all_that_is_wrong_with_several_files_is_told_at_once(folder: Path) -> None:
    result = invoke("validate misspelt.yaml small.yaml open-cup.yaml beaker.yaml")
    assert result.exit_code == 2
    assert result.stdout.splitlines() == [
        "small.yaml: ok (campaign, seed 3)",
        "beaker.yaml: ok (vessel, holds 197.9 mL to the brim)",
    ]
    assert "misspelt.yaml:29:3" in result.stderr
    assert "open-cup.yaml: open.stl: not watertight" in result.stderr
    assert result.stderr.splitlines()[-1] == "2 of 4 file(s) can't be used"


def test_files_that_are_right_pass(folder: Path) -> None:
    write_recorded = folder / "recorded.yaml"
    write_recorded.write_text(RECORDED, encoding="utf-8")
    result = invoke("validate small.yaml recorded.yaml plan-only.yaml")
    write_recorded.unlink()
    assert (result.exit_code, result.stderr) == (0, "")


# What a check needs is numpy and pydantic. Each of these takes a third of a second to import, or seconds.
HEAVY = """
import sys
from orchestrator.cli.app import main
try:
    main()
finally:
    heavy = {"scipy.spatial", "scipy.ndimage", "scipy.stats", "trimesh", "sklearn", "pandas", "ray", "taichi", "rerun",
             "matplotlib"}
    print("loaded:", *sorted(heavy & set(sys.modules)), file=sys.stderr)
"""


@pytest.mark.slow
@pytest.mark.parametrize(
    "file",
    [
        "campaigns/paper.yaml",
        pytest.param("studies/paper.yaml", marks=pytest.mark.slow),
        pytest.param("laboratories/virtual.yaml", marks=pytest.mark.slow),
    ],
)
def test_checking_a_shipped_file_wakes_nothing_heavy(file: str, inputs: Path) -> None:
    done = process(f"validate {ROOT / 'configs' / file}", inputs, HEAVY)
    assert done.returncode == 0, done.stderr
    assert done.stderr.splitlines()[-1] == "loaded:"
