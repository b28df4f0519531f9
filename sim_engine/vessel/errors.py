"""What is wrong with a vessel, in words for the person who described it."""

from __future__ import annotations

from sim_engine.errors import DecantError


class VesselError(DecantError, ValueError):
    """A vessel that can't be built or used; the message says why and what would be right."""
