"""Why a pour can't be simulated. Light: importing this starts nothing."""

from __future__ import annotations


class InvalidSceneError(ValueError):
    """The pour can't be made at all: the vessels touch, or the load does not fit. Nothing was simulated."""


class SimulationCancelled(Exception):  # noqa: N818 - a message, not a fault
    """Nobody waits for this simulation any more."""
