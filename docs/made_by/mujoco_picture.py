"""Picture of docs/mujoco.md: the arm as MuJoCo draws it, and its true errors.

python examples/mujoco_walk.py build/mujoco; python docs/made_by/mujoco_picture.py build/mujoco
"""

import os
import sys
from pathlib import Path

os.environ.setdefault("MUJOCO_GL", "egl")  # it draws without a screen

import matplotlib as mpl
import matplotlib.pyplot as plt
import mujoco
import numpy as np
from drawing import BLUE, INK, STYLE, VERMILLION

sys.path.append(str(Path(__file__).resolve().parents[2] / "examples"))

from mujoco_arm import RealArm

PICTURE = Path(__file__).resolve().parents[1] / "pictures" / "mujoco_arm.png"
POSES = np.radians([[-35, 5, 0, 0, 0], [15, 45, -50, -20, 40], [60, 60, -95, 30, 0]])


def drawn(arm: RealArm) -> np.ndarray:
    """(h, w, 3) pixels: the arm at `POSES`, one scene."""
    renderer = mujoco.Renderer(arm.model, 900, 1200)
    camera = mujoco.MjvCamera()
    camera.lookat[:] = (1.05, 0.2, 0.85)
    camera.distance, camera.azimuth, camera.elevation = 4.1, 112, -16
    scene = None
    for q in POSES:
        for _ in arm.move([q]):
            pass
        if scene is None:
            renderer.update_scene(arm.data, camera)
            scene = renderer.scene
        else:
            mujoco.mjv_addGeoms(
                arm.model, arm.data, mujoco.MjvOption(), mujoco.MjvPerturb(),
                mujoco.mjtCatBit.mjCAT_DYNAMIC, scene,
            )  # fmt: skip
    return renderer.render()


def picture(folder: Path) -> None:
    """Write the arm beside the true error of every target of a walk."""
    without, compensated, p90 = np.loadtxt(folder / "errors.csv", delimiter=",", skiprows=1).T[3:]
    with mpl.rc_context(STYLE):
        figure, (scene, errors) = plt.subplots(
            1, 2, figsize=(9.6, 3.8), layout="constrained", width_ratios=(1.25, 1)
        )
        scene.imshow(drawn(RealArm(1)))
        scene.axis("off")
        order = np.argsort(without)
        errors.semilogy(without[order], "o", color=VERMILLION, label="drawing alone")
        errors.semilogy(compensated[order], "o", color=BLUE, label="diagnosed model")
        errors.semilogy(p90[order], "_", color=INK, label="its promise, 90 %")
        errors.set_xlabel("target")
        errors.set_ylabel("true error of the tip, mm")
        errors.legend(loc="center right")
        figure.savefig(PICTURE, dpi=110)
        plt.close(figure)


if __name__ == "__main__":
    picture(Path(sys.argv[1]))
