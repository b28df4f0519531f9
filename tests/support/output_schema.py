"""Validation of what commands with `--json` print."""

from __future__ import annotations

import json
from functools import cache
from typing import Any

import jsonschema

from orchestrator.cli.json_output import output_schema


def validated(command: str, stdout: str) -> dict[str, Any]:
    """The output of a command, the last line of its stdout, after it was validated.

    Args:
        command: as a key of `OUTPUTS`.
        stdout: of the command.
    """
    data: dict[str, Any] = json.loads(stdout.splitlines()[-1])
    _validator(command).validate(data)
    return data


@cache
def _validator(command: str) -> Any:
    schema = output_schema()
    return jsonschema.Draft202012Validator({"$defs": schema["$defs"], **schema["properties"][command]})
