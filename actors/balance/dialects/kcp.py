"""Kern Communications Protocol: `SI` is answered by `S S     12.34 g`.

It must be switched on in the balance's menu. Sources: Kern KIB-TM-ZB-e-1913 (commands; no question sooner than 100 ms
after the last), CKE-BA-e-2132 (`S I`, `S +`, `S -`). 9600 baud 8N1 is what such balances are usually met with.
Limitations: `TA` reads the tare in some manuals and `MM` in others, so neither is used.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects import status_lines
from actors.balance.dialects.protocol_encoder import ProtocolEncoder


@dataclass(frozen=True, kw_only=True)
class Kcp(status_lines.StatusLines):
    """See the module's text."""

    name: str = "kcp"
    title: str = "Kern KCP"

    def likeness(self, said: Mapping[str, str]) -> int:
        """See `Dialect.likeness`."""
        return 3 if status_lines.is_kern(said) else 1  # whose pace suits both, where nothing else is known

    def voices(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.voices`."""
        return {self.name: lambda: status_lines.StatusLineEncoder(self, '"01" "1.1.2" "1.1.2"', "KERN VIRTUAL 6200-2")}


KCP = Kcp()
"""Kern KCP."""
