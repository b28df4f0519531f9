"""What has been run on this machine, and what was poured, as tables: the catalogue of `decant runs`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

from orchestrator.catalogue import search
from orchestrator.catalogue.columns import TABLES
from orchestrator.catalogue.index import Catalogue
from orchestrator.pour_rows import Row
from sim_engine.extras import require

if TYPE_CHECKING:
    import pandas as pd


def find_runs(
    *words: str,
    since: str | None = None,
    until: str | None = None,
    campaign: str | None = None,
    pourer: str | None = None,
    receiver: str | None = None,
    liquid: str | None = None,
    strategy: str | None = None,
    mode: str | None = None,
    state: str | None = None,
    tag: str | None = None,
) -> pd.DataFrame:
    """Runs of this machine, the newest first; `open_run(path)` opens one. Names may hold * and ?.

    Args:
        words: that all stand somewhere in a run's names, vessels, tags or notes.
        since: begun at that date or later: '2030-03-01', '2030-03', '7d' (ago).
        until: begun at that date or before, to the end of the day or month.
        campaign: its name.
        pourer: name of a vessel that was poured from.
        receiver: name of a vessel that was poured into.
        liquid: its name.
        strategy: of calibration or deployment.
        mode: 'virtual' or 'real'.
        state: as `decant runs` shows it: 'finished', 'interrupted' …
        tag: of `decant runs tag`.

    Returns:
        One row for each run; what the columns mean stands in the data dictionary of `decant runs export`.

    Raises:
        ValueError: a date or the mode is none.
        RunError: the catalogue can't be read.
    """
    conditions = search.searching(**locals())
    return _table("run", lambda catalogue: search.find_runs(catalogue, conditions))


def find_pours(
    *words: str,
    since: str | None = None,
    until: str | None = None,
    run: str | Path | None = None,
    campaign: str | None = None,
    pourer: str | None = None,
    receiver: str | None = None,
    liquid: str | None = None,
    strategy: str | None = None,
    mode: str | None = None,
    tag: str | None = None,
) -> pd.DataFrame:
    """Pours of all runs of this machine, the oldest first: action in display units, masses [g], spillage, loss.

    Args:
        words: see `find_runs`.
        since: weighed at that date or later.
        until: weighed at that date or before, to the end of the day or month.
        run: name of a run's folder, or its path.
        campaign: its name.
        pourer: vessel that was poured from.
        receiver: vessel that was poured into.
        liquid: its name.
        strategy: that asked for the pour.
        mode: 'virtual' or 'real'.
        tag: of the run.

    Returns:
        One row for each pour that had begun.

    Raises:
        ValueError, RunError: see `find_runs`.
    """
    conditions = search.searching(**locals())
    return _table("pour", lambda catalogue: search.find_pours(catalogue, conditions))


def _table(name: str, find: Callable[[Catalogue], list[Row]]) -> pd.DataFrame:
    require("pandas", "A table")
    import pandas as pd

    with Catalogue() as catalogue:
        catalogue.refresh()
        rows = find(catalogue)
    table = pd.DataFrame(rows, columns=[column.name for column in TABLES[name]])
    for column in TABLES[name]:
        if column.type == "time":
            table[column.name] = pd.to_datetime(table[column.name], unit="s", utc=True)
    return table
