"""Predictor files: plain arrays with a JSON header, never a pickle.

An npz file holds the paper's networks. A network from outside the package needs torch and its own
code, so it has another format, safetensors: no program can take it for one of the paper's.
"""

import dataclasses
import hashlib
import io
import json
import os
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
"""Largest input, weight or length (m) that is allowed: no arm is a thousand kilometres long."""
ENDINGS = _PAPERS, _OTHERS = ".npz", ".safetensors"
"""Endings of the files of the paper's networks, and of those from outside the package."""

_PROVENANCE = ("arm_hash", "session_hash", "joint_names", "settings")
_NUMBERS = ("hidden", "scale", "variance_limit")
"""What the header takes over from the provenance and from the predictor."""
_ENCODING = ("kept", "mean", "input_scale", "lower", "upper")
_PREDICTOR = ("weights", "posterior", "offset", "noise", "widen", "alone")
"""Arrays of the encoding (the last ones of `Encoding`) and of the predictor, beside ``gain``."""


class _Network(Declared):
    """Name and origin of a network from outside the package, by which `others` finds it."""

    name: str
    origin: str


class _Header(Declared):
    """The part of a file that is JSON, beside its arrays."""

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
    """Raise InputError if a file's ending does not fit its network: the paper's, or `of_others`."""
    ending = Path(path).suffix
    if of_others != (ending == _OTHERS):
        allowed = f"{_OTHERS} for a network of others, {_PAPERS} for the paper's"
        raise InputError(path, "predictor file", f"ends in {ending or 'nothing'}", allowed)


def save(predictor: Predictor, path: str | os.PathLike[str]) -> None:
    """Write ``predictor`` to ``path``, whole or not at all."""
    network, origin, encoding = predictor.network, predictor.provenance, predictor.encoding
    check_ending(path, network is not None)
    header: dict[str, Any] = {
        "format": "longarm/predictor",
        "version": 1,
        "joints": encoding.joints,
        "context": encoding.context,
        "input_names": encoding.names,
        **{name: getattr(origin, name) for name in _PROVENANCE},
        **{name: getattr(predictor, name) for name in _NUMBERS},
    }
    arrays = {
        **{name: getattr(encoding, name.removeprefix("input_")) for name in _ENCODING},
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
        # One entry: safetensors writes several in any order.
        entry = json.dumps({"header": said, "sha256": _digest(said, arrays)}, sort_keys=True)
        content = packed(arrays, {"longarm": entry})
    write_bytes(path, content)


def read_settings(path: str | os.PathLike[str]) -> dict[str, Any]:
    """Read the settings with which a predictor was trained; its network need not be there."""
    return _read(path)[0].settings


def load(
    path: str | os.PathLike[str],
    *,
    arm_hash: str | None = None,
    joint_names: tuple[str, ...] | None = None,
    model_hash: str | None = None,
    model: str = "",
) -> Predictor:
    """Read a predictor, and check that it belongs to the arm and the model that are given.

    Args:
        arm_hash, joint_names: of the arm; None: not checked.
        model_hash: SHA-256 of model.yaml; empty for the declared arm; None: not checked.
        model: name of the model, for the error message.

    Raises:
        InputError: the file is damaged, or belongs to another arm or model, or its network is not
            known.
    """
    header, arrays = _read(path)
    network, d = None, arrays["kept"].size
    size = NetworkShape(d, header.hidden, 3).size
    if (header.hidden == 0) != (header.network is not None):
        raise InputError(path, "hidden", header.hidden, "0 of a network of others alone")
    if header.network is not None:
        from longarm_comp.core.learn.others import load_saved

        network = load_saved(header.network.name, header.network.origin, path)
        size = network.stack(d, 3).size
    encoding = Encoding(header.joints, header.context, *(arrays[name] for name in _ENCODING))
    columns = len(encoding.columns)
    if not np.array_equal(encoding.kept, np.intersect1d(encoding.kept, range(columns))) or d == 0:
        allowed = f"rising numbers of columns below {columns}"
        raise InputError(path, "kept", encoding.kept.tolist(), allowed)
    number = {name: max(1, len(np.atleast_1d(arrays[name]))) for name in ("weights", "posterior")}
    shapes = {
        "mean": (d,),
        "input_scale": (d,),
        "lower": (columns,),
        "upper": (columns,),
        **{name: (rows, size) for name, rows in number.items()},
        **dict.fromkeys(("offset", "noise", "widen", "alone", "gain"), (3,)),
    }
    for name, shape in shapes.items():
        value = arrays[name]
        if value.shape != shape or value.dtype.kind != "f":
            raise InputError(path, name, f"{value.dtype} {value.shape}", f"floats {shape}")
        least = {"alone": 0.0, "input_scale": 1e-12}.get(name, -_LARGEST)
        unknown = np.isposinf(value) & (name in ("alone", "gain"))
        if not ((value >= least) & (unknown | (value <= _LARGEST))).all():
            allowed = f"numbers from {least:g} to {_LARGEST:g}"
            raise InputError(path, name, value.tolist(), allowed)
    wanted = {"arm_hash": arm_hash, "joint_names": joint_names and tuple(joint_names)}
    for name, one in wanted.items():
        if one is not None and one != (found := getattr(header, name)):
            raise InputError(path, name, found, f"{one} (the arm in use)")
    learned = header.settings.get("model_hash")
    if None not in (learned, model_hash) and learned != model_hash:
        raise InputError(path, "model_hash", str(learned)[:12] or "the declared arm", model)
    given: dict[str, Any] = {name: getattr(header, name) for name in _NUMBERS}
    given |= {name: arrays[name] for name in _PREDICTOR}
    gain = LearnedGain(*arrays["gain"].tolist())
    origin = Provenance(*(getattr(header, name) for name in _PROVENANCE))
    return Predictor(encoding, gain=gain, provenance=origin, network=network, **given)


def _read(path: str | os.PathLike[str]) -> tuple[_Header, dict[str, NDArray[Any]]]:
    """Return the checked header of a file, and its arrays, whose shapes are not checked."""
    try:
        check_regular(path)
        if Path(path).suffix == _OTHERS:
            from safetensors import safe_open

            with safe_open(path, framework="numpy") as data:
                entry = json.loads(data.metadata()["longarm"])
                arrays = {name: data.get_tensor(name) for name in data.keys()}  # noqa: SIM118
            said = entry["header"]
            if entry["sha256"] != _digest(said, arrays):
                raise InputError(path, "sha256", "does not match", "an undamaged file")
        else:
            with np.load(path, allow_pickle=False) as data:
                check_unpacked(path, data.zip)
                arrays = dict(data)  # checked against the checksums of the archive
            said = arrays.pop("header").tobytes()
        header = json.loads(said)
    except InputError:
        raise
    except OSError as error:
        found = error.strerror or str(error)
        raise InputError(path, "predictor file", found, "a readable file") from error
    except Exception as error:  # whatever zipfile, zlib, numpy, safetensors and json raise
        found = f"corrupt or truncated ({error})"
        raise InputError(path, "predictor file", found, "a file that longarm wrote") from error
    for name in (*_ENCODING, *_PREDICTOR, "gain"):
        if not isinstance(arrays.get(name), np.ndarray):
            raise InputError(path, name, "missing", "a file that longarm wrote")
    return parse_declared(_Header, header, str(path)), arrays


def _digest(header: str, arrays: Mapping[str, NDArray[Any]]) -> str:
    """Return the SHA-256 of a file's header and arrays, as safetensors has no checksum."""
    digest = hashlib.sha256(header.encode())
    for name in sorted(arrays):
        array = arrays[name]
        digest.update(f"{name} {array.dtype} {array.shape}".encode() + array.tobytes())
    return digest.hexdigest()
