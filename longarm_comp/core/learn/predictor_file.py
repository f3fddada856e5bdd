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
from longarm_comp.core.learn.inputs import Encoding
from longarm_comp.core.learn.network import NetworkShape
from longarm_comp.core.learn.predictor import LearnedGain, Predictor, Provenance
from longarm_comp.core.yaml_file import Declared, parse_declared

_LARGEST = 1e6
"""Inputs, weights and lengths (m) are far below it: no arm is a thousand kilometres long."""
_OTHERS = ".safetensors"
"""Ending of the file of a network of others."""

_ENCODING = {name: name for name in ("kept", "mean", "lower", "upper")} | {"scale": "input_scale"}
_PREDICTOR = ("weights", "posterior", "offset", "noise", "widen", "alone")
"""Arrays: those of the encoding with their names in the file, those of the predictor, ``gain``."""


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
    network, origin, encoding = predictor.network, predictor.provenance, predictor.encoding
    check_ending(path, network is not None)
    header: dict[str, Any] = {
        "format": "longarm/predictor", "version": 1, "arm_hash": origin.arm_hash,
        "session_hash": origin.session_hash, "joint_names": origin.joint_names,
        "settings": dict(origin.settings), "joints": encoding.joints,
        "context": encoding.context, "hidden": predictor.hidden, "scale": predictor.scale,
        "variance_limit": predictor.variance_limit, "input_names": encoding.names,
    }  # fmt: skip
    arrays = {
        **{name: getattr(encoding, own) for own, name in _ENCODING.items()},
        **{name: getattr(predictor, name) for name in _PREDICTOR},
        "gain": np.array(dataclasses.astuple(predictor.gain)),
    }
    if network is None:
        text = json.dumps(header, sort_keys=True).encode()
        buffer = io.BytesIO()
        np.savez(buffer, header=np.frombuffer(text, dtype=np.uint8), **arrays)
        content = buffer.getvalue()
    else:
        from safetensors.numpy import save as packed

        header["network"] = {"name": network.name, "origin": network.origin}
        said = json.dumps(header, sort_keys=True)
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
    header, arrays = _read(path)
    own = {name: arrays[known] for name, known in _ENCODING.items()}
    encoding = Encoding(header.joints, header.context, **own)
    columns, kept = len(encoding.columns), encoding.kept
    if kept.dtype.kind != "i" or kept.ndim != 1 or not len(kept):
        raise InputError(path, "kept", kept.dtype, "column indices")
    if len(np.unique(kept)) != len(kept) or not 0 <= kept.min() <= kept.max() < columns:
        raise InputError(path, "kept", kept.tolist(), f"distinct columns below {columns}")
    network, d = None, len(kept)
    size = NetworkShape(d, header.hidden, 3).size
    if (header.hidden == 0) != (header.network is not None):
        raise InputError(path, "hidden", header.hidden, "0 of a network of others alone")
    if header.network is not None:
        from longarm_comp.core.learn.others import saved

        network = saved(header.network.name, header.network.origin, path)
        size = network.stack(d, 3).size
    any_of = {name: max(1, len(np.atleast_1d(arrays[name]))) for name in ("weights", "posterior")}
    shapes = {
        "mean": (d,), "input_scale": (d,), "lower": (columns,), "upper": (columns,),
        **{name: (number, size) for name, number in any_of.items()},
        **dict.fromkeys(("offset", "noise", "widen", "alone", "gain"), (3,)),
    }  # fmt: skip
    for name, shape in shapes.items():
        value = arrays[name]
        if value.shape != shape or value.dtype.kind != "f":
            raise InputError(path, name, f"{value.dtype} {value.shape}", f"floats {shape}")
        unknown = np.isposinf(value) & (name in ("alone", "gain"))
        if not (unknown | (np.abs(value) <= _LARGEST)).all():
            raise InputError(path, name, "NaN or too large", f"numbers up to {_LARGEST:g}")
    for name, fits in (("input_scale", encoding.scale > 0), ("alone", arrays["alone"] >= 0)):
        if not fits.all():
            raise InputError(path, name, arrays[name].min(), "above 0")
    wanted = {"arm_hash": arm_hash, "joint_names": joint_names and tuple(joint_names)}
    for name, one in wanted.items():
        if one is not None and one != (found := getattr(header, name)):
            raise InputError(path, name, found, f"{one} (the arm in use)")
    return Predictor(
        encoding,
        hidden=header.hidden,
        scale=header.scale,
        variance_limit=header.variance_limit,
        gain=LearnedGain(*arrays["gain"].tolist()),
        provenance=Provenance(
            header.arm_hash, header.session_hash, header.joint_names, header.settings
        ),
        network=network,
        **{name: arrays[name] for name in _PREDICTOR},
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


def _read(path: str | os.PathLike[str]) -> tuple[_Header, dict[str, NDArray[Any]]]:
    """Checked header, and all arrays of the file, of any shape."""
    try:
        said, arrays = (_packed if Path(path).suffix == _OTHERS else _zipped)(path)
    except InputError:
        raise
    except FileNotFoundError as error:
        raise InputError(path, "predictor file", "not found", "an existing file") from error
    except OSError as error:
        raise InputError(path, "predictor file", str(error), "a readable file") from error
    except Exception as error:  # whatever zipfile, zlib, numpy and safetensors raise
        found = f"corrupt or truncated ({error})"
        raise InputError(path, "predictor file", found, "a file that longarm wrote") from error
    for name in (*_ENCODING.values(), *_PREDICTOR, "gain"):
        if name not in arrays:
            raise InputError(path, name, "missing", "a file that longarm wrote")
    try:
        header = json.loads(said)
    except (ValueError, RecursionError) as error:
        raise InputError(path, "header", "not JSON", "a JSON object") from error
    return parse_declared(_Header, header, str(path)), arrays


def _zipped(path: str | os.PathLike[str]) -> tuple[bytes, dict[str, NDArray[Any]]]:
    with zipfile.ZipFile(Path(path)) as probe:
        check_unpacked(path, probe)
        if (broken := probe.testzip()) is not None:
            raise InputError(path, broken, "checksum does not match", "an undamaged file")
    with np.load(path, allow_pickle=False) as data:
        arrays = dict(data)
    return arrays.pop("header").tobytes(), arrays


def _packed(path: str | os.PathLike[str]) -> tuple[bytes, dict[str, NDArray[Any]]]:
    from safetensors import safe_open

    check_regular(path)
    with safe_open(path, framework="numpy") as data:
        said, arrays = data.metadata(), {name: data.get_tensor(name) for name in data.keys()}  # noqa: SIM118
    if said["sha256"] != _digest(said["header"], arrays):
        raise InputError(path, "sha256", "does not match", "an undamaged file")
    return said["header"].encode(), arrays


def _digest(header: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    """SHA-256 of what a file holds: safetensors has no checksum."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
