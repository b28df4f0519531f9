"""The catalogue of a daemon's machine, asked over HTTP."""

from __future__ import annotations

import json
import zipfile
from collections.abc import Mapping, Sequence
from io import BytesIO
from pathlib import Path
from typing import Any
from urllib.parse import quote

from orchestrator.daemon.daemon_client import Client
from orchestrator.journal.run_record import Row


class RemoteCatalogueClient:
    """`CatalogueClient` of a daemon.

    Args:
        client: open.
    """

    def __init__(self, client: Client) -> None:
        self._client = client

    def runs(self, conditions: Mapping[str, Any]) -> list[Row]:
        """See `CatalogueClient`."""
        return list(self._client.get("/runs", **conditions))

    def pours(self, conditions: Mapping[str, Any]) -> list[Row]:
        """See `CatalogueClient`."""
        return list(self._client.get("/pours", **conditions))

    def run(self, name: str) -> Row:
        """See `CatalogueClient`."""
        return dict(self._client.get(_of(name)))

    def compare(self, names: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        return dict(self._client.get("/runs/compare", run=list(names)))

    def tag(self, name: str, add: Sequence[str], remove: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        return dict(self._client.post(f"{_of(name)}/tags", {"add": list(add), "remove": list(remove)}))

    def note(self, name: str, text: str) -> Row:
        """See `CatalogueClient`."""
        return dict(self._client.post(f"{_of(name)}/notes", {"text": text}))

    def export(self, folder: Path, conditions: Mapping[str, Any], formats: Sequence[str]) -> Row:
        """See `CatalogueClient`."""
        found = self._client.fetch("/runs/export", format=list(formats), **conditions)
        folder.mkdir(parents=True, exist_ok=True)
        files = []
        with zipfile.ZipFile(BytesIO(found)) as archive:
            counts: Row = json.loads(archive.comment)
            for name in archive.namelist():
                path = folder / Path(name).name
                path.write_bytes(archive.read(name))
                files.append(str(path))
        return {"files": files, **counts}


def _of(name: str) -> str:
    return f"/runs/{quote(name, safe='')}"
