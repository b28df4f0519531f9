"""`decant runs …`: what the catalogue knows, in front of people."""

from __future__ import annotations

import contextlib
import time
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from orchestrator.commands.runs_shown import (
    action,
    advice,
    compared,
    count_of_pours,
    date,
    loss,
    mode,
    percent,
    print_pours,
)
from orchestrator.commands.speaking import BAD_INPUT, RefusalError, Refused, mention, print_json, say
from orchestrator.report.table import print_table

if TYPE_CHECKING:
    from orchestrator.catalogue.index import Catalogue
    from orchestrator.catalogue.search import Search
    from orchestrator.pour_rows import Row

NEWEST = 20


def list_runs(conditions: Mapping[str, Any], *, as_json: bool) -> None:
    """Runs that conditions hold for, the newest first."""
    from orchestrator.catalogue.search import find_runs

    search = _search(conditions)
    with _catalogue() as catalogue:
        found = find_runs(catalogue, search)
    if as_json:
        print_json({"runs": found})
        return
    if not found:
        mention("no run; `decant runs add FOLDER` enters runs that the catalogue doesn't know")
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


def list_pours(conditions: Mapping[str, Any], *, as_json: bool) -> None:
    """Pours that conditions hold for, the oldest first."""
    from orchestrator.catalogue.search import find_pours

    search = _search(conditions)
    with _catalogue() as catalogue:
        found = find_pours(catalogue, search)
    if as_json:
        print_json({"pours": found})
    elif found:
        print_pours(found)
    else:
        mention("no pour that this holds for")


def show(name: str, *, as_json: bool) -> None:
    """One run with all that is known of it."""
    from orchestrator.catalogue.remarks import read_remarks
    from orchestrator.catalogue.search import Search, find_pours

    with _catalogue() as catalogue:
        run = _one(catalogue, name)
        pours = find_pours(catalogue, Search(run=run["path"]))
    notes = read_remarks(Path(run["path"])).notes
    if as_json:
        print_json({**run, "notes": [note.model_dump() for note in notes], "list_of_pours": pours})
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
    for note in notes:
        print(f"{'note':<{width}}  {date(note.time)} {note.by}: {note.text}")
    if pours:
        print()
        print_pours(pours, of_one_run=True)


def compare(names: Sequence[str], *, as_json: bool) -> None:
    """Settings in which runs differ, and what they came to."""
    from orchestrator.catalogue.compare import differing_settings, outcomes

    if len(names) < 2:
        raise RefusalError("comparing takes two runs or more: decant runs compare RUN RUN", BAD_INPUT)
    with _catalogue() as catalogue:
        found = [_one(catalogue, name) for name in names]
    with _refusing():
        settings = differing_settings([Path(run["path"]) for run in found])
    came = [outcomes(run) for run in found]
    if as_json:
        print_json({"runs": [run["path"] for run in found], "settings": settings, "outcomes": came})
        return
    heads = [run["run"] for run in found]
    heads = heads if len(set(heads)) == len(heads) else [run["path"] for run in found]
    asked = [compared(place, heads, values) for place, values in settings.items()]
    keys = dict.fromkeys(key for one in came for key in one)
    ended = [compared(key, heads, [one.get(key) for one in came]) for key in keys]
    print_table(asked or [compared("(the same settings)", heads, [""] * len(heads))], title="asked for")
    print_table(ended, title="came to")


def tag(name: str, add: Sequence[str], remove: Sequence[str]) -> None:
    """Change a run's tags."""
    from orchestrator.catalogue.remarks import tag as put

    if not add and not remove:
        raise RefusalError("name tags to put on the run, or --remove those to take off", BAD_INPUT)
    with _catalogue() as catalogue, _refusing():
        run = _one(catalogue, name)
        found = put(Path(run["path"]), tuple(add), tuple(remove))
    print(f"{run['run']}: {', '.join(found.tags) or 'no tags'}")


def note(name: str, text: str) -> None:
    """Write a note about a run."""
    from orchestrator.catalogue.remarks import note as write

    with _catalogue() as catalogue, _refusing():
        run = _one(catalogue, name)
        found = write(Path(run["path"]), text)
    print(f"{run['run']}: {len(found.notes)} note{'s' * (len(found.notes) > 1)}")


def export(folder: Path, conditions: Mapping[str, Any], formats: Sequence[str] | None, *, as_json: bool) -> None:
    """Write runs and pours that conditions hold for."""
    from orchestrator.catalogue import export as files
    from orchestrator.catalogue.search import find_pours, find_runs
    from sim_engine.extras import MissingExtraError

    if wrong := sorted(set(formats or ()) - set(files.FORMATS)):
        raise RefusalError(f"--format {wrong[0]}: should be {' or '.join(files.FORMATS)}", BAD_INPUT)
    search = _search(conditions)
    with _catalogue() as catalogue:
        tables = {"run": find_runs(catalogue, search), "pour": find_pours(catalogue, search)}
    try:
        paths = files.export(tables, folder, formats or files.FORMATS)
    except MissingExtraError as error:
        raise RefusalError(f"{error}; or --format csv", BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{error.filename or folder}: can't be written: {error.strerror}", BAD_INPUT) from None
    if as_json:
        print_json({"files": [str(path) for path in paths], **{f"{k}s": len(rows) for k, rows in tables.items()}})
        return
    mention(f"{len(tables['run'])} runs, {len(tables['pour'])} pours")
    print("\n".join(map(str, paths)))


def add(folders: Sequence[Path]) -> None:
    """Enter runs found in folders."""
    from orchestrator.catalogue.registry import enter, runs_below

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
    """Make the index anew."""
    with _catalogue(anew=True) as catalogue:
        count = len(catalogue.rows("run"))
    print(f"{count} run{'s' * (count != 1)} in the catalogue")


# -- inside ----------------------------------------------------------------------------------------------------------


@contextlib.contextmanager
def _catalogue(*, anew: bool = False, before: Any = None) -> Iterator[Catalogue]:
    """The catalogue, up to date; what of it can't be read is said at the end."""
    from orchestrator.catalogue.index import Catalogue
    from orchestrator.state_directory import state_directory

    with _refusing():
        state = state_directory()
        if before is not None:
            before(state)
        begin = time.monotonic()

        def progress(number: int, count: int) -> None:
            if time.monotonic() - begin > 2.0 and (number % 20 == 0 or number == count):
                mention(f"reading runs: {number} of {count}")

        with Catalogue(state) as catalogue:
            if catalogue.warning:
                say(f"note: {catalogue.warning}")
            looked = catalogue.refresh(progress, anew=anew)
            yield catalogue
    for problem in looked.problems:
        say(f"note: {problem}")
    if looked.missing:
        mention(
            f"note: {looked.missing} known run{'s are' if looked.missing > 1 else ' is'} not where it was; what was "
            "last known of it is shown (`decant runs add` after a move, `decant runs rebuild` forgets it)"
        )


@contextlib.contextmanager
def _refusing() -> Iterator[None]:
    from orchestrator.catalogue.remarks import RemarksError
    from orchestrator.errors import RunError

    try:
        yield
    except (RunError, RemarksError) as error:
        raise RefusalError(str(error), BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{error.filename or ''}: {error.strerror or error}".lstrip(": "), BAD_INPUT) from None


def _search(conditions: Mapping[str, Any]) -> Search:
    from orchestrator.catalogue.search import searching

    with Refused(ValueError):
        return searching(**conditions)


def _one(catalogue: Catalogue, name: str) -> Row:
    from orchestrator.catalogue.search import one_run

    with _refusing():
        return one_run(catalogue, name)
