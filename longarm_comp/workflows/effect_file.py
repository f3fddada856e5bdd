"""What was found without a name, as a file of effects that other diagnoses can try."""

from __future__ import annotations

import re
from pathlib import Path

from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.errors import JobError
from longarm_comp.core.files import write_text
from longarm_comp.core.identify.diagnosis import Diagnosis
from longarm_comp.core.identify.discover.discovery import Cause

_HEAD = '''"""Effects that a diagnosis of {arm} found without a name.

Rename them once you know what they are.

    longarm diagnose ARM SESSION --effects THIS_FILE
"""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm import spatial
from longarm_comp.core.effects.discovered import Discovered
from longarm_comp.core.effects.effect import Effect, parameter
'''

_CLASS = '''

@dataclass(frozen=True)
class {title}(Effect):
    """{sentence}."""

    name: ClassVar[str] = "{name}"
    needs: ClassVar[tuple[str, ...]] = {needs!r}
    loaded: ClassVar[bool] = True
    parts: ClassVar[tuple[Discovered, ...]] = (
{parts}
    )

{fields}

    @classmethod
    def candidates(cls, arm):
        """As a whole."""
        return [(cls(),)]

    def history_joints(self, arm):
        """Joints whose side of arrival it reads."""
        return tuple(sorted({{j for part in self.parts for j in part.history_joints(arm)}}))

    def twists(self, posture):
        """Sum of its parts, each with its amount."""
        total = {{}}
        for number, part in enumerate(self.parts, 1):
            amount = getattr(self, f"amount_{{number}}")
            for station, twist in dataclasses.replace(part, amount=amount).twists(posture).items():
                held = total.get(station, spatial.ZERO_TWIST)
                total[station] = spatial.add_twists(held, twist)
        return total
'''


def write_effects(found: Diagnosis, path: Path) -> None:
    """Write the arm's causes without a name as classes, for ``--effects``."""
    added = found.added.found if found.added is not None else ()
    causes = [c for c in added if c.compensated]
    if not causes:
        raise JobError("nothing was found without a name, so there is no effect to write")
    names = [f"found_{number}_{_word(c.where[0])}" for number, c in enumerate(causes, 1)]
    text = _HEAD.format(arm=_plain(found.arm.name))
    text += "".join(_class(found, c, name) for c, name in zip(causes, names, strict=True))
    write_text(path, text)


def _class(found: Diagnosis, cause: Cause, name: str) -> str:
    terms = [t for t in cause.terms if isinstance(t, Discovered)]
    parts = "\n".join(
        f"        Discovered({t.at!r}, {t.component!r}, {t.function!r}, {t.domain!r}, {t.scale!r}),"
        for t in terms
    )
    fields = "\n".join(
        f'    amount_{n}: float = parameter("{t.parameters(found.arm)[0].unit}", '
        f'"found: {t.amount:.4g}", prior={t.scale!r})'
        for n, t in enumerate(terms, 1)
    )
    return _CLASS.format(
        title="".join(part.title() for part in name.split("_")),
        name=name,
        sentence=_plain(cause.sentence),
        needs=tuple(sorted({i for t in terms for i in t.inputs})),
        parts=parts,
        fields=fields,
    )


def _word(where: str) -> str:
    return re.sub(r"[^a-z0-9]+", "_", where.lower()).strip("_")


def _plain(text: str) -> str:
    """Text that is safe in a docstring."""
    return text.replace("\\", "/").replace('"', "'")
