"""The optimiser in a process of its own (its linear algebra would hold the event loop up), and its twin in a thread."""

from __future__ import annotations

from actors.device import Device, DeviceLostError, MachineLostError
from actors.optimizer.core.problem import Suggestion, SuggestProblem
from actors.protocols import LaboratoryError

DEADLINE = 600.0
"""Longest time for one answer [s]: a fit to thousands of points takes minutes."""

RETRIES = 2
"""How often a question is asked again after a death."""


class Proposer:
    """What runs inside the actor. It keeps nothing from one question to the next."""

    def suggest(self, problem: SuggestProblem) -> Suggestion:
        """See `actors.optimizer.core.propose.propose`."""
        from actors.optimizer.core.propose import propose

        return propose(problem)


class DeviceOptimizer:
    """`Optimizer` over a `Device` that holds a `Proposer`. If its process dies, a new one is asked the same again.

    Args:
        device: of the proposer.
    """

    def __init__(self, device: Device) -> None:
        self.device = device

    async def suggest(self, problem: SuggestProblem) -> Suggestion:
        """See `Optimizer.suggest`.

        Raises:
            LaboratoryError: it died more often than it may, or can't answer the question.
        """
        for _ in range(1 + RETRIES):
            try:
                suggestion: Suggestion = await self.device.call("suggest", problem, deadline=DEADLINE)
                return suggestion
            except MachineLostError:
                raise
            except DeviceLostError as error:
                lost = error
                await self.device.revive()
            except ValueError as error:
                raise LaboratoryError(f"the optimiser can't answer: {error}") from error
        raise LaboratoryError(f"the optimiser died {1 + RETRIES} times over one question: {lost}")
