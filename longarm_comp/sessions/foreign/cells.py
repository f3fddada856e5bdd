"""Reads the cells of a text table or XLSX sheet; finds its separator, header and decimal sign.

pandas and openpyxl parse the file. This module only decides what is a header, a number, a column.
"""

import csv
import io
import re
import zipfile
from collections import Counter
from collections.abc import Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_size, check_unpacked
from longarm_comp.sessions.foreign.units import split_name, unit_of
from longarm_comp.sessions.table import check_cells

WORKBOOK = (".xlsx", ".xlsm")
_SEPARATORS = (r"\t", ";", ",", r"\|", r"\s{2,}|\t", r"\s+")
_POINT = re.compile(r"[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?")
_COMMA = re.compile(r"[-+]?(\d+,?\d*|,\d+)([eE][-+]?\d+)?")
_DATED = re.compile(r"\d{1,4}[-./]\d{1,2}[-./]\d{2,4}|\d:\d\d")
_NONE = {"", "nan", "n/a", "na", "#n/a", "-", "--", "null", "none"}
_REMARK = re.compile(r"^\s*(?:#+|%+|//)\s*(?=[^\s,;|#%])")
"""Comment sign of NumPy, MATLAB or C at the start of a line; a cell ``#`` is a column's name."""
_CELLS = re.compile(r"[\s,;|]+")
_JSON = re.compile(rb"\s*(\{|\[\s*[\[{\"\d-])")
_OTHER_FILES = (
    (re.compile(rb"MATLAB 5\.0|\x89HDF"), "MAT", "CSV: in MATLAB writematrix([q tip], 'log.csv')"),
    (re.compile(rb"\x93NUMPY|PK\x03\x04"), "NPY or ZIP", "CSV: numpy.savetxt('log.csv', rows)"),
    (_JSON, "JSON", "CSV: in Python pandas.read_json('log.json').to_csv('log.csv', index=False)"),
    (re.compile(rb"SQLite format 3|\x89MCAP|#ROSBAG"), "a bag", "longarm bag to-csv ARM BAG"),
    (re.compile(rb"\xd0\xcf\x11\xe0"), "XLS", "XLSX: save it as such"),
)
"""First bytes of files that are not tables, their kind, and how to export a table from them."""
_HEADER_LINES = 12
"""Lines from the first line of numbers (ids, channels) on in which a header line may stand."""


@dataclass(frozen=True)
class Cells:
    """A table of another program: its cells as text, and how they were found in the file."""

    where: str
    names: tuple[str, ...]
    """Names of the columns: header lines are joined, and a line of units is put behind them."""
    rows: tuple[tuple[int, tuple[str, ...]], ...]  # (line in the file, cells) of each row
    separator: str  # between cells; empty for a sheet
    decimal: str  # the sign before decimals
    header_lines: tuple[int, ...]  # lines in the file that the names were made of
    index: tuple[int, ...] = ()
    """Number of each row in the session, where the rows do not simply follow each other."""

    @property
    def breaks(self) -> list[int]:
        """Places of the rows with which further files begin."""
        return (1 + np.flatnonzero(np.diff(self.index) > 1)).tolist()

    def column(self, place: int) -> list[str]:
        return [row[place] for _, row in self.rows]

    def place(self, key: str, field: str) -> int:
        """Return the index of a column by its name: whole, without unit, or without heading.

        Raises:
            InputError: no column has this name, or several have. It names the option ``field``.
        """
        stems = [split_name(name)[0] for name in self.names]
        for called in (
            lambda name, stem: name == key,
            lambda name, stem: stem == key,
            lambda name, stem: f" {name}".endswith(f" {key}") or f" {stem}".endswith(f" {key}"),
        ):
            pairs = enumerate(zip(self.names, stems, strict=True))
            found = [k for k, pair in pairs if called(*pair)]
            if found:
                break
        if len(found) != 1:
            raise InputError(self.where, field, key, f"one column of {', '.join(self.names)}")
        return found[0]

    def number(self, text: str) -> float | None:
        """Return the number in a cell; None if the cell holds no number."""
        plain = text.strip()
        if (_COMMA if self.decimal == "," else _POINT).fullmatch(plain) is None:
            return None
        return float(plain.replace(",", "."))

    def numbers(self, place: int, blanks: bool) -> np.ndarray:
        """Return the (N,) numbers of a column; an empty cell is NaN if `blanks` are allowed.

        Raises:
            InputError: another cell holds no number.
        """
        values = np.empty(len(self.rows))
        for k, (line, row) in enumerate(self.rows):
            number = self.number(row[place])
            if number is None and not (blanks and self.empty(row[place])):
                sign = "comma" if self.decimal == "," else "point"
                allowed = f"a number with a decimal {sign}" + (", or blank" if blanks else "")
                raise InputError(
                    self.where, f"line {line}, {self.names[place]}", row[place], allowed
                )
            values[k] = np.nan if number is None else number
        return values

    @staticmethod
    def empty(text: str) -> bool:
        """Tell whether a cell says that there is no value."""
        return text.strip().lower() in _NONE


Lines = list[tuple[int, list[str]]]


def read_cells(
    path: Path, sheet: str | None = None, decimal: str | None = None, columns: Sequence[str] = ()
) -> Cells:
    """Read a table from a text file or a workbook.

    Args:
        sheet: name of the workbook's sheet; by default its only one.
        decimal: decimal sign of a text file; by default the one that the cells show.
        columns: names of the columns, instead of those in the header.

    Raises:
        InputError: the file is no readable table, a row has more or fewer cells, or names are
            missing.
    """
    where = str(path)
    if path.suffix.lower() in WORKBOOK:
        separator, lines, sign = "", _read_sheet(path, sheet), "."  # its numbers are no text
    else:
        separator, lines = _split_text(where, _read_text(path))
        sign = decimal or _find_decimal_sign(where, separator, lines)
    ids, first = _find_first_row(where, lines, sign)
    width = len(lines[first][1])
    names, used = _join_names(lines[:first], width, ids)
    if columns:
        if len(columns) != width:
            raise InputError(where, "--columns", f"{len(columns)} names", f"{width} names")
        names, used = tuple(columns), ()
    elif not used:
        allowed = "a line with the columns' names above the numbers, or --columns q1,q2,...,x,y,z"
        raise InputError(where, "header", "none", allowed)
    for line, row in lines[first:]:
        if len(row) != width:
            raise InputError(where, f"line {line}", f"{len(row)} cells", f"{width} cells")
    rows = tuple((line, tuple(row)) for line, row in lines[first:])
    return Cells(where, names, rows, separator, sign, used)


def _read_text(path: Path) -> str:
    check_size(path)
    try:
        raw = path.read_bytes()
    except OSError as error:
        raise InputError(path, "file", error.strerror or str(error), "a readable file") from error
    for begins, kind, export in _OTHER_FILES:
        if begins.match(raw):
            raise InputError(path, "file", kind, export)
    wide = raw[:2] in (b"\xff\xfe", b"\xfe\xff")
    for coding in ("utf-16",) if wide else ("utf-8-sig", "cp1252"):
        try:
            return raw.decode(coding)
        except UnicodeDecodeError:
            continue
    allowed = "CSV in UTF-8, UTF-16 or CP1252, or XLSX"
    raise InputError(path, "file", "bytes that are no text", allowed)


def _split_text(where: str, text: str) -> tuple[str, Lines]:
    """Return the separator that fits a text best, and the lines of the text split by it.

    Each separator is tried on the first 200 lines. It is rated by its largest group of lines with
    the same number of cells, at least 2: first by how many of these are mostly numbers, then by
    how many there are.
    """
    sample = "\n".join(text.splitlines()[:200])
    best, most = "", (0, 0)
    for mark in _SEPARATORS:
        rows = [row for _, row in _split_lines(where, sample, mark) if len(row) > 1]
        for width in {len(row) for row in rows}:
            alike = [row for row in rows if len(row) == width]
            numeric = sum(_is_numeric(row, _POINT) or _is_numeric(row, _COMMA) for row in alike)
            if (numeric, len(alike)) > most:
                best, most = mark, (numeric, len(alike))
    if not best:
        allowed = "a table with columns separated by comma, semicolon, tab, | or blanks"
        raise InputError(where, "file", "no columns", allowed)
    return best, _split_lines(where, text, best)


def _split_lines(where: str, text: str, mark: str) -> Lines:
    """Return number and cells of each line that is not blank.

    Comment signs are removed from the lines above the first numbers. A comment below them is
    refused: it may be a row that was taken out.
    """
    import pandas as pd

    lines, above = [], True
    for number, line in enumerate(text.splitlines(), 1):
        remark = _REMARK.match(line)
        above = above and not (remark is None and _is_numeric(_CELLS.split(line.strip()), _POINT))
        if not above and remark and remark[0][-1].isspace():
            raise InputError(where, f"line {number}", line[:40], "a row, without # before it")
        lines.append(_REMARK.sub("", line) if above else line)
    width = max((len(re.split(mark, line.strip())) for line in lines), default=0)
    check_cells(where, width * len(lines))
    if width < 2:
        return []
    try:
        frame = pd.read_csv(
            io.StringIO("\n".join(line.strip(" ") for line in lines)),
            sep=mark,
            header=None,
            names=range(width),
            index_col=False,
            dtype=str,
            na_filter=False,
            skip_blank_lines=False,
            skipinitialspace=True,
            engine="python",
        )
    except (pd.errors.ParserError, pd.errors.EmptyDataError, csv.Error, ValueError) as error:
        raise InputError(where, "file", str(error), "separated text") from error
    rows = ([str(c).strip() for c in row if not pd.isna(c)] for row in frame.to_numpy().tolist())
    return [(line, row) for line, row in enumerate(rows, 1) if any(row)]


def _find_decimal_sign(where: str, separator: str, lines: Lines) -> str:
    cells = [cell for _, row in lines for cell in row]
    commas = sum("," in c and _COMMA.fullmatch(c) is not None for c in cells)
    points = sum("." in c and _POINT.fullmatch(c) is not None for c in cells)
    if separator == "," and not commas:
        return "."
    if commas and points:
        allowed = "one sign before decimals; say it with --decimal , or ."
        raise InputError(where, "numbers", f"{commas} with a comma, {points} with a point", allowed)
    return "," if commas else "."


def _read_sheet(path: Path, name: str | None) -> Lines:
    """Return number and cells of each line with a filled cell, up to the last filled column."""
    import openpyxl

    rows, count = [], 0
    try:
        with zipfile.ZipFile(path) as archive:
            check_unpacked(path, archive)
        with closing(openpyxl.load_workbook(path, read_only=True, data_only=True)) as book:
            sheets = [sheet.title for sheet in book.worksheets]
            if name is None and len(sheets) > 1:
                raise InputError(path, "--sheet", "missing", f"one of {', '.join(sheets)}")
            chosen = name or sheets[0]
            if chosen not in sheets:
                raise InputError(path, "--sheet", chosen, f"one of {', '.join(sheets)}")
            rows_of = book[chosen]
            rows_of.reset_dimensions()  # or every line is filled up to the farthest cell
            for line, row in enumerate(rows_of.iter_rows(), 1):
                count += len(row) + 1
                check_cells(path, count)
                texts = [_text_of(cell) for cell in row]
                if any(texts):
                    rows.append((line, texts))
    except InputError:
        raise
    except Exception as error:  # whatever zipfile, XML and pandas raise on a damaged file
        said = f"{type(error).__name__}: {error}"
        raise InputError(path, "workbook", said, "an undamaged XLSX file") from error
    width = max((k for _, row in rows for k, c in enumerate(row, 1) if c), default=0)
    check_cells(path, width * len(rows))
    return [(line, (row + [""] * width)[:width]) for line, row in rows]


def _text_of(cell: Any) -> str:
    """Return the text of a sheet's cell: a whole number without a point, "" for an error."""
    value = cell.value
    if value is None or cell.data_type == "e":
        return ""
    if isinstance(value, float) and value.is_integer():
        value = int(value)
    return str(value).strip()


def _is_numeric(row: Sequence[str], number: re.Pattern[str]) -> bool:
    """Tell whether more than half of a row's filled cells, at least two, are numbers or times."""
    filled = [c for c in row if c.lower() not in _NONE]
    count = sum(bool(number.fullmatch(c) or _DATED.search(c)) for c in filled)
    return len(filled) > 1 and 2 * count > len(filled)


def _find_first_row(where: str, lines: Lines, decimal: str) -> tuple[int, int]:
    """Return the indices of the first line of numbers, and of the first one below all headers.

    They differ if the header has a line of ids: whole numbers beside a word. Measured numbers above
    a header, and one header above and below numbers, are refused.
    """
    number = _COMMA if decimal == "," else _POINT
    widths = Counter(len(row) for _, row in lines)
    usual = widths.most_common(1)[0][0] if widths else 0
    numeric = [
        k for k, (_, row) in enumerate(lines) if len(row) == usual and _is_numeric(row, number)
    ]
    if not numeric:
        raise InputError(where, "rows", "no row of numbers", "numbers below a header")
    ids = numeric[0]
    below = range(ids, min(ids + _HEADER_LINES, len(lines)))
    heads = [k for k in below if _is_heading(lines[k][1], usual)]
    first = next((k for k in numeric if not heads or k > heads[-1]), None)
    for k in numeric if first is None else numeric[: numeric.index(first)]:
        line, row = lines[k]
        said = [c for c in row if number.fullmatch(c)]
        whole = all(c.isdigit() for c in said) and len(said) < sum(map(bool, row))
        twice = any(lines[head][1] in (above for _, above in lines[:ids]) for head in heads)
        if first is None or not whole or twice:
            raise InputError(where, f"line {line}", "numbers above a header", "numbers below it")
    assert first is not None
    return ids, first


def _is_heading(row: Sequence[str], width: int) -> bool:
    """Tell whether a row looks like names: `width` cells, more than half filled, no number."""
    filled = [c for c in row if c.lower() not in _NONE]
    numeric = any(_POINT.fullmatch(c) or _COMMA.fullmatch(c) or _DATED.search(c) for c in filled)
    return len(row) == width and not numeric and len(filled) > max(1, width // 2)


def _join_names(lines: Lines, width: int, ids: int) -> tuple[tuple[str, ...], tuple[int, ...]]:
    """Join the names of the columns from the heading lines above the numbers.

    The lines are read upwards. Headings end at a blank line, at a line with fewer than two filled
    cells, and, above the line with index `ids`, at a line that holds a number. Returns also the
    numbers of the lines that the names come from.
    """
    headings: Lines = []
    for k in reversed(range(len(lines))):
        line, row = lines[k]
        apart = headings and headings[-1][0] != line + 1
        titled = k < ids and any(_POINT.fullmatch(c) or _DATED.search(c) for c in row if c)
        if headings and (apart or titled or sum(map(bool, row)) < 2):
            break
        headings.append((line, row))
    whole = [
        (line, row) for line, row in headings[::-1] if len(row) == width and sum(map(bool, row)) > 1
    ]
    units = [all(unit_of(c) is not None for c in row if c) for _, row in whole]
    last = max((k for k, pure in enumerate(units) if not pure), default=-1)
    names = [""] * width
    for k, (_, row) in enumerate(whole):
        heading = ""
        for j, cell in enumerate(row):
            if units[k]:
                names[j] += f" [{cell.strip('[](){}')}]" if cell else ""
                continue
            heading = cell or (heading if k < last else "")  # may be over several columns
            names[j] = f"{names[j]} {heading}".strip()
    return tuple(names), tuple(line for line, _ in whole)
