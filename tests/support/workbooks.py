"""Workbooks as Excel writes them, with the parts that a reader needs; no library of the product writes them here."""

from __future__ import annotations

import io
import zipfile
from collections.abc import Collection, Sequence

_MAIN = "http://schemas.openxmlformats.org/spreadsheetml/2006/main"
_OFFICE = "http://schemas.openxmlformats.org/officeDocument/2006/relationships"
_PACKAGE = "http://schemas.openxmlformats.org/package/2006"
_TYPE = "application/vnd.openxmlformats-officedocument.spreadsheetml"


def workbook(
    rows: Sequence[Sequence[str | float]],
    more: str = "",
    names: Sequence[str] = ("Pours",),
    *,
    hidden: Collection[str] = (),
    columns: str = "",
    after: str = "",
) -> bytes:
    """An .xlsx file.

    Args:
        rows: rows of the first sheet, in columns A to Z; '' for an empty cell, a formula without a value from '='.
        more: further XML of the first sheet's data.
        names: names of the sheets; all but the first are empty.
        hidden: numbers of rows and names of sheets that are hidden.
        columns, after: XML before and after the data of the first sheet.
    """
    strings: list[str] = []

    def cell(reference: str, value: str | float) -> str:
        if isinstance(value, str) and value.startswith("="):
            return f'<c r="{reference}"><f>{value[1:]}</f><v/></c>'
        if isinstance(value, str):
            strings.append(value)
            return f'<c r="{reference}" t="s"><v>{len(strings) - 1}</v></c>'
        return f'<c r="{reference}"><v>{value:.17g}</v></c>'

    data = "".join(
        f'<row r="{i}"{" hidden=" + chr(34) + "1" + chr(34) if str(i) in hidden else ""}>'
        + "".join(cell(f"{chr(65 + j)}{i}", one) for j, one in enumerate(row) if one != "")
        + "</row>"
        for i, row in enumerate(rows, start=1)
    )
    numbers = range(1, len(names) + 1)
    parts = {
        "[Content_Types].xml": f'<Types xmlns="{_PACKAGE}/content-types">'
        '<Default Extension="rels" ContentType="application/vnd.openxmlformats-package.relationships+xml"/>'
        f'<Override PartName="/xl/workbook.xml" ContentType="{_TYPE}.sheet.main+xml"/>'
        f'<Override PartName="/xl/sharedStrings.xml" ContentType="{_TYPE}.sharedStrings+xml"/>'
        + "".join(
            f'<Override PartName="/xl/worksheets/sheet{n}.xml" ContentType="{_TYPE}.worksheet+xml"/>' for n in numbers
        )
        + "</Types>",
        "_rels/.rels": f'<Relationships xmlns="{_PACKAGE}/relationships">'
        f'<Relationship Id="rId1" Type="{_OFFICE}/officeDocument" Target="xl/workbook.xml"/></Relationships>',
        "xl/workbook.xml": f'<workbook xmlns="{_MAIN}" xmlns:r="{_OFFICE}"><sheets>'
        + "".join(
            f'<sheet name="{name}" sheetId="{n}" {"state=" + chr(34) + "hidden" + chr(34) if name in hidden else ""} '
            f'r:id="rId{n}"/>'
            for n, name in zip(numbers, names, strict=True)
        )
        + "</sheets></workbook>",
        "xl/_rels/workbook.xml.rels": f'<Relationships xmlns="{_PACKAGE}/relationships">'
        + "".join(
            f'<Relationship Id="rId{n}" Type="{_OFFICE}/worksheet" Target="worksheets/sheet{n}.xml"/>' for n in numbers
        )
        + f'<Relationship Id="rId99" Type="{_OFFICE}/sharedStrings" Target="sharedStrings.xml"/></Relationships>',
        "xl/sharedStrings.xml": f'<sst xmlns="{_MAIN}">'
        + "".join(f"<si><t>{text}</t></si>" for text in strings)
        + "</sst>",
        **{
            f"xl/worksheets/sheet{n}.xml": f'<worksheet xmlns="{_MAIN}">'
            + (f"{columns}<sheetData>{data}{more}</sheetData>{after}" if n == 1 else "<sheetData/>")
            + "</worksheet>"
            for n in numbers
        },
    }
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, text in parts.items():
            archive.writestr(name, f'<?xml version="1.0" encoding="UTF-8"?>{text}')
    return content.getvalue()
