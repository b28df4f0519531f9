"""The version of a checkout: that of the tag, and the same in a clone without tags."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
COPIED = ("setup.py", "pyproject.toml", "README.md", "LICENSE")


def git(folder: Path, *arguments: str) -> str:
    identity = {
        f"GIT_{who}_{what}": "decant@example.org" for who in ("AUTHOR", "COMMITTER") for what in ("NAME", "EMAIL")
    }
    environment = {**os.environ, **identity, "GIT_CONFIG_GLOBAL": os.devnull}
    done = subprocess.run(["git", *arguments], cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.strip()


def version(folder: Path) -> str:
    """As a build gives it."""
    environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
    command = [sys.executable, "setup.py", "--version"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True, check=True)
    return done.stdout.split()[-1]


def commit(folder: Path, changelog: str) -> None:
    (folder / "CHANGELOG.md").write_text(changelog, encoding="utf-8")
    git(folder, "add", "--all")
    git(folder, "commit", "--quiet", "--allow-empty", "--message", "a change")


@pytest.fixture
def checkout(tmp_path: Path) -> Path:
    """A repository two commits after release 0.2.0, without tags."""
    for name in COPIED:
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    git(tmp_path, "init", "--quiet")
    commit(tmp_path, "# Changelog\n\n## [0.1.0] - 2026-01-01\n")
    commit(tmp_path, "# Changelog\n\n## [Unreleased]\n\n## [0.1.0] - 2026-01-01\n")
    released = "# Changelog\n\n## [0.2.0] - 2026-02-01\n\n## [0.1.0] - 2026-01-01\n"
    commit(tmp_path, released)
    commit(tmp_path, released.replace("## [0.2.0]", "## [Unreleased]\n\n## [0.2.0]"))
    commit(tmp_path, released.replace("## [0.2.0]", "## [Unreleased]\n\n- More.\n\n## [0.2.0]"))
    return tmp_path


def test_a_clone_without_tags_has_the_version_of_one_with_tags(checkout: Path) -> None:
    assert version(checkout) == "0.2.1.dev2"
    git(checkout, "tag", "v0.2.0", "HEAD~2")
    assert version(checkout) == "0.2.1.dev2"
    git(checkout, "tag", "--delete", "v0.2.0")
    git(checkout, "checkout", "--quiet", "HEAD~2")
    assert version(checkout) == "0.2.0"


def test_files_without_a_repository_have_the_version_of_the_newest_release(tmp_path: Path) -> None:
    for name in (*COPIED, "CHANGELOG.md"):
        (tmp_path / name).write_bytes((ROOT / name).read_bytes())
    released = re.findall(r"^## \[(\d[\d.]*)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    assert released == sorted(released, key=lambda text: [int(part) for part in text.split(".")], reverse=True)
    assert version(tmp_path) == released[0]
