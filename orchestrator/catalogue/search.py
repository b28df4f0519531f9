"""What may be asked of the catalogue: runs, and single pours, by dates, vessels, liquid, strategy, words."""

from __future__ import annotations

import contextlib
import re
from collections.abc import Sequence
from dataclasses import dataclass
from datetime import datetime, timedelta
from pathlib import Path
from typing import Any

from orchestrator.catalogue.index import Catalogue, CatalogueError
from orchestrator.pour_rows import Row
from sim_engine.errors import InvalidArgumentError

_AGO = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_DATES = (("%Y-%m-%dT%H:%M:%S", 0), ("%Y-%m-%dT%H:%M", 60), ("%Y-%m-%d", 86_400), ("%Y-%m", -1), ("%Y", -12))
"""Forms of a date, and how long it lasts [s]; -1 and -12: so many months."""

MODES = {"virtual": "virtual", "real": "hardware", "hardware": "hardware"}


@dataclass(frozen=True)
class Search:
    """Conditions; all that are given must hold. Texts may hold * and ?, and capitals don't matter.

    Attributes:
        words: each must stand somewhere in a run: its names, vessels, liquid, strategy, state, tags or notes.
        since, until: seconds since 1970; of a run its beginning, of a pour when it was weighed.
        run: name of the folder, or its path.
        mode: 'virtual' or 'hardware'.
        limit: the newest so many.
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


def find_runs(catalogue: Catalogue, search: Search) -> list[Row]:
    """Runs, the newest first; see `columns.RUNS`."""
    where, values = _conditions(search, "run")
    found = catalogue.rows("run", where, values, "begun desc, path")
    if search.state is not None:  # 'interrupted' stands in no journal
        pattern = _like(search.state)
        found = [row for row in found if re.fullmatch(pattern, str(row["state"]), re.IGNORECASE)]
    return found[: search.limit]


def find_pours(catalogue: Catalogue, search: Search) -> list[Row]:
    """Pours, the oldest first; of too many the newest. See `columns.POURS`."""
    where, values = _conditions(search, "pour")
    if search.state is not None:
        paths = [row["path"] for row in find_runs(catalogue, Search(state=search.state))]
        where, values = f"{where} and path in ({', '.join('?' * len(paths))})", [*values, *paths]
    found = catalogue.rows("pour", where, values, "time, path, id")
    return found if search.limit is None else found[max(len(found) - search.limit, 0) :]


def one_run(catalogue: Catalogue, name: str) -> Row:
    """The run of that name, or in that folder; the beginning of a name is enough where only one run has it.

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


def _conditions(search: Search, table: str) -> tuple[str, list[Any]]:
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
    """A moment as people type it, in this machine's time: '2030-03-01', '2030-03', '2030-03-01 14:30', '7d' (ago).

    Args:
        text: as typed.
        end: the end of what is named: of the day, of the month.
        now: what 'ago' counts from.

    Returns:
        Seconds since 1970.

    Raises:
        ValueError: it is none of these.
    """
    with contextlib.suppress(OverflowError):  # farther away than dates go
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
) -> Search:
    """A search from what people type; see `Search`, `moment`, and `MODES` for `mode`.

    Raises:
        ValueError: a date or a mode is none.
    """
    if mode is not None and mode.lower() not in MODES:
        raise InvalidArgumentError(f"mode '{mode}' is not one of {', '.join(MODES)}")
    return Search(
        words=tuple(words),
        since=None if since is None else moment(since),
        until=None if until is None else moment(until, end=True),
        mode=None if mode is None else MODES[mode.lower()],
        **others,
    )
