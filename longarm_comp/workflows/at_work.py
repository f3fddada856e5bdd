"""Model and predictor at work, changed together, and taken back.

A predictor belongs to one version of the model. Beside `predictor.npz`, which is at work, others
are kept under the model that they were trained with, `predictor.of_<hash>.npz`. What is new is
written first, what no longer fits is set aside last: a change that was broken off leaves a model
and a predictor that fit, or the model alone, and the next change finishes it.
"""

from __future__ import annotations

import hashlib
import os
import re
from pathlib import Path
from typing import TYPE_CHECKING

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.model import file_versions, model_file
from longarm_comp.workflows.inputs import file_hash

if TYPE_CHECKING:
    from longarm_comp.workflows.train import TrainedPredictor

_HASH = 12
_KEPT = re.compile(rf"\.of_[0-9a-f]{{{_HASH}}}$")


def put_to_work(
    model: Path, content: bytes, predictor: Path, trained: TrainedPredictor | None = None
) -> Path | None:
    """Replace the model at work by a new version's content, and the predictor by its `trained` one.

    Without one no predictor is at work then. Returns where the predictor before is kept, if any.
    """
    finish(model, predictor)
    aside = _keep(predictor)
    new = hashlib.sha256(content).hexdigest()
    if trained is not None:
        trained.save(_kept(predictor, new))
    else:
        _kept(predictor, new).unlink(missing_ok=True)  # of an earlier time that was taken back
    file_versions.put(model, content)
    finish(model, predictor)
    if aside is not None and trained is None:
        os.replace(predictor, aside)
    _forget(model, predictor)
    return aside


def undo(model: Path) -> Path | None:
    """Restore the version of a model before, byte for byte, and the predictor that belonged to it.

    Predictors are looked for beside the model. One that belonged to the version taken back is
    set aside. Broken off, it is finished by calling it again. Returns the predictor that came back.
    """
    at_work = [p for p in sorted(model.parent.glob("[!.]*.npz")) if _trained_with(p) is not None]
    names = sorted({p.with_name(_KEPT.sub("", p.stem) + p.suffix) for p in at_work})
    discarded = file_hash(model) if model.is_file() else ""
    back = [name for name in names if finish(model, name)]
    if not (back and not file_versions.previous(model).is_file()):
        model_file.undo(model)
        back = [name for name in names if finish(model, name)]
        for name in names:
            if name.is_file() and _trained_with(name) == discarded:
                os.replace(name, _kept(name, discarded))
    return back[0] if back else None


def finish(model: Path, predictor: Path) -> bool:
    """Finish a change that was broken off; whether a predictor is at work again by it."""
    file_versions.settle(model)
    fits = _kept(predictor, file_hash(model)) if model.is_file() else None
    if fits is None or not fits.is_file():
        return False
    _keep(predictor)
    os.replace(fits, predictor)
    return True


def _keep(predictor: Path) -> Path | None:
    """A copy of the predictor at work under its model's name; None where there is none."""
    if not predictor.is_file():
        return None
    aside = _kept(predictor, _trained_with(predictor) or file_hash(predictor))
    with atomic_path(aside) as partial:
        partial.write_bytes(predictor.read_bytes())
    return aside


def _forget(model: Path, predictor: Path) -> None:
    """Remove predictors of versions that `undo` no longer reaches."""
    versions = [path for path in (model, file_versions.previous(model)) if path.is_file()]
    needed = {_kept(predictor, file_hash(path)) for path in versions}
    for path in predictor.parent.glob(f"{predictor.stem}.of_*{predictor.suffix}"):
        if _KEPT.search(path.stem) and path not in needed and _trained_with(path):
            path.unlink()


def _kept(predictor: Path, of: str) -> Path:
    return predictor.with_name(f"{predictor.stem}.of_{of[:_HASH]}{predictor.suffix}")


def _trained_with(path: Path) -> str | None:
    """SHA-256 of the model that a predictor was trained with; None: another kind of file."""
    try:
        settings = predictor_file.load(path).provenance.settings
    except InputError:
        return None
    return str(settings.get("model_hash", ""))
