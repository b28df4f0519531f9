"""Operations on the catalogue with JSON-ready results, the same on this machine and through the daemon.

`CatalogueClient` is the protocol; `LocalCatalogueClient` implements it with the catalogue of this machine.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any, Protocol

from orchestrator.catalogue import annotations as remarks
from orchestrator.catalogue import export
from orchestrator.catalogue.catalogue_index import Catalogue
from orchestrator.catalogue.queries import (
    CatalogueQuery,
    differing_settings,
    find_pours,
    find_runs,
    one_run,
    outcomes,
    searching,
)
from orchestrator.journal.run_record import Row


class CatalogueClient(Protocol):
    """A catalogue. Conditions are those of `queries.searching`; runs are named as in `queries.one_run`.

    Every call may raise RunError or AnnotationsError, whose text gives the reason.
    """

    def runs(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Runs, the newest first. Raises ValueError for an invalid condition."""

    def pours(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Pours, the oldest first. Raises ValueError for an invalid condition."""

    def run(self, name: str) -> Row:
        """One run, with its notes (time, by, text) and its pours under 'list_of_pours'."""

    def compare(self, names: Sequence[str]) -> Row:
        """'runs' (their folders), the differing 'settings', and the 'outcomes' of each run."""

    def tag(self, name: str, add: Sequence[str], remove: Sequence[str]) -> Row:
        """Change a run's tags; returns 'run' and 'tags'."""

    def note(self, name: str, text: str) -> Row:
        """Add a note to a run; returns 'run' and 'notes'."""

    def export(self, folder: Path, conditions: Mapping[str, Any], formats: Sequence[str]) -> Row:
        """Write runs and pours into files.

        Returns 'files' and the numbers of 'runs' and 'pours'. Raises MissingExtraError, OSError.
        """


class LocalCatalogueClient:
    """The catalogue of this machine.

    Args:
        catalogue: open and up to date.
        by: author of notes; the user of this process unless given.
    """

    def __init__(self, catalogue: Catalogue, by: str | None = None) -> None:
        self._catalogue, self._by = catalogue, by

    def runs(self, conditions: Mapping[str, Any]) -> list[Row]:
        """See `CatalogueClient`."""
        return find_runs(self._catalogue, searching(**conditions))

    def pours(self, conditions: Mapping[str, Any]) -> list[Row]:
        """See `CatalogueClient`."""
        return find_pours(self._catalogue, searching(**conditions))

    def run(self, name: str) -> Row:
        """See `CatalogueClient`."""
        found = one_run(self._catalogue, name)
        notes = remarks.read_remarks(Path(found["path"])).notes
        pours = find_pours(self._catalogue, CatalogueQuery(run=found["path"]))
        return {**found, "notes": [note.model_dump() for note in notes], "list_of_pours": pours}

    def compare(self, names: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        found = [one_run(self._catalogue, name) for name in names]
        settings = differing_settings([Path(run["path"]) for run in found])
        came = [outcomes(run) for run in found]
        return {"runs": [run["path"] for run in found], "settings": settings, "outcomes": came}

    def tag(self, name: str, add: Sequence[str], remove: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        found = one_run(self._catalogue, name)
        return {"run": found["run"], "tags": remarks.tag(Path(found["path"]), tuple(add), tuple(remove)).tags}

    def note(self, name: str, text: str) -> Row:
        """See `CatalogueClient`."""
        found = one_run(self._catalogue, name)
        notes = remarks.note(Path(found["path"]), text, self._by).notes
        return {"run": found["run"], "notes": [note.model_dump() for note in notes]}

    def export(self, folder: Path, conditions: Mapping[str, Any], formats: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        tables = {"run": self.runs(conditions), "pour": self.pours(conditions)}
        files = export.export(tables, folder, formats)
        return {"files": [str(path) for path in files], **{f"{name}s": len(rows) for name, rows in tables.items()}}
