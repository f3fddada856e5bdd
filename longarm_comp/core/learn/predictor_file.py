"""Predictor files: plain arrays with a JSON header, never a pickle.

An npz holds the paper's networks. A network of others needs torch and its own code to be of use; so
that no program takes it for one of the paper's, its file is safetensors."""

from __future__ import annotations

import dataclasses
import hashlib
import io
import json
import os
import zipfile
from collections.abc import Mapping
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from longarm_comp.core.errors import InputError
from longarm_comp.core.files import check_regular, check_unpacked, write_bytes
from longarm_comp.core.learn.inputs import Encoding, raw_names
from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance
from longarm_comp.core.yaml_file import Declared, parse_declared

_LARGEST = 1e6
"""Inputs, weights and lengths (m) are far below it: no arm is a thousand kilometres long."""
_OTHERS = ".safetensors"
"""Ending of the file of a network of others."""

_ARRAYS = ("lower", "upper", "weights", "posterior", "offset", "noise", "widen", "alone")
"""Of a predictor, under their own names."""


class _Network(Declared):
    """Which network of others it is; `others` finds it."""

    name: str
    origin: str


class _Header(Declared):
    """What a file says in JSON beside its arrays."""

    format: Literal["longarm/predictor"]
    version: Literal[1]
    arm_hash: str
    session_hash: str
    joint_names: tuple[str, ...]
    settings: dict[str, Any]
    joints: int = Field(ge=1, le=10_000)
    context: tuple[Literal["approach", "temperature_c", "payload_kg"], ...]
    hidden: int = Field(ge=0, le=10_000)
    scale: float = Field(gt=0, le=_LARGEST)
    variance_limit: float = Field(gt=0, le=_LARGEST**2)
    input_names: tuple[str, ...]
    network: _Network | None = None


def check_ending(path: str | os.PathLike[str], of_others: bool) -> None:
    """Check that the name says which kind of network the file holds."""
    ending = Path(path).suffix
    if of_others != (ending == _OTHERS):
        allowed = f"{_OTHERS} for a network of others, .npz for the paper's"
        raise InputError(path, "predictor file", f"ends in {ending or 'nothing'}", allowed)


def save(predictor: Predictor, path: str | os.PathLike[str]) -> None:
    """Write ``predictor`` to ``path``, whole or not at all."""
    check_ending(path, predictor.network is not None)
    origin, encoding = predictor.provenance, predictor.encoding
    header = {
        "format": "longarm/predictor", "version": 1, "arm_hash": origin.arm_hash,
        "session_hash": origin.session_hash, "joint_names": origin.joint_names,
        "settings": dict(origin.settings), "joints": encoding.joints,
        "context": encoding.context, "hidden": predictor.hidden, "scale": predictor.scale,
        "variance_limit": predictor.variance_limit, "input_names": encoding.names,
    }  # fmt: skip
    arrays = {
        "kept": encoding.kept.astype(np.int64),
        "mean": encoding.mean,
        "input_scale": encoding.scale,
        "gain": np.array(dataclasses.astuple(predictor.gain)),
        **{name: getattr(predictor, name) for name in _ARRAYS},
    }
    if predictor.network is None:
        text = json.dumps(header, sort_keys=True).encode()
        buffer = io.BytesIO()
        np.savez(buffer, header=np.frombuffer(text, dtype=np.uint8), **arrays)
        content = buffer.getvalue()
    else:
        from safetensors.numpy import save as packed

        network = {"name": predictor.network.name, "origin": predictor.network.origin}
        said = json.dumps(header | {"network": network}, sort_keys=True)
        arrays = {name: np.ascontiguousarray(array) for name, array in arrays.items()}
        content = packed(arrays, {"header": said, "sha256": _digest(said, arrays)})
    write_bytes(path, content)


def load(
    path: str | os.PathLike[str],
    *,
    arm_hash: str | None = None,
    joint_names: tuple[str, ...] | None = None,
) -> Predictor:
    """Read a predictor. A given ``arm_hash`` or ``joint_names`` must match the file."""
    arrays = _arrays(path)
    header = _header(path, arrays)
    columns = len(raw_names(header.joints, header.context))
    kept = arrays["kept"]
    if kept.dtype.kind != "i" or kept.ndim != 1 or not len(kept) or kept.min() < 0:
        raise InputError(path, "kept", kept.dtype, "column indices")
    if kept.max() >= columns or len(np.unique(kept)) != len(kept):
        raise InputError(path, "kept", kept.tolist(), f"distinct columns below {columns}")
    d = len(kept)
    if (header.hidden == 0) != (header.network is not None):
        raise InputError(path, "hidden", header.hidden, "0 of a network of others alone")
    size = NetworkShape(d, header.hidden, 3).size
    network = None
    if header.network is not None:
        from longarm_comp.core.learn.others import saved

        network = saved(header.network.name, header.network.origin, path)
        size = network.stack(d, 3).size
    members, rank = (max(1, len(np.atleast_1d(arrays[n]))) for n in ("weights", "posterior"))
    shapes = {
        "mean": (d,), "input_scale": (d,), "lower": (columns,), "upper": (columns,),
        "weights": (members, size), "posterior": (rank, size), "offset": (3,),
        "noise": (3,), "widen": (3,), "alone": (3,), "gain": (3,),
    }  # fmt: skip
    for name, shape in shapes.items():
        value = arrays[name]
        if value.shape != shape or value.dtype.kind != "f":
            raise InputError(path, name, f"{value.dtype} {value.shape}", f"floats {shape}")
        unknown = np.isposinf(value) if name in ("alone", "gain") else False
        if not (unknown | (np.abs(value) <= _LARGEST)).all():
            raise InputError(path, name, "NaN or too large", f"numbers up to {_LARGEST:g}")
    for name, fits in (("input_scale", arrays["input_scale"] > 0), ("alone", arrays["alone"] >= 0)):
        if not fits.all():
            raise InputError(path, name, arrays[name].min(), "above 0")
    if arm_hash is not None and header.arm_hash != arm_hash:
        raise InputError(path, "arm_hash", header.arm_hash, f"{arm_hash} (the arm in use)")
    names = header.joint_names
    if joint_names is not None and names != tuple(joint_names):
        raise InputError(path, "joint_names", names, f"{tuple(joint_names)} (the arm in use)")
    arrays["posterior"] = arrays["posterior"].astype(np.float32)
    return Predictor(
        encoding=Encoding(
            header.joints, header.context, kept, arrays["mean"], arrays["input_scale"]
        ),
        hidden=header.hidden,
        scale=header.scale,
        variance_limit=header.variance_limit,
        gain=LearnedGain(*arrays["gain"].tolist()),
        provenance=Provenance(header.arm_hash, header.session_hash, names, header.settings),
        network=network,
        **{name: arrays[name] for name in _ARRAYS},
    )


def belongs(predictor: Predictor, path: str | os.PathLike[str], model_hash: str, to: str) -> None:
    """Check that a predictor was trained on the residual of this physics.

    Args:
        path, to: file of the predictor, and the expected model, for the error message.
        model_hash: SHA-256 of model.yaml; empty for the declared arm.
    """
    found = predictor.provenance.settings.get("model_hash", model_hash)
    if found != model_hash:
        said = str(found)[:12] if found else "the declared arm"
        raise InputError(path, "model_hash", said, to)


def _arrays(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    try:
        arrays = _packed(path) if Path(path).suffix == _OTHERS else _zipped(path)
    except FileNotFoundError as error:
        raise InputError(path, "predictor file", "not found", "an existing file") from error
    except OSError as error:
        raise InputError(path, "predictor file", str(error), "a readable file") from error
    except InputError:
        raise
    except Exception as error:  # whatever zipfile, zlib, numpy and safetensors raise
        found = f"corrupt or truncated ({error})"
        raise InputError(path, "predictor file", found, "a file that longarm wrote") from error
    for name in ("header", "kept", "mean", "input_scale", "gain", *_ARRAYS):
        if not isinstance(arrays.get(name), np.ndarray):
            raise InputError(path, name, "missing", "a file that longarm wrote")
    return arrays


def _zipped(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    with zipfile.ZipFile(Path(path)) as probe:
        check_unpacked(path, probe)
        broken = probe.testzip()
        if broken is not None:
            raise InputError(path, broken, "checksum does not match", "an undamaged file")
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}


def _packed(path: str | os.PathLike[str]) -> dict[str, NDArray[Any]]:
    from safetensors import safe_open

    check_regular(path)
    with safe_open(path, framework="numpy") as data:
        said, arrays = data.metadata(), {name: data.get_tensor(name) for name in data.keys()}  # noqa: SIM118
    if said["sha256"] != _digest(said["header"], arrays):
        raise InputError(path, "sha256", "does not match", "an undamaged file")
    return {**arrays, "header": np.frombuffer(said["header"].encode(), dtype=np.uint8)}


def _digest(header: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of what a file holds: safetensors has no checksum."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()


def _header(path: str | os.PathLike[str], arrays: dict[str, NDArray[Any]]) -> _Header:
    try:
        header = json.loads(arrays["header"].tobytes().decode())
    except (ValueError, RecursionError) as error:
        raise InputError(path, "header", "not JSON", "a JSON object") from error
    return parse_declared(_Header, header, str(path))
