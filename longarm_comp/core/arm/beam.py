"""Elastic beams as `arm.yaml` declares them, and the stiffness of their sections."""

from __future__ import annotations

import math
from functools import cached_property
from typing import Annotated, Literal

from pydantic import Field, model_validator

from longarm_comp.core.arm.pose import NonNegative, Positive
from longarm_comp.core.yaml_file import RANGES, Declared, Misdeclared


class Tube(Declared):
    """Round tube, or round bar with ``id_m: 0``."""

    type: Literal["tube"]
    od_m: Positive
    id_m: NonNegative = 0.0

    @model_validator(mode="after")
    def _hollow(self) -> Tube:
        if self.id_m >= self.od_m:
            raise Misdeclared("id_m", self.id_m, f"less than od_m {self.od_m}")
        return self

    def second_moments(self) -> tuple[float, float, float]:
        """(I about the first, I about the second transverse axis, torsion constant), m^4."""
        i = math.pi / 64 * (self.od_m**4 - self.id_m**4)
        return i, i, 2 * i


class Rect(Declared):
    """Solid or box rectangle; width along the first, height along the second transverse axis."""

    type: Literal["rect"]
    width_m: Positive
    height_m: Positive
    wall_m: Positive | None = Field(default=None, description="box wall; solid if absent")

    @model_validator(mode="after")
    def _walled(self) -> Rect:
        if self.wall_m is not None and 2 * self.wall_m >= min(self.width_m, self.height_m):
            raise Misdeclared("wall_m", self.wall_m, "less than half of width_m and of height_m")
        return self

    def second_moments(self) -> tuple[float, float, float]:
        """(I about the first, I about the second transverse axis, torsion constant), m^4.

        Torsion: Roark's formula for the solid rectangle, Bredt's for the thin-walled box.
        """
        b, h, t = self.width_m, self.height_m, self.wall_m
        about_first, about_second = b * h**3 / 12, h * b**3 / 12
        if t is None:
            long, short = max(b, h) / 2, min(b, h) / 2
            q = short / long
            j = long * short**3 * (16 / 3 - 3.36 * q * (1 - q**4 / 12))
            return about_first, about_second, j
        bi, hi = b - 2 * t, h - 2 * t
        bm, hm = b - t, h - t
        j = 2 * t * bm**2 * hm**2 / (bm + hm)
        return about_first - bi * hi**3 / 12, about_second - hi * bi**3 / 12, j


class Beam(Declared):
    """An elastic beam along ``z_i`` (role d) or ``x_{i-1}`` (role a) of a row, base to tip.

    ``length_m: rest`` is what is left of the row's ``d + q``; the body slides inside
    the beam before it.  Mass is uniform over `body_length_m`, which ends where the beam ends.
    """

    name: str
    row: int
    role: Literal["a", "d"]
    length_m: Positive | Literal["rest"]
    section: Annotated[Tube | Rect, Field(discriminator="type")] | None = None
    E_pa: Positive | None = None
    poisson: Annotated[float, Field(gt=-1, lt=0.5)] | None = None
    G_pa: Positive | None = None
    EI_nm2: Positive | None = None
    GJ_nm2: Positive | None = None
    mass_kg: NonNegative = 0.0
    mass: Literal["uniform"] = "uniform"
    body_length_m: Positive | None = None

    @model_validator(mode="after")
    def _stiff(self) -> Beam:
        if (self.section is None) == (self.EI_nm2 is None):
            state = "missing" if self.section is None else "given beside EI_nm2"
            raise Misdeclared("section", state, "either section with E_pa, or EI_nm2 with GJ_nm2")
        if self.section is not None and self.E_pa is None:
            raise Misdeclared("E_pa", "missing", "Young's modulus of the section in Pa")
        if self.section is not None and (self.poisson is None) == (self.G_pa is None):
            state = "missing" if self.poisson is None else "given beside G_pa"
            raise Misdeclared("poisson", state, "either poisson or G_pa")
        if self.EI_nm2 is not None and self.GJ_nm2 is None:
            raise Misdeclared("GJ_nm2", "missing", "torsional stiffness in N m^2, beside EI_nm2")
        if self.length_m == "rest" and self.body_length_m is None and self.mass_kg > 0:
            raise Misdeclared(
                "body_length_m", "missing", "needed by a beam of length rest with mass"
            )
        lowest, highest = RANGES["_nm2"]
        if not all(lowest <= value <= highest for value in self.stiffness):
            made = ", ".join(f"{value:.3g}" for value in self.stiffness)
            raise Misdeclared("section", made, f"EI and GJ of {lowest:g} to {highest:g} N m^2")
        return self

    @cached_property
    def stiffness(self) -> tuple[float, float, float]:
        """(EI about the first, EI about the second transverse axis, GJ) in N m^2."""
        if self.section is None:
            assert self.EI_nm2 is not None and self.GJ_nm2 is not None
            return self.EI_nm2, self.EI_nm2, self.GJ_nm2
        assert self.E_pa is not None
        shear = self.G_pa if self.G_pa is not None else self.E_pa / (2 * (1 + (self.poisson or 0)))
        first, second, torsion = self.section.second_moments()
        return self.E_pa * first, self.E_pa * second, shear * torsion
