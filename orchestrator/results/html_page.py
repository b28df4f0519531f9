"""Self-contained HTML pages: tables, pictures, and the rendering of templates.

The templates escape all content of a campaign (autoescape). A page loads nothing from other addresses, and its content
security policy forbids it.
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
"""Maximum size of an SVG in a page [bytes]; the PNG replaces a larger one, for example with many facets."""


@dataclass(frozen=True)
class Row:
    """A row of a table; its first cell is the row's name.

    Attributes:
        look: 'best', 'bad' or ''.
    """

    cells: Sequence[str]
    look: str = ""


@dataclass(frozen=True)
class HtmlTable:
    """A table of a page.

    Attributes:
        caption: text above the table, read first by screen readers.
        numbers: columns that are right-aligned.
    """

    caption: str
    header: Sequence[str]
    rows: Sequence[Row]
    numbers: frozenset[int] = frozenset()

    def filled(self) -> HtmlTable:
        """A copy without empty columns."""
        kept = [i for i in range(len(self.header)) if i == 0 or any(row.cells[i].strip("—") for row in self.rows)]
        rows = [Row([row.cells[i] for i in kept], row.look) for row in self.rows]
        numbers = frozenset(place for place, i in enumerate(kept) if i in self.numbers)
        return HtmlTable(self.caption, [self.header[i] for i in kept], rows, numbers)


@dataclass(frozen=True)
class Picture:
    """A picture on a page.

    Attributes:
        source: a data URI.
        alt: description for readers who do not see the picture.
        wide: whether it covers the full width of the page.
    """

    source: str
    alt: str
    caption: str
    wide: bool = False

    @classmethod
    def of(cls, file: Path, alt: str, caption: str, *, wide: bool = False) -> Picture:
        """An embedded file: the SVG next to a PNG if there is one, for print.

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
    """Render a page.

    Args:
        template: 'run.html.j2' or 'study.html.j2'.
        content: values for the template; all of them are escaped.
    """
    from markupsafe import Markup

    style = resources.files("orchestrator.results").joinpath("templates", STYLE).read_text(encoding="utf-8")
    return _templates().get_template(template).render(style=Markup(style), **content)
