"""Studies that tests change and write anew."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from ruamel.yaml import YAML

from orchestrator.study.study_file import load_study
from orchestrator.study.study_plan import StudyPlan

ROOT = Path(__file__).parents[2]
STUDIES = ROOT / "configs" / "studies"


def read(name: str) -> dict[str, Any]:
    data: dict[str, Any] = YAML(typ="safe").load((STUDIES / f"{name}.yaml").read_text(encoding="utf-8"))
    for key in ("campaign", "laboratory"):
        data[key] = str((STUDIES / data[key]).resolve())
    return data


def written(folder: Path, data: dict[str, Any]) -> Path:
    folder.mkdir(parents=True, exist_ok=True)
    path = folder / "study.yaml"
    path.write_text(json.dumps({**data, "directory": str(folder / "runs")}), encoding="utf-8")
    return path


def small(folder: Path, **changes: Any) -> StudyPlan:
    """The quick study with less of everything."""
    data = read("quick")
    data["deployment"]["D2"]["pours"] = data["deployment"]["D3"]["pours"] = 2
    chosen = {key: value for key, value in {**data, **changes}.items() if value is not None}
    return load_study(written(folder, chosen))


def without(data: dict[str, Any], key: str) -> dict[str, Any]:
    return {name: value for name, value in data.items() if name != key}
