"""Reads the public data sets as sessions, with their stated splits."""

import csv
import dataclasses
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.spatial import Frame, sub
from longarm_comp.core.data.session import Session
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.model import Model

JUSTIN = "dlr_justin/samples.csv"
TRACKED = "wam_ur5/{}_samples.csv"


@dataclass(frozen=True)
class Measured:
    """One arm with its rows to fit, and those held out; None where no split is stated."""

    arm: Arm
    train: Session
    test: Session | None

    @property
    def held_out(self) -> Session:
        """The rows of a stated split."""
        assert self.test is not None
        return self.test

    @property
    def splits(self) -> list[tuple[Session, Session | None]]:
        """Rows to fit and rows held out; touches by the places of the tool in turn."""
        if self.test is not None or "location" not in self.train.labels:
            return [(self.train, self.test)]
        place = self.train.labels["location"]
        return [
            (self.train.take(place != p), self.train.take(place == p)) for p in np.unique(place)
        ]


def declared_arm(name: str) -> Arm:
    """Return an arm file that ships with the studies."""
    return Arm.load(Path(__file__).parent / "arms" / f"{name}.yaml")


def _table(path: Path) -> list[dict[str, str]]:
    try:
        with path.open(newline="", encoding="utf-8") as handle:
            return list(csv.DictReader(handle))
    except OSError as error:
        raise InputError(str(path), "file", type(error).__name__, "the public data set") from error


def every_robot(folder: Path) -> dict[str, list[Measured]]:
    """Return the sets that a folder holds, by robot: ``dlr_justin``, ``wam``, ``ur5``.

    Raises:
        InputError: it holds none.
    """
    readers = {
        "dlr_justin": (JUSTIN, justin),
        "wam": (TRACKED.format("wam"), lambda at: laser_tracked(at, "wam")),
        "ur5": (TRACKED.format("ur5"), lambda at: laser_tracked(at, "ur5")),
    }
    held = {
        name: read(folder) for name, (file, read) in readers.items() if (folder / file).exists()
    }
    if not held:
        allowed = f"one that holds {' or '.join(file for file, _ in readers.values())}"
        raise InputError("--data", "folder", folder, allowed)
    return held


def justin(folder: Path) -> list[Measured]:
    """Read DLR Agile Justin, right and left arm (split: default_rng(0), 350 postures to train).

    The other arm loads the torso with its own posture; its weight is one mass at its rigid
    centre of mass in the last torso frame.
    """
    rows = _table(folder / JUSTIN)
    order = np.random.default_rng(0).permutation(500)
    sessions = []
    chains = {side: declared_arm(f"justin_{side}") for side in ("right", "left")}
    columns = {"right": range(4, 11), "left": range(11, 18)}
    for side, other in (("right", "left"), ("left", "right")):
        mine = [r for r in rows if r["arm"] == side]
        numbers = np.array([int(r["sample"]) for r in mine])

        def joints(kind: str, mine: list[dict[str, str]] = mine) -> np.ndarray:
            names = [f"q{j}" for j in (1, 2, 3, *columns[kind])]
            return np.array([[float(r[n]) for n in names] for r in mine])

        mass_at = _centre_of_mass(chains[other], joints(other))
        session = Session.record(
            joints(side),
            np.array([[float(r[c]) for c in "xyz"] for r in mine]),
            index=numbers,
            columns={f"other_arm_{c}": mass_at[:, k] for k, c in enumerate("xyz")},
            source=f"dlr_justin {side}",
        )
        train = np.isin(numbers, order[:350])
        sessions.append(Measured(chains[side], session.take(train), session.take(~train)))
    return sessions


def _centre_of_mass(arm: Arm, q: np.ndarray) -> np.ndarray:
    """Return the centre of mass (N, 3) of all beyond the fixed row 5, in row 4 (last of torso)."""
    still = tuple(m for m in arm.point_masses if m.frame > 5)
    bare = arm.model_copy(update={"point_masses": still})
    model = Model(bare)
    posture = model.posture([q[:, j] for j in range(arm.n)])
    mass, first = posture.carried_masses
    station = posture.frame(5)
    world = tuple(f / mass[station] for f in first[station])
    torso: Frame = posture.frames[posture.frame(4)]
    return np.stack(np.broadcast_arrays(*torso.unrotate(sub(world, torso.p))), -1)  # type: ignore[arg-type]


def laser_tracked(folder: Path, name: str) -> list[Measured]:
    """Read Barrett WAM or UR5 by laser tracker (authors' split: grid to train, random to test)."""
    rows = _table(folder / TRACKED.format(name))
    arm = declared_arm(name)
    session = Session.record(
        np.array([[float(r[f"q{j + 1}"]) for j in range(arm.n)] for r in rows]),
        np.array([[float(r[c]) for c in "xyz"] for r in rows]),
        source=f"{name}_samples.csv",
    )
    session = dataclasses.replace(session, labels={"role": np.array([r["set"] for r in rows])})
    return [Measured(arm, session.where("role", "grid"), session.where("role", "random"))]
