"""Which code made a cell: digests of what decides its numbers."""

from __future__ import annotations

import functools
from collections import Counter
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

from actors.cluster.versions import sources, versions

if TYPE_CHECKING:
    from orchestrator.study.folder import CellResult

_ROOT = Path(__file__).parents[2]


@functools.cache
def code_now() -> dict[str, str]:
    """Version of Decant, and digests of the optimiser, the strategies and the solver, as they are on the disk.

    Cached: a process that was started with some code keeps it, whatever is written to the disk since.
    """
    here = versions()
    return {
        "decant": here.decant,
        "optimiser": sources(_ROOT / "actors" / "optimizer" / "core"),
        "strategies": sources(_ROOT / "orchestrator" / "strategies"),
        "solver": here.simulator,
    }


def made_by(results: Mapping[str, CellResult]) -> Counter[tuple[tuple[str, str], ...]]:
    """How many cells each code has made."""
    return Counter(tuple(result.code.items()) for result in results.values())


def warning(results: Mapping[str, CellResult]) -> str | None:
    """What to say where a study goes on with other code than its finished cells were made with; None: nothing.

    Args:
        results: of the finished cells.
    """
    now, other, parts = code_now(), 0, dict[str, None]()
    for code, count in made_by(results).items():
        if (was := dict(code)) != now:
            other += count
            parts |= dict.fromkeys(name for name in now if was.get(name) != now[name])
    if not other:
        return None
    return (
        f"warning: of this study's cells {other} finished by other code ({', '.join(parts)}: changed since); those "
        "that follow may not compare with them. To have all of one code, give the study another name"
    )


def told(results: Mapping[str, CellResult]) -> str:
    """For the page: how many codes the cells have, and which."""
    count = made_by(results)
    if not count:
        return "Code: no cell is finished."
    listed = [(cells, ", ".join(f"{name} {value}" for name, value in code)) for code, cells in count.most_common()]
    texts = [f"{cells} of {parts}" for cells, parts in listed]
    return f"Code: {len(count)} different for {count.total()} cells: {'; '.join(texts)}."
