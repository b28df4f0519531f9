"""Runs and pours of the catalogue as people read them: dates, units, tables."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from datetime import datetime
from typing import TYPE_CHECKING, Any

from orchestrator.catalogue.columns import ACTION_COLUMNS, POURS
from orchestrator.report.table import print_table

if TYPE_CHECKING:
    from orchestrator.pour_rows import Row

_UNITS = {column.name: column.unit for column in POURS}


def mode(text: str | None) -> str:
    """What kind of bench, so that nobody takes one for the other."""
    return "REAL" if text == "hardware" else "VIRTUAL" if text else ""


def print_pours(pours: Sequence[Row], *, of_one_run: bool = False) -> None:
    """A table of pours; what is the same in all of them stands once, above."""
    used = [name for name in ACTION_COLUMNS if any(pour[name] is not None for pour in pours)]
    many = len(pours) > 1
    differing = [name for name in used if not many or len({_rounded(pour[name]) for pour in pours}) > 1]
    constant = {name: pours[0][name] for name in used if name not in differing}
    rows = [
        {
            "": date(pour["time"]),
            "run": "" if of_one_run else pour["run"],
            "mode": mode(pour["mode"]),
            "by": pour["strategy"] if pour["purpose"] != "calibration" else f"{pour['strategy']} (calibration)",
            "into": pour["receiver"],
            "pour": str(pour["number"]),
            **{_head(name): "" if pour[name] is None else f"{pour[name]:.4g}" for name in differing},
            "spilled [g]": "" if pour["spilled_g"] is None else f"{pour['spilled_g']:.1f}",
            "spilled / poured": percent(pour["spillage"]),
            "loss": loss(pour["loss"], pour["loss_name"]),
            "expected": _expected(pour),
            "remark": _remark(pour),
        }
        for pour in pours
    ]
    if constant:
        print(f"in all of them: {action(constant)}")
    print_table(rows, right=[name for name in rows[0] if name not in ("", "run", "mode", "by", "into", "remark")])
    weighed = [pour for pour in pours if pour["spillage"] is not None]
    if weighed:
        mean = sum(pour["spillage"] for pour in weighed) / len(weighed)
        least = min(weighed, key=lambda pour: float(pour["spillage"]))
        print(
            f"{len(pours)} pours, {len(weighed)} weighed: {percent(mean)} spilled in the mean, at least "
            f"{percent(least['spillage'])} (pour {least['number']} of {least['stage']}, {least['run']})"
        )


def _remark(pour: Row) -> str:
    if pour["outcome"] == "open":
        return "has begun and has no outcome: under way, or UNKNOWN"
    return str(pour["reason"] or "")


def _expected(pour: Row) -> str:
    if pour["predicted_loss"] is None:
        return ""
    return loss(pour["predicted_loss"], pour["loss_name"], pour["predicted_deviation"])


def loss(value: float | None, name: str | None, deviation: float | None = None) -> str:
    """The loss of a pour or a prediction, in its unit: '3.4 %', '3.4 ± 1.2 %'."""
    from orchestrator.report.units import named_loss_unit

    return "" if value is None else named_loss_unit(str(name)).text(value, deviation)


def percent(value: float | None) -> str:
    """A share for people; empty where nobody knows it."""
    return "" if value is None else f"{100 * value:.2f} %"


def advice(run: Row) -> list[tuple[str, dict[str, Any]]]:
    """What a run recommends, by receiver."""
    return list((run["recommended"] or {}).items())


def count_of_pours(run: Row) -> str:
    """'6', or '6 + 1 without a weight'."""
    lost = (run["failed_pours"] or 0) + (run["open_pours"] or 0)
    return f"{run['pours'] or 0}" + (f" + {lost} without a weight" if lost else "")


def action(values: Mapping[str, float | None]) -> str:
    """'angular velocity 41.2 deg/s, x offset 112 mm'."""
    known = ((name, value) for name, value in values.items() if value is not None)
    return ", ".join(f"{_words(name)} {value:.4g} {_UNITS.get(name, '')}" for name, value in known)


def _words(name: str) -> str:
    suffixes = ("_deg_s2", "_deg_s", "_deg", "_mm", "_s")
    return name.removesuffix(next((s for s in suffixes if name.endswith(s)), "")).replace("_", " ")


def _head(name: str) -> str:
    return f"{_words(name)} [{_UNITS[name]}]"


def compared(name: str, heads: Sequence[str], values: Sequence[Any]) -> dict[str, str]:
    """A line of a comparison."""
    return {"": name, **{head: _plain(value) for head, value in zip(heads, values, strict=True)}}


def _plain(value: Any) -> str:
    if value is None:
        return ""
    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _rounded(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def date(seconds: float | None) -> str:
    """When, in this machine's time."""
    return "" if seconds is None else datetime.fromtimestamp(seconds).strftime("%Y-%m-%d %H:%M")
