"""Help texts of all commands, JSON schemas and the description of the daemon's API."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest
from typer.testing import CliRunner

from orchestrator.cli.app import app
from orchestrator.cli.json_schema import SCHEMAS, schema_text
from orchestrator.daemon.http_api import openapi_text
from tests.golden.golden import ROOT, Golden, differing, normalised
from tests.support.cli_inputs import command_tree

PUBLISHED = {
    **{ROOT / "configs" / "schema" / f"{name}.json": name for name in SCHEMAS},
    ROOT / "docs" / "openapi.json": "openapi",
}
"""Descriptions that are part of the repository; they are their own golden files."""


def commands() -> Iterator[tuple[str, ...]]:
    """All commands and groups of commands, in the order of their names."""

    def below(command: object, path: tuple[str, ...]) -> Iterator[tuple[str, ...]]:
        yield path
        for name, found in sorted(getattr(command, "commands", {}).items()):
            yield from below(found, (*path, name))

    return below(command_tree(), ())


def test_help_is_the_same(golden: Golden) -> None:
    pages = []
    for path in commands():
        result = CliRunner().invoke(app, [*path, "--help"])
        assert result.exit_code == 0, (path, result.output)
        pages.append(f"$ {' '.join(('decant', *path, '--help'))}\n{normalised(result.stdout).strip()}\n\n")
    golden.check("interfaces/help.txt", "".join(pages))


@pytest.mark.parametrize("path", PUBLISHED, ids=lambda path: path.name)
def test_published_description_is_the_same(path: Path, golden: Golden) -> None:
    name = PUBLISHED[path]
    text = openapi_text() if name == "openapi" else schema_text(SCHEMAS[name]())
    if golden.regenerate:
        path.write_text(text, encoding="utf-8")
    difference = differing(path.read_text(encoding="utf-8"), text, rtol=0.0)
    assert not difference, "\n".join([f"{path.relative_to(ROOT)} differs:", *difference[:80]])
