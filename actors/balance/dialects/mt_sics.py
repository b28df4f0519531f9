"""Mettler-Toledo's Standard Interface Command Set, levels 0 and 1.

A command sent before the last one is answered may be confused with it, so the driver never has two under way. Sources:
Mettler-Toledo AL/AB operating instructions (commands, `S` replies); AT operating instructions (upper case, CR LF).
9600 baud 8N1 is the factory setting of many; some come with Xon/Xoff (setting `handshake`).
"""

from __future__ import annotations

from dataclasses import dataclass

from actors.balance.dialects import status_lines
from actors.balance.dialects.dialect import LineSettings
from actors.balance.reading import Reading, Reply


@dataclass(frozen=True)
class _MtSics:
    name: str = "mt-sics"
    title: str = "Mettler-Toledo MT-SICS"
    lines: tuple[LineSettings, ...] = tuple(LineSettings(baud) for baud in (9600, 19200, 4800, 2400, 1200))
    gap: float = 0.05
    query: bytes = b"SI\r\n"
    tare: bytes = b"T\r\n"
    zero: bytes | None = b"Z\r\n"
    cancel: bytes | None = b"@\r\n"
    acknowledged: bool = True

    def decode(self, line: bytes) -> Reply:
        return status_lines.decode(line)

    def encode(self, reading: Reading) -> bytes:
        return status_lines.encode(reading)


MT_SICS = _MtSics()
"""Mettler-Toledo MT-SICS."""
