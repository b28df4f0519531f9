"""The optimiser in a process of its own, because its linear algebra would block the event loop.

`Proposer` runs in the process (or in a thread); `DeviceOptimizer` awaits it. The numerical code is in `suggest`.
"""

from __future__ import annotations

from actors.interfaces import LaboratoryError
from actors.optimizer.questions import Suggestion, SuggestionQuery
from actors.runtime.remote_object import Device, DeviceLostError, MachineLostError

DEADLINE = 600.0
"""Longest time for one answer [s]: a fit to thousands of points takes minutes."""


class Proposer:
    """The object inside the actor. It keeps no state between questions."""

    def suggest(self, query: SuggestionQuery) -> Suggestion:
        """See `actors.optimizer.suggest.propose`."""
        from actors.optimizer.suggest import propose

        return propose(query)


class DeviceOptimizer:
    """`Optimizer` over a `Device` that holds a `Proposer`. A process that dies is replaced; the caller repeats the
    question.

    Args:
        device: of the proposer.
    """

    def __init__(self, device: Device) -> None:
        self.device = device

    async def suggest(self, query: SuggestionQuery) -> Suggestion:
        """See `Optimizer.suggest`.

        Raises:
            DeviceLostError: the process died, or took too long; a new process is ready for the repeated question.
            MachineLostError: its machine is gone.
            LaboratoryError: it cannot answer the question.
        """
        try:
            suggestion: Suggestion = await self.device.call("suggest", query, deadline=DEADLINE)
        except MachineLostError:
            raise
        except DeviceLostError:
            await self.device.revive()
            raise
        except ValueError as error:
            raise LaboratoryError(f"the optimiser can't answer: {error}") from error
        return suggestion
