"""The commands `decant runs …`: queries of the catalogue, printed as tables or JSON.

The functions query this machine's catalogue or a daemon's through `CatalogueClient`. Options are declared in
`run_commands`; queries and the index are in `orchestrator.catalogue`.
"""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.catalogue.catalogue_index import ACTION_COLUMNS, POURS
from orchestrator.cli.console import BAD_INPUT, FAILED, RefusalError, print_json, print_message, print_note
from orchestrator.results.console_view import print_table

if TYPE_CHECKING:
    from orchestrator.catalogue.catalogue_client import CatalogueClient
    from orchestrator.catalogue.catalogue_index import Catalogue
    from orchestrator.journal.run_record import Row

_UNITS = {column.name: column.unit for column in POURS}


def mode(text: str | None) -> str:
    """Return 'REAL' or 'VIRTUAL', so that the two kinds of bench can't be confused."""
    return "REAL" if text == "hardware" else "VIRTUAL" if text else ""


def print_pours(pours: Sequence[Row], *, of_one_run: bool = False) -> None:
    """Print a table of pours; values that are equal in all pours are printed once, above it."""
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
    """Format the loss of a pour or a prediction with its unit: '3.4 %', '3.4 ± 1.2 %'."""
    from orchestrator.results.loss_units import named_loss_unit

    return "" if value is None else named_loss_unit(str(name)).text(value, deviation)


def percent(value: float | None) -> str:
    """Format a fraction in percent; '' if it is unknown."""
    return "" if value is None else f"{100 * value:.2f} %"


def advice(run: Row) -> list[tuple[str, dict[str, Any]]]:
    """Return the recommendations of a run, by receiver."""
    return list((run["recommended"] or {}).items())


def count_of_pours(run: Row) -> str:
    """Format the number of pours: '6', or '6 + 1 without a weight'."""
    lost = (run["failed_pours"] or 0) + (run["open_pours"] or 0)
    return f"{run['pours'] or 0}" + (f" + {lost} without a weight" if lost else "")


def action(values: Mapping[str, float | None]) -> str:
    """Format an action: 'angular velocity 41.2 deg/s, x offset 112 mm'."""
    known = ((name, value) for name, value in values.items() if value is not None)
    return ", ".join(f"{_words(name)} {value:.4g} {_UNITS.get(name, '')}" for name, value in known)


def _words(name: str) -> str:
    suffixes = ("_deg_s2", "_deg_s", "_deg", "_mm", "_s")
    return name.removesuffix(next((s for s in suffixes if name.endswith(s)), "")).replace("_", " ")


def _head(name: str) -> str:
    return f"{_words(name)} [{_UNITS[name]}]"


def compared(name: str, heads: Sequence[str], values: Sequence[Any]) -> dict[str, str]:
    """Return one row of a comparison."""
    return {"": name, **{head: _plain(value) for head, value in zip(heads, values, strict=True)}}


def _plain(value: Any) -> str:
    if value is None:
        return ""
    text = f"{value:.5g}" if isinstance(value, float) else str(value)
    return text if len(text) <= 60 else f"{text[:57]}…"


def _rounded(value: float | None) -> str:
    return "" if value is None else f"{value:.6g}"


def date(seconds: float | None) -> str:
    """Format a time in this machine's time zone."""
    return "" if seconds is None else datetime.fromtimestamp(seconds).strftime("%Y-%m-%d %H:%M")


NEWEST = 20


def list_runs(conditions: Mapping[str, Any], *, daemon: bool = False, as_json: bool) -> None:
    """List the runs that meet the conditions, newest first."""
    with _client(daemon) as client:
        found = client.runs(conditions)
    if as_json:
        print_json({"runs": found})
        return
    if not found:
        print_note("no run; `decant runs add FOLDER` enters runs that the catalogue doesn't know")
        return
    rows = [
        {
            "run": run["run"],
            "begun": date(run["begun"]),
            "mode": mode(run["mode"]),
            "state": run["state"],
            "strategies": ", ".join(run["strategy"]),
            "liquid": ", ".join(run["liquid"]),
            "from": ", ".join(run["pourer"]),
            "into": ", ".join(run["receiver"]),
            "pours": count_of_pours(run),
            "best loss": "  ".join(f"{name} {loss(one['best_loss'], one['loss'])}" for name, one in advice(run)),
            "tags": ", ".join(run["tags"]),
        }
        for run in found
    ]
    print_table(rows, right=("pours",))


def list_pours(conditions: Mapping[str, Any], *, daemon: bool = False, as_json: bool) -> None:
    """List the pours that meet the conditions, oldest first."""
    with _client(daemon) as client:
        found = client.pours(conditions)
    if as_json:
        print_json({"pours": found})
    elif found:
        print_pours(found)
    else:
        print_note("no pour that this holds for")


def show(name: str, *, daemon: bool = False, as_json: bool) -> None:
    """Show one run."""
    with _client(daemon) as client:
        run = client.run(name)
    if as_json:
        print_json(run)
        return
    lines = {
        "run": f"{run['run']}  {mode(run['mode'])}",
        "state": f"{run['state']}{': ' + run['reason'] if run['reason'] else ''}",
        "begun": f"{date(run['begun'])}, ended {date(run['ended'])}",
        "campaign": f"{run['campaign']}, seed {run['seed']}, laboratory {run['laboratory']}",
        "strategies": ", ".join(run["strategy"]),
        "liquid": f"{', '.join(run['liquid'])}, from {', '.join(run['pourer'])} into {', '.join(run['receiver'])}",
        "work": f"{run['simulations']} simulations, {count_of_pours(run)} pours, {run['spilled_g'] or 0:.1f} g spilled",
        "θ*": ", ".join(f"{key} {value:.4g}" for key, value in (run["theta"] or {}).items()),
        "test |Δ|": percent(run["test_discrepancy"]),
        **{
            f"best for {receiver}": f"{action(one['action'])}: {loss(one['predicted_loss'], one['loss'])} expected, "
            f"{loss(one['best_loss'], one['loss'])} the best poured"
            for receiver, one in advice(run)
        },
        "tags": ", ".join(run["tags"]),
        "folder": run["path"],
    }
    width = max(map(len, lines))
    for key, text in lines.items():
        if text:
            print(f"{key:<{width}}  {text}")
    for note in run["notes"]:
        print(f"{'note':<{width}}  {date(note['time'])} {note['by']}: {note['text']}")
    if run["list_of_pours"]:
        print()
        print_pours(run["list_of_pours"], of_one_run=True)


def check(name: str, *, as_json: bool) -> None:
    """Check a run's records; exit code 1 if they are damaged or incomplete."""
    from orchestrator.journal.journal import JOURNAL_NAME
    from orchestrator.journal.journal_check import check_journal, has_begun

    folder = Path(name)
    if folder.is_dir():
        if not has_begun(folder / JOURNAL_NAME):
            raise RefusalError(f"{folder}: there is no run in this folder", BAD_INPUT)
    else:
        with _client(daemon=False) as client:
            folder = Path(client.run(name)["path"])
    with _refusing():
        found = check_journal(folder / JOURNAL_NAME)
    if as_json:
        print_json(
            {
                "run": folder,
                "complete": not found.problems,
                "problems": found.problems,
                "entries": found.entries,
                "entries_without_chain": found.unchecked,
                "pours": found.pours,
            }
        )
    else:
        print(f"{folder}: {found.verdict}")
        for pour in found.pours:
            print(f"  {pour}")
    if found.problems:
        raise RefusalError(f"{folder}: {len(found.problems)} problem(s) found", FAILED)


def compare(names: Sequence[str], *, daemon: bool = False, as_json: bool) -> None:
    """Compare runs: the settings in which they differ, and their outcomes."""
    if len(names) < 2:
        raise RefusalError("comparing takes two runs or more: decant runs compare RUN RUN", BAD_INPUT)
    with _client(daemon) as client:
        found = client.compare(names)
    if as_json:
        print_json(found)
        return
    heads = [Path(path).name for path in found["runs"]]
    heads = heads if len(set(heads)) == len(heads) else found["runs"]
    asked = [compared(place, heads, values) for place, values in found["settings"].items()]
    came = found["outcomes"]
    keys = dict.fromkeys(key for one in came for key in one)
    ended = [compared(key, heads, [one.get(key) for one in came]) for key in keys]
    print_table(asked or [compared("(the same settings)", heads, [""] * len(heads))], title="asked for")
    print_table(ended, title="came to")


def tag(name: str, add: Sequence[str], remove: Sequence[str], *, daemon: bool = False) -> None:
    """Add and remove tags of a run."""
    if not add and not remove:
        raise RefusalError("name tags to put on the run, or --remove those to take off", BAD_INPUT)
    with _client(daemon) as client:
        found = client.tag(name, add, remove)
    print(f"{found['run']}: {', '.join(found['tags']) or 'no tags'}")


def note(name: str, text: str, *, daemon: bool = False) -> None:
    """Add a note to a run."""
    with _client(daemon) as client:
        found = client.note(name, text)
    print(f"{found['run']}: {len(found['notes'])} note{'s' * (len(found['notes']) > 1)}")


def export(
    folder: Path, conditions: Mapping[str, Any], formats: Sequence[str] | None, *, daemon: bool = False, as_json: bool
) -> None:
    """Export the runs and pours that meet the conditions."""
    from orchestrator.catalogue.export import FORMATS
    from sim_engine.resources import MissingExtraError

    if wrong := sorted(set(formats or ()) - set(FORMATS)):
        raise RefusalError(f"--format {wrong[0]}: should be {' or '.join(FORMATS)}", BAD_INPUT)
    try:
        with _client(daemon) as client:
            found = client.export(folder, conditions, formats or FORMATS)
    except MissingExtraError as error:
        raise RefusalError(f"{error}; or --format csv", BAD_INPUT) from None
    if as_json:
        print_json(found)
        return
    print_note(f"{found['runs']} runs, {found['pours']} pours")
    print("\n".join(found["files"]))


def add(folders: Sequence[Path]) -> None:
    """Register all runs found in folders."""
    from orchestrator.catalogue.run_registry import enter, runs_below

    found: list[Path] = []
    for folder in folders:
        if not folder.is_dir():
            raise RefusalError(f"{folder}: is not a folder", BAD_INPUT)
        below = list(runs_below(folder.absolute()))
        if not below:
            raise RefusalError(f"{folder}: there is no run in it (no journal.sqlite, at any depth)", BAD_INPUT)
        found += below
    with _catalogue(before=lambda state: enter(found, state)):
        pass
    print(f"{len(found)} run{'s' * (len(found) > 1)} entered, or known already")


def rebuild() -> None:
    """Rebuild the index."""
    with _catalogue(anew=True) as catalogue:
        count = len(catalogue.rows("run"))
    print(f"{count} run{'s' * (count != 1)} in the catalogue")


# -- helpers ---------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _client(daemon: bool) -> Iterator[CatalogueClient]:
    """Open a client of this machine's catalogue or of the daemon's."""
    try:
        if daemon:
            from orchestrator.cli.queue_commands import connected_client
            from orchestrator.daemon.daemon_client import RemoteCatalogueClient

            with connected_client(None, None) as client, _refusing():
                yield RemoteCatalogueClient(client)
        else:
            from orchestrator.catalogue.catalogue_client import LocalCatalogueClient

            with _catalogue() as catalogue, _refusing():
                yield LocalCatalogueClient(catalogue)
    except ValueError as error:  # an invalid date
        raise RefusalError(str(error), BAD_INPUT) from None


@contextlib.contextmanager
def _catalogue(*, anew: bool = False, before: Any = None) -> Iterator[Catalogue]:
    """Open the catalogue and update it; problems with unreadable runs are printed at the end."""
    from orchestrator.catalogue.catalogue_index import Catalogue
    from orchestrator.catalogue.run_registry import state_directory

    with _refusing():
        state = state_directory()
        if before is not None:
            before(state)
        begin = time.monotonic()

        def progress(number: int, count: int) -> None:
            if time.monotonic() - begin > 2.0 and (number % 20 == 0 or number == count):
                print_note(f"reading runs: {number} of {count}")

        with Catalogue(state) as catalogue:
            if catalogue.warning:
                print_message(f"note: {catalogue.warning}")
            looked = catalogue.refresh(progress, anew=anew)
            yield catalogue
    for problem in looked.problems:
        print_message(f"note: {problem}")
    if looked.missing:
        print_note(
            f"note: {looked.missing} known run{'s are' if looked.missing > 1 else ' is'} not where it was; what was "
            "last known of it is shown (`decant runs add` after a move, `decant runs rebuild` forgets it)"
        )


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    from orchestrator.catalogue.annotations import AnnotationsError
    from orchestrator.run_errors import RunError

    try:
        yield
    except (RunError, AnnotationsError) as error:
        raise RefusalError(str(error), BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{error.filename or ''}: {error.strerror or error}".lstrip(": "), BAD_INPUT) from None
