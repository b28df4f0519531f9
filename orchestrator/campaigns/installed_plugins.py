"""All plug-in registries and the plug-ins that installed packages add to them."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from sim_engine.settings.plugin_registry import DISTRIBUTION, PluginRegistry, UnloadablePlugin, entries_of


@dataclass(frozen=True)
class Plugin:
    """One plug-in of an installed package.

    Attributes:
        group: entry-point group that it is registered in.
        name: its name in files.
        package: package that registers it, with its version.
    """

    group: str
    name: str
    package: str


def doors() -> tuple[PluginRegistry[Any], ...]:
    """All plug-in registries. Plug-ins are loaded on first use."""
    from actors.arm.arm_settings import ARMS
    from actors.balance.dialect_registry import BALANCES
    from actors.grippers.gripper_interface import GRIPPERS
    from actors.liquid_devices import PUMPS, SPILL_SENSORS
    from orchestrator.learning.strategy_registry import OBJECTIVES, STRATEGIES
    from sim_engine.vessel.shapes import VESSELS

    return STRATEGIES, OBJECTIVES, BALANCES, ARMS, GRIPPERS, PUMPS, SPILL_SENSORS, VESSELS


def installed() -> list[Plugin]:
    """All usable plug-ins, Decant's own included, by registry and name."""
    return [Plugin(door.group, name, door.package(name)) for door in doors() for name in door.names]


def packages() -> dict[str, tuple[str, list[str]]]:
    """Other packages that register plug-ins: version, and the plug-ins ('decant.balances: spring'). Loads nothing."""
    entries: dict[str, tuple[str, list[str]]] = {}
    for door in doors():
        for entry in entries_of(door.group):
            if entry.dist is not None and entry.dist.name != DISTRIBUTION:
                _, names = entries.setdefault(entry.dist.name, (entry.dist.version, []))
                names.append(f"{door.group}: {entry.name}")
    return entries


def broken() -> list[UnloadablePlugin]:
    """Registered plug-ins that can't be loaded, with the reason."""
    return [plugin for door in doors() for plugin in door.broken]
