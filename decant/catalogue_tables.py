"""Runs and pours of this machine as tables, from the catalogue of `decant runs`."""

from __future__ import annotations

from typing import TYPE_CHECKING, Unpack

from orchestrator.catalogue.catalogue import Catalogue
from orchestrator.catalogue.queries import Conditions, PourConditions
from orchestrator.catalogue.run_reading import TABLES
from orchestrator.records.run_record import Row
from sim_engine.resources import require

if TYPE_CHECKING:
    import pandas as pd


def find_runs(*words: str, **conditions: Unpack[Conditions]) -> pd.DataFrame:
    """Runs of this machine, newest first; `open_run(path)` opens one. Names may contain * and ?.

    Args:
        words: all of them must occur in a run's names, vessels or notes.
        conditions: any of `since`, `until` ('2030-03-01', '2030-03', '7d' ago; to the end of the day or month),
            `campaign`, `pourer`, `receiver`, `liquid`, `strategy` (names), `mode` ('virtual' or 'real'), and
            `state` as `decant runs` shows it ('finished', 'interrupted' …). All given conditions must hold.

    Returns:
        One row for each run; the reference of the catalogue describes the columns. `attrs['units']` has
        the units, in Parquet files, too. Numbers of things are of type Int64, texts of type string.

    Raises:
        ValueError: a date or the mode is invalid.
        RunError: the catalogue cannot be read.
    """
    with _catalogue() as catalogue:
        return _table("run", catalogue.runs({**conditions, "words": words}))


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
    with _catalogue() as catalogue:
        return _table("pour", catalogue.pours({**conditions, "words": words}))


def _catalogue() -> Catalogue:
    require("pandas", "A table")
    catalogue = Catalogue()
    catalogue.refresh()
    return catalogue


_DTYPES = {"text": "string", "integer": "Int64", "number": "float64"}
"""Types of pandas, by the type of a column; each knows missing values."""


def _table(name: str, rows: list[Row]) -> pd.DataFrame:
    import pandas as pd

    columns = TABLES[name]
    table = pd.DataFrame(rows, columns=[column.name for column in columns])
    for column in columns:
        if column.type == "time":
            table[column.name] = pd.to_datetime(table[column.name], unit="s", utc=True)
    table = table.astype({column.name: _DTYPES[column.type] for column in columns if column.type in _DTYPES})
    table.attrs["units"] = {column.name: column.unit for column in columns if column.unit}
    return table
