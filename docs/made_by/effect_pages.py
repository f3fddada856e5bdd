"""A page for every effect of the library, from its class."""

import inspect
from pathlib import Path
from typing import Any

from longarm_comp.core.effects.catalogue import registered
from longarm_comp.core.effects.effect import Bias


def write(folder: Path) -> None:
    """One page an effect, and the list of them."""
    folder.mkdir(parents=True, exist_ok=True)
    names = sorted(registered())
    for name in names:
        (folder / f"{name}.md").write_text(page(name, registered()[name]), encoding="utf-8")
    rows = [
        f"| [{registered()[n].heading()}]({n}.md) | `{n}` | {meaning(registered()[n])} |"
        for n in names
    ]
    listed = "\n".join(["# Effects", "", "| what a mechanic calls it | name | what it does |",
                        "|---|---|---|", *rows])  # fmt: skip
    tree = "\n".join(["```{toctree}", ":hidden:", "", *names, "```"])
    (folder / "index.md").write_text(f"{listed}\n\n{tree}\n", encoding="utf-8")


def meaning(kind: Any) -> str:
    """First paragraph of a class's text, on one line."""
    return " ".join((inspect.getdoc(kind) or "").split("\n\n")[0].split())


def page(name: str, kind: Any) -> str:
    """The page of one effect."""
    side = "the camera: it is never compensated" if issubclass(kind, Bias) else "the arm"
    needs = ", ".join(f"`{need}`" for need in kind.needs) or "nothing besides the joints"
    module = inspect.getmodule(kind)
    assert module is not None
    lines = [
        f"# {kind.heading()[:1].upper()}{kind.heading()[1:]}",
        "",
        meaning(kind),
        "",
        "| | |",
        "|---|---|",
        f"| name | `{name}` |",
        f"| acts on | {side} |",
        f"| reads | {needs} |",
        f"| what to do about it | {kind.action} |",
        "",
        "| parameter | unit | prior (sd) | bounds | meaning |",
        "|---|---|---|---|---|",
    ]
    for p in kind.declared():
        prior = "unknown" if p.unknown else f"{p.prior:g}"
        bounds = f"{p.lower:g} to {p.upper:g}"
        lines.append(f"| {p.name} | {p.unit} | {prior} | {bounds} | {p.meaning} |")
    auto = f".. autoclass:: {module.__name__}.{kind.__name__}"
    lines += ["", "## Class", "", "```{eval-rst}", auto, "   :no-index:", "```", ""]
    return "\n".join(lines)
