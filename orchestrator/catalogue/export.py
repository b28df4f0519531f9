"""Export of runs and pours for other programs: CSV and Parquet, with a data dictionary."""

from __future__ import annotations

import csv
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.catalogue.run_reading import TABLES, Column
from orchestrator.records.run_record import Row
from sim_engine.resources import require

if TYPE_CHECKING:
    import pyarrow as pa

FORMATS = ("csv", "parquet")

DICTIONARY = "dictionary.csv"


def write_tables(tables: Mapping[str, Sequence[Row]], folder: Path, formats: Iterable[str] = FORMATS) -> list[Path]:
    """Write tables as 'runs.csv', 'pours.parquet' …, and the meanings of their columns as 'dictionary.csv'.

    Times are UTC. In CSV, times are ISO 8601, lists and mappings are JSON, and unknown values are empty. In Parquet,
    the metadata of the columns contain meaning and unit.

    Args:
        tables: 'run' and 'pour' to their rows.
        folder: created if needed.
        formats: of `FORMATS`.

    Raises:
        MissingExtraError: pyarrow is not installed.
        OSError: a file can't be written.
    """
    writers: dict[str, Callable[[Path, Sequence[Column], Sequence[Row]], None]] = {
        "csv": _write_csv,
        "parquet": _write_parquet,
    }
    chosen = list(formats)
    if "parquet" in chosen:
        require("pyarrow", "Parquet")
    folder.mkdir(parents=True, exist_ok=True)
    paths = []
    for table, rows in tables.items():
        for form in chosen:
            paths.append(folder / f"{table}s.{form}")
            writers[form](paths[-1], TABLES[table], rows)
    paths.append(folder / DICTIONARY)
    with paths[-1].open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow(("table", "column", "type", "unit", "meaning"))
        writer.writerows((f"{t}s", c.name, c.type, c.unit, c.meaning) for t in tables for c in TABLES[t])
    return paths


def _write_csv(path: Path, columns: Sequence[Column], rows: Sequence[Row]) -> None:
    with path.open("w", newline="", encoding="utf-8") as file:
        writer = csv.writer(file)
        writer.writerow([column.name for column in columns])
        writer.writerows([_text(column, row.get(column.name)) for column in columns] for row in rows)


def _text(column: Column, value: Any) -> Any:
    if value is None:
        return ""
    if column.type == "time":
        return utc(value).isoformat(timespec="milliseconds")
    if column.type in ("texts", "values"):
        return json.dumps(value, ensure_ascii=False)
    return value


def utc(seconds: float) -> datetime:
    """Seconds since 1970 as a date with its time zone."""
    return datetime.fromtimestamp(seconds, UTC)


def _write_parquet(path: Path, columns: Sequence[Column], rows: Sequence[Row]) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    fields = [
        pa.field(c.name, _arrow_type(pa, c), metadata={"meaning": c.meaning, **({"unit": c.unit} if c.unit else {})})
        for c in columns
    ]
    arrays = [
        pa.array([_value(column, row.get(column.name)) for row in rows], field.type)
        for column, field in zip(columns, fields, strict=True)
    ]
    pq.write_table(pa.table(arrays, schema=pa.schema(fields)), path)


def _arrow_type(pa: Any, column: Column) -> pa.DataType:
    return {
        "integer": pa.int64(),
        "number": pa.float64(),
        "time": pa.timestamp("us", tz="UTC"),
        "texts": pa.list_(pa.string()),
    }.get(column.type, pa.string())


def _value(column: Column, value: Any) -> Any:
    if value is None or column.type not in ("time", "values"):
        return value
    return utc(value) if column.type == "time" else json.dumps(value, ensure_ascii=False)
