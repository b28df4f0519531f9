"""`app`: output on a full disk, and names outside the locale. `tests/golden` has the bad input."""

from __future__ import annotations

import subprocess
import sys
from pathlib import Path

import pytest
from ruamel.yaml import YAML

from actors.runtime.child_process import child_environment
from tests.support.waiting import PATIENCE


def decant(*words: str | bytes, stdout: int | None = None, **environment: str) -> subprocess.CompletedProcess[bytes]:
    return subprocess.run(
        [sys.executable, "-c", "from orchestrator.cli.app import main; main()", *words],
        stdout=subprocess.PIPE if stdout is None else stdout, stderr=subprocess.PIPE, check=False, timeout=PATIENCE,
        env={**child_environment(), **environment},
    )  # fmt: skip


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="no /dev/full")
@pytest.mark.parametrize(
    "words", [["--version"], ["queue", "--help"], ["schema", "vessel"]], ids=lambda words: words[0]
)
def test_a_full_disk_below_the_output_is_one_line(words: list[str]) -> None:
    with Path("/dev/full").open("wb") as full:
        done = decant(*words, stdout=full.fileno())
    assert done.returncode == 1
    said = b"decant: the output can't be written completely: No space left on device\n"
    assert done.stderr == said


def test_a_name_is_kept_in_a_locale_without_its_letters(tmp_path: Path) -> None:
    path, sizes = tmp_path / "Gefäß.yaml", ["--height", "95 mm", "--diameters", "5 mm: 60 mm, 95 mm: 72 mm"]
    words = ["vessel", "profile", str(path).encode(), *sizes, "--wall", "3 mm", "--name", "Gefäß".encode()]
    done = decant(*words, LC_ALL="C", PYTHONUTF8="0", PYTHONCOERCECLOCALE="0")
    assert done.returncode == 0, done.stderr.decode()
    assert YAML(typ="safe").load(path)["name"] == "Gefäß"
    assert "Gefäß.png".encode() in done.stderr + done.stdout
    words[2], words[-1] = str(tmp_path / "other.yaml"), b"Gef\xe4\xdf"
    done = decant(*words)
    assert done.returncode == 2
    assert b"should be text in UTF-8" in done.stderr
    assert len(done.stderr.splitlines()) == 1
