"""A connection to one robot: made by a new worker, discarded with it, never mended."""

from __future__ import annotations

from typing import Any

from actors.arm.errors import ArmError, ArmLostError, ArmRefusedError
from actors.arm.spec import UrArmSpec
from actors.arm.ur.facts import UrFacts, facts_of
from actors.arm.ur.messages import SILENCE, Progress
from actors.arm.ur.process import WorkerProcess

OPEN_TIME, ANSWER_TIME = 30.0, 15.0
"""Longest waits for the worker [s]: to start and connect, to answer."""


class Session:
    """None to begin with.

    Args:
        spec: where the robot is, and what it should be.

    Attributes:
        facts: of the robot, as it was when the connection was made; None without one.
    """

    def __init__(self, spec: UrArmSpec) -> None:
        self._spec = spec
        self._worker: WorkerProcess | None = None
        self.facts: UrFacts | None = None

    def open(self) -> UrFacts:
        """Connect anew; nothing moves.

        Raises:
            ArmLostError: the robot can't be reached; ArmRefusedError: it is another one than the settings say.
        """
        self.discard()
        spec = self._spec
        self._worker = WorkerProcess()
        # Only a virtual controller has its time scaled; its process may be kept waiting where a real one isn't.
        silence = SILENCE if spec.time_scale == 1.0 else 8.0 * SILENCE
        try:
            self.ask("open", spec.address, spec.rate, silence, deadline=OPEN_TIME)
            self.facts = self.find_out()
            self._check_model(self.facts)
        except ArmError:
            self.discard()
            raise
        return self.facts

    def ask(self, method: str, *arguments: object, deadline: float = ANSWER_TIME) -> Any:
        """Have the worker do something; see `WorkerProcess.call`."""
        worker = self._worker
        if worker is None or not worker.alive:
            raise ArmLostError("the arm is not connected; connect first")
        try:
            return worker.call(method, *arguments, deadline=deadline)
        except ArmLostError:
            worker.kill()
            raise

    def find_out(self) -> UrFacts:
        """The robot as it is now."""
        return facts_of(self.ask("facts"))

    @property
    def progress(self) -> Progress | None:
        """What the worker last told of a motion."""
        return None if self._worker is None else self._worker.progress

    @property
    def pid(self) -> int | None:
        """Process id of the worker."""
        return None if self._worker is None else self._worker.pid

    def forget_progress(self) -> None:
        """Before another motion."""
        if self._worker is not None:
            self._worker.progress = None

    def stop(self, stops: int) -> None:
        """Order a stop; doesn't wait."""
        if self._worker is not None:
            self._worker.stop(stops)

    def kill(self) -> None:
        """End the worker: a motion under way ends by its watchdog."""
        if self._worker is not None:
            self._worker.kill()

    def discard(self) -> None:
        """End it, and forget the robot."""
        self.kill()
        self._worker, self.facts = None, None

    def _check_model(self, facts: UrFacts) -> None:
        model = facts.model.lower().removesuffix("e") + ("e" if facts.e_series else "")
        if model != self._spec.model:
            raise ArmRefusedError(
                f"the robot at {self._spec.address} is a {model.upper()} (software {facts.version}); "
                f"the arm is set up as {self._spec.model.upper()}"
            )
