"""Conditions of catalogue queries, and their conversion to SQL.

- `CONDITIONS` declares the conditions for the command line, the HTTP API and notebooks.
- `condition_sql` converts conditions to SQL, which `orchestrator.catalogue.catalogue` executes.

The module imports nothing heavy: `decant --help` needs it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping
from datetime import datetime, timedelta
from pathlib import Path
from typing import Annotated, Any, TypedDict, get_type_hints

from sim_engine.errors import InvalidArgumentError

_Text = str | None


class Conditions(TypedDict, total=False):
    """Conditions in addition to words. All given ones must hold; names may contain * and ?, and case is ignored."""

    since: Annotated[
        _Text, "Begun (of a pour: weighed) at that date or later: 2030-03-01, 2030-03 (a month), 7d (ago)."
    ]
    until: Annotated[_Text, "… at that date or before; a day or month counts to its end."]
    campaign: Annotated[_Text, "Name of the campaign."]
    pourer: Annotated[_Text, "Vessel that was poured from, by name."]
    receiver: Annotated[_Text, "Vessel that was poured into, by name."]
    liquid: Annotated[_Text, "What was poured, by name."]
    strategy: Annotated[_Text, "C1 to C4, D1 to D3, or one of a package."]
    mode: Annotated[_Text, "'virtual' or 'real'."]
    state: Annotated[_Text, "finished, paused, failed, unknown, interrupted …"]
    verdict: Annotated[_Text, "complete, incomplete or nothing: what the run reached."]


class PourConditions(Conditions, total=False):
    """Conditions for pours."""

    run: str | Path | None


CONDITIONS = {name: hint.__metadata__[0] for name, hint in get_type_hints(Conditions, include_extras=True).items()}
"""Names and descriptions of `Conditions`."""

_AGO = {"m": "minutes", "h": "hours", "d": "days", "w": "weeks"}
_DATES = (("%Y-%m-%dT%H:%M:%S", 0), ("%Y-%m-%dT%H:%M", 60), ("%Y-%m-%d", 86_400), ("%Y-%m", -1), ("%Y", -12))
"""Formats of a date, and the length of the period [s]; -1 and -12: one month and twelve months."""

MODES = {"virtual": "virtual", "real": "hardware", "hardware": "hardware", "external": "external"}

_LISTS = ("liquid", "pourer", "receiver", "strategy")
_SEARCHED = ("run", "path", "campaign", "mode", "state", "verdict", "reason", "laboratory", *_LISTS, "notes")
_ALL_TEXT = " || ' ' || ".join(f"coalesce({name}, '')" for name in _SEARCHED)
_LIKE = "lower({}) glob lower(?)"
_ANY_LIKE = "exists (select 1 from json_each({}) where lower(value) glob lower(?))"


def condition_sql(table: str, conditions: Mapping[str, Any]) -> tuple[str, list[Any]]:
    """The SQL condition of a query, and its values.

    Args:
        table: 'run' or 'pour'.
        conditions: those of `CONDITIONS`, as text; 'words', each of which must occur in a run's names, vessels, liquid,
            strategy, state or notes; 'run', the name of a run's folder, or its path. None sets no condition.

    Raises:
        ValueError: a date or the mode is invalid.
    """
    if unknown := conditions.keys() - {*CONDITIONS, "words", "run", "limit"}:
        raise TypeError(f"no condition is called {', '.join(sorted(unknown))}")
    of_pour, of_run = ["1"], [f"instr(lower({_ALL_TEXT}), lower(?)) > 0" for _ in conditions.get("words") or ()]
    values: list[Any] = []
    run_values: list[Any] = list(conditions.get("words") or ())
    for name, text in conditions.items():
        match name:
            case "words" | "limit":
                continue
            case _ if text is None:
                continue
            case "since" | "until":
                column, sign = "begun" if table == "run" else "time", ">=" if name == "since" else "<"
                of_pour.append(f"{column} {sign} ?")
                values.append(moment(text, end=name == "until"))
            case "mode":
                if text.lower() not in MODES:
                    raise InvalidArgumentError(f"mode '{text}' is not one of {', '.join(MODES)}")
                of_pour.append("mode = ?")
                values.append(MODES[text.lower()])
            case "run":
                of_pour.append("(lower(run) glob lower(?) or path = ?)")
                values += [str(text), str(Path(text).absolute())]
            case "state" | "verdict":
                of_run.append(_LIKE.format(name))
                run_values.append(text)
            case _:
                of_pour.append((_ANY_LIKE if table == "run" and name in _LISTS else _LIKE).format(name))
                values.append(text)
    if of_run:
        condition = " and ".join(of_run)
        of_pour.append(condition if table == "run" else f"path in (select path from runs where {condition})")
    return " and ".join(of_pour), values + run_values


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
