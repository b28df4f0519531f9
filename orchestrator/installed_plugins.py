"""All doors for packages from outside, and what stands in them."""

from __future__ import annotations

from dataclasses import dataclass
from importlib.metadata import entry_points
from typing import Any

from sim_engine.settings.plugin_registry import PluginRegistry, UnloadablePlugin


@dataclass(frozen=True)
class Plugin:
    """One thing that an installed package adds.

    Attributes:
        group: entry-point group that it is registered in.
        name: that files use.
        package: that registers it, with its version.
    """

    group: str
    name: str
    package: str


def doors() -> tuple[PluginRegistry[Any], ...]:
    """Every door; nothing behind them has been loaded before somebody looks."""
    from actors.balance.dialect_registry import BALANCES
    from orchestrator.config.arm_file import ARMS
    from orchestrator.strategies.strategy_registry import OBJECTIVES, STRATEGIES
    from sim_engine.vessel.shapes import VESSELS

    return STRATEGIES, OBJECTIVES, BALANCES, ARMS, VESSELS


def installed() -> list[Plugin]:
    """What is usable, ours as everybody's, by door and name."""
    return [Plugin(door.group, name, door.package(name)) for door in doors() for name in door.names]


def packages() -> dict[str, tuple[str, list[str]]]:
    """Packages from outside that register something: version, and what ('decant.balances: spring'). Loads nothing."""
    found: dict[str, tuple[str, list[str]]] = {}
    for door in doors():
        for entry in entry_points(group=door.group):
            if entry.dist is not None and entry.dist.name != "decant":
                _, names = found.setdefault(entry.dist.name, (entry.dist.version, []))
                names.append(f"{door.group}: {entry.name}")
    return found


def broken() -> list[UnloadablePlugin]:
    """What is registered and can't be used, with the reason."""
    return [one for door in doors() for one in door.broken]
