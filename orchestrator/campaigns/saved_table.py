"""Tables as programs and people save them: CSV in its dialects, and the first sheet of an .xlsx workbook.

`read_saved_table` returns a `SavedTable`. It accepts a dialect only if the file leaves no doubt about it, and lists in
`SavedTable.assumed` everything that the plain form (UTF-8, commas, decimal points, a header in the first line) does not
have. Whatever a person does not see in a workbook is refused: a hidden first sheet, hidden rows and columns.
`orchestrator.campaigns.table_columns` resolves the names and units of the header.
"""

from __future__ import annotations

import csv
import io
import itertools
import math
import re
import warnings
import zipfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import IO, Any
from xml.etree import ElementTree

from orchestrator.campaigns.yaml.file_access import SIZE_LIMIT, UnreadableError, read_bytes
from orchestrator.campaigns.yaml.yaml_errors import ConfigError, Problem
from sim_engine.resources import MissingExtraError, require
from sim_engine.settings.quantity import QuantityError, decimals_of, number_readings, parse_unit, plain_number

UNPACKED_LIMIT = 20_000_000
"""Largest content of a workbook after decompression [bytes]."""

MOST_COLUMNS = 256
"""Columns of a sheet that are read: some add-ins keep hidden values in the last of its 16,384 columns."""

MOST_LINES = 20_000
"""Largest number of a line or row with values, unless a caller says otherwise."""

TITLE_LINES = 12
"""Lines in which a header below titles is looked for."""

SEPARATORS = {";": "semicolons", "\t": "tabs", ",": "commas"}

_INVISIBLE = "\ufeff\u200b\u200c\u200d\u2060"
_UNNAMED = re.compile(r"(Unnamed: [0-9]+(\.[0-9]+)*)?")
"""Name that pandas gives to a column without one, also after several rounds of saving and reading."""

_SEPARATOR_LINE = re.compile(r'"?sep=(\t|[^\w\s"#])"?\s*')
"""First line that Excel reads and writes: 'sep=;'."""

_COMMENT = re.compile(r"#(?!([\w/]+[!?]|N/A|NV)(\W|$))")
"""Beginning of a comment; '#DIV/0!' and '#N/A' are values of spreadsheet programs."""


Cell = str | float


@dataclass(frozen=True)
class TableRow:
    """One row.

    Attributes:
        line: line of the file, or row of the sheet, from 1.
        cells: stripped texts; numbers of a workbook are floats.
        starts: character at which each cell begins, or column of the sheet, from 1.
        source: the line as written; empty for a workbook.
    """

    line: int
    cells: tuple[Cell, ...]
    starts: tuple[int, ...]
    source: str = ""

    @property
    def empty(self) -> bool:
        """Whether no cell has a value."""
        return not any(cell != "" for cell in self.cells)


@dataclass
class SavedTable:
    """A table of a file.

    Attributes:
        path: the file.
        header: names of the columns, as written.
        rows: rows with any value.
        assumed: everything that differs from the plain form, each as a phrase.
        decimal_comma: whether numbers have a decimal comma.
    """

    path: Path
    header: TableRow
    rows: list[TableRow]
    assumed: list[str] = field(default_factory=list)
    decimal_comma: bool = False

    @property
    def note(self) -> str:
        """One sentence on what was assumed; empty for a file in the plain form."""
        return f"{self.path.name} was read with {', '.join(self.assumed)}" if self.assumed else ""

    def problem(self, row: TableRow, index: int | None, name: str, message: str) -> Problem:
        """A problem of a row's cell; `index` None for the whole row."""
        start = row.starts[index] if index is not None and index < len(row.starts) else 1
        return Problem(self.path, row.line, start, name, message, row.source)

    def misfits(self) -> list[Problem]:
        """The problem of all rows that have more or fewer cells than the header, with its likely cause; or none."""
        width = len(self.header.cells)
        rows = [row for row in self.rows if len(row.cells) != width]
        if not rows:
            return []
        count, hint = len(rows[0].cells), ""
        if rows[0].source.count('"') % 2 or any("\n" in str(cell) for cell in rows[0].cells):
            hint = "; is a quote still open?"
        elif count > width:
            hint = "; are there decimal commas? Then save it with semicolons or tabs between the cells"
        others = f" ({len(rows) - 1} more lines have another number, too)" if len(rows) > 1 else ""
        text = f"has {count} cell{'s' * (count > 1)}, the header {width}{hint}{others}"
        return [self.problem(rows[0], None, "", text)]

    def number(self, cell: Cell) -> float:
        """The number in a cell.

        Raises:
            ValueError: it is empty, or not a finite number; the message says so.
        """
        if isinstance(cell, str):
            if not cell:
                raise ValueError("is empty; every row needs a value")
            value = float(plain_number(cell, decimal_comma=self.decimal_comma) or math.nan)
        else:
            value = cell
        if not math.isfinite(value):
            raise ValueError(f"{cell!r} is not a number; write it like 12.5")
        return value


def read_saved_table(path: Path, *, limit: int = SIZE_LIMIT, most_lines: int = MOST_LINES) -> SavedTable:
    """Read a table.

    Args:
        path: a text file, or an .xlsx workbook whose first sheet is read. The content decides, not the name.
        limit: largest file [bytes].
        most_lines: largest number of a line with values.

    Raises:
        ConfigError: the file can't be read, or its dialect is in doubt; one problem.
    """

    def refused(message: str, row: TableRow | None = None, index: int | None = None, name: str = "") -> ConfigError:
        if row is None:
            return ConfigError([Problem(path, 0, 0, "", message)])
        return ConfigError([SavedTable(path, row, []).problem(row, index, name, message)])

    try:
        content = read_bytes(path, limit=limit)
        assumed: list[str] = []
        other = _other_kind(content)
        if other == "xlsx":
            rows = _sheet_rows(content, assumed, most_lines)
        elif other:
            raise UnreadableError(other)
        else:
            rows = _text_rows(_decoded(content, assumed), assumed)
        if not rows:
            raise UnreadableError("is empty; it needs a header and a line for each row")
        if (last := rows[-1]).line > most_lines:
            raise _RowError(f"stands beyond line {most_lines:,}; is it the right file?", last)
        _check_header(rows)
        if any(not isinstance(cell, str) or decimals_of(cell) or plain_number(cell) for cell in rows[0].cells):
            raise _RowError("has no header; the first line should have the names of the columns", rows[0])
        table = _without_unnamed(SavedTable(path, rows[0], rows[1:], assumed))
        _find_decimals(table)
    except (UnreadableError, MissingExtraError) as error:
        raise refused(str(error)) from None
    except _RowError as error:
        raise refused(str(error), error.row, error.index, error.name) from None
    return table


class _RowError(Exception):
    def __init__(self, message: str, row: TableRow, index: int | None = None, name: str = "") -> None:
        super().__init__(message)
        self.row, self.index, self.name = row, index, name


# -- kinds of files ----------------------------------------------------------------------------------------------------


def _other_kind(content: bytes) -> str:
    """'xlsx', the reason why a file is no table, or '' for a text."""
    if content.startswith(b"PK"):
        try:
            with zipfile.ZipFile(io.BytesIO(content)) as archive:
                names = set(archive.namelist())
                unpacked = sum(entry.file_size for entry in archive.infolist())
        except (zipfile.BadZipFile, ValueError, NotImplementedError):
            return "is a damaged workbook or archive; save the table again, as CSV"
        if unpacked > UNPACKED_LIMIT:
            return f"has {unpacked / 1e6:.3g} MB unpacked, and {UNPACKED_LIMIT / 1e6:g} MB are read at most"
        if "xl/workbook.xml" in names:
            return "xlsx"
        if "xl/workbook.bin" in names:
            return "is a binary Excel workbook (.xlsb); save it as .xlsx or CSV"
        if "content.xml" in names:
            return "is a workbook of LibreOffice (.ods); save it as .xlsx or CSV"
        if any(name.startswith("Index") for name in names):
            return "is a workbook of Numbers; export it as .xlsx or CSV"
        return "is an archive, not a table; save the table as CSV"
    if content.startswith(b"\xd0\xcf\x11\xe0"):
        return "is an old Excel workbook (.xls), or one with a password; save it as .xlsx or CSV"
    head = content[:1000].lstrip(b"\xef\xbb\xbf \t\r\n").lower()
    if head.startswith((b"<!doctype", b"<html", b"<table", b"<?xml")):
        return "is a web page or XML, not a table; save the table as CSV"
    return ""


def _decoded(content: bytes, assumed: list[str]) -> str:
    """The text, in UTF-8, UTF-16 with its mark, or Windows-1252.

    Raises:
        UnreadableError: it is no text.
    """
    if content.startswith((b"\xff\xfe", b"\xfe\xff")):
        assumed.append("text in UTF-16")
        try:
            return content.decode("utf-16")
        except UnicodeDecodeError:
            raise UnreadableError("is not text in UTF-16, as its first bytes say; save it as UTF-8") from None
    if content.count(0) > len(content) / 4:
        raise UnreadableError("is not text in UTF-8 (perhaps UTF-16 without its first mark); save it as UTF-8")
    try:
        return content.decode("utf-8-sig")
    except UnicodeDecodeError as error:
        if b"\0" in content:
            raise UnreadableError(f"is not text (byte {error.start}); save the table as CSV in UTF-8") from None
        try:
            text = content.decode("cp1252")
        except UnicodeDecodeError:
            raise UnreadableError(f"is not text in UTF-8 (byte {error.start}); save it as UTF-8") from None
    assumed.append("text in Windows-1252")
    return text


def _sheet_rows(content: bytes, assumed: list[str], most_lines: int) -> list[TableRow]:
    """Rows of the first sheet of a workbook.

    Rows are read one by one: a table of cells from the first to the last used one may need more memory than there is.

    Raises:
        MissingExtraError: the reader is not installed.
        UnreadableError: the workbook is damaged, or its first sheet hidden.
        _RowError: a person sees another table than this reader.
    """
    try:
        require("openpyxl", "an Excel workbook")
    except MissingExtraError as error:
        raise MissingExtraError(f"{error}; or save the first sheet as CSV") from None
    import openpyxl

    rows: list[TableRow] = []
    try:
        with warnings.catch_warnings(action="ignore"):  # of styles and extensions that it does not read
            book = openpyxl.load_workbook(io.BytesIO(content), read_only=True, data_only=True)
            sheet = book.worksheets[0]
            _check_shown(book.worksheets)
            sheet.reset_dimensions()  # as written in the file, which other programs set wrongly
            before = None
            for number, values in enumerate(sheet.iter_rows(max_col=MOST_COLUMNS, values_only=True), start=1):
                if values is before:  # a row that the file leaves out: there may be a million
                    continue
                before = values
                row = TableRow(number, tuple(map(_cell, values)), tuple(range(1, len(values) + 1)))
                filled = [cell for cell in row.cells if cell != ""]
                if not filled or (len(filled) == 1 and _COMMENT.match(str(filled[0]))):
                    continue
                rows.append(row)
                if number > most_lines:
                    break
            if len(book.sheetnames) > 1:
                assumed.append(f"sheet '{sheet.title}', the first of {len(book.sheetnames)}")
            if rows:
                _check_header(rows)
                with zipfile.ZipFile(io.BytesIO(content)) as archive, archive.open(sheet._worksheet_path) as stream:
                    _check_seen(stream, rows)
    except (UnreadableError, _RowError):
        raise
    except Exception as error:  # damaged workbooks raise arbitrary errors
        with zipfile.ZipFile(io.BytesIO(content)) as archive:
            charts = any(name.startswith("xl/chartsheets/") for name in archive.namelist())
        cause = "one of its sheets is a chart" if charts else type(error).__name__
        raise UnreadableError(
            f"is a workbook that can't be read ({cause}); save the sheet with the table as CSV"
        ) from None
    return rows


def _check_shown(sheets: Sequence[Any]) -> None:
    """Refuse a hidden first sheet.

    Raises:
        UnreadableError: it is hidden.
    """
    hidden = [f"'{sheet.title}'" for sheet in sheets if sheet.sheet_state != "visible"]
    shown = [f"'{sheet.title}'" for sheet in sheets if sheet.sheet_state == "visible"]
    if sheets[0].sheet_state != "visible":
        others = f"shown: {', '.join(shown)}" if shown else "no sheet is shown"
        raise UnreadableError(
            f"its first sheet is hidden ({', '.join(hidden)}; {others}); move the sheet with the table to the front"
        )


def _check_seen(stream: IO[bytes], rows: Sequence[TableRow]) -> None:
    """Refuse cells that a person does not see, or that have no value of their own.

    Args:
        stream: XML of the sheet.
        rows: with values.

    Raises:
        _RowError: rows or columns are hidden, cells are merged, or formulas have no stored value; one error for all.
    """
    from openpyxl.utils import get_column_letter, range_boundaries

    lines = {row.line: row for row in rows}
    width = max(i + 1 for i, cell in enumerate(rows[0].cells) if cell != "")
    hidden: list[str] = []
    formulas: list[str] = []
    columns: list[str] = []
    merged: list[str] = []
    places: list[int] = []
    for _, element in ElementTree.iterparse(stream):
        match element.tag.rpartition("}")[2]:
            case "col" if _hides(element, "width"):
                for i in range(int(element.get("min", 1)), min(int(element.get("max", 1)), width) + 1):
                    if any(i <= len(row.cells) and row.cells[i - 1] != "" for row in rows):
                        columns.append(get_column_letter(i))
            case "c":
                # an empty text is a result, too: t="str"
                if element.find("{*}f") is not None and element.get("t") != "str" and not element.findtext("{*}v"):
                    formulas.append(element.get("r", "?"))
            case "row":
                number = element.get("r", "")
                if _hides(element, "ht") and number.isdecimal() and int(number) in lines:
                    hidden.append(number)
                    places.append(int(number))
                element.clear()
            case "mergeCell":
                left, top, _, bottom = range_boundaries(element.get("ref", ""))
                if left <= width and any(line in lines for line in range(top, min(bottom, rows[-1].line) + 1)):
                    merged.append(element.get("ref", ""))

    def refused(cells: list[str], subject: str, message: str, row: TableRow = rows[0]) -> None:
        if cells:
            names = ", ".join(cells[:8]) + (f" and {len(cells) - 8} more" if len(cells) > 8 else "")
            raise _RowError(f"{subject}{'s' * (len(cells) > 1)} {names} {message}", row)

    verb = "are" if len(hidden) > 1 or len(columns) > 1 else "is"
    text = f"{verb} hidden, by hand or by a filter; show what belongs to the table, and delete the others"
    refused(hidden, "row", text, lines[places[0]] if places else rows[0])
    refused(columns, "column", text)
    verb = "have" if len(merged) > 1 else "has"
    text = f"{verb} a value in the first cell only; unmerge the cells, and give every row its values"
    refused(merged, "merged range", text)
    refused(
        formulas,
        "cell",
        "with a formula but no stored value; open the workbook in a spreadsheet program and save it, or save it as CSV",
    )


def _hides(element: ElementTree.Element, size: str) -> bool:
    """Whether a row or column is hidden, also by a height or width of 0."""
    return element.get("hidden") in ("1", "true") or element.get(size) == "0"


def _cell(value: object) -> Cell:
    if value is None:
        return ""
    if isinstance(value, int | float) and not isinstance(value, bool):
        return float(value)
    return _clean(str(value))


# -- text --------------------------------------------------------------------------------------------------------------


def _clean(text: str) -> str:
    return text.strip().strip(_INVISIBLE).strip().replace("−", "-").replace("–", "-")


def _text_rows(text: str, assumed: list[str]) -> list[TableRow]:
    """Rows of a text that have a value.

    Raises:
        UnreadableError, _RowError: it is not CSV.
    """
    lines = list(io.StringIO(text, newline=""))
    begin, separator = 0, ""
    if lines and (stated := _SEPARATOR_LINE.fullmatch(lines[0])):
        begin, separator = 1, stated[1]
    comments = [i for i in range(begin, len(lines)) if _COMMENT.match(lines[i].lstrip())]
    without = set(comments)
    filled = [i for i in range(begin, len(lines)) if i not in without and _clean(lines[i])]
    if not filled:
        return []
    header = filled[0]
    before = [i for i in comments if i < header]
    if before and any(plain_number(cell.strip()) for cell in re.split(r"[;,\t]", lines[header])):
        # numpy.savetxt writes the header as a comment
        commented = lines[before[-1]].lstrip().lstrip("#").lstrip(" ")
        if _number_of_cells(commented, lines[header]):
            header = before[-1]
            lines[header] = commented
            filled.insert(0, header)
            comments.remove(header)
            assumed.append(f"the header of the comment in line {header + 1}")
    if not separator:
        top = _top_of_table([lines[i] for i in filled[:TITLE_LINES]])
        separator = _separator(lines[filled[top]], lines[filled[top + 1]] if len(filled) > top + 1 else "")
    if not separator:
        words = len(lines[header].split())
        if words > 1 and len(filled) > 1 and words == len(lines[filled[1]].split()):
            message = "cells are separated by spaces; save it with commas, semicolons or tabs"
            raise _RowError(message, TableRow(header + 1, (), (), lines[header]))
        if any(separator in cell for cell in _cells(lines[header], ",") for separator in SEPARATORS):
            message = "the whole line is one cell in quotes; save the table again, without quotes around the lines"
            raise _RowError(message, TableRow(header + 1, (), (), lines[header]))
    if separator not in ("", ","):
        assumed.append(f"{SEPARATORS.get(separator, repr(separator))} between cells")
    if comments:
        assumed.append(f"{len(comments)} comment line{'s' * (len(comments) > 1)} left out")
    return list(_parsed(lines, filled, separator or ","))


def _number_of_cells(header: str, row: str) -> bool:
    """Whether a header and a row have the same number of cells, in any dialect."""
    separator = _separator(header, row)
    return bool(separator) and len(_cells(header, separator)) == len(_cells(row, separator))


def _top_of_table(lines: Sequence[str]) -> int:
    """Position of the first line that has as many cells as the next one, and more than any line before; 0 if none."""
    pairs = [
        [(len(_cells(line, separator)), len(_cells(after, separator))) for separator in SEPARATORS]
        for line, after in itertools.pairwise(lines)
    ]
    first = max((count for count, _ in pairs[0]), default=0) if pairs else 0
    for k, counts in enumerate(pairs):
        if any(count == after and count > (first if k else 1) for count, after in counts):
            return k
    return 0


def _cells(line: str, separator: str) -> list[str]:
    try:
        return next(csv.reader([line], delimiter=separator), [])
    except csv.Error:
        return []


def _separator(header: str, row: str) -> str:
    """The character between the cells; '' if there is only one."""
    several = [separator for separator in SEPARATORS if len(_cells(header, separator)) > 1]
    for separator in several:
        others = [other for other in SEPARATORS if other != separator]
        if not any(other in cell.strip() for cell in _cells(header, separator) for other in others):
            return separator
    agreeing = [separator for separator in several if len(_cells(header, separator)) == len(_cells(row, separator))]
    return next(iter(agreeing or several), "")


def _parsed(lines: list[str], filled: list[int], separator: str) -> Iterator[TableRow]:
    number = 0

    def texts() -> Iterator[str]:
        nonlocal number
        for number in filled:
            yield lines[number]

    reader = csv.reader(texts(), delimiter=separator)
    while True:
        try:
            cells = next(reader, None)
        except csv.Error as error:
            row = TableRow(number + 1, (), (), "")
            raise _RowError(f"is not CSV: {error}; is a quote still open?", row) from None
        if cells is None:
            return
        starts, at = [], 1
        for cell in cells:
            starts.append(at)
            at += len(cell) + 1
        row = TableRow(number + 1, tuple(map(_clean, cells)), tuple(starts), lines[number])
        if not row.empty:
            yield row


# -- header ------------------------------------------------------------------------------------------------------------


def _check_header(rows: Sequence[TableRow]) -> None:
    """Refuse titles above the header, and units below it.

    Raises:
        _RowError: there is such a line.
    """

    def words(row: TableRow) -> list[str]:
        """The filled cells of a row; none if one of them is a number."""
        filled = [cell for cell in row.cells if cell != ""]
        texts = [cell for cell in filled if isinstance(cell, str)]
        numbers = len(texts) < len(filled) or any(decimals_of(text) or plain_number(text) for text in texts)
        return [] if numbers else texts

    titles = sum(cell != "" for cell in rows[0].cells)
    for row in rows[1:TITLE_LINES]:
        if len(words(row)) > max(titles, 1):
            text = f"stands above the header, which is in line {row.line}; remove the lines before that"
            raise _RowError(f"{text}, or begin them with '#'", rows[0])
    second = words(rows[1]) if len(rows) > 1 else []
    units = [text for text in second if is_unit(text.strip("[]() "))]
    if units and 2 * len(units) >= len(second):
        index = rows[1].cells.index(units[0])
        name = str(rows[0].cells[index]) if index < len(rows[0].cells) else ""
        name = re.split(r"\s*[\[(]", name)[0]
        example = f"'{name} [{units[0].strip('[]() ')}]'"
        text = f"has the units of the columns; write them in the header, such as {example}, and remove this line"
        raise _RowError(text, rows[1])


def is_unit(text: str) -> bool:
    """Whether a text is a unit of any kind."""
    try:
        parse_unit(text, "1", "1")
    except QuantityError as error:
        return not str(error).startswith(("unknown unit", "a text of"))  # the second: too long for any unit
    return True


# -- columns and numbers -----------------------------------------------------------------------------------------------


def _without_unnamed(table: SavedTable) -> SavedTable:
    """The table without empty columns, and without row numbers that have no name.

    Raises:
        _RowError: another column has values and no name.
    """
    header = table.header
    width = max(len(row.cells) for row in (header, *table.rows))
    dropped: list[int] = []
    numbered: list[int] = []
    for index in range(width):
        inside = index < len(header.cells)
        if inside and not _UNNAMED.fullmatch(str(header.cells[index])):
            continue
        values = [row.cells[index] for row in table.rows if index < len(row.cells)]
        if not any(value != "" for value in values):
            dropped.append(index)
        elif inside and _is_index(values) and len(values) == len(table.rows):
            dropped.append(index)
            numbered.append(index + 1)
        elif inside:
            raise _RowError(f"column {index + 1} has values and no name; name it, or remove it", header, index)

    if numbered:
        columns = f"column{'s' * (len(numbered) > 1)} {' and '.join(map(str, numbered))}"
        table.assumed.append(f"{columns} without a name taken for row numbers")
    last = len(header.cells)

    def reduced(row: TableRow) -> TableRow:
        filled = max((i for i, cell in enumerate(row.cells) if cell != ""), default=-1) + 1
        used = [i for i in range(len(row.cells)) if i not in dropped and i < max(last, filled)]
        cells, starts = tuple(row.cells[i] for i in used), tuple(row.starts[i] for i in used)
        return TableRow(row.line, cells, starts, row.source)

    table.header, table.rows = reduced(header), [reduced(row) for row in table.rows]
    return table


def _is_index(values: Sequence[Cell]) -> bool:
    """Whether values are increasing whole numbers, as row numbers are, also after rows were removed."""
    numbers = []
    for value in values:
        if not re.fullmatch(r"[0-9]{1,9}(\.0)?", str(value)):
            return False
        numbers.append(float(value))
    return all(a < b for a, b in itertools.pairwise(numbers))


def _find_decimals(table: SavedTable) -> None:
    """Set `decimal_comma`.

    Raises:
        _RowError: the numbers can be read in two ways.
    """
    first: dict[str, tuple[TableRow, int]] = {}
    for row in table.rows:
        for index, cell in enumerate(row.cells):
            if isinstance(cell, str) and (kind := decimals_of(cell)):
                first.setdefault(kind, (row, index))

    def refused(kind: str, message: str) -> _RowError:
        row, index = first[kind]
        name = str(table.header.cells[index]) if index < len(table.header.cells) else ""
        return _RowError(message, row, index, name)

    def shown(kind: str) -> str:
        row, index = first[kind]
        return str(row.cells[index])

    if "," in first and "." in first:
        later = max(",.", key=lambda kind: first[kind][0].line)
        other = ",."[later == ","]
        text = f"{shown(later)!r} and {shown(other)!r} (line {first[other][0].line}) have different decimal signs"
        raise refused(later, f"{text}; save the table with decimal points")
    for weak, strong in ((",?", ","), (".?", ".")):
        doubtful = weak in first and strong not in first and (weak == ",?" or "," in first)
        if doubtful:
            readings = " or ".join(number_readings(shown(weak)))
            raise refused(weak, f"{shown(weak)!r} may be {readings}; write one of these")
    if "," in first:
        table.decimal_comma = True
        table.assumed.append("decimal commas")
    if "spaced" in first:
        table.assumed.append(f"{shown('spaced')!r} as one number")
