"""How busy the pool was beside the arm, in words."""

from __future__ import annotations

from collections.abc import Mapping
from typing import TYPE_CHECKING

from orchestrator.report.summary import PoolUse

if TYPE_CHECKING:
    from rich.console import RenderableType


def occupancy_lines(stages: Mapping[str, PoolUse]) -> list[RenderableType]:
    """'pool 97 % busy while there was work (41 % of the time); the arm waited at most 0.06 s for a decision'."""
    from rich.text import Text

    lines: list[RenderableType] = []
    for stage, one in stages.items():
        if one.pool_busy is None:
            continue
        text = f"  {stage.rpartition(':')[2]}: pool {100 * one.pool_busy:.0f} % busy"
        if one.pool_useful is not None and one.pool_useful < 0.995:
            text += f" while there was work ({100 * one.pool_useful:.0f} % of the time)"
        if one.arm_longest_wait_s is not None:
            text += f"; between two pours the arm waited {one.arm_longest_wait_s:.2g} s at most"
        lines.append(Text(text, style="dim"))
    return lines
