"""What a run keeps of its campaign: the file with everything filled in, standing alone (`resolved.json`)."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from orchestrator.config.campaign.sections import CampaignFile
from orchestrator.config.yaml.dump import as_file
from orchestrator.config.yaml.references import References
from orchestrator.config.yaml.source import Place


def campaign_record(file: CampaignFile, root: Place, references: References, directory: Path) -> dict[str, Any]:
    """The campaign in the language of campaign files, JSON-ready: loading it gives the same plan.

    Args:
        file: without problems.
        root: its place.
        references: that its other files were read by.
        directory: in which its runs get folders.
    """
    record = as_file(file, root, references)
    record["outputs"]["directory"] = str(directory)
    return record
