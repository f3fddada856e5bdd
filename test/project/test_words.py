"""One word for one thing: the glossary says which words a page or message does not use."""

import ast
import inspect
import re
from collections.abc import Iterator
from pathlib import Path

import click
import pytest
from cli_shell import ENTRIES, click_command
from places import ROOT

import longarm_comp
from longarm_comp.core.effects.catalogue import BUILT_IN

GLOSSARY = ROOT / "docs" / "glossary.md"
ENTRY = re.compile(r"^- \*\*(.+?)\*\*:? (.+?)(?:\(not: (.+)\))?$", re.MULTILINE)


def entries() -> list[tuple[str, str, tuple[str, ...]]]:
    """Of every word its name, what it means, and the words that are not used for it."""
    page = GLOSSARY.read_text("utf-8").split("\n## Ideas")[0]
    return [(word, said, tuple(filter(None, re.split(", ", no)))) for word, said, no in
            ENTRY.findall(re.sub(r"\n  +", " ", page))]  # fmt: skip


def unused() -> dict[str, str]:
    """A word that is not used -> the word that stands for it."""
    return {no: word for word, _, others in entries() for no in others}


def prose(page: str) -> str:
    """A page without its code, addresses and the glossary's own lists of other words."""
    page = re.sub(r"^```.*?^```", "", page, flags=re.DOTALL | re.MULTILINE)
    return re.sub(r"`[^`]*`|\]\([^)]*\)|\(not: [^)]*\)|^ +longarm .*", "", page, flags=re.MULTILINE)


def in_text(text: str) -> list[str]:
    """The unused words that a text holds."""
    return [
        no for no in unused() if re.search(rf"(?<![\w-]){re.escape(no)}s?(?![\w-])", text, re.I)
    ]


def messages(file: Path) -> str:
    """What a module says: its strings of several words, without docstrings and patterns."""
    tree = ast.parse(file.read_text("utf-8"))
    docs = {id(node.value) for node in ast.walk(tree) if isinstance(node, ast.Expr)}
    strings = (node for node in ast.walk(tree) if isinstance(node, ast.Constant))
    said = (node.value for node in strings if isinstance(node.value, str) and id(node) not in docs)
    return "\n".join(text for text in said if " " in text.strip() and "(?" not in text)


def texts() -> Iterator[tuple[str, str]]:
    """Everything that a user reads, by where it is."""
    for page in [*ROOT.glob("*.md"), *sorted((ROOT / "docs").rglob("*.md"))]:
        if "made" not in page.parts:
            yield page.name, prose(page.read_text("utf-8"))
    for name in ENTRIES:
        command = click_command(name)
        assert isinstance(command, click.Command)
        yield f"longarm {name}", prose(command.get_help(click.Context(command)))
    for file in sorted((ROOT / "longarm_comp").rglob("*.py")):
        yield file.name, messages(file)
    for file in sorted((ROOT / "config").glob("*.yaml")):
        said = re.findall(r"#(.*)$", file.read_text("utf-8"), re.MULTILINE)
        yield file.name, "\n".join(said)
    for file in sorted((ROOT / "longarm_interfaces").rglob("*.*")):
        if file.suffix in (".msg", ".srv", ".action") and "build" not in file.parts:
            yield file.name, "\n".join(re.findall(r"#(.*)$", file.read_text("utf-8"), re.MULTILINE))
    for name, kind in BUILT_IN.items():
        meanings = (p.meaning for p in kind.declared())
        yield name, "\n".join([kind.title, kind.action, kind.__doc__ or "", *meanings])
    for name in longarm_comp.__all__:
        yield f"la.{name}", prose(inspect.getdoc(getattr(longarm_comp, name)) or "")


def test_every_text_uses_the_words_of_the_glossary() -> None:
    faults = [
        f"{where}: {no} (say {unused()[no]})" for where, text in texts() for no in in_text(text)
    ]
    assert not faults, "\n".join(faults)


def test_the_glossary_is_short_and_says_each_word_once() -> None:
    words = [word for word, _, _ in entries()]
    assert len(words) == len(set(words)) == GLOSSARY.read_text("utf-8").count("\n- **")
    assert len(words) <= 40 and len(unused()) > 20
    assert not {*unused()} & {*words}


@pytest.mark.parametrize(
    "text", ["The TCP is here.", "sealed poses", "Two hypotheses are left", "at every waypoint"]
)
def test_a_planted_word_is_found(text: str) -> None:
    assert in_text(text)
    assert not in_text(prose("See `waypoints.csv` (not: slack)\n```\nsealed\n```\n"))
