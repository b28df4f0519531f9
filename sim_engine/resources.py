"""Resources of the machine: the cache directory and optional packages.

- `load_arrays` and `store_arrays` keep results that are slow to compute in one cache directory, which may be deleted at
  any time.
- `require` checks that the package of an extra is installed.

This module has no slow imports.
"""

from __future__ import annotations

import errno
import getpass
import importlib.util
import logging
import os
import stat
import sys
import tempfile
from collections.abc import Mapping
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from sim_engine.errors import DecantError
from sim_engine.settings.plugin_registry import DISTRIBUTION

ENVIRONMENT_VARIABLE = "DECANT_CACHE_DIR"


_log = logging.getLogger(__name__)
_reported: set[str] = set()


def cache_directory() -> Path:
    """The cache directory, created on demand: $DECANT_CACHE_DIR, else the platform's user cache under 'decant'.

    If it cannot be written, for example in a read-only home directory, or this user has no home directory, a folder of
    this user in the directory for temporary files is used. This is logged once, with the cause.

    Raises:
        OSError: neither can be written; the text names both.
    """
    try:
        directory = _configured()
        directory.mkdir(parents=True, exist_ok=True)
        if not os.access(directory, os.W_OK | os.X_OK):
            raise PermissionError(errno.EACCES, os.strerror(errno.EACCES), str(directory))
    except RuntimeError:  # Path.home() and expanduser()
        cause = "is unknown, because this user has no home directory"
    except OSError as error:
        cause = f"{directory} can't be written ({error.filename}: {error.strerror})"
    else:
        return directory
    substitute = _temporary(cause)
    if cause not in _reported:
        _log.warning("the cache directory %s; %s is used. Set %s", cause, substitute, _CURE)
        _reported.add(cause)
    return substitute


_CURE = f"${ENVIRONMENT_VARIABLE} to a folder that you can write"


def _temporary(cause: str) -> Path:
    """A folder that only this user can write.

    Compiled kernels are executed, so other users must not be able to write it.
    """
    directory = Path(tempfile.gettempdir()) / f"decant-cache-{getpass.getuser() if os.name == 'nt' else os.getuid()}"
    try:
        directory.mkdir(mode=0o700, exist_ok=True)
        status = directory.lstat()
    except OSError as error:
        text = f"the cache directory {cause}, and {directory} can't be made ({error.strerror}); set {_CURE}"
        raise OSError(error.errno, text) from None
    if not stat.S_ISDIR(status.st_mode) or (
        os.name != "nt" and (status.st_uid != os.getuid() or status.st_mode & 0o022)
    ):
        text = f"the cache directory {cause}, and {directory} belongs to another user; set {_CURE}"
        raise OSError(errno.EPERM, text)
    return directory


def _configured() -> Path:
    chosen = os.environ.get(ENVIRONMENT_VARIABLE)
    if chosen:
        directory = Path(chosen).expanduser()
    elif sys.platform == "darwin":
        directory = Path.home() / "Library" / "Caches" / "decant"
    elif sys.platform == "win32":
        directory = Path(os.environ.get("LOCALAPPDATA", Path.home() / "AppData" / "Local")) / "decant" / "Cache"
    else:
        directory = Path(os.environ.get("XDG_CACHE_HOME") or Path.home() / ".cache").expanduser() / "decant"
    return directory


def load_arrays(name: str) -> dict[str, NDArray[np.generic]] | None:
    """Arrays stored under a name; None if there are none or the file is damaged (it is then removed).

    Args:
        name: file name without suffix.
    """
    try:
        path = cache_directory() / f"{name}.npz"
        with np.load(path, allow_pickle=False) as stored:
            return {key: stored[key] for key in stored.files}
    except FileNotFoundError:
        return None
    except Exception:  # a truncated zip file raises various errors; none of them should end a campaign
        discard(name)
        return None


def discard(name: str) -> None:
    """Remove the data stored under a name, if they exist and may be removed."""
    try:
        (cache_directory() / f"{name}.npz").unlink(missing_ok=True)
    except OSError:
        return


def store_arrays(name: str, arrays: Mapping[str, NDArray[np.generic]], *, compressed: bool = True) -> bool:
    """Store arrays under a name, atomically: readers see the old file, the new one or none, never half of one.

    Args:
        name: file name without suffix.
        arrays: by name.
        compressed: smaller on disk; without compression storing takes a tenth of the time.

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


EXTRAS = {
    "ray": "lab",
    "serial": "lab",
    "psutil": "lab",
    "pinocchio": "urdf",
    "franky": "franka",
    "franky_sim": "franka-sim",
    "rerun": "live",
    "apprise": "daemon",
    "fastapi": "daemon",
    "httpx": "daemon",
    "prometheus_client": "daemon",
    "pythonjsonlogger": "daemon",
    "uvicorn": "daemon",
    "manifold3d": "vessels",
    "skimage": "vessels",
    "pandas": "tables",
    "pyarrow": "tables",
    "openpyxl": "excel",
    "unitelabs": "sila",
}
"""Importable name → extra."""

PACKAGES = {
    "serial": "pyserial",
    "pinocchio": "pin",
    "franky": "franky-control",
    "franky_sim": "franky-sim",
    "skimage": "scikit-image",
    "pythonjsonlogger": "python-json-logger",
    "unitelabs": "unitelabs-cdk",
}
"""Importable name → name of the package that provides it, if they differ."""


class MissingExtraError(DecantError, ImportError):
    """A package that belongs to an extra is not installed; the text says what to install."""


def installed(module: str) -> bool:
    """Whether a package is installed; it is not imported."""
    return importlib.util.find_spec(module) is not None


def require(module: str, what_for: str) -> None:
    """Check that the package of an extra is installed.

    Args:
        module: one of `EXTRAS`.
        what_for: begins the sentence: 'a recording'.

    Raises:
        MissingExtraError: it is not installed.
    """
    if not installed(module):
        package, extra = PACKAGES.get(module, module), EXTRAS[module]
        raise MissingExtraError(
            f"{what_for} needs the package '{package}', which is not installed: pip install '{DISTRIBUTION}[{extra}]'"
        )
