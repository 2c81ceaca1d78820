"""CSV as it is met: the numbers that are in it, or a refusal that says what to do."""

import gzip

import numpy as np
import pytest

from robsmooth.io.records import smooth_record
from tests.io.test_records import discrete

X = np.nan
ROWS = [[1.5, -2.0], [X, 0.25], [3e-3, X]]
GAPS = "1.5,-2\n{0},0.25\n0.003,{0}\n"
EITHER = "may be a header or a sample: say header=True or header=False"
HEADER, NO_HEADER = {"header": True}, {"header": False}
COMMA = {"delimiter": ";", "decimal": ","}

# What the file is called, its content, options, and the two columns of numbers or the refusal.
DIALECTS = {
    # --- gaps
    "empty": (GAPS.format(""), {}, ROWS),
    "NA": (GAPS.format("NA"), {}, ROWS),
    "N/A": (GAPS.format("N/A"), {}, ROWS),
    "#N/A": (GAPS.format("#N/A"), {}, ROWS),
    "null": (GAPS.format("null"), {}, ROWS),
    "nan": (GAPS.format("nan"), {}, ROWS),
    "NaN": (GAPS.format("NaN"), {}, ROWS),
    "a dot": (GAPS.format("."), {}, ROWS),
    "quoted": (GAPS.format('""'), {}, ROWS),
    "after a space": ("I, Q\n1.5, -2\nNA, 0.25\n0.003, NA\n", {}, ROWS),
    "a space": ("1.5,-2\n ,0.25\n0.003, \n", {}, ROWS),
    "-999": (GAPS.format("-999"), {"missing": "-999"}, ROWS),
    "two words": ("1.5,-2\nOVL,0.25\n0.003,-\n", {"missing": ["OVL", "-"]}, ROWS),
    "another word": (GAPS.format("OVL"), {}, r"line 2.* 'OVL'; .*missing= say how to read it"),
    "a row of gaps": ("1,2\n,\n3,4\n", {}, [[1, 2], [X, X], [3, 4]]),
    "a row of gaps between spaces": ("1 2\n \n3 4\n", {"delimiter": " "}, [[1, 2], [X, X], [3, 4]]),
    # --- the first line
    "names": ("I,Q\n1,2\n", {}, [[1, 2]]),
    "quoted names": ('"I (A, rms)",Q\n1,2\n', {}, [[1, 2]]),
    "a name missing": (",Q\n1,2\n", {}, [[1, 2]]),
    "names in Latin-1": ("\xb5V,Q\n1,2\n".encode("latin-1"), {"columns": [0, "Q"]}, [[1, 2]]),
    "names and nothing": ("I,Q", {}, np.empty((0, 2))),
    "no names": ("1,2\n3,4\n", {}, [[1, 2], [3, 4]]),
    "counts": ("512,511\n510,513\n", {}, [[512, 511], [510, 513]]),
    "numbered": ("0,1\n0.5,0.25\n", {}, EITHER),
    "numbered above counts": ("0,1\n2,3\n", {}, EITHER),
    "numbered, with an index": (",0,1\n0,0.5,0.25\n", {}, EITHER),
    "numbered by floats": ("0.0,1.0\n0.5,0.25\n", {}, EITHER),
    "floats": ("1.0,2.0\n0.5,0.25\n", {}, [[1, 2], [0.5, 0.25]]),
    "wavelengths": ("400,500\n0.5,0.25\n", {}, EITHER),
    "numbered, a header": ("0,1\n0.5,0.25\n", HEADER, [[0.5, 0.25]]),
    "numbered, a sample": ("0,1\n0.5,0.25\n", NO_HEADER, [[0, 1], [0.5, 0.25]]),
    "gaps": ("NA,NA\n1,2\n", {}, EITHER),
    "gaps of others": ("None,-\n1,2\n", {"missing": ["None", "-"]}, EITHER),
    "a gap's word unsaid": ("OVL,OVL\n1,2\n", {}, EITHER),
    "empty gaps": (",\n1,2\n", {}, EITHER),
    "gaps, a sample": ("NA,NA\n1,2\n", NO_HEADER, [[X, X], [1, 2]]),
    "gaps, a header": ("NA,NA\n1,2\n", HEADER, [[1, 2]]),
    "a word and a number": ("V1,2\n1,2\n", {}, EITHER),
    # each of these was taken for names, and the record shifted by a sample
    "the nan of C": ("-nan,-nan(ind)\n1,2\n", {"missing": ["-nan", "-nan(ind)"]}, EITHER),
    "an overflow of C": ("inf,-inf\n1,2\n", {}, "line 1, column 0: inf where there must be"),
    "a minus of typographers": ("\u22121.5,2\n1,2\n", {}, "line 1"),
    "words of instruments": ("OL,#NUM!\n1,2\n", {}, EITHER),
    "a bound": ("<1.5,(2)\n1,2\n", {}, EITHER),
    "a currency": ("$1.5,$2\n1,2\n", {}, EITHER),
    "names with signs": ("#I,\u00b0C\n1,2\n", {}, [[1, 2]]),
    "a comment": ("# of a scope\nI,Q\n1,2\n", {}, "got 1: column 0 .*skip_rows="),
    "a comment left out": ("# of a scope\n\nI,Q\n1,2\n", {"skip_rows": 2}, [[1, 2]]),
    "units": ("I,Q\nmV,mV\n1,2\n", {}, "line 2: .* 'mV'; .*skip_rows="),
    "units left out": ("I,Q\nmV,mV\n1,2\n", {"skip_rows": 2}, [[1, 2]]),
    # --- marks
    "semicolons": ("1;2\n3;4\n", {"delimiter": ";"}, [[1, 2], [3, 4]]),
    "semicolons unsaid": ("I;Q\n1;2\n", {}, r"got 1: column 0 \('I;Q'\)"),
    "tabs": ("1\t2\n\t4\n", {"delimiter": "\t"}, [[1, 2], [X, 4]]),
    "tsv": ("1\t2\n\t4\n", {"name": "y.tsv"}, [[1, 2], [X, 4]]),
    "a bar": ("1|2\n", {"delimiter": "|"}, [[1, 2]]),
    "aligned by spaces": ("1  2\n3  4\n", {"delimiter": " "}, r"got 3: column 0, .* delimiter="),
    "decimal commas": ("I;Q\n1,5;-2\n;0,25\n3e-3;\n", COMMA, ROWS),
    "decimal commas unsaid": ("1,5;2,5\n", {"delimiter": ";"}, "line 1: .*'1,5'.* decimal="),
    "decimal commas in commas": ("1,5,2,5\n", {}, "must name 2 columns .* got 4"),
    "both marks commas": ("1,5\n", {"decimal": ","}, "delimiter and decimal must differ"),
    "a point among commas": ("1,5;2\n1.5;2\n", COMMA, "line 2: .* '1.5'"),
    "thousands": ("1,2\n1_000,2\n", {}, "line 2: .*'1_000'"),
    "quoted thousands": ('1.5,2\n"1,000",2\n', {}, "line 2: .*'1,000'"),
    "quoted numbers": ('"1.5","-2"\n"","0.25"\n"3e-3",""\n', {}, ROWS),
    "all ways to write one": ("+1,2.\n.5,-1E+2\n", {}, [[1, 2], [0.5, -100]]),
    "Fortran's": ("1,2\n1d5,2\n", {}, "line 2: .*'1d5'"),
    "infinity": ("1,2\n-inf,4\n", NO_HEADER, "line 2, column 0: -inf where there must be a finite"),
    "overflow": ("I,Q\n1,1e999\n", {}, r"line 2, column 1 \('Q'\): inf where"),
    # --- lines
    "CR LF": ("1.5,-2\r\n,0.25\r\n3e-3,\r\n", {}, ROWS),
    "CR": ("1,2\r3,4\r", {}, "in UTF-8 with line ends of LF"),
    "no end": ("1,2\n3,4", {}, [[1, 2], [3, 4]]),
    "blank at the end": ("1,2\n3,4\n\n\r\n\n", {}, [[1, 2], [3, 4]]),
    "blank within": ("1,2\n\n3,4\n", {}, "line 2: blank; a row of gaps has its nan or delimiters"),
    "blank below a header": ("I,Q\n\n1,2\n", {}, "line 2: blank"),
    "blank, with CR": ("1,2\r\n3,4\r\n\r\n5,6\r\n", {}, "line 3: blank"),
    "too short": ("1,2\n3,4\n5\n", {}, "line 3: Expected 2 columns, got 1: 5"),
    "too long": ("1,2\n3,4,5\n", {}, "line 2: Expected 2 columns, got 3: 3,4,5"),
    "an open quote": (
        'I,Q,n\n1,2,"a\n3,4,b"\n5,6,\n',
        {"columns": [0, 1]},
        "quote runs over several",
    ),
    "words elsewhere": ('I,note,Q\n1,"a, b",2\n', {"columns": ["I", "Q"]}, [[1, 2]]),
    "a long line": ("1," + 2_000_000 * "9", {}, "y.csv: field larger than field limit"),
    "a long line later": ("1,2\n3,4\n5," + 4_000_000 * "9", {}, "y.csv: straddling"),
    # --- bytes
    "empty file": ("", {}, "must begin with names or numbers"),
    "a mark of UTF-8": ("\ufeffI,Q\n1,2\n", {"columns": ["I", "Q"]}, [[1, 2]]),
    "UTF-16": ("1,2\n".encode("utf-16"), {}, "in UTF-8"),
    "gzip": (gzip.compress(b"1,2\n3,4\n"), {"name": "y.csv.gz"}, [[1, 2], [3, 4]]),
    "gzip by another name": (gzip.compress(b"I,Q\n1,2\n"), {}, [[1, 2]]),
    "gzip, cut off": (gzip.compress(GAPS.format("").encode())[:-9], {}, "y.csv: Compressed file"),
    "xz": (b"\xfd7zXZ\0\0\4\n", {}, "in UTF-8"),
    "a zip": (b"PK\x03\x04\x14\0\0\0\x08\0y.csv\n", {}, "in UTF-8"),
}


@pytest.mark.parametrize("chunk", [1, 1000])
@pytest.mark.parametrize(("content", "options", "expected"), DIALECTS.values(), ids=DIALECTS)
def test_a_dialect_gives_its_numbers_or_says_what_to_do(
    tmp_path, content, options, expected, chunk
):
    assert len(DIALECTS) >= 60
    options = {"name": "y.csv", "chunk": chunk} | options
    source, target = tmp_path / options.pop("name"), tmp_path / "out.npy"
    source.write_bytes(content if isinstance(content, bytes) else content.encode())
    if isinstance(expected, str):
        with pytest.raises(ValueError, match=expected) as error:
            smooth_record(discrete(), source, target, **options)
        assert str(source) in str(error.value) or "delimiter" in str(error.value)
        assert len(str(error.value)) < 500
        assert not target.exists()
    else:
        assert smooth_record(discrete(), source, target, **options) == len(expected)
        np.testing.assert_array_equal(np.load(target), discrete().run(expected))
