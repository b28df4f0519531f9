"""What must be the same on every machine of a cluster, so that the same task has the same outcome anywhere."""

from __future__ import annotations

import functools
import hashlib
import importlib.metadata
import sys
from dataclasses import dataclass, fields
from pathlib import Path


@dataclass(frozen=True)
class Versions:
    """The versions on one machine.

    Attributes:
        python: e.g. '3.11.7'.
        decant: the installed package's.
        simulator: digest of the simulator's sources; a checkout may have changed without a new version.
        taichi: it compiles the solver.
        numpy: it makes the initial positions.
    """

    python: str
    decant: str
    simulator: str
    taichi: str
    numpy: str

    def difference(self, other: Versions) -> str | None:
        """The first thing in which two machines differ, for people; None if there is none.

        Args:
            other: of the other machine.
        """
        for field in fields(self):
            ours, theirs = getattr(self, field.name), getattr(other, field.name)
            if ours != theirs:
                what = "the simulator's code" if field.name == "simulator" else field.name.capitalize()
                return f"{what}: {theirs} there, {ours} here"
        return None


@functools.cache
def versions() -> Versions:
    """The versions on this machine."""
    return Versions(
        python=sys.version.split()[0],
        decant=_installed("decant"),
        simulator=sources(Path(__file__).parents[2] / "sim_engine"),
        taichi=_installed("taichi"),
        numpy=_installed("numpy"),
    )


def _installed(package: str) -> str:
    try:
        return importlib.metadata.version(package)
    except importlib.metadata.PackageNotFoundError:
        return "not installed"


def sources(folder: Path) -> str:
    """Digest of a folder's Python sources."""
    digest = hashlib.sha256()
    for path in sorted(folder.rglob("*.py")):
        if path.parent.name == "validation":
            continue  # judges outcomes, and makes none
        digest.update(path.relative_to(folder).as_posix().encode() + b"\0" + path.read_bytes() + b"\0")
    return digest.hexdigest()[:12]
