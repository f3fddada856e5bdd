"""Cases of the loop study: effects, arm and data."""

import dataclasses
import hashlib
import itertools
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.errors import InputError
from longarm_comp.sim.hidden.catalogue import OUTSIDE_EVERY_LIBRARY
from studies.true_camera import HIDDEN

NAMES = tuple(kind.name for kind in LIBRARY if kind.name in HIDDEN)
"""Effects that the study's arm can have. Slides without a declared guide are on other arms."""
GROUPS = ("none", "single", "pair", "removed", "outside")


@dataclass(frozen=True)
class Spoiled:
    """Disturbances of the measurement.

    Attributes:
        outliers: share of gross errors.
        rho: correlation of the noise from row to row.
        tail_dof: of Student's t; None is normal.
        geometry: times the usual geometry errors (joint zeros, DH rows, base).
    """

    outliers: float = 0.02
    rho: float = 0.0
    tail_dof: float | None = None
    geometry: float = 1.0


SPOILED: dict[str, Spoiled] = {
    "usual": Spoiled(),
    "clean": Spoiled(outliers=0.0, geometry=0.0),
    "outliers": Spoiled(outliers=0.12),
    "heavy_tails": Spoiled(tail_dof=3.0),
    "correlated": Spoiled(rho=0.9),
    "geometry": Spoiled(geometry=3.0),
}


@dataclass(frozen=True)
class Case:
    """One data set to diagnose. Its `id` names it and seeds all of its random choices.

    Attributes:
        group: none, single, pair, removed (the true effects are not in the library) or outside.
        effects: canonical names of the hidden effects.
        one_place: the effect is at one joint or beam only, if it could be at several.
        spoiled: key of `SPOILED`.
        plan: ``grid`` (the paper's) or ``sobol``.
        rows: number of rows for fitting, without the hold-out.
        noise: factor on the usual noise of a stereo head (0.22 mm across, 0.36 mm in depth).
        arm: 0 is the declared arm, others are random variants.
        number: number of the repetition.
    """

    group: str
    effects: tuple[str, ...]
    one_place: bool
    spoiled: str
    plan: str
    rows: int
    noise: float
    arm: int
    number: int

    @property
    def id(self) -> str:
        """``single/backlash/one/usual/grid/300/1/arm2/0``."""
        place = "one" if self.one_place else "all"
        words = (self.group, "+".join(self.effects) or "-", place, self.spoiled, self.plan)
        return f"{'/'.join(words)}/{self.rows}/{self.noise:g}/arm{self.arm}/{self.number}"

    @property
    def rng(self) -> np.random.Generator:
        """A random generator of this case alone."""
        return np.random.default_rng(list(hashlib.sha256(self.id.encode()).digest()))

    def as_dict(self) -> dict[str, object]:
        """Return fields of a JSON line."""
        return {**dataclasses.asdict(self), "effects": list(self.effects), "id": self.id}


@dataclass(frozen=True)
class Design:
    """Selection of cases: every combination of the lists, `repeats` times.

    Raises:
        InputError: an unknown group, effect or plan, or too few rows.
    """

    groups: Sequence[str] = GROUPS
    effects: Sequence[str] = NAMES
    plans: Sequence[str] = ("grid",)
    rows: Sequence[int] = (300, 60)
    noises: Sequence[float] = (1.0,)
    arms: int = 3
    repeats: int = 2
    pairs: int = 20

    def __post_init__(self) -> None:
        known: Mapping[str, tuple[Sequence[str], Sequence[str]]] = {
            "groups": (self.groups, GROUPS),
            "effects": (self.effects, NAMES),
            "plans": (self.plans, ("grid", "sobol")),
        }
        for name, (given, allowed) in known.items():
            for value in given:
                if value not in allowed:
                    raise InputError("study loop", name, value, ", ".join(allowed))
        if min(self.rows) < 30:
            raise InputError("study loop", "rows", min(self.rows), "at least 30")
        for name in ("arms", "repeats"):
            if getattr(self, name) < 1:
                raise InputError("study loop", name, getattr(self, name), "at least 1")

    def cases(self) -> list[Case]:
        """Return all cases. Repetitions are the outer loop, so that a part is a fair sample."""
        drawn = []
        for number, arm in itertools.product(range(self.repeats), range(self.arms)):
            for plan, rows, noise in itertools.product(self.plans, self.rows, self.noises):
                for group in self.groups:
                    for effects, spoiled in self._menu(group, number * self.arms + arm):
                        odd = (number + arm) % 2 == 1
                        drawn.append(
                            Case(group, effects, odd, spoiled, plan, rows, noise, arm, number)
                        )
        return drawn

    def _menu(self, group: str, turn: int) -> Iterator[tuple[tuple[str, ...], str]]:
        """Yield the effects and the disturbance of every case of a group, on one arm."""
        if group == "none":
            yield from (((), name) for name in SPOILED)
        elif group == "pair":  # other pairs on every arm; in the end all of them
            every = list(itertools.combinations(self.effects, 2))
            order = np.random.default_rng(len(every)).permutation(len(every))
            for k in range(min(self.pairs, len(every))):
                yield every[order[(turn * self.pairs + k) % len(every)]], "usual"
        else:
            names = OUTSIDE_EVERY_LIBRARY if group == "outside" else self.effects
            yield from (((name,), "usual") for name in names)
