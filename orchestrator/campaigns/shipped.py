"""The shipped files: campaigns, laboratories, studies, vessels, weighed pours, settings and unit file of a daemon."""

from __future__ import annotations

import shutil
from pathlib import Path

STARTING_SET = (
    "README.md", "campaigns", "daemon.yaml", "data", "laboratories", "schema", "studies", "systemd", "vessels",
)  # fmt: skip
"""The shipped files that `starting_set` copies."""

_BESIDE, _INSIDE = "directory: ../../runs", "directory: ../runs"


def shipped(name: str = "") -> Path:
    """Path of a shipped file such as 'campaigns/quickstart.yaml'; without a name, the folder of all of them.

    Raises:
        FileNotFoundError: there is no such file.
    """
    root = _root()
    path = root / name
    if not path.exists():
        names = sorted(str(p.relative_to(root)) for p in root.glob("*/*.yaml"))
        raise FileNotFoundError(f"Decant comes with no '{name}'; there are {', '.join(names)}")
    return path


def starting_set(directory: Path | str) -> list[Path]:
    """Copy the shipped files into a folder: `decant init DIR`.

    Their runs go into a folder next to it; of a copy into the working directory, into this directory.

    Args:
        directory: created if needed; must be empty.

    Returns:
        The campaigns.

    Raises:
        FileExistsError: the directory is not empty.
        OSError: it can't be written.
    """
    directory = Path(directory)
    if directory.exists() and (not directory.is_dir() or any(directory.iterdir())):
        raise FileExistsError(f"{directory}: is not an empty folder; name another one")
    directory.mkdir(parents=True, exist_ok=True)
    for name in STARTING_SET:
        source = shipped(name)
        if source.is_dir():
            shutil.copytree(source, directory / name)
        else:
            shutil.copy(source, directory / name)
    if directory.resolve() == Path.cwd():
        for path in directory.glob("*/*.yaml"):
            path.write_text(path.read_text("utf-8").replace(_BESIDE, _INSIDE), "utf-8")
    return sorted((directory / "campaigns").glob("*.yaml"))


def _root() -> Path:
    """In an installed package the folder is next to the modules, in a checkout at the top."""
    product = Path(__file__).parents[1]
    return product / "configs" if (product / "configs").is_dir() else product.parent / "configs"
