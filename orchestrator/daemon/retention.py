"""Which recordings are kept: journals, figures and summaries always are."""

from __future__ import annotations

import time
from collections.abc import Collection
from pathlib import Path

from orchestrator.daemon.settings import Settings


def prune_recordings(settings: Settings, busy: Collection[str] = (), now: float | None = None) -> list[Path]:
    """Remove recordings that are too many or too old.

    Args:
        settings: say which.
        busy: names of runs that are being written.
        now: seconds since 1970.

    Returns:
        What was removed.
    """
    if settings.keep_recordings is None and settings.recording_age is None:
        return []
    now = time.time() if now is None else now
    runs: dict[Path, float] = {}
    for path in settings.runs.glob("*/*.rrd"):
        runs[path.parent] = max(runs.get(path.parent, 0.0), path.stat().st_mtime)
    newest = sorted(runs, key=lambda run: runs[run], reverse=True)
    removed = []
    for index, run in enumerate(newest):
        many = settings.keep_recordings is not None and index >= settings.keep_recordings
        old = settings.recording_age is not None and now - runs[run] > settings.recording_age
        if (many or old) and run.name not in busy:
            for path in run.glob("*.rrd"):
                path.unlink()
                removed.append(path)
    return removed
