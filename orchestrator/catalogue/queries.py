"""Conditions of catalogue queries, their conversion to SQL, and comparisons of runs.

- `CONDITIONS` declares the conditions for the command line, the HTTP API and notebooks.
- `condition_sql` converts conditions to SQL, which `orchestrator.catalogue.catalogue` executes.
- `differing_settings` and `outcomes` compare runs.

The module imports nothing heavy: `decant --help` needs it.
"""

from __future__ import annotations

import contextlib
import re
from collections.abc import Mapping, Sequence
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
    tag: Annotated[_Text, "A tag of the run."]


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
_SEARCHED = ("run", "path", "campaign", "mode", "state", "reason", "laboratory", *_LISTS, "tags", "notes")
_ALL_TEXT = " || ' ' || ".join(f"coalesce({name}, '')" for name in _SEARCHED)
_LIKE = "lower({}) glob lower(?)"
_ANY_LIKE = "exists (select 1 from json_each({}) where lower(value) glob lower(?))"


def condition_sql(table: str, conditions: Mapping[str, Any]) -> tuple[str, list[Any]]:
    """The SQL condition of a query, and its values.

    Args:
        table: 'run' or 'pour'.
        conditions: those of `CONDITIONS`, as text; 'words', each of which must occur in a run's names, vessels, liquid,
            strategy, state, tags or notes; 'run', the name of a run's folder, or its path. None sets no condition.

    Raises:
        ValueError: a date or the mode is invalid.
    """
    if unknown := conditions.keys() - {*CONDITIONS, "words", "run", "limit"}:
        raise TypeError(f"no condition is called {', '.join(sorted(unknown))}")
    own, of_run = ["1"], [f"instr(lower({_ALL_TEXT}), lower(?)) > 0" for _ in conditions.get("words") or ()]
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
                own.append(f"{column} {sign} ?")
                values.append(moment(text, end=name == "until"))
            case "mode":
                if text.lower() not in MODES:
                    raise InvalidArgumentError(f"mode '{text}' is not one of {', '.join(MODES)}")
                own.append("mode = ?")
                values.append(MODES[text.lower()])
            case "run":
                own.append("(lower(run) glob lower(?) or path = ?)")
                values += [str(text), str(Path(text).absolute())]
            case "state" | "tag":
                of_run.append(_LIKE.format(name) if name == "state" else _ANY_LIKE.format("tags"))
                run_values.append(text)
            case _:
                own.append((_ANY_LIKE if table == "run" and name in _LISTS else _LIKE).format(name))
                values.append(text)
    if of_run:
        condition = " and ".join(of_run)
        own.append(condition if table == "run" else f"path in (select path from runs where {condition})")
    return " and ".join(own), values + run_values


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


_MISSING = object()


def differing_settings(plans: Sequence[Mapping[str, Any]]) -> dict[str, list[Any]]:
    """Settings in which runs differ: place in the plan → its value in each run, None if a run does not have it.

    If a whole section is missing in one run, the section is listed, not all of its values.

    Args:
        plans: the fingerprints of the runs' plans.
    """
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


def outcomes(run: Mapping[str, Any]) -> dict[str, Any]:
    """The result of a run, one value for each line of a comparison: by θ, and by receiver."""
    theta = {f"θ* {name}": value for name, value in (run["theta"] or {}).items()}
    shown: dict[str, Any] = {
        name: run[name] for name in ("state", "simulations", "pours", "spilled_g", "test_discrepancy")
    }
    for receiver, advice in (run["recommended"] or {}).items():
        shown |= {f"{receiver}: {name}": advice[name] for name in ("strategy", "best_loss", "predicted_loss")}
        shown |= {f"{receiver}: {name}": value for name, value in advice["action"].items()}
    return shown | theta
