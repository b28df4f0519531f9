"""How balances talk: bytes to readings and back, one dialect a module, no ports."""

from __future__ import annotations

from actors.balance.dialects.dialect import Dialect, LineSettings
from actors.balance.dialects.kcp import KCP
from actors.balance.dialects.kern_swt import KERN_SWT
from actors.balance.dialects.mt_sics import MT_SICS
from actors.balance.dialects.sbi import SBI

DIALECTS: dict[str, Dialect] = {dialect.name: dialect for dialect in (KCP, KERN_SWT, MT_SICS, SBI)}
"""All dialects by the names that files use."""

__all__ = ["DIALECTS", "KCP", "KERN_SWT", "MT_SICS", "SBI", "Dialect", "LineSettings"]
