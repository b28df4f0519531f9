"""Plug-in registries: classes that an installed package adds to Decant through entry points.

Decant's own strategies, objectives, balances, arms and vessel sources are registered in the same way, in
`pyproject.toml`. A `PluginRegistry` loads its group once, on first use. Entries that cannot be loaded are kept as
`UnloadablePlugin` with their package and the reason, so that an invalid plug-in affects only users who need it.
"""

from __future__ import annotations

import difflib
import sys
from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from importlib.metadata import Distribution, EntryPoint, EntryPoints, distribution, entry_points
from pathlib import Path
from typing import TYPE_CHECKING, Any, Generic, TypeVar

from sim_engine.errors import DecantError

if TYPE_CHECKING:
    from sim_engine.settings.model import Settings

T = TypeVar("T")

DISTRIBUTION = "decant-pouring"
"""Name of the distribution with Decant's own plug-ins. `decant` on the package index is another project."""


class PluginError(DecantError, LookupError):
    """A name has no usable plug-in: it is unknown, or its plug-in cannot be loaded."""


@dataclass(frozen=True)
class UnloadablePlugin:
    """A plug-in that cannot be used."""

    group: str
    """Entry-point group in which it is registered."""

    name: str
    """Name under which it is registered."""

    package: str
    """Distribution that registers it, with its version."""

    reason: str
    """Why it cannot be used, for the author of the package."""

    def __str__(self) -> str:
        return f"plug-in '{self.name}' ({self.group}) of {self.package} can't be used: {self.reason}"


class PluginRegistry(Generic[T]):
    """The plug-ins of one entry-point group, by name.

    Args:
        group: the entry-point group, such as `decant.balances`.
        what: the kind of an entry, for messages: 'balance'.
        accept: returns the loaded object if it is valid for the group; else raises TypeError or ValueError with the
            reason.
    """

    def __init__(self, group: str, what: str, accept: Callable[[object, str], T]) -> None:
        self.group = group
        _REGISTRIES[group] = self
        self._what = what
        self._accept = accept

    @property
    def names(self) -> tuple[str, ...]:
        """Names of all usable plug-ins, sorted."""
        return tuple(self._content[0])

    @property
    def all(self) -> dict[str, T]:
        """All usable plug-ins by name, sorted by name."""
        return dict(self._content[0])

    @property
    def broken(self) -> tuple[UnloadablePlugin, ...]:
        """Registered plug-ins that cannot be used."""
        return self._content[1]

    def package(self, name: str) -> str:
        """Distribution that registers a usable name, with its version."""
        self.get(name)
        return self._content[2][name]

    def get(self, name: str) -> T:
        """The plug-in registered under a name.

        Raises:
            PluginError: there is none, or it cannot be loaded; the message names the package, or the nearest names.
        """
        usable, broken, _ = self._content
        if name in usable:
            return usable[name]
        for plugin in broken:
            if plugin.name == name:
                raise PluginError(str(plugin))
        near = difflib.get_close_matches(name, usable, n=1)
        hint = f"did you mean '{near[0]}'?" if near else f"known: {', '.join(usable) or 'none'}"
        raise PluginError(f"unknown {self._what} '{name}'; {hint}")

    @cached_property
    def _content(self) -> tuple[dict[str, T], tuple[UnloadablePlugin, ...], dict[str, str]]:
        usable: dict[str, T] = {}
        packages: dict[str, str] = {}
        broken: list[UnloadablePlugin] = []
        for entry in sorted(entries_of(self.group), key=_decant_first):
            package = _package(entry)
            if entry.name in usable:
                if packages[entry.name] != package:  # the same package may be on the path twice
                    reason = f"{packages[entry.name]} has registered '{entry.name}' already"
                    broken.append(UnloadablePlugin(self.group, entry.name, package, reason))
                continue
            try:
                usable[entry.name] = _whole(self._accept(entry.load(), entry.name))
            except Exception as error:  # a foreign module may raise any error; Decant continues
                broken.append(UnloadablePlugin(self.group, entry.name, package, f"{type(error).__name__}: {error}"))
            else:
                packages[entry.name] = package
        return dict(sorted(usable.items())), tuple(broken), packages


_REGISTRIES: dict[str, PluginRegistry[Any]] = {}


def why_unusable(group: str, name: str) -> str:
    """The plug-in of a group that has this name, with its package, if it could not be loaded; else ''."""
    broken = _REGISTRIES[group].broken if group in _REGISTRIES else ()
    return next((str(plugin) for plugin in broken if plugin.name == name), "")


def settings_kind(base: type[Any]) -> Callable[[object, str], Any]:
    """An `accept` of `PluginRegistry` for settings classes that are told apart by their field `kind`.

    Args:
        base: class of `decant.plugins` from which they derive.
    """

    def accept(loaded: object, name: str) -> Any:
        if not (isinstance(loaded, type) and issubclass(loaded, base)):
            raise TypeError(f"should be a class derived from decant.plugins.{base.__name__}")
        fields: Any = getattr(loaded, "model_fields", {})
        if fields["kind"].default != name:
            raise TypeError(f"its field 'kind' should be Literal['{name}'] = '{name}', as it is registered")
        return loaded

    return accept


def _whole(plugin: T) -> T:
    """Return a loaded object, unless it is a class with missing abstract members.

    Raises:
        TypeError: members are missing; the text names them.
    """
    if missing := sorted(getattr(plugin, "__abstractmethods__", ())) if isinstance(plugin, type) else []:
        raise TypeError(f"its class {plugin} lacks {', '.join(f'{name!r}' for name in missing)}")
    return plugin


def entries_of(group: str) -> EntryPoints:
    """The entry points of a group in all installed packages."""
    entries: EntryPoints = _on_path(tuple(sys.path)).select(group=group)
    return entries


def own_extras(group: str, name: str | None = None) -> dict[str, Any]:
    """What the optional packages of Decant's own distribution register in a group, loaded, by name.

    A package that was removed from the installation registers nothing. With a name, only this entry is loaded.
    Reading one distribution is much faster than `entries_of`, so that the command line can use it at its start.

    Raises:
        ModuleNotFoundError: a package of another distribution is missing.
    """
    loaded = {}
    entries = distribution(DISTRIBUTION).entry_points.select(group=group)
    for entry in entries if name is None else entries.select(name=name):
        try:
            loaded[entry.name] = entry.load()
        except ModuleNotFoundError as error:
            if (error.name or "").partition(".")[0] not in ("orchestrator", "actors", "sim_engine"):
                raise
    return loaded


@dataclass(frozen=True)
class FileKind:
    """A kind of file that an optional package reads; the package registers it in the group `decant.files`."""

    settings: Callable[[], type[Settings]]
    """Imports and returns the class of its keys, for `decant schema`."""

    check: Callable[[Path], tuple[str, list[str]]]
    """Reads a file for `decant validate`; returns a short description and the problems."""


def file_kind(name: str) -> FileKind:
    """The kind of file that an optional package registers under a name.

    Raises:
        PluginError: the package is not installed.
    """
    kinds: dict[str, FileKind] = own_extras("decant.files", name)
    if name not in kinds:
        raise PluginError(f"this installation has no package that reads files of the kind '{name}'")
    return kinds[name]


@cache
def _on_path(_: tuple[str, ...]) -> Any:
    return entry_points()  # reads a file of every package


@cache
def _label(package: Distribution) -> str:
    return f"{package.name} {package.version}"


def _package(entry: EntryPoint) -> str:
    return "an unknown package" if entry.dist is None else _label(entry.dist)


def _decant_first(entry: EntryPoint) -> tuple[bool, str, str]:
    package = _package(entry)
    return (not package.startswith(f"{DISTRIBUTION} "), package, entry.name)
