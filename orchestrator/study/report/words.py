"""What a study's differences say, in plain sentences: which strategy was better, by how much, where nobody knows."""

from __future__ import annotations

import math
from collections.abc import Sequence

from orchestrator.study.report.drawing import level_words
from orchestrator.study.report.effects import ALL
from orchestrator.study.report.intervals import Estimate
from orchestrator.study.report.tables import Table


def plain_words(shown: Sequence[Table]) -> list[str]:
    """A sentence for each pair of strategies at each level: over all receivers, after the last pour that is shown."""
    rows = [row for table in shown if table.name == "table-effects" for row in table.rows]
    last: dict[tuple[str, str, str, str], tuple[str, Estimate, str]] = {}
    for compared, of, level, receiver, _, difference, better, _ in rows:
        assert isinstance(difference, Estimate)
        kind = str(of).partition(" after ")[0]
        last[str(compared), kind, str(level), str(receiver)] = (str(of), difference, str(better))
    everywhere = {(compared, kind, level) for compared, kind, level, receiver in last if receiver == ALL}
    return [
        _sentence(compared, of, level, receiver, difference, better)
        for (compared, kind, level, receiver), (of, difference, better) in last.items()
        if receiver == ALL or (compared, kind, level) not in everywhere
    ]


def _sentence(compared: str, of: str, level: str, receiver: str, difference: Estimate, better: str) -> str:
    first, _, second = compared.partition(" − ")
    into = {ALL: ", over all receivers", "—": ""}.get(receiver, f", into {receiver}")
    where = f"At {level_words(level)}{into}, {of}{' pours' if of[-1:].isdigit() else ''}"
    size = f"{compared}: {difference.text()}, better in {better}"
    if math.isnan(difference.low):
        return f"{where}: there are too few repetitions for an interval ({size})."
    if difference.low <= 0.0 <= difference.high:
        return f"{where}: nothing tells {first} from {second} ({size})."
    return f"{where}: {first} is {'better' if difference.high < 0.0 else 'worse'} than {second} ({size})."
