"""The driver of an arm of hardware: it moves nothing under safety settings that nobody has accepted."""

from __future__ import annotations

from actors.arm.checksum import ChecksumError, require_accepted
from actors.arm.spec import UrArmSpec
from actors.arm.ur.driver import UrArm
from actors.arm.ur.facts import ArmFacts


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

    def connect(self) -> ArmFacts:
        """See `UrArm.connect`.

        Raises:
            ChecksumError: other safety settings than the accepted ones; the arm is let go of.
        """
        return self._compared(super().connect())

    def facts(self) -> ArmFacts:
        """See `UrArm.facts`; raises as `connect`."""
        return self._compared(super().facts())

    def _compared(self, facts: ArmFacts) -> ArmFacts:
        try:
            require_accepted(self._accepted or None, facts.checksum or None, self._address)
        except ChecksumError:
            self.close()
            raise
        return facts
