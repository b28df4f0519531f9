"""Campaigns and vessels: loaded from files, built in a program, or taken from the set that Decant comes with."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from orchestrator.config.file_loading import campaign_from, load_campaign, load_vessel
from orchestrator.config.yaml.yaml_source import Document
from orchestrator.shipped import shipped, starting_set
from orchestrator.strategies.campaign_plan import CampaignPlan

__all__ = ["build_campaign", "load_campaign", "load_vessel", "shipped", "starting_set"]


def build_campaign(content: Mapping[str, Any], folder: Path | str = ".") -> CampaignPlan:
    """A campaign from the keys of a campaign file, with its defaults and its checks.

    Args:
        content: as in YAML: quantities are texts with units ('40 deg/s'), vessels and laboratory paths or mappings.
        folder: that relative paths in it start from.

    Raises:
        ConfigError: anything is wrong with it; all problems at once, with their places.
    """
    path = Path(folder).expanduser().resolve() / "campaign.json"
    return campaign_from(Document.parse(json.dumps(content, indent=2, ensure_ascii=False), path))
