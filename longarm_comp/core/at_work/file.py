"""The file of what was learned at work, from which a restart continues.

It holds the model in use with its uncertainty, not the explanations that were still open. A doubt
about the last sightings is not stored either: the model from before it is.
"""

import json
import os
from contextlib import suppress
from pathlib import Path
from typing import Literal

from pydantic import Field

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.at_work.explanations import NamedChange
from longarm_comp.core.at_work.learner import STEP_M, Learner, Version
from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_regular, follow_link, write_text
from longarm_comp.core.model.model import Model
from longarm_comp.core.model.model_file import StoredModel, restore, store
from longarm_comp.core.yaml_file import Declared, parse_declared


class _StoredVersion(Declared):
    """A version of the model, and since when it is in use; the first one is the given model."""

    at_s: float | None
    model: StoredModel
    named: NamedChange | None


class _StoredLearner(Declared):
    schema_: Literal["longarm/at_work/1"] = Field(alias="schema")
    given: str = Field(description="SHA-256 of the model.yaml that it began with")
    frozen: bool
    sightings: int = Field(ge=0)
    doubtful: int = Field(ge=0)
    served: StoredModel
    versions: tuple[_StoredVersion, ...] = Field(min_length=1)


def save(path: str | Path, learner: Learner, given: str) -> None:
    """Write the state of a learner to a file.

    Args:
        given: SHA-256 of the model.yaml that the learner began with.
    """
    stored = _StoredLearner(
        schema="longarm/at_work/1",
        given=given,
        frozen=learner.frozen,
        sightings=learner.sightings,
        doubtful=learner.doubtful,
        served=store(learner.settled or learner.model),
        versions=tuple(
            _StoredVersion(
                at_s=None if v.named is None else v.at_s, model=store(v.model), named=v.named
            )
            for v in learner.versions
        ),
    )
    write_text(path, stored.model_dump_json(by_alias=True, indent=1))


def take_up(path: Path, given: str) -> None:
    """Put the file of what was learned with a model in its place, if there is one.

    A file there that learned with another model is kept beside it, under the hash of that model.

    Args:
        given: SHA-256 of the model.yaml in use.

    Raises:
        InputError: the file there cannot be read.
    """
    here = follow_link(path)
    held = _read(here) if here.exists() else None
    if held is not None and held.given == given:
        return
    with suppress(OSError):  # a folder that takes no name takes no file either, which `save` says
        if held is not None and held.sightings:
            os.replace(here, _kept_as(here, held.given))
        if (kept := _kept_as(here, given)).exists():
            os.replace(kept, here)


def _kept_as(path: Path, given: str) -> Path:
    return path.with_name(f"{path.stem}.of_{given[:12]}{path.suffix}")


def load(path: str | Path, model: Model, given: str, step_m: float = STEP_M) -> Learner:
    """Return the learner that a file holds for a model.

    Without a file, or with one of another model, the learner begins from the model.

    Args:
        model: the model of model.yaml.
        given: SHA-256 of this model.yaml.
        step_m: largest step of the tip by one sighting, m.

    Raises:
        InputError: the file cannot be read, or a model in it has no uncertainty.
    """
    begun = Learner.of(model, step_m)
    if not Path(path).exists():
        return begun
    stored = _read(path)
    if stored.given != given:
        return begun
    where, arm = str(path), model.arm
    versions = (
        begun.versions[0],
        *(
            Version(v.at_s or 0.0, _restore_known(v.model, arm, where), v.named)
            for v in stored.versions[1:]
        ),
    )
    return Learner(
        _restore_known(stored.served, arm, where),
        versions=versions,
        frozen=stored.frozen,
        step_m=step_m,
        sightings=stored.sightings,
        doubtful=stored.doubtful,
    )


def _read(path: str | Path) -> _StoredLearner:
    check_regular(path)
    try:
        read = json.loads(Path(path).read_text(encoding="utf-8"))
    except (ValueError, OSError) as error:
        raise InputError(path, "file", str(error), "a file that kinematics wrote") from None
    return parse_declared(_StoredLearner, read, str(path))


def _restore_known(stored: StoredModel, arm: Arm, where: str) -> Model:
    """Restore a model; refuse one without uncertainty, because learning needs it."""
    model = restore(stored, arm, where)
    if model.uncertainty is None:
        raise InputError(where, "uncertainty", "missing", "a model that kinematics wrote")
    return model
