"""Which code made a cell: digests of what decides its numbers."""

from __future__ import annotations

import functools
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from actors.cluster.versions import sources, versions

CODE = "code"
"""Key of a cell's result; results from before versions were noted have none."""

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


def made_by(results: Mapping[str, Mapping[str, Any]]) -> dict[tuple[tuple[str, str], ...], int]:
    """How many cells each code has made; the empty code stands for cells from before versions were noted."""
    count: dict[tuple[tuple[str, str], ...], int] = {}
    for result in results.values():
        code = tuple(result.get(CODE, {}).items())
        count[code] = count.get(code, 0) + 1
    return count


def warning(results: Mapping[str, Mapping[str, Any]]) -> str | None:
    """What to say where a study goes on with other code than its finished cells were made with; None: nothing.

    Args:
        results: of the finished cells.
    """
    now, other, unknown, parts = code_now(), 0, 0, dict[str, None]()
    for code, count in made_by(results).items():
        if not code:
            unknown += count
        elif (was := dict(code)) != now:
            other += count
            parts |= dict.fromkeys(name for name in now if was.get(name) != now[name])
    said = []
    if other:
        said.append(f"{other} finished by other code ({', '.join(parts)}: changed since)")
    if unknown:
        said.append(f"{unknown} finished before versions were noted")
    if not said:
        return None
    return (
        f"warning: of this study's cells {', '.join(said)}; those that follow may not compare with them. To have "
        "all of one code, give the study another name"
    )


def told(results: Mapping[str, Mapping[str, Any]]) -> str:
    """For the page: how many codes the cells have, and which."""
    count = made_by(results)
    if not count:
        return "Code: no cell is finished."
    texts = []
    for code, cells in sorted(count.items(), key=lambda item: -item[1]):
        what = ", ".join(f"{name} {value}" for name, value in code) if code else "before versions were noted"
        texts.append(f"{cells} of {what}")
    return f"Code: {len(count)} different for {sum(count.values())} cells: {'; '.join(texts)}."
