"""Seeded damage to files: what typing, spreadsheets and broken disks do to them."""

import re
from collections.abc import Callable

import numpy as np

NUMBERS = (
    *(
        "0",
        "-0",
        "1",
        "-1",
        "2",
        "3",
        "17",
        "-5",
        "1e-320",
        "5e-324",
        "1e-9",
        "1e9",
        "1e30",
        "1e300",
    ),
    *("-1e300", "1e308", "1e999", "nan", ".nan", "inf", "-.inf", "015", "1:30", "0x1F", "1_000"),
    *("1,5", "1.5.2", "true", "null", "~", "''", "[]", "{}", "9999", "100000", "3.5", "text", "½"),
    "9" * 400,
)
PIECES = (
    *("\x00", "\ufeff", "\t", "\r", "\n", "\n\n", '"', "'", "#", "%", "&", "*a", "&a ", "- ", ": "),
    *(
        "{",
        "}",
        "[",
        "]",
        "<",
        ">",
        "!!python/object:os.system ",
        "<<: *a",
        "---\n",
        "...",
        "é",
        "🦾",
    ),
    *("[" * 3000, "{a: " * 3000, "\n" + "a: &a [x,x]\n", ",,,,", ";", "../../x", "\x1b[31m"),
)
_NUMBER = re.compile(r"(?<![\w.])[-+]?(\d+\.?\d*|\.\d+)([eE][-+]?\d+)?(?![\w.])")

Damage = Callable[[str, np.random.Generator], str]


def _another_number(text: str, rng: np.random.Generator) -> str:
    found = list(_NUMBER.finditer(text))
    if not found:
        return text
    at = found[int(rng.integers(len(found)))]
    return text[: at.start()] + str(rng.choice(NUMBERS)) + text[at.end() :]


def _piece(text: str, rng: np.random.Generator) -> str:
    at = int(rng.integers(len(text) + 1))
    return text[:at] + str(rng.choice(PIECES)) + text[at:]


def _cut_short(text: str, rng: np.random.Generator) -> str:
    return text[: int(rng.integers(len(text) + 1))]


def _gap(text: str, rng: np.random.Generator) -> str:
    at = int(rng.integers(len(text) + 1))
    return text[:at] + text[at + int(rng.integers(1, 40)) :]


def _lines(text: str, rng: np.random.Generator, change: Callable[[list[str], int], object]) -> str:
    lines = text.split("\n")
    change(lines, int(rng.integers(len(lines))))
    return "\n".join(lines)


def _line_twice(text: str, rng: np.random.Generator) -> str:
    return _lines(text, rng, lambda lines, k: lines.insert(k, lines[k]))


def _line_lost(text: str, rng: np.random.Generator) -> str:
    return _lines(text, rng, lambda lines, k: lines.pop(k))


def _lines_swapped(text: str, rng: np.random.Generator) -> str:
    def swap(lines: list[str], k: int) -> None:
        lines[k], lines[k - 1] = lines[k - 1], lines[k]

    return _lines(text, rng, swap)


def _word_for_another(text: str, rng: np.random.Generator) -> str:
    words = list(re.finditer(r"\w+", text))
    if not words:
        return text
    at, other = (words[int(k)] for k in rng.integers(len(words), size=2))
    return text[: at.start()] + other.group() + text[at.end() :]


DAMAGES: tuple[Damage, ...] = (
    *(_another_number, _another_number, _another_number, _piece, _cut_short, _gap),
    *(_line_twice, _line_lost, _lines_swapped, _word_for_another),
)


def damaged_text(text: str, rng: np.random.Generator) -> str:
    """A text with one to three damages."""
    for _ in range(int(rng.integers(1, 4))):
        text = DAMAGES[int(rng.integers(len(DAMAGES)))](text, rng)
    return text


def damaged_bytes(data: bytes, rng: np.random.Generator) -> bytes:
    """Bytes with some flipped, some lost, or the end missing."""
    held = bytearray(data)
    way = int(rng.integers(3))
    if way == 0:
        for at in rng.integers(len(held), size=int(rng.integers(1, 20))):
            held[at] ^= int(rng.integers(1, 256))
    elif way == 1:
        at = int(rng.integers(len(held)))
        del held[at : at + int(rng.integers(1, 200))]
    else:
        del held[int(rng.integers(len(held))) :]
    return bytes(held)


def damaged(data: bytes, rng: np.random.Generator) -> bytes:
    """A file's contents, damaged: as text where they are text, now and then as bytes."""
    try:
        text = data.decode("utf-8")
    except UnicodeDecodeError:
        return damaged_bytes(data, rng)
    if rng.random() < 0.1:
        return damaged_bytes(data, rng)
    return damaged_text(text, rng).encode("utf-8", "surrogatepass")
