"""Layouts for Foxglove and PlotJuggler: in the form that these read, of topics that are there."""

import json
import re
import xml.etree.ElementTree as ElementTree
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from places import ROOT

from longarm_comp.core.arm.arm import Arm
from longarm_comp.nodes import interfaces as graph

LAYOUTS = ROOT / "config" / "layouts"
TYPES = {f"/{topic.name.lstrip('/')}": topic.type for topic in graph.TOPICS}


def field(path: str) -> Any:
    """What a message of a topic holds at a path ``/topic.field.field`` or with slashes."""
    topic = max((t for t in TYPES if re.match(rf"{t}[./]", f"{path}/")), key=len, default=None)
    assert topic is not None, f"{path}: no such topic"
    at = TYPES[topic]()
    for name in filter(None, re.split(r"[./]", path[len(topic) :])):
        assert hasattr(at, name), f"{path}: {type(at).__name__} has no {name}"
        at = getattr(at, name)
    return at


@pytest.mark.parametrize("path", ["/tip_measured/pose/position/x", "/tip.pose", "/motion.evnt"])
def test_a_path_that_is_wrong_is_noticed(path: str) -> None:
    with pytest.raises(AssertionError):
        field(path)


def leaves(tree: Any) -> Iterator[str]:
    """Panels of a tree of splits."""
    if isinstance(tree, str):
        yield tree
        return
    assert set(tree) == {"direction", "first", "second", "splitPercentage"}
    assert tree["direction"] in ("row", "column") and 0 < tree["splitPercentage"] < 100
    yield from leaves(tree["first"])
    yield from leaves(tree["second"])


def test_foxglove() -> None:
    layout = json.loads((LAYOUTS / "longarm.foxglove.json").read_text("utf-8"))
    assert set(layout) == {"configById", "globalVariables", "userNodes", "playbackConfig", "layout"}
    panels = layout["configById"]
    assert sorted(leaves(layout["layout"])) == sorted(panels)
    assert all(re.fullmatch(r"(3D|Image|Plot|StateTransitions|DiagnosticSummary)!\w+", p)
               for p in panels)  # fmt: skip
    for path in (p for panel in panels.values() for p in panel.get("paths", [])):
        plain = re.sub(r"\.@mul\(1000\)$|\[:\]", "", path["value"])
        assert isinstance(field(plain), int | float) or "[:]" in path["value"], path["value"]
    scene, image = panels["3D!arm"], panels["Image!left"]["imageMode"]
    named = [*scene["topics"], scene["publish"]["poseTopic"], *image.values()]
    named.append(panels["DiagnosticSummary!health"]["topicToRender"])
    assert set(named) <= set(TYPES)
    assert TYPES[image["imageTopic"]] is graph.Image
    assert TYPES[scene["publish"]["poseTopic"]] is graph.TARGET_POSE.type


def test_plotjuggler(demo_arm_path: Path) -> None:
    root = ElementTree.parse(LAYOUTS / "longarm.plotjuggler.xml").getroot()
    assert root.tag == "root"
    for splitter in root.iter("DockSplitter"):
        areas = splitter.findall("DockArea")
        sizes = [float(size) for size in splitter.attrib["sizes"].split(";")]
        assert len(areas) == len(sizes) == int(splitter.attrib["count"])
        assert sum(sizes) == pytest.approx(1.0, abs=1e-4)
    equations = {snippet.attrib["name"]: snippet for snippet in root.iter("snippet")}
    curves = {curve.attrib["name"] for curve in root.iter("curve")}
    sources = {e.text for name in ("linked_source", "v1") for e in root.iter(name)}
    assert set(equations) <= curves and len(equations) == 3
    joints = {f"/joint_states/{name}/position" for name in Arm.load(demo_arm_path).joint_names}
    assert joints <= curves
    for path in (curves | sources) - set(equations) - joints:
        assert isinstance(field(path), int | float), path
