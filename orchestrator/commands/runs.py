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
from orchestrator.commands.speaking import BAD_INPUT, FAILED, RefusalError, mention, print_json, say
from orchestrator.report.table import print_table

if TYPE_CHECKING:
    from orchestrator.catalogue.desk import Desk
    from orchestrator.catalogue.index import Catalogue

NEWEST = 20


def list_runs(conditions: Mapping[str, Any], *, daemon: bool = False, as_json: bool) -> None:
    """Runs that conditions hold for, the newest first."""
    with _desk(daemon) as desk:
        found = desk.runs(conditions)
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


def list_pours(conditions: Mapping[str, Any], *, daemon: bool = False, as_json: bool) -> None:
    """Pours that conditions hold for, the oldest first."""
    with _desk(daemon) as desk:
        found = desk.pours(conditions)
    if as_json:
        print_json({"pours": found})
    elif found:
        print_pours(found)
    else:
        mention("no pour that this holds for")


def show(name: str, *, daemon: bool = False, as_json: bool) -> None:
    """One run with all that is known of it."""
    with _desk(daemon) as desk:
        run = desk.run(name)
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
    from orchestrator.journal import JOURNAL_NAME
    from orchestrator.journal_check import check_journal, has_begun

    folder = Path(name)
    if folder.is_dir():
        if not has_begun(folder / JOURNAL_NAME):
            raise RefusalError(f"{folder}: there is no run in this folder", BAD_INPUT)
    else:
        with _desk(daemon=False) as desk:
            folder = Path(desk.run(name)["path"])
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
    """Settings in which runs differ, and what they came to."""
    if len(names) < 2:
        raise RefusalError("comparing takes two runs or more: decant runs compare RUN RUN", BAD_INPUT)
    with _desk(daemon) as desk:
        found = desk.compare(names)
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
    """Change a run's tags."""
    if not add and not remove:
        raise RefusalError("name tags to put on the run, or --remove those to take off", BAD_INPUT)
    with _desk(daemon) as desk:
        found = desk.tag(name, add, remove)
    print(f"{found['run']}: {', '.join(found['tags']) or 'no tags'}")


def note(name: str, text: str, *, daemon: bool = False) -> None:
    """Write a note about a run."""
    with _desk(daemon) as desk:
        found = desk.note(name, text)
    print(f"{found['run']}: {len(found['notes'])} note{'s' * (len(found['notes']) > 1)}")


def export(
    folder: Path, conditions: Mapping[str, Any], formats: Sequence[str] | None, *, daemon: bool = False, as_json: bool
) -> None:
    """Write runs and pours that conditions hold for."""
    from orchestrator.catalogue.export import FORMATS
    from sim_engine.extras import MissingExtraError

    if wrong := sorted(set(formats or ()) - set(FORMATS)):
        raise RefusalError(f"--format {wrong[0]}: should be {' or '.join(FORMATS)}", BAD_INPUT)
    try:
        with _desk(daemon) as desk:
            found = desk.export(folder, conditions, formats or FORMATS)
    except MissingExtraError as error:
        raise RefusalError(f"{error}; or --format csv", BAD_INPUT) from None
    if as_json:
        print_json(found)
        return
    mention(f"{found['runs']} runs, {found['pours']} pours")
    print("\n".join(found["files"]))


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
def _desk(daemon: bool) -> Iterator[Desk]:
    """Whoever answers: this machine's catalogue, or the daemon's."""
    try:
        if daemon:
            from orchestrator.commands.daemon import talking
            from orchestrator.daemon.remote_desk import RemoteDesk

            with talking((None, None)) as client, _refusing():
                yield RemoteDesk(client)
        else:
            from orchestrator.catalogue.desk import LocalDesk

            with _catalogue() as catalogue, _refusing():
                yield LocalDesk(catalogue)
    except ValueError as error:  # a date that is none
        raise RefusalError(str(error), BAD_INPUT) from None


@contextlib.contextmanager
def _catalogue(*, anew: bool = False, before: Any = None) -> Iterator[Catalogue]:
    """The catalogue, up to date; what of it can't be read is printed at the end."""
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
