"""The optimiser in a process of its own (its linear algebra would hold the event loop up), and its twin in a thread."""

from __future__ import annotations

from actors.interfaces import LaboratoryError
from actors.optimizer.questions import Suggestion, SuggestProblem
from actors.runtime.remote_object import Device, DeviceLostError, MachineLostError

DEADLINE = 600.0
"""Longest time for one answer [s]: a fit to thousands of points takes minutes."""


class Proposer:
    """What runs inside the actor. It keeps nothing from one question to the next."""

    def suggest(self, problem: SuggestProblem) -> Suggestion:
        """See `actors.optimizer.suggest.propose`."""
        from actors.optimizer.suggest import propose

        return propose(problem)


class DeviceOptimizer:
    """`Optimizer` over a `Device` that holds a `Proposer`. A process that dies is replaced; whoever asked asks again.

    Args:
        device: of the proposer.
    """

    def __init__(self, device: Device) -> None:
        self.device = device

    async def suggest(self, problem: SuggestProblem) -> Suggestion:
        """See `Optimizer.suggest`.

        Raises:
            DeviceLostError: it died over the question, or took too long; a new process is there to be asked again.
            MachineLostError: its machine is gone.
            LaboratoryError: it can't answer the question.
        """
        try:
            suggestion: Suggestion = await self.device.call("suggest", problem, deadline=DEADLINE)
        except MachineLostError:
            raise
        except DeviceLostError:
            await self.device.revive()
            raise
        except ValueError as error:
            raise LaboratoryError(f"the optimiser can't answer: {error}") from error
        return suggestion
