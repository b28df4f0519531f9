"""Runs and pours of this machine as tables, from the catalogue of `decant runs`."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING, Unpack

from orchestrator.catalogue import queries as search
from orchestrator.catalogue.catalogue_index import TABLES, Catalogue
from orchestrator.catalogue.query_conditions import Conditions, PourConditions
from orchestrator.journal.run_record import Row
from sim_engine.resources import require

if TYPE_CHECKING:
    import pandas as pd


def find_runs(*words: str, **conditions: Unpack[Conditions]) -> pd.DataFrame:
    """Runs of this machine, newest first; `open_run(path)` opens one. Names may contain * and ?.

    Args:
        words: all of them must occur in a run's names, vessels, tags or notes.
        conditions: any of `since`, `until` ('2030-03-01', '2030-03', '7d' ago; to the end of the day or month),
            `campaign`, `pourer`, `receiver`, `liquid`, `strategy`, `tag` (names), `mode` ('virtual' or 'real'), and
            `state` as `decant runs` shows it ('finished', 'interrupted' …). All given conditions must hold.

    Returns:
        One row for each run; the data dictionary of `decant runs export` describes the columns.

    Raises:
        ValueError: a date or the mode is invalid.
        RunError: the catalogue cannot be read.
    """
    return _table("run", search.find_runs, search.searching(words=words, **conditions))


def find_pours(*words: str, **conditions: Unpack[PourConditions]) -> pd.DataFrame:
    """Pours of all runs of this machine, oldest first: action in display units, masses [g], spillage, loss.

    Args:
        words: see `find_runs`.
        conditions: see `find_runs`; dates are those of the weighing. `run` is the name of a run's folder, or its path.

    Returns:
        One row for each pour that had begun.

    Raises:
        ValueError, RunError: see `find_runs`.
    """
    run = conditions.pop("run", None)
    asked = search.searching(words=words, run=None if run is None else str(run), **conditions)
    return _table("pour", search.find_pours, asked)


def _table(
    name: str, find: Callable[[Catalogue, search.CatalogueQuery], list[Row]], asked: search.CatalogueQuery
) -> pd.DataFrame:
    require("pandas", "A table")
    import pandas as pd

    with Catalogue() as catalogue:
        catalogue.refresh()
        rows = find(catalogue, asked)
    table = pd.DataFrame(rows, columns=[column.name for column in TABLES[name]])
    for column in TABLES[name]:
        if column.type == "time":
            table[column.name] = pd.to_datetime(table[column.name], unit="s", utc=True)
    return table
