"""What arm and balance show after a crash: read, never moved or tared, for the person who says what came of a pour."""

from __future__ import annotations

from actors.protocols import LaboratoryError
from actors.spec import LaboratorySpec
from orchestrator.commands.doctor_balance import look_at_balance
from orchestrator.commands.hands_on import reached


def found_at(spec: LaboratorySpec) -> dict[str, str]:
    """What is found at a bench, in words. Takes seconds.

    Args:
        spec: of the laboratory.

    Returns:
        By what was looked at; what could not be read says so.
    """
    if spec.arm is None:
        return {"bench": "made of numbers: it has no arm and no balance that could be read"}
    found: dict[str, str] = {}
    try:
        with reached(spec) as ready:
            assert ready.arm is not None
            checks = ready.arm.look().checks(None, accept="", virtual=True) + look_at_balance(ready.balance, tare=False)
    except (LaboratoryError, OSError, ValueError) as error:
        return {"bench": f"can't be read: {error}"}
    for check in checks:
        found[check.name] = check.found
    if spec.mode == "virtual":
        found["note"] = "arm and balance are virtual and were started anew: they show nothing of the pour"
    return found
