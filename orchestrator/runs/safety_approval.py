"""The accepted safety settings of a controller, kept in a small file next to the laboratory's file for review.

Decant can't judge safety settings. It only detects that they differ from the settings that were accepted.
"""

from __future__ import annotations

import json
import re
from dataclasses import asdict, fields
from pathlib import Path

from actors.arm.arm_settings import SafetyRecord
from orchestrator.run_errors import RunError
from orchestrator.strategies.campaign_plan import CampaignPlan
from sim_engine.errors import shown_path

SUFFIX = ".safety.json"
_CHECKSUM = re.compile(r"[0-9A-F]{8}")


class SafetyRecordError(RunError):
    """The record can't be read, or there is none; the text gives the reason."""

    exit_code = 2


def record_path(laboratory: Path) -> Path:
    """Path of the record of a laboratory's file: NAME.safety.json next to NAME.yaml."""
    return laboratory.with_name(laboratory.stem + SUFFIX)


def read_record(laboratory: Path) -> SafetyRecord | None:
    """The accepted safety settings of a laboratory.

    Args:
        laboratory: the laboratory's file.

    Returns:
        None if none were accepted.

    Raises:
        SafetyRecordError: the record exists but is invalid.
    """
    path = record_path(laboratory)
    try:
        data = json.loads(path.read_text(encoding="utf-8"))
    except FileNotFoundError:
        return None
    except (OSError, ValueError) as error:
        raise SafetyRecordError(
            f"{path}: {error}. Restore it, or accept the settings anew: {_accept(laboratory)}"
        ) from None
    names = {field.name for field in fields(SafetyRecord)}
    if not isinstance(data, dict) or set(data) != names or not all(isinstance(v, str) for v in data.values()):
        raise SafetyRecordError(
            f"{path}: should hold {', '.join(sorted(names))}, each a text. Restore it, or accept the settings anew: "
            f"{_accept(laboratory)}"
        )
    record = SafetyRecord(**data)
    if not _CHECKSUM.fullmatch(record.checksum.upper()):
        raise SafetyRecordError(f"{path}: checksum '{record.checksum}' should be eight hexadecimal digits")
    return record


def write_record(laboratory: Path, record: SafetyRecord) -> Path:
    """Store the accepted settings.

    Raises:
        OSError: the file can't be written.
    """
    path = record_path(laboratory)
    path.write_text(json.dumps(asdict(record), indent=2, ensure_ascii=False) + "\n", encoding="utf-8")
    return path


def accepted_checksum(laboratory: Path) -> str | None:
    """Accepted checksum of a laboratory; None if none was accepted.

    Args:
        laboratory: the file that describes the laboratory; the campaign's file if it contains the laboratory.

    Raises:
        SafetyRecordError: the record is invalid.
    """
    record = read_record(laboratory)
    return None if record is None else record.checksum.upper()


def required_checksum(plan: CampaignPlan) -> str:
    """Checksum that was accepted for the hardware of a campaign's laboratory.

    Raises:
        SafetyRecordError: none was accepted, or the record can't be read.
    """
    laboratory = plan.laboratory_source or plan.source
    checksum = accepted_checksum(laboratory)
    if checksum is None:
        raise SafetyRecordError(
            f"laboratory {plan.laboratory.name}: nobody has accepted the controller's safety settings. Run "
            f"'decant doctor {shown_path(laboratory)}' first; it says how"
        )
    return checksum


def _accept(laboratory: Path) -> str:
    return f"decant doctor {laboratory} --accept-safety"
