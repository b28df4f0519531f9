"""Doors for people from outside: classes that an installed package adds to Decant, found by entry points.

Decant's own strategies, objectives, balances, arms and sources of vessels are registered in the same way, in
`pyproject.toml`. A door loads what is registered once, on first use; what can't be loaded is left out and kept with its
package and the reason, so that a broken plug-in disturbs nobody who doesn't need it.
"""

from __future__ import annotations

import difflib
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property
from importlib.metadata import EntryPoint, entry_points
from typing import Generic, TypeVar

from sim_engine.errors import DecantError

T = TypeVar("T")


class PluginError(DecantError, LookupError):
    """Nothing usable is registered under a name: unknown, or of a plug-in that can't be loaded."""


@dataclass(frozen=True)
class UnloadablePlugin:
    """A plug-in that can't be used."""

    group: str
    """Entry-point group that it is registered in."""

    name: str
    """Name that it is registered under."""

    package: str
    """Distribution that registers it, with its version."""

    reason: str
    """Why it can't be used, for the author of the package."""

    def __str__(self) -> str:
        return f"plug-in '{self.name}' ({self.group}) of {self.package} can't be used: {self.reason}"


class PluginRegistry(Generic[T]):
    """What is registered in one entry-point group, by name.

    Args:
        group: the entry-point group, such as `decant.balances`.
        what: what one entry is, for messages: 'balance'.
        accept: returns what was loaded if it is fit for the group; raises TypeError or ValueError saying why it is not.
    """

    def __init__(self, group: str, what: str, accept: Callable[[object, str], T]) -> None:
        self.group = group
        self._what = what
        self._accept = accept

    @property
    def names(self) -> tuple[str, ...]:
        """Names of everything usable, sorted."""
        return tuple(self._content[0])

    @property
    def all(self) -> dict[str, T]:
        """Everything usable by name, sorted by name."""
        return dict(self._content[0])

    @property
    def broken(self) -> tuple[UnloadablePlugin, ...]:
        """What is registered and can't be used."""
        return self._content[1]

    def package(self, name: str) -> str:
        """Distribution that registers a usable name, with its version."""
        self.get(name)
        return self._content[2][name]

    def get(self, name: str) -> T:
        """What is registered under a name.

        Raises:
            DoorError: nothing is, or it can't be loaded; the message names the package, or the nearest names.
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

    def forget(self) -> None:
        """Look again at what is installed, on the next use."""
        self.__dict__.pop("_content", None)

    @cached_property
    def _content(self) -> tuple[dict[str, T], tuple[UnloadablePlugin, ...], dict[str, str]]:
        usable: dict[str, T] = {}
        packages: dict[str, str] = {}
        broken: list[UnloadablePlugin] = []
        for entry in sorted(entry_points(group=self.group), key=_decant_first):
            package = _package(entry)
            if entry.name in usable:
                if packages[entry.name] != package:  # the same one may be on the path twice
                    reason = f"{packages[entry.name]} has registered '{entry.name}' already"
                    broken.append(UnloadablePlugin(self.group, entry.name, package, reason))
                continue
            try:
                usable[entry.name] = _whole(self._accept(entry.load(), entry.name))
            except Exception as error:  # whatever a stranger's module raises, Decant goes on
                broken.append(UnloadablePlugin(self.group, entry.name, package, f"{type(error).__name__}: {error}"))
            else:
                packages[entry.name] = package
        return dict(sorted(usable.items())), tuple(broken), packages


def _whole(found: T) -> T:
    """What was loaded, unless it is a class that leaves open what it has to say.

    Raises:
        TypeError: it does; names what is missing.
    """
    if missing := sorted(getattr(found, "__abstractmethods__", ())) if isinstance(found, type) else []:
        raise TypeError(f"its class {found} lacks {', '.join(f'{name!r}' for name in missing)}")
    return found


def _package(entry: EntryPoint) -> str:
    return "an unknown package" if entry.dist is None else f"{entry.dist.name} {entry.dist.version}"


def _decant_first(entry: EntryPoint) -> tuple[bool, str, str]:
    package = _package(entry)
    return (not package.startswith("decant "), package, entry.name)
