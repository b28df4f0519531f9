"""What an arm tells when it is looked at, for `decant doctor`: lines for people, and what of it people accept."""

from __future__ import annotations

from dataclasses import dataclass

from actors.checks import Check


@dataclass(frozen=True)
class SafetyRecord:
    """Safety settings of an arm that somebody has accepted.

    Attributes:
        checksum: of the settings, as the arm tells it.
        serial: of the robot.
        model: of the robot.
        software: version on its controller.
        date: day and time, ISO 8601.
        accepted_by: who.
    """

    checksum: str
    serial: str
    model: str
    software: str
    date: str
    accepted_by: str


@dataclass(frozen=True)
class ArmLook:
    """An arm that was looked at, moving and setting nothing. Arms with more to tell derive from this.

    Attributes:
        checksum: of the settings that keep people safe; '' if the arm tells none, and then none can be accepted.
        serial, model, software: as in `SafetyRecord`.
        problem: why the arm can't move now, or can't be reached; '' if it could.
    """

    checksum: str = ""
    serial: str = ""
    model: str = ""
    software: str = ""
    problem: str = ""

    def checks(self, record: SafetyRecord | None, *, accept: str, virtual: bool) -> list[Check]:
        """One line for everything that was found.

        Args:
            record: what was accepted; None if nothing was.
            accept: the command that accepts it.
            virtual: nobody has to.
        """
        who = " ".join(filter(None, (self.model, self.serial, self.software))) or "not reached"
        checks = [Check("arm", "fail" if self.problem else "ok", self.problem or who)]
        if self.checksum and not virtual:
            accepted = record is not None and (record.checksum, record.serial) == (self.checksum, self.serial)
            found = f"{self.checksum}, accepted by {record.accepted_by if record and accepted else 'nobody'}"
            advice = "" if accepted else f"read the arm's safety settings, then: {accept}"
            checks.append(Check("safety checksum", "ok" if accepted else "fail", found, advice))
        return checks

    def at_home(self) -> Check:
        """Whether the arm stands where it waits."""
        return Check("position", "ok", "at home, as far as the driver tells")
