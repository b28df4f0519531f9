"""Names that a module gives without importing anything itself: each is imported on first use (PEP 562).

A module writes them once, as `from … import NAME as NAME` under `if TYPE_CHECKING:`, where type checkers read them;
`names_for_type_checkers` reads the same lines.
"""

from __future__ import annotations

import re
from importlib import import_module
from pathlib import Path
from typing import Any

_LINE = re.compile(r"^    from (\S+) import (\w+) as \2$", re.MULTILINE)


def names_for_type_checkers(file: str) -> dict[str, str]:
    """Name → its module, sorted, from the indented imports of a Python file."""
    return dict(sorted((name, module) for module, name in _LINE.findall(Path(file).read_text("utf-8"))))


def import_name(module: str, name: str, homes: dict[str, str]) -> Any:
    """Import a name of a module.

    Args:
        module: which gives the name.
        name: that is asked for.
        homes: of `names_for_type_checkers`.

    Raises:
        AttributeError: the module does not have it; the text lists what there is.
    """
    if name not in homes:
        raise AttributeError(f"module '{module}' has no attribute '{name}'; it has {', '.join(homes)}")
    home = import_module(homes[name])
    return getattr(home, name) if hasattr(home, name) else import_module(f"{homes[name]}.{name}")
