"""Kern Communications Protocol: `SI` is answered by `S S     12.34 g`.

It must be switched on in the balance's menu. Sources: Kern KIB-TM-ZB-e-1913 (commands; at least 100 ms between two
queries), CKE-BA-e-2132 (`S I`, `S +`, `S -`). 9600 baud 8N1 is the most common setting of such balances.

Limitations: `TA` reads the tare in some manuals and `MM` does in others, so the driver uses neither.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

from actors.balance.dialects import status_lines
from actors.balance.dialects.protocol_encoder import ProtocolEncoder


@dataclass(frozen=True, kw_only=True)
class Kcp(status_lines.StatusLines):
    """The KCP dialect; see the module docstring."""

    name: str = "kcp"
    title: str = "Kern KCP"

    def likeness(self, answers: Mapping[str, str]) -> int:
        """See `Dialect.likeness`."""
        return 3 if status_lines.is_kern(answers) else 1  # default of the two: its query interval suits both dialects

    def encoders(self) -> Mapping[str, Callable[[], ProtocolEncoder]]:
        """See `Dialect.encoders`."""
        return {self.name: lambda: status_lines.StatusLineEncoder(self, '"01" "1.1.2" "1.1.2"', "KERN VIRTUAL 6200-2")}


KCP = Kcp()
"""Kern KCP."""
