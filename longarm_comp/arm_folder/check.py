"""Checks an arm's folder: missing files, implausible values, unmeasured assumptions."""

import math
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from longarm_comp.arm_folder.head import View, head_for
from longarm_comp.arm_folder.make import ARM, NODES
from longarm_comp.arm_folder.measured import (
    CAMERAS,
    FILE,
    SIDES,
    camera_path,
    is_changed,
    read_measured,
)
from longarm_comp.arm_folder.parameter_file import find_strangers, own_parameters, read_parameters
from longarm_comp.arm_folder.servos import ROUNDING_TICKS, find_contradictions
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.arm.parts import Beam, Rect, Tube
from longarm_comp.core.data.plan import sobol
from longarm_comp.core.errors import InputError
from longarm_comp.core.model.declared_model import declared_model
from longarm_comp.core.model.model import unstack
from longarm_comp.core.vibration.modes import find_modes
from longarm_comp.devices.servo_config import ServoConfig
from longarm_comp.sim.cameras import CameraPair

LEVELS = ("missing", "implausible", "unmeasured", "measured", "declared")
"""The first two must be corrected. Unmeasured is an assumption, measured what a command measured,
declared a value of arm.yaml to compare with the arm."""


@dataclass(frozen=True)
class _FolderFinding:
    """A finding on an arm's folder, and what to do."""

    level: str
    where: str  # file, and the key in it
    text: str

    @property
    def blocks(self) -> bool:
        """True if the folder cannot be used as it is."""
        return self.level in ("missing", "implausible")


missing, implausible, unmeasured, measured, declared = (
    partial(_FolderFinding, level) for level in LEVELS
)


def check_record(folder: Path) -> Iterator[_FolderFinding]:
    """Yield a finding for each recorded measurement, and one if the cameras are not calibrated."""
    try:
        entries = read_measured(folder)
    except InputError as error:
        yield implausible(f"{FILE}: {error.field}", f"{error.value}; allowed: {error.allowed}")
        return
    for file, entry in entries.items():
        told = {k: v for k, v in entry.facts.items() if k not in ("session", "before")}
        facts = ", ".join(f"{name} {value}" for name, value in told.items())
        said = f"{entry.at}, longarm {entry.by}: {facts}"
        if is_changed(folder, file, entry):
            yield unmeasured(file, f"measured, but changed since: {said}. Measure again")
        else:
            yield measured(file, said)
    if CAMERAS not in entries and not all(camera_path(folder, side).is_file() for side in SIDES):
        said = "no calibration (longarm stereo calibrate), unless the camera driver has one"
        yield unmeasured(CAMERAS, said)


def _describe_beams(arm: Arm, q: np.ndarray) -> Iterator[_FolderFinding]:
    """Yield findings on each beam, the sag and the lowest natural frequency, in one pose.

    It is the pose of q (N, n), rad and m, in which the tip is horizontally farthest from the base.
    """
    model, rigid = declared_model(arm), declared_model(arm, deflection=False)
    tips = rigid.tip(q)
    level = np.array(arm.gravity_mps2) / (np.linalg.norm(arm.gravity_mps2) or 1.0)
    out = tips - arm.base.xyz_m
    out = np.linalg.norm(out - (out @ level)[:, None] * level, axis=1)
    at = q[int(out.argmax())]
    posture = rigid.posture(unstack(at))
    for beam in arm.links:
        row = posture.chain.rows[beam.row - 1]
        element = (row.elements_a if beam.role == "a" else row.elements_d)[0]
        fell = np.array([float(v) for v in posture.gravity_in(element.station)])
        across = np.abs(fell[[(element.axis + 1) % 3, (element.axis + 2) % 3]])
        first, second, torsion = beam.stiffness
        bending = f"{first:.3g}" if first == second else f"{first:.3g} and {second:.3g}"
        stiff = f"EI {bending}, GJ {torsion:.3g} N m^2"
        text = f"{_describe_section(beam)}; {stiff}; {1e3 * beam.mass_kg:.4g} g"
        if isinstance(beam.section, Rect):  # width and height: which side is up
            lean = math.degrees(math.atan2(*across))
            if np.linalg.norm(across) < 0.1 * (np.linalg.norm(fell) or 1.0):
                text += "; the beam is vertical here, so no side is up"
            elif lean <= 45.0:
                text += f"; height_m is upright there, to {lean:.0f} deg"
            else:
                text += f"; width_m is upright there, to {90.0 - lean:.0f} deg"
        yield declared(f"arm.yaml: links.{beam.name}", text)
    sag = 1e3 * float(np.linalg.norm(model.tip(at) - rigid.tip(at)))
    joints = []
    for name, number, value in zip(arm.joint_names, arm.commanded, at, strict=True):
        turns = arm.joints[number - 1].type == "revolute"
        said = f"{math.degrees(value):.0f} deg" if turns else f"{1e3 * value:.0f} mm"
        joints.append(f"{name} {said}")
    said = f"held out to {out.max():.2f} m ({', '.join(joints)}) the tip sags by {sag:.3g} mm. "
    said += "Measure it: twice or half of it means a wrong section, or width and height swapped"
    yield declared("arm.yaml: links", said)
    hz, known = find_modes(model, at).hz, model.arm.damping
    if len(hz):
        more = f"damping {known:g}" if known else "how long: longarm modes, and `damping`"
        yield declared("arm.yaml: damping", f"there it rings at {hz[0]:.3g} Hz; {more}")


def _describe_section(beam: Beam) -> str:
    section = beam.section
    if section is None:
        return "EI and GJ as declared"
    if isinstance(section, Tube):
        inner = f"/{1e3 * section.id_m:.4g}" if section.id_m else ", solid"
        return f"tube {1e3 * section.od_m:.4g}{inner} mm"
    wall = f"wall {1e3 * section.wall_m:.4g}" if section.wall_m else "solid"
    return f"{1e3 * section.width_m:.4g} wide x {1e3 * section.height_m:.4g} high mm, {wall}"


_REACH_M = (0.05, 20.0)
"""Usual reach of arms, m. A reach outside of it suggests lengths in another unit."""
_MOST_DEG = 720.0
"""Largest plausible limit of a joint that is not endless: two turns, as in `import_urdf`."""
_SESSIONS = ("samples.csv", "session", "session_1")


def check_folder(folder: Path) -> list[_FolderFinding]:
    """Return the findings on an arm's folder (or that of an arm.yaml), blocking ones first.

    Raises InputError if there is no such folder.
    """
    folder = folder.parent if folder.name == ARM and folder.is_file() else folder
    if not folder.is_dir():
        raise InputError(folder, "DIR", "missing", "an arm's folder: `longarm init DIR` makes one")
    arm, found = _load_file(folder / ARM, Arm.load)
    if arm is None:
        return found
    found += _check_arm(arm)
    record = list(check_record(folder))
    known = {finding.where for finding in record if finding.level == "measured"}
    if any((folder / f"{node}.yaml").exists() for node in NODES):
        found += _check_servos(folder, arm, known)
        look = not any(finding.blocks for finding in found)
        found += _check_cameras(folder, arm, known, look)
    else:
        said = "no servo and camera files: another program drives the arm (longarm init --arm)"
        found.append(unmeasured(ARM, said))
    if not any((folder / name).exists() for name in _SESSIONS):
        said = "no session yet: longarm up, plan and collect; or longarm import-data"
        found.append(unmeasured("samples.csv", said))
    return sorted(found + record, key=lambda finding: LEVELS.index(finding.level))


def _load_file(path: Path, load: Callable[[Path], Any]) -> tuple[Any, list[_FolderFinding]]:
    if not path.is_file():
        how = "longarm init" if path.name == ARM else f"longarm init DIR --arm {ARM}"
        return None, [missing(path.name, f"no such file; {how} makes it")]
    try:
        return load(path), []
    except InputError as error:
        said = f"{error.value!r}; allowed: {error.allowed}"
        return None, [implausible(f"{path.name}: {error.field}", said)]


def _check_arm(arm: Arm) -> Iterator[_FolderFinding]:
    q = np.vstack([arm.mid, sobol(arm, 64, 0).q])
    rigid = declared_model(arm, deflection=False).tip(q)
    reach = float(np.linalg.norm(rigid - np.array(arm.base.xyz_m), axis=1).max())
    if not _REACH_M[0] <= reach <= _REACH_M[1]:
        low, high = _REACH_M
        said = f"the tip is up to {reach:.3g} m from the base; usual: {low:g} to {high:g}"
        yield implausible(ARM, f"{said}. Lengths are metres")
    if float(np.ptp(rigid, axis=0).max()) < 1e-3 * reach:
        yield implausible(f"{ARM}: joints", "no joint moves the tip")
    for joint in arm.joints:
        farthest = max(map(abs, joint.limits_deg or (0.0, 0.0)))
        if farthest > _MOST_DEG and not joint.endless:
            said = f"{farthest:g} deg is more than two turns; "
            said += "endless: true where it turns on and on"
            name = joint.name or f"joint{joint.id}"
            yield implausible(f"{ARM}: joints.{name}.limits_deg", said)
    if not arm.links:
        yield unmeasured(f"{ARM}: links", "no beam is declared: the arm is taken as rigid")
    else:
        sag = np.linalg.norm(declared_model(arm).tip(q) - rigid, axis=1)
        # A sag above this share of the reach is no arm's, or no longer a small deflection
        if float(sag.max()) > 0.15 * reach:
            said = f"the tip sags by up to {1e3 * sag.max():.0f} mm of {1e3 * reach:.0f} mm"
            yield implausible(f"{ARM}: links", f"{said}: check E_pa, sections, masses")
        yield from _describe_beams(arm, q)
    weight = sum(b.mass_kg for b in arm.links) + sum(m.mass_kg for m in arm.point_masses)
    if not weight:
        until = "Compliances are relative to 1 kg a metre until then"
        until = "Without weight no compliance can be found" if arm.declares_weight else until
        yield unmeasured(f"{ARM}: point_masses", f"no part has a mass: weigh them. {until}")
    if arm.payload is None:
        yield unmeasured(f"{ARM}: payload", "no payload is declared: weigh tool and marker")
    where, gravity = f"{ARM}: gravity_mps2", np.array(arm.gravity_mps2)
    if not gravity.any():
        yield implausible(where, "no gravity")
        return
    foot = arm.base.frame().matrix()[:3, 2]
    lean = math.degrees(math.acos(np.clip(-gravity @ foot / np.linalg.norm(gravity), -1.0, 1.0)))
    how = "stands on" if lean < 45.0 else "hangs down from" if lean > 135.0 else "reaches out from"
    said = f"the arm {how} its base: the base's z leans {lean:.0f} deg from upright"
    if lean > 135.0 and foot[2] > math.cos(math.radians(45.0)):  # a slip of gravity's sign
        said += ", by gravity towards +z with a level base.rpy_deg. "
        yield unmeasured(where, said + "On a floor it is [0, 0, -9.80665]: every sag turns round")
    else:
        yield declared(where, said)


def _load_servos(path: Path) -> ServoConfig:
    """Read the servos of a driver's file; refuse other parameters of it that the driver refuses."""
    servos, sections = ServoConfig.load(path), ServoConfig.model_fields
    known, given = (
        {name: value for name, value in values.items() if name.partition(".")[0] not in sections}
        for values in (own_parameters("servo_driver"), read_parameters(path))
    )
    for name, value, allowed in find_strangers(known, given):
        raise InputError(path, name, value, allowed)
    servos.check_rate((known | given)["rate_hz"], path.name)
    return servos


def _check_servos(folder: Path, arm: Arm, known: set[str]) -> list[_FolderFinding]:
    path = folder / "servo_driver.yaml"
    servos, found = _load_file(path, _load_servos)
    if servos is None:
        return found
    found += [
        implausible(f"{error.where}: {error.field}", f"{error.value}; allowed: {error.allowed}")
        for error in find_contradictions(servos, arm, path.name, ARM)
    ]
    if found:
        return found
    for name, lower, upper in zip(arm.joint_names, arm.lower, arm.upper, strict=True):
        joint = servos.joints[name]
        if max(joint.lower - lower, upper - joint.upper) > ROUNDING_TICKS * joint.si_per_tick:
            said = f"limits {joint.lower:g} to {joint.upper:g} {joint.unit}; poses are planned "
            said += f"within {lower:g} to {upper:g}, as in {ARM}"
            found.append(implausible(f"{path.name}: joints.{name}", said))
    turns = {name: joint.servo.ticks_per_turn for name, joint in servos.joints.items()}
    zeros = [n for n, turn in turns.items() if servos.joints[n].zero_ticks % turn == turn / 2]
    if zeros and path.name not in known:
        said = f"half a turn at {', '.join(zeros)}: read the encoders at joint value 0"
        said += " (longarm servo setup); check ids, gearing and directions too"
        found.append(unmeasured(f"{path.name}: zero_ticks", said))
    return found


def _check_cameras(folder: Path, arm: Arm, known: set[str], look: bool) -> list[_FolderFinding]:
    """Check the files of the camera nodes; if `look`, also how often they see the marker.

    Values in the files `known` were measured.
    """
    read, found = {}, []
    for node in NODES[1:]:
        given, faults = _load_file(folder / f"{node}.yaml", read_parameters)
        own = own_parameters(node)
        found += faults
        if given is not None:
            found += [
                implausible(f"{node}.yaml: {name}", f"{value!r}; allowed: {allowed}")
                for name, value, allowed in find_strangers(own, given)
            ]
            lacking = [name for name in own if name not in given]
            if lacking:
                said = f"the file is incomplete: {', '.join(lacking)}; longarm init writes all"
                found.append(missing(f"{node}.yaml", said))
            read[node] = own | given
    if "stereo_bridge" not in read or any(finding.blocks for finding in found):
        return found
    bridge = read["stereo_bridge"]
    placed = "stereo_bridge.yaml" in known
    found += _check_assumed(arm, bridge, placed)
    if not look or "simulated_arm" not in read:
        return found
    simulated = read["simulated_arm"]
    stands = CameraPair(tuple(simulated["camera.position"]), tuple(simulated["camera.axis"]))
    assumed = View.of(bridge, simulated)
    view = replace(assumed, left_in_base=stands.left_in_base)
    tips = declared_model(arm).pose(sobol(arm, 64, 0).q)
    why = view.unseen(tips)
    seen = why.count("")
    read_as = assumed.left_in_base @ np.linalg.inv(view.left_in_base) @ tips
    off = 1e3 * float(np.median(np.linalg.norm((read_as - tips)[:, :3, 3], axis=1)))
    if seen < 0.5 * len(why):
        kinds = Counter(text.partition(":")[0] for text in why if text)
        usual = next(text for text in why if text.startswith(kinds.most_common(1)[0][0]))
        said = f"the marker is seen at {seen} of {len(why)} poses, at most others {usual}: "
        best = head_for(arm.model_copy(update={"camera": None}))
        found_best = View.of(bridge | best["stereo_bridge"], simulated | best["simulated_arm"])
        most = found_best.unseen(tips).count("")
        # What no place of the cameras mends is no fault of theirs
        if seen < 0.5 * most:
            said += f"move the cameras or turn the marker (marker.mounting): {most} could be seen"
        else:
            said += "narrow the limits in arm.yaml, or leave these out (longarm plan --seen)"
        level = implausible if seen < 0.5 * most else unmeasured
        found.append(level("simulated_arm.yaml: camera, marker", said))
    elif off > 10.0 and not placed:
        said = f"the tip is measured {off:.0f} mm from where it is: the cameras of "
        said += "simulated_arm.yaml stand elsewhere"
        found.append(implausible("stereo_bridge.yaml: hand_eye", said))
    return found


def _check_assumed(arm: Arm, bridge: dict[str, Any], placed: bool) -> Iterator[_FolderFinding]:
    """Yield findings on values that are still as assumed; `placed`: the head was measured."""
    file, made = "stereo_bridge.yaml", head_for(arm)["stereo_bridge"]
    own = own_parameters("stereo_bridge")
    if not placed and bridge["hand_eye.xyz"] in (made["hand_eye.xyz"], own["hand_eye.xyz"]):
        said = "the place of the left camera is assumed: measure it (longarm stereo hand-eye)"
        yield unmeasured(f"{file}: hand_eye", said)
    if bridge["marker.tag_m"] in (made["marker.tag_m"], own["marker.tag_m"]):
        yield unmeasured(f"{file}: marker", "measure the printed tags: tag_m and gap_m")
    if not any(bridge["tip_in_marker"]):
        yield unmeasured(f"{file}: tip_in_marker", "the tip is assumed at the marker's middle")
    place = bridge["hand_eye.xyz"]
    if arm.camera is not None and not np.allclose(arm.camera.position_m, place, atol=0.01):
        said = f"{list(arm.camera.position_m)}; {file} has hand_eye.xyz {place}"
        if placed:  # a model belongs to one arm.yaml, so that file is left to the user
            yield unmeasured(f"{ARM}: camera", f"{said}, which was measured: correct it")
        else:
            yield implausible(f"{ARM}: camera", said)
