"""Submission bundles: a campaign with all files that it refers to, as one self-contained unit.

`pack` makes a bundle from a loaded campaign; `unpack` writes it to a folder; `load_confined` loads a campaign that may
read only given folders. Later changes of the original files do not affect a bundle.
"""

from __future__ import annotations

import base64
import binascii
import json
import re
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from orchestrator.config.file_loading import load_campaign
from orchestrator.config.yaml.file_access import confined, out_of_bounds
from orchestrator.config.yaml.yaml_errors import ConfigError, Problem
from orchestrator.journal.journal import JOURNAL_NAME
from orchestrator.journal.journal_file import whole_copy
from orchestrator.strategies.campaign_plan import CampaignPlan

CAMPAIGN, THETA = "campaign.yaml", "theta.yaml"
"""Names of the campaign's file, and of the file with the θ for planning (`orchestrator.run_service.read_theta`)."""

_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9._-]{0,79}(/[A-Za-z0-9][A-Za-z0-9._-]{0,79}){0,3}")
_FILES = 100

Files = dict[str, str]
"""Name → content in base64. Names are relative paths of letters, digits, '.', '_' and '-'."""


class SubmissionBundleError(ValueError):
    """The bundle can't be unpacked; the message gives the reason."""


def pack(plan: CampaignPlan, theta: Path | None = None) -> tuple[str, Files]:
    """Convert a loaded campaign to text and files.

    Args:
        plan: campaign as loaded from its files.
        theta: file with the θ for planning, such as a calibration's `theta.json`; None: the campaign's θ.

    Returns:
        The campaign's text (JSON, which is YAML) with paths of the returned files, and these files.

    Raises:
        OSError: a file can't be read.
        ConfigError: a file is outside the folders that this campaign may read.
    """
    files: Files = {}
    resolved = dict(plan.resolved)
    resolved["outputs"] = {k: v for k, v in resolved.get("outputs", {}).items() if k != "directory"}
    table = _packed(resolved, files)
    if theta is not None:
        files[THETA] = _coded(theta.read_bytes())
    return json.dumps(table, indent=1, ensure_ascii=False) + "\n", files


def _packed(value: Any, files: Files) -> Any:
    if isinstance(value, Mapping):
        return {key: _packed(one, files) for key, one in value.items()}
    if isinstance(value, list):
        return [_packed(one, files) for one in value]
    if isinstance(value, str) and value.startswith("/"):  # only absolute paths begin with '/' in a record
        return _taken(Path(value), files)
    return value


def _taken(path: Path, files: Files) -> str:
    if (outside := out_of_bounds(path)) is not None:
        raise ConfigError([Problem(path, 0, 0, "", outside)])
    stem = re.sub(r"[^A-Za-z0-9._-]", "_", path.name).lstrip("._-")[-60:] or "file"
    name = f"files/{len(files) + 1}-{stem}"
    if (path / JOURNAL_NAME).is_file():  # a previous run: only its journal is read
        files[f"{name}/{JOURNAL_NAME}"] = _coded(whole_copy(path / JOURNAL_NAME))
    elif path.is_file():
        files[name] = _coded(path.read_bytes())
    else:
        return str(path)
    return name


def _coded(content: bytes) -> str:
    return base64.b64encode(content).decode("ascii")


def unpack(text: str, files: Mapping[str, str], folder: Path) -> Path:
    """Write a bundle to a new folder.

    Args:
        text: text of the campaign.
        files: files that it refers to.
        folder: is created; must not exist.

    Returns:
        Path of the campaign's file.

    Raises:
        SubmissionBundleError: a name is not allowed, or a file is not in base64.
    """
    if len(files) > _FILES:
        raise SubmissionBundleError(f"{len(files)} files; a campaign refers to some, and {_FILES} are taken at most")
    contents: dict[str, bytes] = {}
    for name, coded in files.items():
        if not _NAME.fullmatch(name) or ".." in name or name == CAMPAIGN:
            raise SubmissionBundleError(
                f"files: {name[:80]!r} is not a name for one; names are words of letters, digits, '.', '_' and '-' "
                "with '/' between them"
            )
        try:
            contents[name] = base64.b64decode(coded, validate=True)
        except (binascii.Error, ValueError):
            raise SubmissionBundleError(f"files: {name}: is not in base64") from None
    folder.mkdir(parents=True, mode=0o700)
    for name, content in contents.items():
        path = folder / name
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            path.write_bytes(content)
        except (FileExistsError, NotADirectoryError, IsADirectoryError):
            raise SubmissionBundleError(f"files: {name}: is a file and a folder at once") from None
    campaign = folder / CAMPAIGN
    campaign.write_text(text, encoding="utf-8")
    return campaign


def load_confined(campaign: Path, roots: Sequence[Path], laboratory: Path | None = None) -> CampaignPlan:
    """Load a campaign that may read only given folders.

    Args:
        campaign: its file.
        roots: folders that it may read.
        laboratory: laboratory file instead of its own.

    Raises:
        ConfigError: the campaign is invalid, or it refers to a file elsewhere.
    """
    with confined([*roots, *([] if laboratory is None else [laboratory])]):
        return load_campaign(campaign, laboratory)
