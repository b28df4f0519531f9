"""What a stage learnt: the base of all results. Each kind is declared beside the strategy that learns it."""

from __future__ import annotations

from typing import Any, ClassVar

from pydantic import BaseModel, ConfigDict


class Part(BaseModel):
    """A piece of a result: it can't be changed, and its JSON form has exactly the declared fields."""

    model_config = ConfigDict(frozen=True, extra="forbid", use_attribute_docstrings=True, defer_build=True)


class Learnt(Part):
    """What a strategy has learnt so far. A subclass declares its own `kind`, a text that no other one bears.

    Journals, the studies' files and `summary.json` hold dumps; `orchestrator.results` reads them back by their kind.
    """

    KINDS: ClassVar[dict[str, type[Learnt]]] = {}
    """All that have been declared in the imported modules, by kind."""

    kind: str

    @classmethod
    def __pydantic_init_subclass__(cls, **kwargs: Any) -> None:
        """Make the kind known.

        Raises:
            TypeError: another class has it already, or this one names none.
        """
        super().__pydantic_init_subclass__(**kwargs)
        kind = cls.model_fields["kind"].default
        if not isinstance(kind, str):
            raise TypeError(f"{cls.__qualname__} has to declare its kind: kind: Literal['…'] = '…'")
        known = Learnt.KINDS.setdefault(kind, cls)
        if (known.__module__, known.__qualname__) != (cls.__module__, cls.__qualname__):
            raise TypeError(f"{cls.__qualname__}: {known.__qualname__} has the kind '{kind}' already; choose another")
