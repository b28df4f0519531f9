"""Mettler-Toledo's Standard Interface Command Set, levels 0 and 1.

A command sent before the last one is answered may be confused with it, so the driver never has two under way. Sources:
Mettler-Toledo AL/AB operating instructions (commands, `S` replies); AT operating instructions (upper case, CR LF).
9600 baud 8N1 is the factory setting of many; some come with Xon/Xoff (setting `handshake`).
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects import status_lines
from actors.balance.virtual_serial.voice import Voice


@dataclass(frozen=True, kw_only=True)
class MtSics(status_lines.StatusLines):
    """See the module's text."""

    name: str = "mt-sics"
    title: str = "Mettler-Toledo MT-SICS"
    gap: float = 0.05

    def likeness(self, said: Mapping[str, str]) -> int:
        """See `Dialect.likeness`."""
        return 2 if status_lines.levels_of_sics(said) else 0

    def voices(self) -> Mapping[str, Callable[[], Voice]]:
        """See `Dialect.voices`."""
        return {self.name: lambda: status_lines.StatusLineVoice(self, '"01" "2.30" "2.22"', "VIRTUAL 6200.00 g")}


MT_SICS = MtSics()
"""Mettler-Toledo MT-SICS."""
