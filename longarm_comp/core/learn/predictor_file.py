"""Predictor files: an npz of plain arrays with a JSON header, never a pickle."""

from __future__ import annotations

import dataclasses
import io
import json
import os
import zipfile
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import atomic_path, check_unpacked
from longarm_comp.core.learn.inputs import INPUT_KINDS, Encoding, raw_names
from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance

FORMAT = "longarm/predictor"
VERSION = 1

_LARGEST = 1e6
"""Inputs, weights and lengths (m) are far below it: no arm is a thousand kilometres long."""

_ARRAYS = (
    "kept", "mean", "input_scale", "lower", "upper", "weights", "posterior", "offset", "noise",
    "widen",
)  # fmt: skip


def save(predictor: Predictor, path: str | os.PathLike[str]) -> None:
    """Write ``predictor`` to ``path``, whole or not at all."""
    origin, encoding = predictor.provenance, predictor.encoding
    header = {
        "format": FORMAT, "version": VERSION, "arm_hash": origin.arm_hash,
        "session_hash": origin.session_hash, "joint_names": list(origin.joint_names),
        "settings": dict(origin.settings), "joints": encoding.joints,
        "context": list(encoding.context), "hidden": predictor.hidden, "scale": predictor.scale,
        "variance_limit": predictor.variance_limit, "input_names": list(encoding.names),
    }  # fmt: skip
    text = json.dumps(header, sort_keys=True).encode()
    buffer = io.BytesIO()
    np.savez(
        buffer,
        header=np.frombuffer(text, dtype=np.uint8),
        kept=encoding.kept.astype(np.int64),
        mean=encoding.mean,
        input_scale=encoding.scale,
        lower=predictor.lower,
        upper=predictor.upper,
        weights=predictor.weights,
        posterior=predictor.posterior,
        offset=predictor.offset,
        noise=predictor.noise,
        widen=predictor.widen,
        alone=predictor.alone,
        gain=np.array(dataclasses.astuple(predictor.gain)),
    )
    with atomic_path(path) as partial:
        partial.write_bytes(buffer.getvalue())


def load(
    path: str | os.PathLike[str],
    *,
    arm_hash: str | None = None,
    joint_names: tuple[str, ...] | None = None,
) -> Predictor:
    """Read a predictor. A given ``arm_hash`` or ``joint_names`` must match the file."""
    arrays = _arrays(path)
    header = _header(path, arrays)
    joints, context, hidden = header["joints"], tuple(header["context"]), header["hidden"]
    columns = len(raw_names(joints, context))
    kept = arrays["kept"]
    if kept.dtype.kind != "i" or kept.ndim != 1 or not len(kept) or kept.min() < 0:
        raise InputError(path, "kept", kept.dtype, "column indices")
    if kept.max() >= columns or len(np.unique(kept)) != len(kept):
        raise InputError(path, "kept", kept.tolist(), f"distinct columns below {columns}")
    d = len(kept)
    size = NetworkShape(d, hidden, 3).size
    members, rank = (max(1, len(np.atleast_1d(arrays[n]))) for n in ("weights", "posterior"))
    shapes = {
        "mean": (d,), "input_scale": (d,), "lower": (columns,), "upper": (columns,),
        "weights": (members, size), "posterior": (rank, size), "offset": (3,),
        "noise": (3,), "widen": (3,),
    }  # fmt: skip
    for name, shape in shapes.items():
        value = arrays[name]
        if value.shape != shape or value.dtype.kind != "f":
            raise InputError(path, name, f"{value.dtype} {value.shape}", f"floats {shape}")
        if not (np.abs(value) <= _LARGEST).all():
            raise InputError(path, name, "NaN or too large", f"numbers up to {_LARGEST:g}")
    if not (arrays["input_scale"] > 0).all():
        raise InputError(path, "input_scale", arrays["input_scale"].min(), "> 0")
    alone = arrays.get("alone", np.full(3, np.inf))  # files of earlier versions hold none
    if alone.shape != (3,) or alone.dtype.kind != "f" or not _lengths(alone, alone >= 0):
        raise InputError(path, "alone", alone.tolist(), "three lengths of 0 m or more")
    gain = arrays.get("gain", np.array(dataclasses.astuple(LearnedGain())))
    if gain.shape != (3,) or gain.dtype.kind != "f" or not _lengths(gain):
        raise InputError(path, "gain", gain.tolist(), "three lengths in m")
    if arm_hash is not None and header["arm_hash"] != arm_hash:
        raise InputError(path, "arm_hash", header["arm_hash"], f"{arm_hash} (the arm in use)")
    names = tuple(header["joint_names"])
    if joint_names is not None and names != tuple(joint_names):
        raise InputError(path, "joint_names", names, f"{tuple(joint_names)} (the arm in use)")
    return Predictor(
        encoding=Encoding(joints, context, kept, arrays["mean"], arrays["input_scale"]),
        lower=arrays["lower"],
        upper=arrays["upper"],
        weights=arrays["weights"],
        hidden=hidden,
        posterior=arrays["posterior"].astype(np.float32),
        offset=arrays["offset"],
        scale=header["scale"],
        noise=arrays["noise"],
        widen=arrays["widen"],
        variance_limit=header["variance_limit"],
        alone=alone,
        gain=LearnedGain(*gain.tolist()),
        provenance=Provenance(
            header["arm_hash"], header["session_hash"], names, header["settings"]
        ),
    )


def _lengths(values: NDArray[Any], fits: NDArray[Any] | bool = True) -> bool:
    """Whether these are lengths; infinite is what is unknown."""
    known = np.isposinf(values) | (np.abs(values) <= _LARGEST)
    return bool((known & fits).all())


def belongs(predictor: Predictor, path: str | os.PathLike[str], model_hash: str, to: str) -> None:
    """Check that a predictor was trained on the residual of this physics.

    Args:
        path: file of the predictor, for the error message.
        model_hash: SHA-256 of model.yaml; empty for the declared arm.
        to: the expected model, for the error message.
    """
    found = predictor.provenance.settings.get("model_hash", model_hash)
    if found != model_hash:
        said = str(found)[:12] if found else "the declared arm"
        raise InputError(path, "model_hash", said, to)


def _arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    try:
        with zipfile.ZipFile(Path(path)) as probe:
            check_unpacked(path, probe)
            broken = probe.testzip()
            if broken is not None:
                raise InputError(path, broken, "checksum does not match", "an undamaged file")
        with np.load(path, allow_pickle=False) as data:
            arrays = {name: data[name] for name in data.files}
    except FileNotFoundError as error:
        raise InputError(path, "predictor file", "not found", "an existing file") from error
    except OSError as error:
        raise InputError(path, "predictor file", str(error), "a readable file") from error
    except InputError:
        raise
    except Exception as error:  # whatever zipfile, zlib and numpy raise on damaged bytes
        found = f"corrupt or truncated ({error})"
        raise InputError(path, "predictor file", found, "an npz that longarm wrote") from error
    for name in ("header", *_ARRAYS):
        if not isinstance(arrays.get(name), np.ndarray):
            raise InputError(path, name, "missing", f"the arrays {['header', *_ARRAYS]}")
    return arrays


_HEADER_TYPES: dict[str, type | tuple[type, ...]] = {
    "arm_hash": str, "session_hash": str, "joint_names": list, "settings": dict, "joints": int,
    "context": list, "hidden": int, "scale": float, "variance_limit": float,
}  # fmt: skip


def _header(path: str | os.PathLike[str], arrays: dict[str, NDArray[Any]]) -> dict[str, Any]:
    try:
        header = json.loads(arrays["header"].tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise InputError(path, "header", "not JSON", "a JSON object") from error
    if not isinstance(header, dict) or header.get("format") != FORMAT:
        found = header.get("format") if isinstance(header, dict) else type(header).__name__
        raise InputError(path, "format", found, FORMAT)
    if header.get("version") != VERSION:
        raise InputError(path, "version", header.get("version"), VERSION)
    for name, kind in _HEADER_TYPES.items():
        if not isinstance(header.get(name), kind):
            raise InputError(path, name, header.get(name), f"a {kind}")
    for name in ("joints", "hidden"):
        if not 1 <= header[name] <= 10_000:
            raise InputError(path, name, header[name], "1..10000")
    for name in ("scale", "variance_limit"):
        if not np.isfinite(header[name]) or header[name] <= 0:
            raise InputError(path, name, header[name], "a finite number > 0")
    if not all(name in INPUT_KINDS["context"] for name in header["context"]):
        raise InputError(path, "context", header["context"], f"of {INPUT_KINDS['context']}")
    return header
