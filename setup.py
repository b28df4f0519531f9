"""Everything is declared in pyproject.toml; here the shipped files of configs/ come into the package."""

from __future__ import annotations

import shutil
from pathlib import Path

from setuptools import setup
from setuptools.command.build_py import build_py

SHIPPED = ("README.md", "campaigns", "data", "laboratories", "schema", "studies", "vessels")


class BuildWithShippedFiles(build_py):
    """A checkout has them at its top, an installed package beside `orchestrator/shipped.py`."""

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


setup(cmdclass={"build_py": BuildWithShippedFiles})
