"""`saved_table`: tables of weighed pours as spreadsheet programs, pandas and numpy save them: read with a note, or
one clear error.

Every dialect holds the same pours. Sources of the dialects, all public reports of other programs:

- SheetJS/sheetjs#2239, Open-Systems-Pharmacology/MoBi#210: semicolons with decimal commas, as Excel saves in Europe
- jasp-stats/jasp-issues#3608: 0,435 and 1,286 in one column, read as 435 and 1286
- wligithub/tax-tool#16: U+202F between thousands in a French locale
- mui/mui-x#1656, ApamaCommunity/apama-log-analyzer#5: the line 'sep=,' before the header
- webyog/sqlyog-community#582: quoted numbers with decimal commas between commas
- pandas-dev/pandas#10670, #13017: a nameless index, after several rounds also 'Unnamed: 0'
- astropy/astropy#8674, pandas-dev/pandas#20378: numpy.savetxt's header in a comment
- NOAA-OWP/ngen#510: units in square or round brackets, with or without a space
- Unstructured-IO/unstructured#4443: Excel's 'Unicode text' is UTF-16 with tabs; ebranlard/pyDatView#196: a degree sign
  in one byte
- pandas-dev/pandas#42562, tidyverse/readxl#428: rows that a filter hides are read; pyexcel/pyexcel#21: hidden sheets
- felipe-prenholato/openpyxl#69: formulas of a workbook that a library wrote have no value
- tidyverse/readxl#355: of merged cells, the first alone has a value
- elixir-explorer/explorer#781, tidyverse/readr#179, pandas-dev/pandas#10898: titles above the header, units below it
- tafia/calamine#693, xberg-io/xberg#331: a workbook of 2 kB with a cell in the last row and column
"""

from __future__ import annotations

import io
import zipfile
from pathlib import Path

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from orchestrator.campaigns.campaign_checks import check_campaign
from orchestrator.campaigns.file_loading import load_campaign
from orchestrator.campaigns.pour_table import RecordTable, read_records
from orchestrator.campaigns.yaml.yaml_errors import ConfigError
from sim_engine import resources
from tests.support.campaign_files import CSV, RECORDED, report, write
from tests.support.hypothesis_examples import examples
from tests.support.workbooks import workbook

HEADER = "angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,split"
ROWS = ("20.5,95,180,4.25,20,train", "60,110,190,30,10,train", "80,120,200,50,0,test")
PLAIN = "\n".join([HEADER, *ROWS]) + "\n"
EUROPEAN = PLAIN.replace(",", ";").replace(".", ",")


def numbered(text: str, *names: str) -> str:
    """With columns of row numbers before the others."""
    first, *rest = text.splitlines()
    lines = [",".join([*names, first])]
    return "\n".join(lines + [",".join([*[str(i)] * len(names), line]) for i, line in enumerate(rest)]) + "\n"


def cells(text: str) -> list[list[str | float]]:
    table: list[list[str | float]] = [[*HEADER.split(",")]]
    for line in text.splitlines()[1:]:
        table.append([one if one.isalpha() else float(one) for one in line.split(",")])
    return table


def read(folder: Path, content: str | bytes, name: str = "pours.csv", **options: object) -> RecordTable:
    path = folder / name
    path.write_bytes(content.encode() if isinstance(content, str) else content)
    return read_records(path, loaded=0.2, **options)  # type: ignore[arg-type]


DIALECTS: dict[str, tuple[str | bytes, str]] = {
    "plain": (PLAIN, ""),
    "byte order mark and CRLF": (b"\xef\xbb\xbf" + PLAIN.replace("\n", "\r\n").encode(), ""),
    "line ends of an old Mac": (PLAIN.replace("\n", "\r"), ""),
    "Excel in Europe": (EUROPEAN, "pours.csv was read with semicolons between cells, decimal commas"),
    "semicolons and points": (PLAIN.replace(",", ";"), "semicolons between cells"),
    "tabs": (PLAIN.replace(",", "\t"), "tabs between cells"),
    "tabs and decimal commas": (EUROPEAN.replace(";", "\t"), "tabs between cells, decimal commas"),
    "Excel's Unicode text": (PLAIN.replace(",", "\t").encode("utf-16"), "text in UTF-16, tabs between cells"),
    "UTF-16, big-endian": (b"\xfe\xff" + PLAIN.encode("utf-16-be"), "text in UTF-16"),
    "quoted decimal commas": (PLAIN.replace("20.5", '"20,5"').replace("4.25", '"4,25"'), "decimal commas"),
    "stated separator": ("sep=;\n" + EUROPEAN, "semicolons between cells, decimal commas"),
    "stated comma": ("sep=,\r\n" + PLAIN, ""),
    "comments": ("# bench 2\n" + PLAIN.replace("60,110", "# new glass\n60,110"), "2 comment lines left out"),
    "pandas' index": (numbered(PLAIN, ""), "column 1 without a name taken for row numbers"),
    "pandas' index, twice": (numbered(PLAIN, "Unnamed: 0.1", "Unnamed: 0"), "columns 1 and 2 without a name taken"),
    "numbered in a column #": (numbered(PLAIN, "#"), "the header of the comment in line 1, column 1 without a name"),
    "numpy.savetxt": ("# " + PLAIN, "the header of the comment in line 1"),
    "empty columns and rows": (PLAIN.replace("\n", ",,\n") + ",,,,,,,\n\n", ""),
    "empty cells after rows": (PLAIN.replace("train\n", "train,\n"), ""),
    "square brackets": (PLAIN.replace("poured_g", "poured [g]").replace("max_angle_deg", "max_angle[deg]"), ""),
    "round brackets": (PLAIN.replace("angular_velocity_deg_s", "speed (deg/s)"), "'speed (deg/s)' as angular_velocity"),
    "words": (PLAIN.replace("max_angle_deg", "Max angle (deg)").replace("poured_g", "Poured (g)"), ""),
    "other units": (
        PLAIN.replace("retained_g", "retained (kg)").replace(",20,t", ",0.02,t").replace(",10,t", ",0.01,t"),
        "'retained (kg)' as retained_g",
    ),
    "unit after the name": (
        PLAIN.replace("spilled_g", "spilled_mg")
        .replace("4.25", "4250")
        .replace(",30,", ",30000,")
        .replace(",50,", ",50e3,"),
        "'spilled_mg' as spilled_g",
    ),
    "degree sign in one byte": (PLAIN.replace("angle_deg", "angle [°]").encode("cp1252"), "text in Windows-1252"),
    "minus and spaces": (PLAIN.replace(",0,test", ",\u2009−0.0\u00a0,test"), ""),
    "workbook": (workbook(cells(PLAIN)), ""),
    "workbook with row numbers": (
        workbook([["" if i == 0 else float(i), *row] for i, row in enumerate(cells(PLAIN))]),
        "column 1 without a name taken for row numbers",
    ),
    "workbook with several sheets": (
        workbook(cells(PLAIN), names=("Pours", "Notes")),
        "sheet 'Pours', the first of 2",
    ),
    "workbook with numbers as text": (
        workbook([["20,5" if cell == 20.5 else cell for cell in row] for row in cells(PLAIN)]),
        "decimal commas",
    ),
    "workbook with a cell at the end of the sheet": (
        workbook(cells(PLAIN), '<row r="1048576"><c r="XFD1048576"><v>1</v></c></row>'),
        "",
    ),
}


@pytest.mark.parametrize("dialect", DIALECTS, ids=lambda case: case.replace(" ", "-"))
def test_the_same_pours_are_read_from_every_dialect_with_a_note_on_what_was_assumed(dialect: str, folder: Path) -> None:
    content, assumed = DIALECTS[dialect]
    expected = read(folder, PLAIN)
    table = read(folder, content)
    assert table.problems == []
    assert [(row.poured, row.spilled, row.retained, row.split) for row in table.rows] == [
        (pytest.approx(row.poured), pytest.approx(row.spilled), pytest.approx(row.retained), row.split)
        for row in expected.rows
    ]
    assert [row.action for row in table.rows] == [pytest.approx(row.action) for row in expected.rows]
    assert assumed in table.assumed
    assert bool(table.assumed) == bool(assumed)


def test_plain_tables_give_the_numbers_bit_by_bit(folder: Path) -> None:
    """The fingerprints of runs depend on them."""
    row = read(folder, PLAIN).rows[0]
    assert (row.poured, row.spilled, row.retained) == (180 * 1e-3, 4.25 * 1e-3, 20 * 1e-3)
    assert row.action == {"angular_velocity": 20.5 * 0.017453292519943295, "max_angle": 95 * 0.017453292519943295}


def test_a_comma_is_a_decimal_sign_where_another_number_of_the_file_shows_it(folder: Path) -> None:
    lines = EUROPEAN.replace("4,25", "1,286").replace(";30;", ";0,435;").replace(";50;", ";0,118;")
    assert [row.spilled for row in read(folder, lines).rows] == pytest.approx([1.286e-3, 0.435e-3, 0.118e-3])


def test_thousands_that_a_space_separates_are_one_number(folder: Path) -> None:
    heavy = EUROPEAN.replace("180;4,25;20", "1\u202f180,5;4,25;19,5")
    path = write(folder, "pours.csv", "\n".join(heavy.splitlines()[:2]))
    table = read_records(path, loaded=1.2)
    assert [row.poured for row in table.rows] == pytest.approx([1.1805])
    assert "as one number" in table.assumed


def test_names_from_the_campaign_may_have_a_unit_in_the_file(folder: Path) -> None:
    text = PLAIN.replace("poured_g", "Weight (net)").replace("angular_velocity_deg_s", "v [rad/s]")
    text = text.replace("20.5,", "0.35,").replace("60,", "1.0,").replace("80,1", "1.4,1").replace("181.4,", "180,")
    columns = {"poured_g": "Weight (net)", "angular_velocity": "v"}
    table = read(folder, text, columns=columns)
    assert table.problems == []
    assert [row.action["angular_velocity"] for row in table.rows] == pytest.approx([0.35, 1.0, 1.4])


IN_DOUBT: dict[str, tuple[str | bytes, str]] = {
    "thousands or thousandths": (
        EUROPEAN.replace("20,5", "20").replace("4,25", "4,251"),
        "pours.csv:2:11: spilled_g: '4,251' may be 4.251 or 4251; write one of these",
    ),
    "quoted thousands": (PLAIN.replace("180", '"1,180"'), "poured_g: '1,180' may be 1.180 or 1180"),
    "points between decimal commas": (EUROPEAN.replace("180", "1.180"), "poured_g: '1.180' may be 1.180 or 1180"),
    "both signs": (
        EUROPEAN.replace("20,5", "20.5"),
        "pours.csv:2:13: spilled_g: '4,25' and '20.5' (line 2) have different decimal signs",
    ),
    "decimal commas between commas": (
        PLAIN.replace("20.5", "20,5"),
        "pours.csv:2:1: has 7 cells, the header 6; are there decimal commas? Then save it with semicolons or tabs",
    ),
    "values without a name": (numbered(PLAIN, "").replace("\n1,", "\n0,"), "pours.csv:1:1: column 1 has values and no"),
    "no header": (PLAIN.split("\n", 1)[1], "pours.csv:1:1: has no header"),
    "spaces": (PLAIN.replace(",", " "), "pours.csv:1:1: cells are separated by spaces; save it with commas"),
    "whole lines in quotes": (
        "\n".join(f'"{line}"' for line in PLAIN.splitlines()),
        "pours.csv:1:1: the whole line is one cell in quotes",
    ),
    "another quantity": (
        PLAIN.replace("poured_g", "poured [mm]"),
        "pours.csv:1:38: poured [mm]: the unit 'mm' is a length; should be a mass",
    ),
    "unknown unit": (PLAIN.replace("poured_g", "poured (gg)"), "poured (gg): unknown unit 'gg'; did you mean 'g'?"),
    "no unit": (PLAIN.replace("poured_g", "poured"), "poured: has no unit; write 'poured_g' or 'poured [g]'"),
    "two units": (PLAIN.replace("poured_g", "poured_g [kg]"), "poured_g [kg]: has two units"),
    "the same twice": (
        PLAIN.replace("spilled_g", "poured [kg]")
        .replace("retained_g", "spilled_g")
        .replace("split", "retained_g,split"),
        "poured [kg]: stands twice in the header (as 'poured_g')",
    ),
    "an error of the spreadsheet": (
        PLAIN.replace("20.5", "#DIV/0!"),
        "pours.csv:2:1: angular_velocity_deg_s: '#DIV/0!'",
    ),
    "UTF-16 without its mark": (PLAIN.encode("utf-16-le"), "pours.csv: is not text in UTF-8 (perhaps UTF-16"),
    "old Excel": (
        b"\xd0\xcf\x11\xe0\xa1\xb1\x1a\xe1" + bytes(500),
        "is an old Excel workbook (.xls), or one with a pass",
    ),
    "web page": (b"\xef\xbb\xbf<html><table><tr><td>1</td></tr></table></html>", "is a web page or XML, not a table"),
    "picture": (b"\x89PNG\r\n\x1a\n\0\0\0\rIHDR", "pours.csv: is not text (byte 0)"),
    "half a workbook": (workbook(cells(PLAIN))[:900], "is a damaged workbook or archive"),
    "broken sheet": (workbook(cells(PLAIN), "<row"), "is a workbook that can't be read (ParseError); save the sheet"),
    "number as text": (
        workbook([[*HEADER.split(",")], ["fast", 95.0, 180.0, 4.25, 20.0, "train"]]),
        "pours.csv:2:1: angular_velocity_deg_s: 'fast' is not a number",
    ),
    "a row far below": (
        workbook(cells(PLAIN), '<row r="1048576"><c r="A1048576"><v>1</v></c></row>'),
        "pours.csv:1048576:1: stands beyond line 20,000",
    ),
}


FORMULAS = [
    [f"=C{i}*1" if i > 1 and j == 4 else one for j, one in enumerate(row)] for i, row in enumerate(cells(PLAIN), 1)
]
MERGED = [["" if i in (2, 3) and j == 1 else one for j, one in enumerate(row)] for i, row in enumerate(cells(PLAIN))]
TITLED = [["Pours of Monday"], [], *cells(PLAIN)]

IN_DOUBT |= {
    "a hidden first sheet": (
        workbook(cells(PLAIN), names=("Old", "Pours"), hidden=["Old"]),
        "pours.csv: its first sheet is hidden ('Old'; shown: 'Pours'); move the sheet with the table to the front",
    ),
    "hidden rows": (
        workbook(cells(PLAIN), hidden=["2", "4"]),
        "pours.csv:2:1: rows 2, 4 are hidden, by hand or by a filter; show what belongs to the table, and delete",
    ),
    "a row of no height": (
        workbook(cells(PLAIN), '<row r="9" ht="0" customHeight="1"><c r="A9"><v>1</v></c></row>'),
        "pours.csv:9:1: row 9 is hidden",
    ),
    "a hidden column": (
        workbook(cells(PLAIN), columns='<cols><col min="5" max="16384" width="0" hidden="1"/></cols>'),
        "pours.csv:1:1: columns E, F are hidden, by hand or by a filter",
    ),
    "merged cells": (
        workbook(MERGED, after='<mergeCells count="1"><mergeCell ref="B2:B4"/></mergeCells>'),
        "pours.csv:1:1: merged range B2:B4 has a value in the first cell only; unmerge the cells",
    ),
    "merged cells, saved as text": (
        PLAIN.replace("60,110", "60,").replace("80,120", "80,"),
        "pours.csv:3:4: max_angle_deg: is empty in 2 lines (3, 4); a merged cell has its value in the first line only",
    ),
    "formulas without a value": (
        workbook(FORMULAS),
        "pours.csv:1:1: cells E2, E3, E4 with a formula but no stored value; open the workbook in a spreadsheet",
    ),
    "a title": (
        "Pours of Monday, bench 2\n\n" + EUROPEAN,
        "pours.csv:1:1: stands above the header, which is in line 3; remove the lines before that, or begin them with",
    ),
    "a title in a workbook": (
        workbook(TITLED, after='<mergeCells count="1"><mergeCell ref="A1:F1"/></mergeCells>'),
        "pours.csv:1:1: stands above the header, which is in line 3",
    ),
    "a title, names, and units of a data logger": (
        '"TOA5","CR3000","CPU:pours","24006"\n' + PLAIN,
        "pours.csv:1:1: stands above the header, which is in line 2",
    ),
    "units below names": (
        "\n".join(["speed,angle,poured,spilled,retained,split", "deg/s,deg,g,g,g,", *ROWS]),
        "pours.csv:2:1: has the units of the columns; write them in the header, such as 'speed [deg/s]', and remove",
    ),
    "units in brackets below names with units": (
        "\n".join([HEADER, "", "[deg/s],[deg],[g],[g],[g],-", *ROWS]),
        "pours.csv:3:1: has the units of the columns; write them in the header",
    ),
}


@pytest.mark.parametrize("case", IN_DOUBT, ids=lambda case: case.replace(" ", "-"))
def test_a_table_in_doubt_is_refused_with_one_error(case: str, folder: Path) -> None:
    content, expected = IN_DOUBT[case]
    (folder / "pours.csv").write_bytes(content.encode() if isinstance(content, str) else content)
    # Without x_offset in the campaign: the table would give it, if it could be read.
    path = write(folder, "bad.yaml", RECORDED.replace("x_offset: 84 mm, ", ""))
    told = report(path)
    assert expected in told
    assert told.count("pours.csv:") + told.count("bad.yaml:") == 1, "one cause, one message"


def test_what_is_hidden_beside_the_table_is_no_part_of_it(folder: Path) -> None:
    content = workbook(
        [*cells(PLAIN), [], ["", "", "", "", "", "", "", ""]],
        names=("Pours", "Lists"),
        hidden=["Lists", "5", "6"],
        columns='<cols><col min="9" max="16384" hidden="1"/></cols>',
        after='<autoFilter ref="A1:F4"><filterColumn colId="0"><filters blank="1"/></filterColumn></autoFilter>'
        '<mergeCells count="1"><mergeCell ref="J8:K9"/></mergeCells>',
    )
    table = read(folder, content)
    assert table.problems == []
    assert len(table.rows) == 3


def test_a_formula_whose_result_is_an_empty_text_is_an_empty_cell(folder: Path) -> None:
    more = '<row r="5"><c r="A5" t="str"><f>IF(B5="","",1)</f><v></v></c></row>'
    assert len(read(folder, workbook(cells(PLAIN), more)).rows) == 3


def other_workbook(*names: str) -> bytes:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w") as archive:
        for name in names:
            archive.writestr(name, "x")
    return content.getvalue()


@pytest.mark.parametrize(
    ("names", "expected"),
    [
        (("mimetype", "content.xml"), "is a workbook of LibreOffice (.ods); save it as .xlsx or CSV"),
        (("xl/workbook.bin",), "is a binary Excel workbook (.xlsb); save it as .xlsx or CSV"),
        (("Index/Document.iwa", "preview.jpg"), "is a workbook of Numbers; export it as .xlsx or CSV"),
        (("pours.csv",), "is an archive, not a table; save the table as CSV"),
    ],
)
def test_other_workbooks_are_refused_by_name(names: tuple[str, ...], expected: str, folder: Path) -> None:
    (problem,) = read(folder, other_workbook(*names)).problems
    assert problem.message == expected


def test_a_workbook_without_its_reader_says_what_to_install_or_save(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(resources, "installed", lambda module: module != "openpyxl")
    (problem,) = read(folder, workbook(cells(PLAIN)), "pours.xlsx").problems
    assert str(problem).endswith(
        "pours.xlsx: an Excel workbook needs the package 'openpyxl', which is not installed: "
        "pip install 'decant-pouring[excel]'; or save the first sheet as CSV"
    )


def test_a_workbook_that_unpacks_to_far_more_is_refused_before_it_is_read(folder: Path) -> None:
    content = io.BytesIO()
    with zipfile.ZipFile(content, "w", zipfile.ZIP_DEFLATED) as archive:
        archive.writestr("xl/workbook.xml", bytes(30_000_000))
    (problem,) = read(folder, content.getvalue()).problems
    assert problem.message == "has 30 MB unpacked, and 20 MB are read at most"


def test_validate_and_run_show_what_was_assumed(folder: Path) -> None:
    (folder / "pours.csv").write_text(CSV.replace(",", ";"), encoding="utf-8")
    shown: list[str] = []
    plan = load_campaign(write(folder, "recorded.yaml", RECORDED))
    check_campaign(plan, warn=lambda problem: shown.append(str(problem).splitlines()[0]))
    (note,) = [text for text in shown if "pours.csv" in text]
    assert "recorded.yaml:12:17: calibration.pours.from: pours.csv was read with semicolons between cells" in note


# -- after an error, nothing that only follows from it -----------------------------------------------------------------


@pytest.mark.parametrize(
    ("old", "new", "expected"),
    [
        ("pours.csv", "absent.csv", "calibration.pours.from: no such file"),
        ("{from:", "{form:", "calibration.pours.form: unknown key"),
        ("mass: 200 g", "mass: 200", "liquid.mass: 200 has no unit"),
        ("[15 deg/s,", "[15 deg,", "calibration.actions.angular_velocity[0]: '15 deg' is an angle"),
    ],
)
def test_nothing_follows_from_a_table_that_could_not_be_used(old: str, new: str, expected: str, folder: Path) -> None:
    first, *rest = CSV.splitlines()
    write(folder, "pours.csv", "\n".join([f"x_offset_mm,{first}", *[f"84,{line}" for line in rest]]))
    good = RECORDED.replace("x_offset: 84 mm, ", "")
    load_campaign(write(folder, "good.yaml", good))
    told = report(write(folder, "bad.yaml", good.replace(old, new, 1)))
    assert expected in told
    assert told.count("bad.yaml:") == 1, "one cause, one message"


# -- anything at all ---------------------------------------------------------------------------------------------------


def problems_of(folder: Path, content: bytes) -> int:
    table = read(folder, content)
    str(ConfigError(table.problems))
    return len(table.problems)


@given(content=st.binary(max_size=300))
@example(content=b"sep=;\n1;2")
@example(content=b"\xff\xfe")
@example(content=b"\xfe\xff\xd8\x00")
@example(content=b'"')
@example(content=b"#\n1")
@example(content=b"PK\x05\x06" + bytes(18))
@settings(max_examples=examples(200))
def test_no_bytes_end_in_a_traceback(content: bytes, tmp_path_factory: pytest.TempPathFactory) -> None:
    assert problems_of(tmp_path_factory.getbasetemp(), content) > 0


CELLS = st.one_of(
    st.sampled_from(["", " ", '"', "#", "1,234", "1.234,5", "−3", "1e999", "\u202f", "nan", "4,25", "train", "0", "'"]),
    st.sampled_from(
        [*HEADER.split(","), "poured [g]", "spilled (kg)", "speed (deg/s)", "Unnamed: 0", "poured [", "[g]"]
    ),
    st.floats(-1e4, 1e4).map(lambda value: f"{value:.3f}"),
    st.text(max_size=8),
)


@given(
    rows=st.lists(st.lists(CELLS, max_size=8), max_size=6),
    separator=st.sampled_from([",", ";", "\t", " ", "|", ", ", "; "]),
    end=st.sampled_from(["\n", "\r\n", "\r", "\n\n"]),
    start=st.sampled_from(["", HEADER + "\n", HEADER.replace(",", ";") + "\n", "sep=;\n", "# comment\n", "\ufeff"]),
    encoding=st.sampled_from(["utf-8", "utf-16", "cp1252"]),
)
@settings(max_examples=examples(240))
def test_no_dialect_ends_in_a_traceback(
    rows: list[list[str]], separator: str, end: str, start: str, encoding: str, tmp_path_factory: pytest.TempPathFactory
) -> None:
    text = start + end.join(separator.join(row) for row in rows)
    problems_of(tmp_path_factory.getbasetemp(), text.encode(encoding, errors="replace"))


@given(position=st.integers(0, 5000), value=st.integers(0, 255))
@settings(max_examples=examples(80))
def test_no_damaged_workbook_ends_in_a_traceback(
    position: int, value: int, tmp_path_factory: pytest.TempPathFactory
) -> None:
    content = bytearray(workbook(cells(PLAIN)))
    content[position % len(content)] = value
    problems_of(tmp_path_factory.getbasetemp(), bytes(content))


NOTEBOOK = """\
pour no.,date,angular_velocity_deg_s,max_angle_deg,poured_g,spilled_g,retained_g,remarks
1,2026-11-20,20,95,180,4,20,
2,2026-11-20,60,110,190,30,10,glass was wet
3,2026-11-21,80,120,199,50,1,
4,2026-11-21,40,118,198,21,2,"slow, by hand"
"""


def test_columns_of_a_notebook_are_remarks_that_are_listed(tmp_path: Path) -> None:
    table = read(tmp_path, NOTEBOOK.replace("remarks", "remarks,split").replace("\n", ",train\n").replace(
        "remarks,split,train", "remarks,split"))  # fmt: skip
    assert not table.problems
    assert "columns 'pour no.', 'date', 'remarks' read as remarks" in table.assumed
    assert table.rows[1].remarks == {"pour no.": "2", "date": "2026-11-20", "remarks": "glass was wet"}
    assert table.rows[1].pour({"height": 0.08, "x_offset": 0.1}).remarks["remarks"] == "glass was wet"


def test_a_long_text_below_a_name_is_no_unit(tmp_path: Path) -> None:
    """The title page of a thesis, saved as a workbook."""
    page = "TITLE\nVision-based robot manipulation of transparent liquid containers in a laboratory\n"
    assert "column 'poured_g' is missing (not recognised: 'TITLE')" in str(read(tmp_path, page).problems[0])


def test_the_time_of_day_of_a_notebook_is_no_misspelt_hold_time(tmp_path: Path) -> None:
    table = read(
        tmp_path, NOTEBOOK.replace("date", "Time").replace("2026-11-20", "10:15").replace("2026-11-21", "9:02 pm")
    )
    assert "columns 'pour no.', 'Time', 'remarks' read as remarks" in table.assumed
    (problem,) = read(tmp_path, NOTEBOOK.replace("date", "Time").replace("2026-11-2", "")).problems
    assert "Time: unknown column; did you mean 'hold_time_s'?" in str(problem)


def test_a_table_without_splits_keeps_pours_for_testing_and_names_them(tmp_path: Path) -> None:
    table = read(tmp_path, NOTEBOOK, holdout=2)
    assert [row.split for row in table.rows] == ["train", "test", "train", "test"]
    assert "no column 'split': lines 3, 5 kept for testing" in table.assumed
    assert [row.split for row in read(tmp_path, NOTEBOOK).rows].count("test") == 1, "an eighth, at least one"
    (problem,) = read(tmp_path, NOTEBOOK, holdout=4).problems
    assert "none is left to fit" in str(problem)
    (problem,) = read(tmp_path, PLAIN, holdout=1).problems
    assert "has a column 'split'" in str(problem)
    (problem,) = read(tmp_path, NOTEBOOK.splitlines()[0] + "\n", holdout=2).problems
    assert "has a header and no pour below it" in str(problem)


def test_a_misspelt_column_is_no_remark(tmp_path: Path) -> None:
    (problem,) = read(tmp_path, NOTEBOOK.replace("spilled_g", "spiled_g")).problems
    assert "did you mean 'spilled_g'" in str(problem)
    (problem,) = read(tmp_path, NOTEBOOK.replace("spilled_g", "lost")).problems
    assert "column 'spilled_g' is missing (not recognised: 'pour no.', 'date', 'lost', 'remarks')" in str(problem)


def test_a_doubled_line_is_named_and_a_pour_does_not_test_itself(tmp_path: Path) -> None:
    assert "lines 2, 5 have the same numbers" in read(tmp_path, PLAIN + ROWS[0] + "\n").assumed
    (problem,) = read(tmp_path, PLAIN + ROWS[0].replace("train", "test") + "\n").problems
    assert "lines 2, 5 have the same numbers and the splits test and train" in str(problem)
    numbered_twice = NOTEBOOK + NOTEBOOK.splitlines()[2].replace("2,", "5,", 1) + "\n"
    assert "lines 3, 6 have the same numbers" in read(tmp_path, numbered_twice).assumed


def test_pours_that_contradict_each_other_are_named_before_any_simulation(tmp_path: Path) -> None:
    swapped = PLAIN.replace("180,4.25,20", "200,4.25,0").replace("200,50,0", "130,50,70")
    assert "line 4 was tilted farther than line 2, and more stayed in the pourer (70 g, 0 g)" in read(
        tmp_path, swapped
    ).assumed  # fmt: skip
    again = PLAIN + "60,110,190,110,10,train\n"
    assert "lines 3 and 5 have the same action and spilled 15.8 % and 57.9 %" in read(tmp_path, again).assumed
    assert not read(tmp_path, PLAIN).assumed


def test_a_chart_as_a_sheet_of_its_own_is_named(tmp_path: Path) -> None:
    """pandas-dev/pandas#41448, saulpw/visidata#797: AttributeError instead of a reason."""
    content = (Path(__file__).parents[2] / "data" / "tables" / "chartsheet_first.xlsx").read_bytes()
    (problem,) = read(tmp_path, content, "pours.xlsx").problems
    assert "one of its sheets is a chart" in str(problem)


def test_several_merged_ranges_are_named_in_the_plural(tmp_path: Path) -> None:
    ranges = '<mergeCells count="2"><mergeCell ref="B2:B3"/><mergeCell ref="C2:C3"/></mergeCells>'
    content = workbook(cells(PLAIN), after=ranges)
    (problem,) = read(tmp_path, content, "pours.xlsx").problems
    assert "merged ranges B2:B3, C2:C3 have a value" in str(problem)
