"""Bending of the declared beams under their own weight and the weight that they carry."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TypeVar

from longarm_comp.core.arm import stacked
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.posture import Element, Posture, Twists, compute_loads, sign_of
from longarm_comp.core.arm.spatial import Frame, Scalar, Twist, Vec, absolute
from longarm_comp.core.effects.effect import Effect, Sites

_T = TypeVar("_T")


@dataclass(frozen=True)
class LinkDeflection(Effect):
    """Every declared beam bends as a cantilever clamped to the part before it (paper, Sec. II.B).

    It has no parameter: sections, moduli and masses are declared in the arm.
    """

    name = "link_deflection"
    title = "sag of the beams"
    action = "Nothing to repair: a stiffer section or less load lowers it."
    loaded = True
    bends_beams = True
    searched = False

    @classmethod
    def sites(cls, arm: Arm) -> Sites:
        """Return no place: no diagnosis searches for this effect, `declared_model` adds it."""
        return []

    def twists(self, posture: Posture) -> Twists:
        return {e.station: cantilever(posture, e) for e in posture.chain.elements}


def extra_sag(posture: Posture, share: Scalar, beam: str = "") -> Twists:
    """Return a fraction of the declared cantilever twists by station; `beam` "": of all beams."""
    return {
        e.station: tuple(share * t for t in cantilever(posture, e))  # type: ignore[misc]
        for e in posture.chain.elements
        if not beam or e.beam.name == beam
    }


def cantilever(posture: Posture, element: Element) -> Twist:
    """Compute the twist at the end of a beam element under end force, end moment and dead weight.

    The twists of all elements are computed once per posture, because several effects use them.

    With u the beam axis, l the length, F, M the end loads and w = density x gravity over
    the last h of the beam, the bending moment is ``M(s) = M + (l-s) u x F + m(s) u x w``, where
    ``m(s)`` is ``(l-s)^2/2`` over the last h and ``h (l-s-h/2)`` before it.  The slope is its
    integral over EI and the deflection ``int theta x u ds`` (Euler-Bernoulli; a uniformly loaded
    beam has h = l: ``w l^3/6EI`` and ``w l^4/8EI``).  Loads are taken in the axes halfway along
    the bend, which makes one element second-order accurate.
    Along the beam, `exp` of the twist pulls the end back by ``theta x d / 2``.  The true
    foreshortening, half the integral of the slope squared, is 0.4 ``theta d`` under an end force
    (a third under an end moment, 0.43 under dead weight), so a tenth is added back.
    """
    # once per posture, because several effects use them
    return posture.once(("cantilevers",), lambda: _compute_cantilevers(posture))[element.station]


def _compute_cantilevers(posture: Posture) -> dict[int, Twist]:
    """Compute the twists of all elements, by station; similar elements are stacked."""
    kinds: dict[tuple, dict[tuple[int, int], tuple[Scalar, ...]]] = {}
    masses, firsts = posture.carried_masses
    for e in posture.chain.elements:
        length, sign, inverse = _describe_beam(posture, e)
        at, spread = e.station, posture.line_loads[e.station]
        frame = posture.frames[at]
        n, o, a = _beam_axes(e.axis, frame[:3])
        carried = (*n, *o, *a, *frame.p, masses[at], *firsts[at])
        kind = sign, tuple(h is length for _, h in spread)
        item = (length, *inverse, *carried, *(x for load in spread for x in load))
        kinds.setdefault(kind, {})[at, e.axis] = item
    made = {}
    for (sign, whole), items in kinds.items():
        for stations, x in stacked.stack_alike(items):
            frame = Frame(x[4:7], x[7:10], x[10:13], x[13:16])
            felt = compute_loads(frame, x[16], x[17:20], posture.gravity)
            along = list(zip(x[20::2], x[21::2], whole, strict=True))
            twist = _cantilever(sign, x[0], x[1:4], felt, along)
            apart = [twist] if x is items[stations[0]] else stacked.take_apart(twist, len(stations))
            for (station, axis), each in zip(stations, apart, strict=True):
                made[station] = _frame_axes(axis, each)  # type: ignore[arg-type]
    return made


def _cantilever(
    sign: float,
    length: Scalar,
    inverse: Vec,
    felt: tuple[Vec, Vec, Vec],
    spread: Sequence[tuple[Scalar, Scalar, bool]],
) -> Twist:
    """Compute the twist at the end of an element as `cantilever` does, in the beam's axes.

    Args:
        sign, length, inverse: as returned by `_describe_beam`.
        felt: gravity (m/s^2), force (N) and moment (N m) at the end, in the beam's axes.
        spread: density (kg/m) and loaded length (m) of each mass along the element, and whether
            this length is the whole element.
    """
    gravity, force, moment = felt
    # moments of w = 1 over the last h: integrals of M(s) and of M(s) (l - s)
    slope_w: Scalar = 0.0
    sag_w: Scalar = 0.0
    for density, h, whole in spread:
        if whole:
            slope_w = slope_w + density * (length * length * length / 6)
            sag_w = sag_w + density * (length * length * length * length / 8)
            continue
        rest = length - h
        slope_w = slope_w + density * h * (0.5 * rest * length + h * h / 6)
        bent_before = (length * length * length - h * h * h) / 3 - h * (length * length - h * h) / 4
        sag_w = sag_w + density * h * (h * h * h / 8 + bent_before)

    slope, sag = _end_loaded(length, sign, force, moment)
    for k, w in enumerate(_across(sign, gravity)):
        slope[k + 1] = slope[k + 1] + slope_w * w
        sag[k] = sag[k] + sag_w * w
    _, y, z, *theta = _bend_beam(sign, slope, sag, inverse)
    about_x, about_y, about_z = (0.5 * t for t in theta)
    shortened = -0.2 * (about_y * z - about_z * y)
    return (shortened, y - about_x * z, z + about_x * y, *theta)  # type: ignore[return-value]


def bent(posture: Posture, element: Element, force: Vec, moment: Vec) -> Twist:
    """Compute the twist at the end of a beam element under an end load (N, N m), to first order.

    Load and twist are in the axes of the element's station.
    """
    length, sign, inverse = _describe_beam(posture, element)
    ends = (_beam_axes(element.axis, v) for v in (force, moment))
    slope, sag = _end_loaded(length, sign, *ends)
    return _frame_axes(element.axis, _bend_beam(sign, slope, sag, inverse))


def _describe_beam(
    posture: Posture, element: Element
) -> tuple[Scalar, float, tuple[float, float, float]]:
    """Return an element's length (m), sign along its axis, and (1/GJ, 1/EI, 1/EI), 1/(N m^2).

    The two EI are about the first and the second transverse axis.
    """
    signed = posture.lengths[element.station]
    first, second, torsion = element.beam.stiffness
    return absolute(signed), sign_of(signed), (1 / torsion, 1 / first, 1 / second)


def _beam_axes(axis: int, of_frame: tuple[_T, _T, _T]) -> tuple[_T, _T, _T]:
    """Reorder values for a frame's x, y, z: first for the axis along the beam, then across it."""
    return of_frame[axis:] + of_frame[:axis]  # type: ignore[return-value]


def _frame_axes(axis: int, twist: Twist) -> Twist:
    """Reorder a twist from the beam's axes (the first along the beam) to the frame's axes."""
    d, theta = twist[:3], twist[3:]
    return (*d[3 - axis :], *d[: 3 - axis], *theta[3 - axis :], *theta[: 3 - axis])  # type: ignore[return-value]


def _across(sign: float, v: Vec) -> tuple[Scalar, Scalar]:
    """Return the two transverse components of ``u x v``, where u is the beam's direction."""
    return (-v[2], v[1]) if sign > 0 else (v[2], -v[1])


def _end_loaded(
    length: Scalar, sign: float, force: Vec, moment: Vec
) -> tuple[list[Scalar], list[Scalar]]:
    """Integrate ``M(s)`` of end loads about all axes, and ``M(s) (l - s)`` about the transverse."""
    l1, l2, l3 = length, 0.5 * length * length, length * length * length / 3
    slope: list[Scalar] = [l1 * m for m in moment]
    sag: list[Scalar] = []
    for k, pushed in enumerate(_across(sign, force), 1):
        slope[k] = slope[k] + l2 * pushed
        sag.append(l2 * moment[k] + l3 * pushed)
    return slope, sag


def _bend_beam(sign: float, slope: list[Scalar], sag: list[Scalar], inverse: Vec) -> Twist:
    """Compute the twist (m, rad) of a beam's end from the integrals of `_end_loaded`."""
    y, z = _across(-sign, (0.0, sag[0] * inverse[1], sag[1] * inverse[2]))
    return (0.0, y, z, slope[0] * inverse[0], slope[1] * inverse[1], slope[2] * inverse[2])
