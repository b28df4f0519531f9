"""Everything is declared in pyproject.toml, except the version and the shipped files of configs/."""

from __future__ import annotations

import re
import shutil
import subprocess
from pathlib import Path
from typing import Any

from setuptools import setup
from setuptools.command.build_py import build_py
from setuptools_scm import Configuration, ScmVersion
from setuptools_scm.git import parse as parse_git
from setuptools_scm.version import meta

ROOT = Path(__file__).parent

NO_TAG = "0.0"
"""The tag that setuptools_scm reports for a repository without tags."""

SHIPPED = (
    "README.md", "campaigns", "daemon.yaml", "data", "laboratories", "recordings", "schema", "studies", "systemd",
    "vessels",
)  # fmt: skip


class BuildWithShippedFiles(build_py):
    """A checkout has them at its top, an installed package beside `orchestrator/campaigns/shipped.py`."""

    def run(self) -> None:
        """Build, and copy them; an editable installation uses those of the checkout."""
        super().run()
        if not self.editable_mode:
            for name in SHIPPED:
                source, target = Path("configs", name), Path(self.build_lib, "orchestrator", "configs", name)
                target.parent.mkdir(parents=True, exist_ok=True)
                if source.is_dir():
                    shutil.copytree(source, target, dirs_exist_ok=True)
                else:
                    shutil.copy(source, target)


def newest_release() -> str:
    """The version of the changelog's newest release: '0.2.0'."""
    found = re.search(r"^## \[(\d+\.\d+\.\d+)\]", (ROOT / "CHANGELOG.md").read_text(encoding="utf-8"), re.MULTILINE)
    if found is None:
        raise ValueError("CHANGELOG.md has no release: a heading such as '## [0.2.0] - 2026-11-21'")
    return found[1]


def unpacked_version() -> str:
    """The version of files without a repository: an unpacked source distribution names its own."""
    file = ROOT / "PKG-INFO"
    found = re.search(r"^Version: (\S+)", file.read_text(encoding="utf-8"), re.MULTILINE) if file.is_file() else None
    return newest_release() if found is None else found[1]


def parse_checkout(root: str, config: Configuration) -> ScmVersion:
    """The version of a checkout, with and without tags.

    The release is the commit that enters its heading into the changelog, which is also the one to be tagged. A clone
    that has no tags therefore has the version of one that has them: '0.2.1.dev3' three commits after 0.2.0.
    """
    found = parse_git(root, config=config)
    if found is None:
        return meta(unpacked_version(), config=config)
    if str(found.tag) != NO_TAG:
        return found
    release = newest_release()

    def git(*arguments: str) -> str:
        return subprocess.run(["git", *arguments], cwd=root, capture_output=True, text=True, check=True).stdout.strip()

    entered = git("log", "-1", "--format=%H", f"-S## [{release}]", "--", "CHANGELOG.md")
    distance = int(git("rev-list", "--count", f"{entered}..HEAD")) if entered else 0
    return meta(release, distance=distance, dirty=found.dirty, node=found.node, branch=found.branch, config=config)


def scm_version() -> dict[str, Any]:
    """Settings of setuptools_scm. Machines of a cluster compare versions: those of one commit are equal."""
    return {"local_scheme": "no-local-version", "fallback_version": NO_TAG, "parse": parse_checkout}


setup(cmdclass={"build_py": BuildWithShippedFiles}, use_scm_version=scm_version)
