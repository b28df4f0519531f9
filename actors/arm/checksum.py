"""A controller whose safety settings nobody here has accepted moves nothing."""

from __future__ import annotations

from actors.protocols import LaboratoryError


class ChecksumError(LaboratoryError):
    """The controller's safety settings aren't those that people have accepted."""


def require_accepted(accepted: str | None, found: str | None, controller: str) -> None:
    """Compare the checksum of a controller's safety configuration with the accepted one.

    Called once the controller is connected, before anything is asked to move.

    Args:
        accepted: eight hexadecimal digits, as `decant doctor --accept-safety` recorded them; None if nobody has.
        found: as the controller says now; None if it says nothing.
        controller: its address, for people.

    Raises:
        ChecksumError: with what to do about it.
    """
    if accepted is None:
        raise ChecksumError(
            f"arm at {controller}: nobody has accepted its safety settings (checksum {found or 'unknown'}) for this "
            "laboratory. Run 'decant doctor' on the laboratory's file first; it says how"
        )
    if found is None:
        raise ChecksumError(
            f"arm at {controller}: the controller tells no safety checksum, which it leaves out while no safety "
            f"configuration is applied; {accepted} was accepted. Confirm the settings on the teach pendant"
        )
    if found.upper() != accepted.upper():
        raise ChecksumError(
            f"arm at {controller}: its safety settings have changed: checksum {found.upper()}, accepted was "
            f"{accepted.upper()}. Nothing moves. Find out on the teach pendant who changed what; when the settings are "
            "right, accept them with 'decant doctor --accept-safety'"
        )
