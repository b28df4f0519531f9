"""Where kernels run. Light to import: a backend is refused before Taichi starts."""

from __future__ import annotations

import ctypes
from typing import Literal

from sim_engine.errors import DecantError

Backend = Literal["cpu", "cuda"]

BACKENDS: tuple[Backend, ...] = ("cpu", "cuda")


class BackendError(DecantError, RuntimeError):
    """A backend was asked for that is not there."""


def require_backend(backend: str) -> None:
    """Make sure that this machine has a backend; Taichi itself would fall back to another without a word.

    Args:
        backend: one of `BACKENDS`.

    Raises:
        BackendError: with what to do.
    """
    if backend not in BACKENDS:
        raise BackendError(f"there is no backend '{backend}'; there are {', '.join(BACKENDS)}")
    if backend == "cuda" and cuda_devices() == 0:
        raise BackendError(
            "backend cuda: no CUDA device answers on this machine; use cpu, or install NVIDIA's driver (nvidia-smi "
            "lists the devices that it finds)"
        )


def cuda_devices() -> int:
    """How many devices NVIDIA's driver finds; 0 without a driver."""
    try:
        driver = ctypes.CDLL("libcuda.so.1")
    except OSError:
        return 0
    count = ctypes.c_int(0)
    if driver.cuInit(0) != 0 or driver.cuDeviceGetCount(ctypes.byref(count)) != 0:
        return 0
    return count.value
