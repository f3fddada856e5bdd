"""A tube that twists more than declared, as a wound one does, is no soft bearing."""

import numpy as np
import pytest

from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.calibration.calibrate import geometry_terms
from longarm_comp.core.calibration.candidates import list_candidates
from longarm_comp.core.data.session import Session
from longarm_comp.core.effects.catalogue import LIBRARY
from longarm_comp.core.effects.compliances import (
    BearingTilt,
    JointCompliance,
    LinkStiffness,
    LinkTorsion,
)
from longarm_comp.core.effects.effect import Effect
from longarm_comp.core.effects.link_deflection import LinkDeflection
from longarm_comp.core.identify.posterior.explain import explain_session
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import Model

UPPER = {"name": "upper", "row": 3, "role": "a", "length_m": 0.7, "mass_kg": 0.3}
FORE = {"name": "fore", "row": 4, "role": "d", "length_m": 0.6, "mass_kg": 0.2}
SHEAR_PA = 2.7e10


def arm(softer: float) -> Arm:
    """Two tubes with an elbow between them, so the load beyond twists the first one."""
    turning = [(0, 0, 0.25), (90, 0, 0), (0, 0.7, 0), (90, 0, 0.6), (-90, 0, 0)]
    joints = [
        {"id": k, "type": "revolute", "limits_deg": [-80, 80], "alpha_deg": a, "a_m": x, "d_m": d}
        for k, (a, x, d) in enumerate(turning, 1)
    ]
    tube = {"type": "tube", "od_m": 0.04, "id_m": 0.036}
    made = {"section": tube, "E_pa": 7e10, "G_pa": SHEAR_PA / softer}
    return Arm.parse(
        {
            "name": "tubes",
            "convention": "mdh_craig",
            "tip": {"frame": 5, "position_m": [0.25, 0.0, 0.1]},
            "joints": joints,
            "links": [beam | made | {"body_length_m": beam["length_m"]} for beam in (UPPER, FORE)],
            "payload": {"mass_kg": 2.0, "frame": 5, "position_m": [0.25, 0.0, 0.1]},
        },
        "test",
    )


def drawn(rows: int) -> np.ndarray:
    return np.random.default_rng(3).uniform(arm(1).lower, arm(1).upper, (rows, 5))


def test_the_effect_is_a_smaller_shear_modulus() -> None:
    """Of a beam along a and of one along d."""
    q = drawn(40)
    twisted = [LinkTorsion(beam=name, softness=4.0) for name in ("upper", "fore")]
    tip = Model(arm(1), (LinkDeflection(), *twisted)).tip(q)
    stiff, soft = (Model(arm(by), (LinkDeflection(),)).tip(q) for by in (1, 5))
    assert np.linalg.norm(soft - stiff, axis=1).max() > 1e-3
    assert tip == pytest.approx(soft, abs=5e-6)  # the turns do not commute


def test_a_tube_that_twists_is_no_soft_bearing() -> None:
    q = drawn(120)
    noise = 1e-4 * np.random.default_rng(5).standard_normal((len(q), 3))
    rows = Session.record(q, Model(arm(5), (LinkDeflection(),)).tip(q) + noise)
    base = declared_model(arm(1)).plus(*geometry_terms(arm(1), rows))
    loaded = [kind for kind in LIBRARY if issubclass(kind, Effect) and kind.loaded]
    tried = list_candidates(arm(1), rows.context(), loaded, base.terms).testable
    found = explain_session(base, rows, tried)
    assert {"link_torsion"} == {name for f in found.found for name in f.credible}
    (softness,) = {round(t.softness, 0) for t in found.chosen_terms if isinstance(t, LinkTorsion)}
    assert softness == 4.0


def parallel_arm() -> Arm:
    """A light arm whose two tubes bend in one plane: its joints 2, 3 and 4 are parallel."""
    rows = [
        (0, 0, 0.25, [-90, 90]),
        (90, 0, 0, [-40, 70]),
        (0, 0.7, 0, [-100, 20]),
        (0, 0.6, 0, [-60, 60]),
        (-90, 0, 0, [-150, 150]),
    ]
    joints = [
        {"id": k, "type": "revolute", "limits_deg": ends, "alpha_deg": a, "a_m": x, "d_m": d}
        for k, (a, x, d, ends) in enumerate(rows, 1)
    ]
    beams = [("upper", 3, 0.7, 0.04, 0.26), ("fore", 4, 0.6, 0.03, 0.125)]
    made = {"role": "a", "E_pa": 7e10, "poisson": 0.3}
    at = {"frame": 5, "position_m": [0.15, 0.03, 0.08]}
    return Arm.parse(
        {
            "name": "parallel",
            "convention": "mdh_craig",
            "tip": at,
            "joints": joints,
            "links": [
                {"name": name, "row": row, "length_m": x, "body_length_m": x, "mass_kg": kg}
                | {"section": {"type": "tube", "od_m": od, "id_m": 0.9 * od}}
                | made
                for name, row, x, od, kg in beams
            ],
            "payload": at | {"mass_kg": 0.8},
            "point_masses": [
                {"name": f"servo {k}", "frame": k, "mass_kg": kg}
                for k, kg in enumerate((1.2, 1.0, 0.5, 0.3, 0.1), 1)
            ],
        },
        "test",
    )


def test_two_names_replace_one_that_imitates_both() -> None:
    """Tubes that bend and twist more, and soft joints: three soft bearings imitate two of these.

    No exchange of one name for another leaves the bearings.
    """
    light, rng = parallel_arm(), np.random.default_rng(4)
    q = rng.uniform(light.lower, light.upper, (150, 5))
    hidden = (
        *(LinkStiffness(beam=name, softness=s) for name, s in (("upper", 1.3), ("fore", 0.9))),
        *(LinkTorsion(beam=name, softness=s) for name, s in (("upper", 3.8), ("fore", 2.5))),
        *(JointCompliance(joint, compliance=c) for joint, c in ((2, 1.5e-4), (4, 2e-3))),
    )
    tip = Model(light, (LinkDeflection(), *hidden)).tip(q)
    rows = Session.record(q, tip + 1e-4 * rng.standard_normal((150, 3)))
    base = declared_model(light).plus(*geometry_terms(light, rows))
    kinds = (LinkStiffness, LinkTorsion, JointCompliance, BearingTilt)
    tried = list_candidates(light, rows.context(), kinds, base.terms).testable
    found = explain_session(base, rows, tried, functions=False)
    sure = {f.name for f in found.found if f.credible == (f.name,)}
    assert {"link_stiffness", "link_torsion"} <= sure
    assert "bearing_tilt" not in sure
