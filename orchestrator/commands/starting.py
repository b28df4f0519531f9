"""`decant init`: files to begin with, in a folder of one's own."""

from __future__ import annotations

from pathlib import Path

from orchestrator.commands.speaking import BAD_INPUT, RefusalError
from orchestrator.shipped import starting_set


def init(directory: Path) -> None:
    """Copy the shipped campaigns and what they refer to.

    Raises:
        RefusalError: the folder is not empty, or can't be written (exit code 2).
    """
    try:
        campaigns = starting_set(directory)
    except FileExistsError as error:
        raise RefusalError(str(error), BAD_INPUT) from None
    except OSError as error:
        raise RefusalError(f"{directory}: can't be written: {error.strerror}", BAD_INPUT) from None
    for path in campaigns:
        print(path)
