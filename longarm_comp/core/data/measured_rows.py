"""The measurements of a session's rows, of any kind, and the channels of their equations."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.measuring import KnownDistance
from longarm_comp.core.data.kinds import KINDS, EncoderReading, Kind
from longarm_comp.core.errors import InputError


@dataclass(frozen=True)
class ChannelBlock:
    """The channels of one kind of measurement."""

    kind: str
    sensor: str | None = None  # the text in the column `sensor` of its rows; None: all rows

    @property
    def channels(self) -> tuple[str, ...]:
        """Names of its scalar equations: ``x``, or ``left x`` for the sensor ``left``."""
        return tuple(f"{self.sensor or ''} {name}".strip() for name in KINDS[self.kind].scalars)


class MeasuredRows:
    """The measuring side of a `Session`, whose fields it reads."""

    q: np.ndarray
    xyz: np.ndarray
    sigma: np.ndarray | None
    labels: Mapping[str, np.ndarray]
    source: str
    readings: Mapping[str, np.ndarray]
    sigmas: Mapping[str, np.ndarray]
    touch_distances: tuple[KnownDistance, ...]
    blocks: tuple[ChannelBlock, ...]

    def error(self, field: str, value: object, allowed: str) -> InputError:
        """Return an `InputError` about the rows, with their source."""
        return InputError(self.source, field, value, allowed)

    def texts(self, label: str) -> np.ndarray:
        """Return the texts (N,) of a column; all empty if it was not recorded."""
        return self.labels.get(label, np.full(len(self.xyz), ""))

    @cached_property
    def _channel_kinds(self) -> list[Kind]:
        return [KINDS[b.kind] for b in self.blocks for _ in b.channels]

    @cached_property
    def seen(self) -> np.ndarray:
        """(N,) True for rows with any measurement of the tip."""
        of_tip = [not kind.of_joint for kind in self._channel_kinds]
        return np.asarray(self.measured[:, of_tip].any(axis=1))

    @cached_property
    def has_position(self) -> np.ndarray:
        """(N,) True for rows with all three coordinates of the tip."""
        return np.isfinite(self.xyz).all(axis=1)

    @cached_property
    def has_orientation(self) -> np.ndarray:
        """(N,) True for rows with a measured orientation of the tip."""
        return np.isfinite(self.reading(KINDS["orientation"])).all(axis=1)

    @cached_property
    def placed(self) -> np.ndarray:
        """(N,) True for rows with a measurement that depends on the tip's position."""
        where = [not kind.turns and not kind.of_joint for kind in self._channel_kinds]
        return np.asarray(self.measured[:, where].any(axis=1))

    @cached_property
    def plain(self) -> bool:
        """True if the only measurements are whole positions by one sensor."""
        half = np.isfinite(self.xyz).any(axis=1) & ~self.has_position
        return self.blocks == (ChannelBlock("position"),) and not half.any()

    @property
    def kinds(self) -> tuple[Kind, ...]:
        """The kinds of measurement in the session, each once, in the order of the channels."""
        return tuple(KINDS[name] for name in dict.fromkeys(b.kind for b in self.blocks))

    def has_own_frame(self, arm: Arm) -> bool:
        """Tell whether a sensor has a frame of its own, in which the base is to be placed."""
        return any(kind.has_own_frame(arm) for kind in self.kinds)

    @property
    def turns(self) -> bool:
        """True if a kind of measurement depends on the tip's orientation."""
        return any(kind.turns for kind in self.kinds)

    @cached_property
    def read_joints(self) -> tuple[int, ...]:
        """Indices (0-based, among the commanded joints) of the joints with encoder readings."""
        return tuple(kind.number - 1 for kind in self.kinds if kind.of_joint)

    @cached_property
    def channels(self) -> tuple[str, ...]:
        """Names of the d scalar equations (channels) of a row."""
        return tuple(name for block in self.blocks for name in block.channels)

    @cached_property
    def units(self) -> tuple[str, ...]:
        """The unit of each of the d channels, ``m`` or ``rad``."""
        return tuple(kind.unit for kind in self._channel_kinds)

    @cached_property
    def measured(self) -> np.ndarray:
        """(N, d) True for the channels that each row measured."""
        made = []
        for block in self.blocks:
            rows = KINDS[block.kind].find_measured(self.reading(KINDS[block.kind]))
            if block.sensor is not None:
                rows = rows & (self.labels["sensor"] == block.sensor)[:, None]
            made.append(rows)
        return np.concatenate(made, axis=1)

    @cached_property
    def frames(self) -> np.ndarray:
        """(N,) name of each row's frame: its group; with several sensors, group and sensor."""
        group = self.texts("group")
        if len({block.sensor for block in self.blocks}) < 2:
            return group
        pairs = zip(group, self.labels["sensor"], strict=True)
        return np.array([f"{g} seen by {s}".strip() for g, s in pairs])

    @cached_property
    def stated_sigma(self) -> np.ndarray:
        """(N, d) standard deviations recorded in the rows, m or rad; NaN where there is none."""
        stated = {name: values[:, None] for name, values in self.sigmas.items()}
        if self.sigma is not None:
            stated["position"] = self.sigma
        shapes = ((b.kind, (len(self.xyz), len(b.channels))) for b in self.blocks)
        made = [np.broadcast_to(stated.get(kind, np.nan), shape) for kind, shape in shapes]
        whole = np.concatenate(made, axis=1)
        told = self.measured & np.isfinite(whole) & (whole > 0)
        return np.where(told, whole, np.nan)

    def names_of(self, kind: Kind) -> tuple[str, ...]:
        """Return the names (anchors, points, ...) in the rows that one kind measured, each once."""
        if kind.label not in self.labels:
            return ()
        rows = kind.find_measured(self.reading(kind)).any(axis=1)
        return tuple(str(name) for name in np.unique(self.labels[kind.label][rows]))

    @cached_property
    def claimed_sigma(self) -> dict[str, float]:
        """Median of `stated_sigma` by channel name; channels without any are left out."""
        pairs = zip(self.channels, self.stated_sigma.T, strict=True)
        stated = ((name, values[np.isfinite(values)]) for name, values in pairs)
        return {name: float(np.median(values)) for name, values in stated if len(values)}

    def uneven(self, usual: Mapping[str, float]) -> np.ndarray:
        """Return (N,) ratio of the noise that each row states to the usual noise (by channel name).

        It is the geometric mean over the row's channels; 1 where it states none.
        """
        share = self.stated_sigma / np.array([usual.get(name, np.nan) for name in self.channels])
        known = np.isfinite(share)
        logs = np.log(share, where=known, out=np.zeros(share.shape))
        return np.asarray(np.exp(logs.sum(axis=1) / np.maximum(known.sum(axis=1), 1)))

    def reading(self, kind: Kind) -> np.ndarray:
        """Return the readings (N, c) of one kind; NaN where it was not measured.

        A kind without numbers, such as a touch, has one column: 0 in rows that measured it.
        """
        if kind.name == "position":
            return self.xyz
        if not kind.cells:
            return self._stood[kind.name]
        absent = np.full((len(self.xyz), len(kind.cells)), np.nan)
        return self.readings.get(kind.name, absent)

    @cached_property
    def _stood(self) -> dict[str, np.ndarray]:
        """Readings (N, 1) of the kinds without numbers: 0 in rows that measured it, else NaN.

        A name (of a touched point or plane) counts only if it is in more rows than determine its
        place, or if its distance from another touched point is known.
        """
        made = {}
        for kind in KINDS.values():
            if not kind.cells:
                texts = self.texts(kind.label)
                _, which, count = np.unique(texts, return_inverse=True, return_counts=True)
                known = [d[:2] for d in self.touch_distances if kind.label == "touch"]
                tied = {n for pair in known if np.isin(pair, texts).all() for n in pair}
                enough = (count[which.reshape(-1)] > kind.takes) | np.isin(texts, list(tied))
                told = (texts != "") & enough
                made[kind.name] = np.where(told, 0.0, np.nan)[:, None]
        return made

    def _check_readings(self, n_rows: int) -> None:
        readings: dict[str, np.ndarray] = {}
        for name, given in self.readings.items():
            if name == "position" or name not in KINDS or not KINDS[name].cells:
                known = [k for k, v in KINDS.items() if k != "position" and v.cells]
                allowed = ", ".join([*known, "read_q1", "..."])
                raise self.error(f"readings {name}", "unknown kind", allowed)
            kind = KINDS[name]
            values = freeze(self.source, name, given, float, (n_rows, len(kind.cells)))
            if isinstance(kind, EncoderReading) and kind.number > self.q.shape[1]:
                raise self.error(name, "unknown", f"read_q1..q{self.q.shape[1]}")
            wrong, allowed = kind.wrong(values)
            partly = np.isnan(values).any(axis=1) & ~np.isnan(values).all(axis=1)
            for row in np.flatnonzero(wrong | partly | np.isinf(values).any(axis=1)):
                field = f"row {row + 1}, {', '.join(kind.cells)}"
                said = ", ".join(f"{v:g}" for v in values[row])
                raise self.error(field, said, allowed if wrong[row] else "numbers, or all blank")
            rows = kind.find_measured(values).any(axis=1)
            if not rows.any():
                continue
            readings[name] = values
            unnamed = rows & (self.texts(kind.label) == "") & bool(kind.label)
            for row in np.flatnonzero(unnamed):
                field = f"row {row + 1}, {kind.label}"
                raise self.error(field, "blank", f"a name beside {kind.name}")
        object.__setattr__(self, "readings", readings)
        sigmas = {
            name: freeze(self.source, KINDS[name].sigma, given, float, (n_rows,))
            for name, given in self.sigmas.items()
            if name in readings
        }
        object.__setattr__(self, "sigmas", sigmas)

    def _blocks(self) -> tuple[ChannelBlock, ...]:
        """Return one block per kind of measurement, or per kind and sensor if there are several."""
        names = np.unique(self.texts("sensor"))
        rows = {k: v.find_measured(self.reading(v)).any(axis=1) for k, v in KINDS.items()}
        kinds = [k for k in KINDS if rows[k].any()] or ["position"]
        joints = (KINDS[name] for name in self.readings if KINDS[name].of_joint)
        read = tuple(ChannelBlock(k.name) for k in sorted(joints, key=lambda k: k.number))
        if len(names) < 2:
            return tuple(ChannelBlock(kind) for kind in kinds) + read
        mine = {str(name): self.labels["sensor"] == name for name in names}
        sensed = ((k, s) for k in kinds for s in mine if (rows[k] & mine[s]).any())
        return (*(ChannelBlock(k, s) for k, s in sensed), *read)


def freeze(
    where: str, name: str, values: ArrayLike, kind: type, shape: tuple[int, ...]
) -> np.ndarray:
    """Return values as a read-only array; what others may still write to is copied.

    Raises:
        InputError: they do not have a given shape, or a value is no number of the given kind.
    """
    plain = not isinstance(values, np.ma.MaskedArray)
    if issubclass(kind, np.integer) and not (plain and getattr(values, "dtype", None) == kind):
        numbers, most = array_of(where, name, values), np.iinfo(kind).max
        wrong = ~((numbers == np.floor(numbers)) & (np.abs(numbers) <= most))
        if wrong.any():
            allowed = f"whole numbers up to {most}"
            raise InputError(where, name, f"{numbers[wrong][0]:g}", allowed)
    held = array_of(where, name, values, kind)
    frozen = held.copy() if held is values and held.flags.writeable else held.view()
    if frozen.shape != shape:
        raise InputError(where, name, f"shape {frozen.shape}", f"shape {shape}")
    frozen.flags.writeable = False
    return frozen


def array_of(where: str, name: str, values: ArrayLike, kind: type = float) -> np.ndarray:
    """Return values as an array of a kind; a masked number is NaN: none was measured.

    Raises:
        InputError: the values are of another kind, or of no shape.
    """
    try:
        if np.iscomplexobj(values):  # NumPy would leave out the imaginary part
            raise TypeError("complex numbers")
        if isinstance(given := values, np.ma.MaskedArray):
            given = np.ma.filled(given, "") if kind is str else np.ma.filled(given * 1.0, np.nan)
        return np.asarray(given, dtype=kind)
    except (TypeError, ValueError) as error:
        raise InputError(where, name, str(error), "text" if kind is str else "numbers") from error
