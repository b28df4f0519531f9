"""Where results that are slow to compute wait for the next run: one directory, safe to delete at any time."""

from __future__ import annotations

import os
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

ENVIRONMENT_VARIABLE = "DECANT_CACHE_DIR"


def cache_directory() -> Path:
    """The cache directory, created on demand: $DECANT_CACHE_DIR, else the platform's user cache under 'decant'.

    Raises:
        OSError: it can't be created.
    """
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    if chosen:
        directory = Path(chosen).expanduser()
    elif sys.platform == "darwin":
        directory = Path.home() / "Library" / "Caches" / "decant"
    elif sys.platform == "win32":
        directory = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "decant" / "Cache"
    else:
        directory = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache") / "decant"
    directory.mkdir(parents=True, exist_ok=True)
    return directory


def load_arrays(name: str) -> dict[str, NDArray[np.generic]] | None:
    """Arrays stored under a name, or None when there are none or the file is damaged (it is removed then).

    Args:
        name: file name without suffix.
    """
    try:
        path = cache_directory() / f"{name}.npz"
        with np.load(path, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except FileNotFoundError:
        return None
    except Exception:  # a truncated zip raises half a dozen kinds of error; none of them is worth a campaign
        discard(name)
        return None


def discard(name: str) -> None:
    """Remove what is stored under a name, if it is there and may be removed."""
    try:
        (cache_directory() / f"{name}.npz").unlink(missing_ok=True)
    except OSError:
        return


def store_arrays(name: str, arrays: Mapping[str, NDArray[np.generic]], *, compressed: bool = True) -> bool:
    """Store arrays under a name, atomically: readers see the old file, the new one or none, never half of one.

    Args:
        name: file name without suffix.
        arrays: by name.
        compressed: small on disk; what hardly gets any smaller is stored in a tenth of the time without.

    Returns:
        Whether they were stored. A full or read-only disk costs time on the next run, not this one.
    """
    temporary: Path | None = None
    try:
        directory = cache_directory()
        with tempfile.NamedTemporaryFile(dir=directory, prefix=f"{name}-", suffix=".tmp", delete=False) as file:
            temporary = Path(file.name)
            (np.savez_compressed if compressed else np.savez)(file, **dict(arrays))  # type: ignore[arg-type]
        temporary.replace(directory / f"{name}.npz")
        return True
    except OSError:
        if temporary is not None:
            temporary.unlink(missing_ok=True)
        return False
