"""`decant plugins`: what installed packages add, and what of it can't be used."""

from __future__ import annotations

import dataclasses

from orchestrator.commands.speaking import FAILED, RefusalError, print_json
from orchestrator.plugins import broken, installed


def plugins(*, as_json: bool) -> None:
    """List strategies, objectives, balances, arms and sources of vessels by the names that files use.

    Args:
        as_json: one line of JSON in place of the table.

    Raises:
        RefusalError: a package registers something that can't be used (exit code 1).
    """
    found, unusable = installed(), broken()
    if as_json:
        print_json(
            {
                "plugins": [dataclasses.asdict(plugin) for plugin in found],
                "broken": [dataclasses.asdict(one) for one in unusable],
            }
        )
    else:
        width = [max(len(row) for row in column) for column in zip(*((p.group, p.name) for p in found), strict=True)]
        for plugin in found:
            print(f"{plugin.group:<{width[0]}}  {plugin.name:<{width[1]}}  {plugin.package}")
    if unusable:
        raise RefusalError("\n".join(map(str, unusable)), FAILED)
