"""What people ask of the catalogue and how it answers, JSON-ready: the same on this machine and through the daemon."""

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
    """Who answers. Conditions are those of `search.searching`; a run is named as `search.one_run` knows it.

    Every call may raise RunError or RemarksError, whose text says why.
    """

    def runs(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Runs, the newest first. Raises ValueError where a condition is none."""

    def pours(self, conditions: Mapping[str, Any]) -> list[Row]:
        """Pours, the oldest first. Raises ValueError where a condition is none."""

    def run(self, name: str) -> Row:
        """One run, with its notes (time, by, text) and under 'list_of_pours' its pours."""

    def compare(self, names: Sequence[str]) -> Row:
        """'runs' (their folders), 'settings' in which they differ, and 'outcomes' of each."""

    def tag(self, name: str, add: Sequence[str], remove: Sequence[str]) -> Row:
        """Change a run's tags; 'run' and 'tags'."""

    def note(self, name: str, text: str) -> Row:
        """Write a note about a run; 'run' and 'notes'."""

    def export(self, folder: Path, conditions: Mapping[str, Any], formats: Sequence[str]) -> Row:
        """Write runs and pours into files; 'files', and how many 'runs', 'pours'. Raises MissingExtraError, OSError."""


class LocalCatalogueClient:
    """The catalogue of this machine.

    Args:
        catalogue: open, and brought up to date.
        by: who writes notes; the user of this process unless given.
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
