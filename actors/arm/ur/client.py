"""Whether the client library is there that a UR arm is reached by."""

from __future__ import annotations

import importlib.util


def client_missing() -> str | None:
    """Why no arm can be reached from here at all: the client library isn't installed; None if it is."""
    if importlib.util.find_spec("rtde_receive") is not None:
        return None
    return (
        "the arm needs the package ur-rtde, which is not installed: pip install 'decant[lab]' (it has no wheel for "
        "Python 3.13 yet)"
    )
