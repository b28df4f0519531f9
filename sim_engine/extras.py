"""Packages that only some installations have, by the extra that brings them."""

from __future__ import annotations

import importlib.util

from sim_engine.errors import DecantError

EXTRAS = {
    "ray": "lab",
    "serial": "lab",
    "psutil": "lab",
    "rtde_receive": "lab",
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
}
"""Importable name → extra."""

PACKAGES = {
    "serial": "pyserial",
    "rtde_receive": "ur-rtde",
    "skimage": "scikit-image",
    "pythonjsonlogger": "python-json-logger",
}
"""Importable name → name of the package that brings it, if they differ."""


class MissingExtraError(DecantError, ImportError):
    """A package that belongs to an extra is not installed; the text says what to install."""


def installed(module: str) -> bool:
    """Whether a package is there; it is not imported."""
    return importlib.util.find_spec(module) is not None


def require(module: str, what_for: str) -> None:
    """Say which extra is missing before anything begins.

    Args:
        module: one of `EXTRAS`.
        what_for: begins the sentence: 'a recording'.

    Raises:
        MissingExtraError: it is not installed.
    """
    if not installed(module):
        package, extra = PACKAGES.get(module, module), EXTRAS[module]
        raise MissingExtraError(
            f"{what_for} needs the package '{package}', which is not installed: pip install 'decant[{extra}]'"
        )
