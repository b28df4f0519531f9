"""Every key of a settings file that a page names exists: in the schemas that are shipped for editors."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from ruamel.yaml import YAML, YAMLError

ROOT = Path(__file__).parents[1]
SCHEMAS = [json.loads(path.read_text(encoding="utf-8")) for path in (ROOT / "configs" / "schema").glob("*.json")]
PAGES = sorted(page for page in (ROOT / "docs").glob("**/*.md") if page.parent.name != "extend")  # keys of plug-ins
NOT_SETTINGS = {"dry_run", "off", "…"}
"""Keys of requests, and words of prose."""


def alternatives(schema: dict[str, Any], root: dict[str, Any]) -> Iterator[dict[str, Any]]:
    """A schema without references and alternatives."""
    if "$ref" in schema:
        target: Any = root
        for word in schema["$ref"].removeprefix("#/").split("/"):
            target = target[word]
        yield from alternatives(target, root)
        return
    inner = [*schema.get("anyOf", ()), *schema.get("oneOf", ()), *schema.get("allOf", ())]
    for option in inner:
        yield from alternatives(option, root)
    if not inner or "properties" in schema:
        yield schema


def named_schemas() -> dict[str, list[dict[str, Any]]]:
    """Key → the schemas of its values, wherever it stands."""
    found: dict[str, list[dict[str, Any]]] = {}
    for root in SCHEMAS:
        waiting: list[Any] = [root]
        while waiting:
            value = waiting.pop()
            if isinstance(value, dict):
                for name, schema in value.get("properties", {}).items():
                    if isinstance(schema, dict):
                        found.setdefault(name, []).extend(alternatives(schema, root))
                waiting += value.values()
            elif isinstance(value, list):
                waiting += value
    return found


KEYS = named_schemas()


def written(page: Path) -> Iterator[tuple[str, dict[str, Any]]]:
    """Pieces of settings on a page: inline code such as `listen: {port: 8377}`, and blocks in YAML."""
    text = page.read_text(encoding="utf-8")
    pieces = re.findall(r"^```yaml\n(.*?)^```", text, re.MULTILINE | re.DOTALL)
    prose = re.sub(r"^```.*?^```", "", text, flags=re.MULTILINE | re.DOTALL)
    pieces += re.findall(r"`([a-z_]+: [^`]+)`", prose)
    for piece in pieces:
        try:
            table = YAML(typ="safe").load(piece)
        except YAMLError:
            continue
        if isinstance(table, dict):
            yield piece.strip(), table


def unknown_keys(table: dict[str, Any], allowed: set[str] | None = None) -> Iterator[str]:
    """Keys that no file has, or that none has at this place."""
    for key, value in table.items():
        if key in NOT_SETTINGS or not isinstance(key, str):
            continue
        if key not in KEYS or (allowed is not None and key not in allowed):
            yield key
            continue
        objects = [schema for schema in KEYS[key] if "properties" in schema]
        inside = {name for schema in objects for name in schema["properties"]}
        free = any("properties" not in schema and schema.get("type") != "null" for schema in KEYS[key])
        if isinstance(value, dict) and objects:
            yield from unknown_keys(value, None if free else inside)
        elif isinstance(value, str) and objects and not free and value not in inside and value not in ("…", "..."):
            yield f"{key}: {value}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_the_keys_on_a_page_exist(page: Path) -> None:
    unknown = {piece: list(unknown_keys(table)) for piece, table in written(page)}
    assert not {piece: keys for piece, keys in unknown.items() if keys}


def test_a_removed_key_is_found() -> None:
    assert list(unknown_keys({"listen": "body"})) == ["listen: body"]
    assert list(unknown_keys({"listen": {"body": 3}})) == ["body"]
    assert list(unknown_keys({"listen": {"host": "0.0.0.0", "port": 1}, "rigs": {"left": "a.yaml"}})) == []
