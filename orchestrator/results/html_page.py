"""HTML pages that need nothing beside them: pieces of a page, and how a template is filled.

Whatever comes from a campaign is escaped by the templates (autoescape); nothing on a page is loaded from elsewhere, and
a content security policy says so to the browser.
"""

from __future__ import annotations

import base64
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from importlib import resources
from pathlib import Path
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from jinja2 import Environment

STYLE = "style.css"

LARGEST_VECTOR = 1_500_000
"""Bytes of an SVG that goes into a page; of a larger one, with a surface of many facets, the PNG does."""


@dataclass(frozen=True)
class Row:
    """A row of a table: the first cell names it.

    Attributes:
        look: 'best', 'bad' or ''.
    """

    cells: Sequence[str]
    look: str = ""


@dataclass(frozen=True)
class HtmlTable:
    """A table for people.

    Attributes:
        caption: above it; a screen reader says it first.
        numbers: columns that are aligned to the right.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Row]
    numbers: frozenset[int] = frozenset()

    def filled(self) -> HtmlTable:
        """Without columns in which no row has anything."""
        kept = [i for i in range(len(self.header)) if i == 0 or any(row.cells[i].strip("—") for row in self.rows)]
        rows = [Row([row.cells[i] for i in kept], row.look) for row in self.rows]
        numbers = frozenset(place for place, i in enumerate(kept) if i in self.numbers)
        return HtmlTable(self.caption, [self.header[i] for i in kept], rows, numbers)


@dataclass(frozen=True)
class Picture:
    """A picture on a page.

    Attributes:
        source: a data URI.
        alt: what it shows, for those who don't see it.
        wide: over the whole page.
    """

    source: str
    alt: str
    caption: str
    wide: bool = False

    @classmethod
    def of(cls, file: Path, alt: str, caption: str, *, wide: bool = False) -> Picture:
        """A file as a part of the page: SVG where it lies beside a PNG, so that print has lines.

        Raises:
            OSError: it can't be read.
        """
        vector = file.with_suffix(".svg")
        file = vector if vector.is_file() and vector.stat().st_size <= LARGEST_VECTOR else file
        kind = "svg+xml" if file.suffix == ".svg" else "png"
        data = base64.b64encode(file.read_bytes()).decode("ascii")
        return cls(f"data:image/{kind};base64,{data}", alt, caption, wide)


@cache
def _templates() -> Environment:
    from jinja2 import Environment, PackageLoader, StrictUndefined

    return Environment(
        loader=PackageLoader("orchestrator.results", "templates"),
        autoescape=True,
        undefined=StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )


def render(template: str, **content: Any) -> str:
    """A page.

    Args:
        template: 'run.html.j2' or 'study.html.j2'.
        content: what it asks for; all of it is escaped.
    """
    from markupsafe import Markup

    style = resources.files("orchestrator.results").joinpath("templates", STYLE).read_text(encoding="utf-8")
    return _templates().get_template(template).render(style=Markup(style), **content)
