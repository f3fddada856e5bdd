"""Values of a YAML file change; comments, order and all else stay."""

import pytest

from longarm_comp.arm_folder.parameter_file import edit_text
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import parse_yaml


def test_values_change_and_all_else_stays() -> None:
    text = """# mine
a:
  one:
    zero: 1  # measured?
    ends: [1, 2]
  # between
  two: {zero: 3, odd: true}  # flow
  three: {}
b: "last"
"""
    made = edit_text(
        text,
        {
            ("a", "one", "zero"): 7.5, ("a", "one", "sign"): -1, ("a", "two", "sign"): -1,
            ("a", "three", "zero"): 1, ("a", "one", "ends"): [3, 4], ("c",): "/dev/x", ("b",): 2,
        },
        "file",
    )  # fmt: skip
    assert parse_yaml(made, "made") == {
        "a": {
            "one": {"zero": 7.5, "ends": [3, 4], "sign": -1},
            "two": {"zero": 3, "odd": True, "sign": -1},
            "three": {"zero": 1},
        },
        "b": 2,
        "c": "/dev/x",
    }
    assert [line.split("#")[1] for line in made.splitlines() if "#" in line] == [
        " mine", " measured?", " between", " flow",
    ]  # fmt: skip
    with pytest.raises(InputError, match="d"):
        edit_text(text, {("d", "e"): 1}, "file")
    assert edit_text("a:\nb: {c: , d: 1}\n", {("a",): 2, ("b", "c"): [3]}, "file") == (
        "a: 2\nb: {c: [3], d: 1}\n"
    )
    assert parse_yaml(edit_text("a: &x 1\nb: *x\n", {("a",): 2}, "file"), "") == {"a": 2, "b": 1}
    with pytest.raises(InputError, match=r"a\.c: 'cannot be edited'"):
        edit_text("a: &x {c: 1}\nb: *x\n", {("a", "c"): 2, ("b", "c"): 3}, "file")
