"""How long a test waits for what should happen: long enough for any machine, as waiting is free."""

from __future__ import annotations

PATIENCE = 600.0
"""Seconds until a test that waits for an event gives up. Only a defect takes so long."""
