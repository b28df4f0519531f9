"""A laboratory's Ray cluster as written in files."""

from __future__ import annotations

import re
from typing import Annotated, ClassVar

from pydantic import AfterValidator, Strict
from pydantic_core import PydanticCustomError

from actors.spec import RaySpec
from orchestrator.config.yaml.sections import Name, Section


def _address(text: str) -> str:
    host, colon, port = text.rpartition(":")
    if colon and re.fullmatch(r"[A-Za-z0-9._-]+|\[[0-9A-Fa-f:.]+\]", host) and port.isdigit() and 0 < int(port) < 65536:
        return text
    raise PydanticCustomError(
        "ray_address",
        "{text} should be host:port of the cluster's head as 'ray start --head' prints it, e.g. 10.0.0.1:6379",
        {"text": repr(text)},
    )


Address = Annotated[str, Strict(), AfterValidator(_address)]


class RaySection(Section):
    """A Ray cluster that runs already; Decant joins it and leaves it running."""

    required: ClassVar[dict[str, str]] = {"address": "10.0.0.1:6379"}

    address: Address | None = None
    """Address of its head, host:port."""

    bench_resource: Name = RaySpec.bench_resource
    """Custom resource of the node that arm, balance and bench run on; 'ray start --resources' gives it one."""


def resolve_ray(section: RaySection | None) -> RaySpec | None:
    """The cluster of a file; None if it names none, or its address is wrong (which is reported already)."""
    if section is None or section.address is None:
        return None
    return RaySpec(section.address, section.bench_resource)
