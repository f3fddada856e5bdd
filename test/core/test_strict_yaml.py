"""YAML is read in one way, whether PyYAML has libyaml or not."""

import pytest
from yaml.scanner import Scanner

from longarm_comp.core import strict_yaml
from longarm_comp.core.errors import InputError
from longarm_comp.core.strict_yaml import DEEPEST, parse_yaml


@pytest.fixture(autouse=True, params=["libyaml", "PyYAML"])
def reader(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> None:
    if request.param == "PyYAML":
        monkeypatch.setattr(strict_yaml, "CParser", None)
    else:
        pytest.importorskip("yaml._yaml")


def refused(text: str) -> str:
    with pytest.raises(InputError) as caught:
        parse_yaml(text, "file.yaml")
    assert caught.value.where == "file.yaml"
    return f"{caught.value.field} | {caught.value.value}"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("limits_deg: [-015, 015]", "limits_deg.0 (line 1) | -015"),
        ("joints:\n- limits_deg: [0, 1:30]", "joints.0.limits_deg.1 (line 2) | 1:30"),
        ("a: 1:30:15.5", "a (line 1) | 1:30:15.5"),
        ("a: 0x1F", "a (line 1) | 0x1F"),
        ("a: 0b11", "a (line 1) | 0b11"),
        ("a: 1_000", "a (line 1) | 1_000"),
        ("a: 09", "a (line 1) | 09"),
        ("a: 1e999", "a | 1e999"),
        ("a: 1\nb: {c: 2}\na: 3", "a | twice, lines 1 and 3"),
        ("b: {c: 2, 'c': 3}", "b.c | twice, lines 1 and 1"),
        ("a: &x [1, *x]", "line 1 | *x"),
        ("[" * 5000, "line 1 | nested more than"),
        ("a: " + "{a: " * 5000, "line 1 | nested more than"),
        ("a: 2024-99-99", "YAML | month must be"),
        ("? [1, 2]\n: 3", "YAML | while constructing"),
        ("a: !!python/name:os.system", "YAML | could not determine"),
        ("a: !!bool maybe", "YAML | 'maybe'"),
        ("a: !!float ''", "YAML | string index"),
        ("a: !!timestamp now", "YAML | 'NoneType'"),
        ("a: 1\nb: [1, c: 2}", 'YAML | while parsing a flow sequence in "<unicode string>", line 2,'
         " column 4: b: [1, c: 2} ^ expected ',' or ']', but got '}'"),
        ("a: 1\n--- 2", "YAML | expected a single document in the stream in"),
        ("a: *none", "YAML | found undefined alias 'none' in"),
        ("a: \t1", "YAML | while scanning for the next token found character '\\t'"),
        ("%YAML 1.1#\n--- 1", "YAML | while scanning a directive"),
        ("a: {b: c?}", "YAML | while parsing a flow mapping in"),
        ("a: >#\n  text", "YAML | while scanning a block scalar in"),
    ],
)  # fmt: skip
def test_yaml_that_is_refused(text: str, said: str) -> None:
    assert refused(text).startswith(said)


def test_an_alias_bomb_is_refused_and_plain_aliases_are_not() -> None:
    bomb = "a0: &a0 [1, 1, 1, 1, 1, 1, 1, 1, 1, 1]\n"
    for k in range(1, 9):
        bomb += f"a{k}: &a{k} [{', '.join([f'*a{k - 1}'] * 10)}]\n"
    assert "more than" in refused(bomb)
    shared = parse_yaml("tube: &t {od_m: 0.1}\none: *t\ntwo: {<<: *t, id_m: 0.05}", "f")
    assert shared["one"] == {"od_m": 0.1} and shared["two"] == {"od_m": 0.1, "id_m": 0.05}


def test_yaml_that_is_read() -> None:
    text = "[15, -0.5, .5, 1., 1e-3, -2.5E+2, 0, -0, 0.0, 'a', '015', yes, ~, .inf, 1e]"
    nested = "[" * (DEEPEST - 1) + "]" * (DEEPEST - 1)
    assert parse_yaml(text, "f") == [
        *(15, -0.5, 0.5, 1.0, 1e-3, -250.0, 0, 0, 0.0, "a", "015", True, None, float("inf"), "1e"),
    ]
    assert parse_yaml(nested, "f") == eval(nested)
    assert parse_yaml("", "f") is None


@pytest.mark.parametrize(
    ("text", "data"),
    [
        ("%TAG ! tag:a,2000:\n---\na: 1", {"a": 1}),
        ("a: |\n  b\n  c\nd: >-\n  e\n  f", {"a": "b\nc\n", "d": "e f"}),
        ("[a:{b: c}]", [{"a": {"b": "c"}}]),  # refused by libyaml
        ("a:\n\ufeff  b: 1", {"a": None, "\ufeff  b": 1}),
        ("a: '\t'  # a tab?", {"a": "\t"}),
    ],
)
def test_both_readers_find_the_same(text: str, data: object) -> None:
    assert parse_yaml(text, "f") == data


def test_a_file_without_faults_is_not_read_letter_by_letter(
    reader: None, request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch
) -> None:
    """PyYAML's own scanner takes four times as long."""
    asked: list[Scanner] = []
    fetch = Scanner.fetch_more_tokens
    monkeypatch.setattr(Scanner, "fetch_more_tokens", lambda s: (asked.append(s), fetch(s))[1])
    assert parse_yaml("a: [1, 0.5, 'x']", "f") == {"a": [1, 0.5, "x"]}
    assert bool(asked) == (strict_yaml.CParser is None)
