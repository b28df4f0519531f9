"""Queries of the catalogue: runs and pours by date, vessels, liquid, strategy and words, and comparisons of runs.

- `searching` creates a `CatalogueQuery` from text; `find_runs`, `find_pours` and `one_run` execute queries.
- `differing_settings` and `outcomes` compare runs.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from orchestrator.catalogue.catalogue_index import Catalogue, CatalogueError
from orchestrator.journal.journal import JOURNAL_NAME, JournalReader
from orchestrator.journal.run_record import Row
from sim_engine.errors import InvalidArgumentError

_AGO = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_DATES = (("%Y-%m-%dT%H:%M:%S", 0), ("%Y-%m-%dT%H:%M", 60), ("%Y-%m-%d", 86_400), ("%Y-%m", -1), ("%Y", -12))
"""Formats of a date, and the length of the period [s]; -1 and -12: one month and twelve months."""

MODES = {"virtual": "virtual", "real": "hardware", "hardware": "hardware"}


@dataclass(frozen=True)
class CatalogueQuery:
    """Conditions; all given ones must hold. Texts may contain * and ?; case is ignored.

    Attributes:
        words: each must occur in a run: in its names, vessels, liquid, strategy, state, tags or notes.
        since, until: seconds since 1970; compared with the start of a run, or the weighing of a pour.
        run: name of the folder, or its path.
        mode: 'virtual' or 'hardware'.
        limit: maximum number of rows, the newest ones.
    """

    words: tuple[str, ...] = ()
    since: float | None = None
    until: float | None = None
    run: str | None = None
    campaign: str | None = None
    pourer: str | None = None
    receiver: str | None = None
    liquid: str | None = None
    strategy: str | None = None
    mode: str | None = None
    state: str | None = None
    tag: str | None = None
    limit: int | None = None


class NoSuchRunError(CatalogueError):
    """The catalogue has no such run."""


def find_runs(catalogue: Catalogue, search: CatalogueQuery) -> list[Row]:
    """Runs, the newest first; see `catalogue_index.RUNS`."""
    where, values = _conditions(search, "run")
    found = catalogue.rows("run", where, values, "begun desc, path")
    if search.state is not None:  # no journal contains 'interrupted'
        pattern = _like(search.state)
        found = [row for row in found if re.fullmatch(pattern, str(row["state"]), re.IGNORECASE)]
    return found[: search.limit]


def find_pours(catalogue: Catalogue, search: CatalogueQuery) -> list[Row]:
    """Pours, the oldest first; beyond the limit only the newest. See `catalogue_index.POURS`."""
    where, values = _conditions(search, "pour")
    if search.state is not None:
        paths = [row["path"] for row in find_runs(catalogue, CatalogueQuery(state=search.state))]
        where, values = f"{where} and path in ({', '.join('?' * len(paths))})", [*values, *paths]
    found = catalogue.rows("pour", where, values, "time, path, id")
    return found if search.limit is None else found[max(len(found) - search.limit, 0) :]


def one_run(catalogue: Catalogue, name: str) -> Row:
    """The run with that name, or in that folder; an unambiguous beginning of a name is enough.

    Raises:
        NoSuchRunError: there is none.
        CatalogueError: there are several.
    """
    path = str(Path(name).absolute())
    runs = catalogue.rows("run", "path = ?", [path])
    runs = runs or catalogue.rows("run", "run = ?", [name])
    runs = runs or catalogue.rows("run", "substr(run, 1, length(?)) = ?", [name, name], "run")
    if len(runs) == 1:
        return runs[0]
    if not runs:
        raise NoSuchRunError(
            f"{name}: no such run in the catalogue; `decant runs` lists the newest, `decant runs add FOLDER` enters "
            "runs that it doesn't know"
        )
    places = "\n  ".join(row["path"] for row in runs[:10])
    raise CatalogueError(f"{name}: {len(runs)} runs are called so; name one by its folder:\n  {places}")


def _conditions(search: CatalogueQuery, table: str) -> tuple[str, list[Any]]:
    parts: list[str] = ["1"]
    values: list[Any] = []
    when = "begun" if table == "run" else "time"
    for condition, value in ((f"{when} >= ?", search.since), (f"{when} < ?", search.until)):
        if value is not None:
            parts.append(condition)
            values.append(value)
    for name in ("campaign", "mode"):
        if (text := getattr(search, name)) is not None:
            parts.append(f"lower({name}) glob lower(?)")
            values.append(text)
    for name in ("pourer", "receiver", "liquid", "strategy"):
        if (text := getattr(search, name)) is not None:
            several = f"exists (select 1 from json_each({name}) where lower(value) glob lower(?))"
            parts.append(several if table == "run" else f"lower({name}) glob lower(?)")
            values.append(text)
    if search.run is not None:
        parts.append("(lower(run) glob lower(?) or path = ?)")
        values += [search.run, str(Path(search.run).absolute())]
    inside: list[str] = []
    if search.tag is not None:
        inside.append("exists (select 1 from json_each(run.tags) where lower(value) glob lower(?))")
        values.append(search.tag)
    for word in search.words:
        inside.append(f"instr(lower({_EVERYTHING}), lower(?)) > 0")
        values.append(word)
    if inside:
        condition = " and ".join(inside)
        parts.append(condition if table == "run" else f"path in (select path from run where {condition})")
    return " and ".join(parts), values


_EVERYTHING = " || ' ' || ".join(
    f"coalesce(run.{name}, '')"
    for name in (
        *("run", "path", "campaign", "mode", "state", "reason", "laboratory", "liquid", "pourer", "receiver"),
        *("strategy", "tags", "notes"),
    )
)


def _like(text: str) -> str:
    return "".join({"*": ".*", "?": "."}.get(letter, re.escape(letter)) for letter in text)


def moment(text: str, *, end: bool = False, now: datetime | None = None) -> float:
    """Parse a moment in local time: '2030-03-01', '2030-03', '2030-03-01 14:30', '7d' (ago).

    Args:
        text: as typed.
        end: return the end of the named period: of the day, of the month.
        now: reference of 'ago'.

    Returns:
        Seconds since 1970.

    Raises:
        ValueError: it is none of these.
    """
    with contextlib.suppress(OverflowError):  # beyond the range of dates
        if ago := re.fullmatch(r"(\d{1,9})\s*([mhdw])", text.strip(), re.ASCII):
            return ((now or datetime.now()) - timedelta(**{_AGO[ago[2]]: int(ago[1])})).timestamp()
        for form, lasts in _DATES:
            with contextlib.suppress(ValueError):
                begin = datetime.strptime(text.strip().replace(" ", "T"), form)
                return (_after(begin, lasts) if end else begin).timestamp()
    raise InvalidArgumentError(
        f"'{text}' is not a date: write 2030-03-01, 2030-03, '2030-03-01 14:30', or 7d for 7 days ago"
    )


def _after(begin: datetime, lasts: int) -> datetime:
    if lasts >= 0:
        return begin + timedelta(seconds=lasts)
    months = begin.month - 1 - lasts
    return begin.replace(year=begin.year + months // 12, month=months % 12 + 1)


def searching(
    *,
    since: str | None = None,
    until: str | None = None,
    mode: str | None = None,
    words: Sequence[str] = (),
    **others: Any,
) -> CatalogueQuery:
    """A query from typed text; see `CatalogueQuery`, `moment`, and `MODES` for `mode`.

    Raises:
        ValueError: a date or a mode is invalid.
    """
    if mode is not None and mode.lower() not in MODES:
        raise InvalidArgumentError(f"mode '{mode}' is not one of {', '.join(MODES)}")
    return CatalogueQuery(
        words=tuple(words),
        since=None if since is None else moment(since),
        until=None if until is None else moment(until, end=True),
        mode=None if mode is None else MODES[mode.lower()],
        **others,
    )


_MISSING = object()


def differing_settings(runs: Sequence[Path]) -> dict[str, list[Any]]:
    """Settings in which runs differ: place in the plan → its value in each run, None if a run does not have it.

    If a whole section is missing in one run, the section is listed, not all of its values.

    Raises:
        RunError: a journal can't be read.
    """
    plans = []
    for run in runs:
        with JournalReader(run / JOURNAL_NAME) as journal:
            plans.append(journal.header.fingerprint)
    found: dict[str, list[Any]] = {}
    _compare("", plans, found)
    return found


def _compare(place: str, values: Sequence[Any], found: dict[str, list[Any]]) -> None:
    if all(value == values[0] for value in values):
        return
    if all(isinstance(value, Mapping) for value in values):
        for key in dict.fromkeys(key for value in values for key in value):
            _compare(f"{place}.{key}" if place else key, [value.get(key, _MISSING) for value in values], found)
        return
    same_length = all(isinstance(value, list) and len(value) == len(values[0]) for value in values)
    if same_length and any(isinstance(part, Mapping) for part in values[0]):
        for index, parts in enumerate(zip(*values, strict=True)):
            _compare(f"{place}[{index}]", parts, found)
        return
    found[place] = [None if value is _MISSING else value for value in values]


def outcomes(run: Row) -> dict[str, Any]:
    """The result of a run, one value for each line of a comparison: by θ, and by receiver."""
    theta = {f"θ* {name}": value for name, value in (run["theta"] or {}).items()}
    shown: dict[str, Any] = {
        name: run[name] for name in ("state", "simulations", "pours", "spilled_g", "test_discrepancy")
    }
    for receiver, advice in (run["recommended"] or {}).items():
        shown |= {f"{receiver}: {name}": advice[name] for name in ("strategy", "best_loss", "predicted_loss")}
        shown |= {f"{receiver}: {name}": value for name, value in advice["action"].items()}
    return shown | theta
