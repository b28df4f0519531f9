"""A change of what others build on is named, so that nobody makes one without knowing."""

from __future__ import annotations

import difflib

from tests.public_api import KEPT, public_api


def test_the_public_api_is_the_one_that_was_written_down() -> None:
    kept, now = KEPT.read_text(encoding="utf-8"), public_api()
    changes = [
        line
        for line in difflib.unified_diff(kept.splitlines(), now.splitlines(), "written down", "now", lineterm="", n=0)
        if not line.startswith("@@")
    ]
    assert not changes, (
        "the public API has changed:\n" + "\n".join(changes) + "\nIf that is meant: a line in CHANGELOG.md, then "
        "python -m tests.public_api"
    )
