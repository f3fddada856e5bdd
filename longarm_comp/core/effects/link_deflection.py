"""Sag of the declared beams under their own and the carried weight."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import ClassVar

from longarm_comp.core.arm.posture import Element, Posture, abs_
from longarm_comp.core.arm.spatial import Scalar, Twist, Vec, cross
from longarm_comp.core.effects.effect import Effect


@dataclass(frozen=True)
class LinkDeflection(Effect):
    """Every declared beam is a cantilever clamped to what is before it (paper, Section II.B).

    It has no parameter: sections, moduli and masses are declared in the arm.
    """

    name: ClassVar[str] = "link_deflection"
    title: ClassVar[str] = "sag of the beams"
    action: ClassVar[str] = "Nothing to repair: a stiffer section or less load lowers it."
    loaded: ClassVar[bool] = True
    searched: ClassVar[bool] = False

    def twists(self, posture: Posture) -> Mapping[int, Twist]:
        """Cantilever twist of every beam element at its end station."""
        return {e.station: cantilever(posture, e) for e in _elements(posture)}


def extra_sag(posture: Posture, share: Scalar, beam: str = "") -> Mapping[int, Twist]:
    """A share of the declared cantilever twist, at the end of every element.

    Args:
        posture: the arm under its load.
        share: factor, a number or one per row.
        beam: name of the only beam that sags more; all where empty.
    """
    return {
        e.station: tuple(share * t for t in cantilever(posture, e))  # type: ignore[misc]
        for e in _elements(posture)
        if not beam or e.beam.name == beam
    }


def _elements(posture: Posture) -> Iterator[Element]:
    return (e for row in posture.chain.rows for e in row.elements_a + row.elements_d)


def cantilever(posture: Posture, element: Element) -> Twist:
    """Twist at the end of a beam element under end force, end moment and dead weight.

    It is computed once a posture: several effects are shares of it.

    With u the beam axis, l the length, F, M the end loads and w = density x gravity over
    the last h of the beam, the bending moment is ``M(s) = M + (l-s) u x F + u x w (...)``,
    the slope its integral over EI and the deflection ``int theta x u ds`` (Euler-Bernoulli;
    a uniformly loaded beam has h = l: ``w l^3/6EI`` and ``w l^4/8EI``).  Loads are read in
    the axes halfway along the bend, which makes one element second-order accurate.
    Along the beam, `exp` of the twist pulls the end back by ``theta x d / 2``; the beam's
    foreshortening, half the integral of the slope squared, is 0.4 of it under an end force
    (a third under an end moment, 0.43 under dead weight), so a tenth is given back.
    """
    key = ("cantilever", element.station)
    return posture.once(key, lambda: _cantilever(posture, element))


def _cantilever(posture: Posture, element: Element) -> Twist:
    station, axis = element.station, element.axis
    length, axis_u, inverse = _beam(posture, element)
    force, moment = posture.force(station), posture.moment(station)
    gravity = posture.gravity_in(station)

    # moments of w = 1 over the last h: integrals of M(s) and of M(s) (l - s)
    slope_w: Scalar = 0.0
    sag_w: Scalar = 0.0
    for density, h in posture.line_loads[station]:
        if h is length:
            slope_w = slope_w + density * (length * length * length / 6)
            sag_w = sag_w + density * (length * length * length * length / 8)
            continue
        rest = length - h
        slope_w = slope_w + density * h * (0.5 * rest * length + h * h / 6)
        sag_w = sag_w + density * h * (
            h * h * h / 8
            + (length * length * length - h * h * h) / 3
            - h * (length * length - h * h) / 4
        )

    uw = cross(axis_u, gravity)
    slope, sag = _end_loaded(length, axis_u, force, moment)
    theta = [(slope[k] + slope_w * uw[k]) * inverse[k] for k in range(3)]
    bend = [(sag[k] + sag_w * uw[k]) * inverse[k] for k in range(3)]
    bend[axis] = 0.0
    d = cross((bend[0], bend[1], bend[2]), axis_u)
    half = (0.5 * theta[0], 0.5 * theta[1], 0.5 * theta[2])
    turned_d, turned_w = list(cross(half, d)), cross(half, (theta[0], theta[1], theta[2]))
    turned_d[axis] = -0.2 * turned_d[axis]
    return (
        d[0] + turned_d[0],
        d[1] + turned_d[1],
        d[2] + turned_d[2],
        theta[0] + turned_w[0],
        theta[1] + turned_w[1],
        theta[2] + turned_w[2],
    )


def bent(posture: Posture, element: Element, force: Vec, moment: Vec) -> Twist:
    """Twist at the end of a beam element under a force (N) and moment (N m) there, first order.

    Both in the axes of the element's end.
    """
    length, axis_u, inverse = _beam(posture, element)
    slope, sag = _end_loaded(length, axis_u, force, moment)
    theta = [slope[k] * inverse[k] for k in range(3)]
    bend = [sag[k] * inverse[k] for k in range(3)]
    bend[element.axis] = 0.0
    d = cross((bend[0], bend[1], bend[2]), axis_u)
    return (d[0], d[1], d[2], theta[0], theta[1], theta[2])


def _beam(posture: Posture, element: Element) -> tuple[Scalar, Vec, tuple[float, float, float]]:
    """Length (m), direction and compliances about x, y, z (1/(N m^2)) of a beam element."""
    signed = posture.lengths[element.station]
    length = abs_(signed)
    u = [0.0, 0.0, 0.0]
    u[element.axis] = -1.0 if signed is not length and signed != length else 1.0
    first, second, torsion = element.beam.stiffness
    return length, (u[0], u[1], u[2]), _by_axis(element.axis, 1 / first, 1 / second, 1 / torsion)


def _end_loaded(length: Scalar, u: Vec, force: Vec, moment: Vec) -> tuple[list[Scalar], ...]:
    """Integrals over the length of the bending moment ``M(s)`` and of ``M(s) (l - s)``."""
    uf = cross(u, force)
    l1, l2, l3 = length, 0.5 * length * length, length * length * length / 3
    slope = [l1 * moment[k] + l2 * uf[k] for k in range(3)]
    return slope, [l2 * moment[k] + l3 * uf[k] for k in range(3)]


def _by_axis(axis: int, first: float, second: float, along: float) -> tuple[float, float, float]:
    """Compliances about x, y, z of a beam along x (axis 0) or z (axis 2)."""
    return (along, first, second) if axis == 0 else (first, second, along)
