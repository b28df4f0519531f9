"""The public API as text: names of `decant`, `decant.plugins` and `decant.plugins.testing` with their signatures, and
entry points.

`python -m tests.public_api` writes it to tests/public-api.txt.
"""

from __future__ import annotations

import dataclasses
import inspect
import tomllib
from enum import Enum
from pathlib import Path
from types import UnionType
from typing import Any, Union, get_origin

import decant
from decant import plugins
from decant.plugins import testing

ROOT = Path(__file__).parent.parent
KEPT = Path(__file__).with_name("public-api.txt")


def public_api() -> str:
    """One line for each name, sorted."""
    lines = [
        line
        for module in (decant, plugins, testing)
        for name in module.__all__
        for line in _lines(f"{module.__name__}.{name}", getattr(module, name))
    ]
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    lines += [
        f"entry point {group}: {name}"
        for group, names in project["entry-points"].items()
        for name in sorted(names)
        if group not in OF_OWN_EXTRAS
    ]
    return "\n".join(sorted(lines)) + "\n"


OF_OWN_EXTRAS = tuple(
    f"decant.{kind}" for kind in ("commands", "documents", "emulators", "files", "nodes", "outputs", "stage_results")
)
"""Groups that only packages of Decant itself use (`sim_engine.settings.plugin_registry.own_extras`)."""


def _lines(name: str, value: Any) -> list[str]:
    if inspect.ismodule(value):
        own = [n for n, v in vars(value).items() if inspect.isclass(v) and v.__module__ == value.__name__]
        return [line for n in own if not n.startswith("_") for line in _lines(f"{name}.{n}", getattr(value, n))]
    if inspect.isclass(value):
        return [_class_line(name, value), *_members(name, value)]
    if inspect.isfunction(value):
        return [f"{name}{inspect.signature(value)}"]
    kind = "UnionType" if get_origin(value) in (Union, UnionType) else type(value).__name__
    return [f"{name}: {kind}"]


def _class_line(name: str, cls: type) -> str:
    if issubclass(cls, Enum):
        return f"{name}: {', '.join(member.name for member in cls)}"
    if dataclasses.is_dataclass(cls):
        return f"{name}({', '.join(f'{field.name}: {field.type}' for field in dataclasses.fields(cls))})"
    fields = getattr(cls, "model_fields", None)
    return f"{name}({', '.join(fields)})" if fields else name


def _members(name: str, cls: type) -> list[str]:
    lines = []
    shared = [base for base in cls.__mro__[1:] if base.__name__.startswith("_") and base.__module__ == cls.__module__]
    for key, value in {k: v for owner in (*shared[::-1], cls) for k, v in vars(owner).items()}.items():
        if key.startswith("_"):
            continue
        if isinstance(value, property):
            lines.append(f"{name}.{key}")
        elif inspect.isfunction(value):
            lines.append(f"{name}.{key}{inspect.signature(value)}")
    return lines


if __name__ == "__main__":
    KEPT.write_text(public_api(), encoding="utf-8")
