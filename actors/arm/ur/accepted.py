"""The driver of an arm of hardware: it moves nothing under safety settings that nobody has accepted."""

from __future__ import annotations

from actors.arm.errors import NotAcceptedError
from actors.arm.spec import UrArmSpec
from actors.arm.ur.driver import UrArm
from actors.arm.ur.facts import UrFacts


class AcceptedArm(UrArm):
    """A `UrArm` that compares the controller's safety checksum whenever it asks who is there.

    Args:
        spec: as for `UrArm`.
        accepted: checksum that people have accepted; '' if nobody has.
    """

    def __init__(self, spec: UrArmSpec, accepted: str) -> None:
        super().__init__(spec)
        self._accepted = accepted
        self._address = spec.address

    def connect(self) -> UrFacts:
        """See `UrArm.connect`.

        Raises:
            NotAcceptedError: other safety settings than the accepted ones; the arm is let go of.
        """
        return self._compared(super().connect())

    def facts(self) -> UrFacts:
        """See `UrArm.facts`; raises as `connect`."""
        return self._compared(super().facts())

    def _compared(self, facts: UrFacts) -> UrFacts:
        try:
            require_accepted(self._accepted or None, facts.checksum or None, self._address)
        except NotAcceptedError:
            self.close()
            raise
        return facts


def require_accepted(accepted: str | None, found: str | None, controller: str) -> None:
    """Compare the checksum of a controller's safety configuration with the accepted one.

    Called once the controller is connected, before anything is asked to move.

    Args:
        accepted: eight hexadecimal digits, as `decant doctor --accept-safety` recorded them; None if nobody has.
        found: as the controller says now; None if it says nothing.
        controller: its address, for people.

    Raises:
        NotAcceptedError: with what to do about it.
    """
    if accepted is None:
        raise NotAcceptedError(
            f"arm at {controller}: nobody has accepted its safety settings (checksum {found or 'unknown'}) for this "
            "laboratory. Run 'decant doctor' on the laboratory's file first; it says how"
        )
    if found is None:
        raise NotAcceptedError(
            f"arm at {controller}: the controller tells no safety checksum, which it leaves out while no safety "
            f"configuration is applied; {accepted} was accepted. Confirm the settings on the teach pendant"
        )
    if found.upper() != accepted.upper():
        raise NotAcceptedError(
            f"arm at {controller}: its safety settings have changed: checksum {found.upper()}, accepted was "
            f"{accepted.upper()}. Nothing moves. Find out on the teach pendant who changed what; when the settings are "
            "right, accept them with 'decant doctor --accept-safety'"
        )
