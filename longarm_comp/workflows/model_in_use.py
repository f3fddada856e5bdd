"""Replaces the model and the predictor in use together, and can undo this.

A predictor belongs to one version of the model. `predictor.npz` is in use. Others are kept beside
it as `predictor.of_<hash>.npz`, with the hash of the model that they were trained with. New files
are written first, and a predictor that no longer fits is set aside last. So an interrupted change
leaves a model with a predictor that fits, or a model alone, and the next change finishes it.
"""

import hashlib
import os
import re
from pathlib import Path

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import alone_in, file_hash, follow_link, write_bytes
from longarm_comp.core.learn import predictor_file
from longarm_comp.core.model import model_file
from longarm_comp.workflows.train import TrainedPredictor

_HASH = 12
_KEPT = re.compile(rf"\.of_[0-9a-f]{{{_HASH}}}$")


def put_to_work(
    model: Path, content: bytes, predictor: Path, trained: TrainedPredictor | None
) -> Path | None:
    """Replace the model in use by a new version, and the predictor in use by the `trained` one.

    Without a trained predictor, none is in use afterwards.

    Args:
        content: the new model file.

    Returns:
        The file that keeps the earlier predictor, if there was one.
    """
    finish_change(model, predictor)
    aside = _keep_predictor(predictor)
    new = _kept_as(predictor, hashlib.sha256(content).hexdigest())
    if trained is not None:
        trained.save(new)
    else:
        new.unlink(missing_ok=True)  # of an earlier time that was taken back
    model_file.write_version(model, content)
    finish_change(model, predictor)
    if aside is not None and trained is None:
        os.replace(predictor, aside)
    # Predictors of versions that `undo` no longer reaches
    versions = [path for path in (model, model_file.previous(model)) if path.is_file()]
    needed = {aside, *(_kept_as(predictor, file_hash(path)) for path in versions)}
    for path in predictor.parent.glob(f"{predictor.stem}.of_*{predictor.suffix}"):
        if _KEPT.search(path.stem) and path not in needed and _trained_with(path):
            path.unlink()
    return aside


def undo(model: Path, predictor: Path | None = None) -> Path | None:
    """Restore a model's previous version, byte for byte, and the predictor that belonged to it.

    Predictors are looked for beside the model. One that belonged to the undone version is set
    aside. An interrupted undo is finished by calling it again.

    Args:
        predictor: file of the predictor in use, if it may be in another folder.

    Returns:
        The file of the predictor that was restored, if any.

    Raises:
        InputError: there is no previous version; another process changes the model.
    """
    with alone_in(follow_link(model).parent):
        beside = [
            follow_link(p)
            for ending in predictor_file.ENDINGS
            for p in model.parent.glob(f"[!.]*{ending}")
            if p.is_symlink() or _trained_with(p) is not None
        ]
        beside += [] if predictor is None else [follow_link(predictor)]
        names = sorted({p.with_name(_KEPT.sub("", p.stem) + p.suffix) for p in beside})
        discarded = file_hash(model) if model.is_file() else ""
        back = [name for name in names if finish_change(model, name)]
        if not (back and not model_file.previous(model).is_file()):
            model_file.undo(model)
            back = [name for name in names if finish_change(model, name)]
            for name in names:
                if name.is_file() and _trained_with(name) == discarded:
                    os.replace(name, _kept_as(name, discarded))
        return back[0] if back else None


def finish_change(model: Path, predictor: Path) -> bool:
    """Finish an interrupted change; return whether this puts a predictor that was kept to use."""
    model_file.settle(model)
    fits = _kept_as(predictor, file_hash(model)) if model.is_file() else None
    if fits is None or not fits.is_file():
        return False
    _keep_predictor(predictor)
    os.replace(fits, predictor)
    return True


def _keep_predictor(predictor: Path) -> Path | None:
    """Copy the predictor in use to a file named after its model, and return that; None if none."""
    if not predictor.is_file():
        return None
    aside = _kept_as(predictor, _trained_with(predictor) or file_hash(predictor))
    write_bytes(aside, predictor.read_bytes())
    return aside


def _kept_as(predictor: Path, of: str) -> Path:
    return predictor.with_name(f"{predictor.stem}.of_{of[:_HASH]}{predictor.suffix}")


def _trained_with(path: Path) -> str | None:
    """Return the SHA-256 of the model that a predictor was trained with; None for another file."""
    try:
        return str(predictor_file.read_settings(path).get("model_hash", ""))
    except InputError:
        return None
