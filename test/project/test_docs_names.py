"""What the pages name is there: commands, options, make targets, tests, pages, sections."""

import re
from functools import cache
from pathlib import Path

import click
import pytest
from cli_shell import ENTRIES, click_command
from places import ROOT

from longarm_comp.cli.registry import GROUPS
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.strict_yaml import parse_yaml

PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md", *sorted((ROOT / "docs").rglob("*.md"))]
PAGES = [page for page in PAGES if "made" not in page.parts]
FENCED = re.compile(r"^```[^\n]*\n(.*?)^```", re.DOTALL | re.MULTILINE)


@cache
def options(name: str) -> set[str]:
    """Every option of a command."""
    command = click_command(name)
    assert isinstance(command, click.Command)
    given = {o for p in command.params for o in (*p.opts, *p.secondary_opts)}
    return given | {"-h", "--help"}


def calls(text: str) -> list[list[str]]:
    """The words after `longarm`, of blocks and of code in a line; without comments."""
    blocks = FENCED.findall(text)
    lines = "\n".join(blocks).replace("\\\n", " ").splitlines()
    inline = re.findall(r"`(longarm [^`]+)`", FENCED.sub("", text))
    said = [*lines, *(" ".join(each.split()) for each in inline)]
    begun = (re.match(r"\s*longarm (.*?)(?:\s#.*)?$", line) for line in said)
    return [match[1].split() for match in begun if match]


def named(words: list[str]) -> str | None:
    """The command that words begin with; None for a placeholder (COMMAND) or an option."""
    if not words or words[0].isupper() or words[0].startswith("-"):
        return None
    first = words[0].rstrip(".,;")
    if first not in {*GROUPS, "study"}:
        assert first in ENTRIES, f"longarm {first}: no such command"
        return first
    assert len(words) > 1, f"longarm {first}: which?"
    for second in words[1].rstrip(".,;").split("|"):
        assert f"{first} {second}" in ENTRIES, f"longarm {first} {second}: no such command"
    return f"{first} {second}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_commands_and_options(page: Path) -> None:
    for words in calls(page.read_text("utf-8")):
        name = named(words)
        if name is None:
            continue
        rest = words[len(name.split()) :]
        written = {w.split("=")[0].rstrip(".,;") for w in rest if re.match(r"-[-a-zA-Z]", w)}
        strange = {w for w in written if not re.match(r"-\d", w)} - options(name)
        assert not strange, f"longarm {name}: {strange}"
        assert_arm_is_a_file(name, rest)


def assert_arm_is_a_file(name: str, rest: list[str]) -> None:
    """Assert that the words after a command's name do not give a folder where it reads arm.yaml."""
    params = click_command(name).params
    if params and params[0].metavar == "ARM" and rest and not rest[0].startswith("-"):
        assert rest[0].endswith(("ARM", ".yaml")), f"longarm {name} {rest[0]}: a folder"


@pytest.mark.parametrize("name", ENTRIES)
def test_examples_of_the_help_give_the_file_of_the_arm(name: str) -> None:
    for words in calls(f"```\n{click_command(name).help}\n```"):
        if words[: len(name.split())] == name.split():
            assert_arm_is_a_file(name, words[len(name.split()) :])


def test_what_is_wrong_is_noticed() -> None:
    for line in ("longarm diagnos arm.yaml", "longarm servo", "longarm stereo maker my_arm"):
        with pytest.raises(AssertionError):
            named(line.split()[1:])
    picture = "```{image} a.svg\n:alt: A\n```\nlongarm is\n"
    block = "```\nlongarm plan a --kind x \\\n --nope 1  # because\n```"
    assert calls(picture + block) == [["plan", "a", "--kind", "x", "--nope", "1"]]
    assert "--nope" not in options("plan") and "--kind" in options("plan")


def test_every_command_is_on_a_page() -> None:
    said = {name for page in PAGES for w in calls(page.read_text("utf-8")) if (name := named(w))}
    together = " ".join(page.read_text("utf-8") for page in PAGES)
    missing = {name for name in ENTRIES if name not in said and f"`{name}" not in together}
    assert not missing


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_targets_tests_pages_and_sections(page: Path) -> None:
    text = " ".join(page.read_text("utf-8").split())
    made = re.findall(r"^([\w]+):", (ROOT / "Makefile").read_text("utf-8"), re.MULTILINE)
    assert set(re.findall(r"`make (\w+)", text)) <= set(made)
    for test in re.findall(r"\btest/[\w/]+\.py", text):
        assert (ROOT / test).is_file(), test
    for test, chosen in re.findall(r"pytest (test/[\w/]+\.py)(?: -k (\w+))?", text):
        source = (ROOT / test).read_text("utf-8")
        names = re.findall(r"def test_(\w+)|id=\"(\w+)\"", source)
        assert any(chosen in "".join(pair) for pair in names) or chosen in source, (test, chosen)
    for other in re.findall(r"`docs/(\w+\.md)`", text):
        assert (ROOT / "docs" / other).is_file(), other
    for other, section in re.findall(r"`docs/(\w+\.md)`,? (?:section )?\"([^\"]+)\"", text):
        page_named = (ROOT / "docs" / other).read_text("utf-8")
        headings = re.findall(r"^#+ (.+)$", page_named, re.MULTILINE)
        assert any(section in heading for heading in headings), f"{other}: {section}"


def test_files_of_the_architecture_are_there() -> None:
    """A bare name stands for a file in the folder of the name before it."""
    text = (ROOT / "docs" / "architecture.md").read_text("utf-8")
    folder, missing = ROOT, []
    for name in re.findall(r"`([\w/]+(?:\.py|/))`", text):
        tops = (folder, ROOT / "longarm_comp", ROOT)
        found = next((top / name for top in tops if (top / name).exists()), None)
        if found is None:
            missing.append(name)
        else:
            folder = found if found.is_dir() else found.parent
    assert not missing


def test_the_page_of_arm_yaml_has_every_key_and_its_example_holds() -> None:
    page = (ROOT / "docs" / "arm.md").read_text("utf-8")
    schema = Arm.model_json_schema()
    keys = {key for part in (schema, *schema["$defs"].values()) for key in part["properties"]}
    assert not {key for key in keys if f"`{key}`" not in page and f"`{key}: " not in page}
    told = set(re.findall(r"`(\w+_(?:m|deg|kg|pa|nm2|mps2|c))`", page)) - {"payload_kg"}
    assert told <= keys, told - keys
    example = re.search(r"```yaml\n(.*?)```", page, re.S)
    assert example is not None
    assert Arm.parse(parse_yaml(example[1], "arm.md"), "arm.md").joint_names[0] == "luff"
