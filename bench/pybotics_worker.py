"""The peer's process of the rigid calibration; it runs in pybotics's own environment.

Reads one JSON object (``data``: npz with rows (n, 4) of alpha, a, theta, d, ``prismatic`` (n,),
``q``, ``xyz``, ``tip`` (3,), ``held_q``, ``held_xyz``), answers one. It must not import
longarm_comp: that is not installed there.
"""

import json
import sys
import time

import numpy as np
from pybotics.kinematic_chain import MDHKinematicChain
from pybotics.link import PrismaticMDHLink, RevoluteMDHLink
from pybotics.optimization import OptimizationHandler, compute_absolute_errors, optimize_accuracy
from pybotics.robot import Robot
from pybotics.tool import Tool
from scipy.optimize import least_squares


def main() -> None:
    """Answer requests until the input ends."""
    for line in sys.stdin:
        with np.load(json.loads(line)["data"]) as data:
            given = {name: data[name] for name in data.files}
        links = [
            (PrismaticMDHLink if slides else RevoluteMDHLink)(*map(float, row))
            for row, slides in zip(given["rows"], given["prismatic"], strict=True)
        ]
        tool = Tool()
        tool.position = given["tip"]
        robot = Robot(MDHKinematicChain(links), tool=tool)
        # The first row moves the arm as the world's pose does; with both free it hardly converges.
        rows = [False] * 4 + [True] * 4 * (len(links) - 1)
        handler = OptimizationHandler(robot, kinematic_chain_mask=rows, world_mask=True)
        # The default ftol of 1e-8 takes minutes; 20 steps come within 3 % of the best error.
        begin = time.perf_counter()
        found = least_squares(
            optimize_accuracy,
            handler.generate_optimization_vector(),
            args=(handler, given["q"], given["xyz"]),
            ftol=1e-4,
            max_nfev=20,
        )
        seconds = time.perf_counter() - begin
        handler.apply_optimization_vector(found.x)
        left = compute_absolute_errors(given["held_q"], given["held_xyz"], handler.robot)
        answer = {"seconds": seconds, "held_out_mm": 1e3 * float(left.mean()), "p": len(found.x)}
        print(json.dumps(answer), flush=True)


if __name__ == "__main__":
    main()
