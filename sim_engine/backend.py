"""Where kernels run. Light to import: checked before Taichi is."""

from __future__ import annotations

from typing import Literal

Backend = Literal["cpu", "cuda"]

BACKENDS: tuple[Backend, ...] = ("cpu", "cuda")


class BackendError(RuntimeError):
    """A backend was asked for that is not there."""
