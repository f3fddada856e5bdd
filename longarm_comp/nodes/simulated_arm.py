"""`simulated_arm`: simulates arm, servos and cameras, so that the real nodes run unchanged.

It offers a servo bus on a pseudo-terminal. It publishes the images of two cameras, temperature and
payload.
"""

import time
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
from geometry_msgs.msg import PointStamped
from rcl_interfaces.msg import SetParametersResult
from rclpy.executors import SingleThreadedExecutor
from rclpy.parameter import Parameter
from sensor_msgs.msg import Temperature
from std_msgs.msg import Float64, Header, String

from longarm_comp.arm_folder.measured import SIDES
from longarm_comp.core.arm.arm import Arm
from longarm_comp.core.errors import InputError
from longarm_comp.nodes import interfaces as graph
from longarm_comp.nodes.clock import stamp_of, steady_timer
from longarm_comp.nodes.frames import prefix_of
from longarm_comp.nodes.health import OK, PERIOD, Report
from longarm_comp.nodes.images import image_message, info_message
from longarm_comp.nodes.messages import pose_message
from longarm_comp.nodes.node import ArmNode, program
from longarm_comp.nodes.params import Param
from longarm_comp.sim.cameras import CameraPair, tag_plate
from longarm_comp.sim.plant import Plant, PlantConfig, hidden_effects, mount_plate
from longarm_comp.sim.servo_emulator.joints import read_arm
from longarm_comp.sim.servo_emulator.motor import MotorSpec

PARAMS = (
    Param("arm", "", "arm.yaml: the declared arm, which all other nodes use"),
    Param("servos", "", "the servo driver's YAML file: which servos there are"),
    Param("port", "", "symbolic link to make to the servo bus"),
    Param("seed", 1, "seed of all random numbers", 0, 2**31),
    Param("hidden", "", "undeclared effects and their size at the tip, 'name=mm name=mm'"),
    Param("more_play", "", "play that has grown since the start, 'joint=rad joint=m'", live=True),
    Param("unplugged", "", "joints whose servos do not answer, 'joint2 joint4'", live=True),
    Param("covered", "", "cameras that see nothing: 'left', 'right' or both", live=True),
    Param("frame_rate_hz", 5.0, "pairs of images a second", 0.0, 60.0),
    Param("context_rate_hz", 1.0, "temperature and payload messages a second", 0.0, 60.0),
    Param("speed_ticks_s", 3000.0, "no-load speed of the servos", 1.0, 1e6),
    Param("lag_s", 0.03, "time constant of a servo near its goal", 1e-4, 10.0),
    Param("dead_band_ticks", 0.0, "a servo stops this near to its goal", 0.0, 1000.0),
    Param("wire_faults_hz", 0.0, "servo replies lost, cut or damaged in a second", 0.0, 50.0),
    Param("temperature_c", 22.0, "temperature at the start", -50.0, 100.0),
    Param("warming_k", 0.0, "temperature rise over hours", -50.0, 50.0),
    Param("damping", 0.0, "share of critical damping; 0: the arm does not ring", 0.0, 0.9),
    Param("payload_kg", 0.25, "mass carried at the tool", 0.0, 1000.0, live=True),
    Param("sockets", "", "conical sockets in the base frame, 'name=x,y,z name=x,y,z', m"),
    Param("camera.position", [0.75, -1.7, 0.3], "left camera in the base frame, m"),
    Param("camera.axis", [0.0, 1.0, 0.0], "direction in which the cameras look"),
    Param("camera.baseline_m", 0.3, "from the left to the right camera", 1e-3, 10.0),
    Param("camera.focal_px", 640.0, "focal length", 10.0, 1e5),
    Param("camera.width", 640, "image width", 16, 8192),
    Param("camera.height", 480, "image height", 16, 8192),
    Param("marker.tag_m", 0.06, "side of a tag's black square", 1e-3, 10.0),
    Param("marker.gap_m", 0.012, "white between tags", 0.0, 10.0),
    Param("marker.columns", 2, "tags across", 1, 20),
    Param("marker.rows", 2, "tags down", 1, 20),
    Param(
        "marker.mounting",
        [-0.31333312, -1.92702538, -0.47266542],
        "rotation vector of the plate against the tip frame, rad; its centre is the tip",
        -6.3,
        6.3,
    ),
    PERIOD,
)


def sizes(text: str) -> dict[str, float]:
    """Read the sizes of hidden effects, mm, by name, from ``name=mm name=mm``."""
    found = numbers("hidden", text, 1, "name=mm, for instance backlash=2.0")
    return {name: size for name, (size,) in found.items()}


def numbers(field: str, text: str, count: int, allowed: str) -> dict[str, list[float]]:
    """Read ``count`` numbers for each name from ``name=number,number name=...``."""
    by_name = {}
    for part in text.split():
        name, _, said = part.partition("=")
        try:
            by_name[name] = [float(number) for number in said.split(",")]
        except ValueError:
            by_name[name] = []
        if len(by_name[name]) != count:
            raise InputError("parameters of simulated_arm", field, part, allowed)
    return by_name


def _check_names(field: str, text: str, known: Iterable[str]) -> list[str]:
    """Return the words of a text; raise InputError if one is not ``known``."""
    for word in text.split():
        if word not in known:
            raise InputError("parameters of simulated_arm", field, word, ", ".join(known))
    return text.split()


class _SimulatedArm(ArmNode):
    """The node. Its worker renders images; a pair is skipped while an earlier one waits."""

    def __init__(self, executor: SingleThreadedExecutor) -> None:
        super().__init__(executor, "simulated_arm", PARAMS)
        p = self.p
        arm = Arm.load(p["arm"])
        rng = np.random.default_rng(p["seed"])
        config = PlantConfig(
            arm,
            read_arm(p["servos"]),
            CameraPair(
                position_m=tuple(p["camera.position"]),
                optical_axis=tuple(p["camera.axis"]),
                baseline_m=p["camera.baseline_m"],
                focal_px=p["camera.focal_px"],
                size=(p["camera.width"], p["camera.height"]),
            ),
            tag_plate(p["marker.tag_m"], p["marker.gap_m"], p["marker.columns"], p["marker.rows"]),
            mount_plate(p["marker.mounting"]),
            hidden_effects(arm, sizes(p["hidden"]), rng),
            MotorSpec(
                max_speed_ticks_s=p["speed_ticks_s"],
                lag_s=p["lag_s"],
                dead_band_ticks=p["dead_band_ticks"],
            ),
            temperature_c=(p["temperature_c"], p["warming_k"]),
            payload_kg=p["payload_kg"],
            damping=p["damping"],
            sockets=numbers("sockets", p["sockets"], 3, "name=x,y,z (m)"),
        )
        self._plant = Plant(config, Path(p["port"]), rng)
        self._covered: list[str] = []
        self._live: dict[str, Callable[[Any], None]] = {
            "more_play": self._set_play,
            "unplugged": self._unplug_servos,
            "covered": self._cover_cameras,
            "payload_kg": self._plant.carry,
        }
        for name, take in self._live.items():
            take(p[name])
        self.add_on_set_parameters_callback(self._on_set)
        self.add_post_set_parameters_callback(self._take_live)
        self._started = time.monotonic()
        self._frames = self._late = 0
        self._worker = self.worker(1)
        self._worker.start()
        self._images = graph.LEFT_IMAGE.publisher(self), graph.RIGHT_IMAGE.publisher(self)
        self._infos = graph.LEFT_INFO.publisher(self), graph.RIGHT_INFO.publisher(self)
        self._truth = self.create_publisher(PointStamped, "~/true_tip", 20)
        self._temperature = graph.TEMPERATURE.publisher(self)
        self._payload = graph.PAYLOAD.publisher(self)
        if config.sockets:
            self._contact = graph.CONTACT.publisher(self)
            # Between two looks for contact of the ball, s
            steady_timer(self, 0.1, self._tell_contact)
        if p["frame_rate_hz"]:
            steady_timer(self, 1.0 / p["frame_rate_hz"], self._expose_cameras)
        if p["context_rate_hz"]:
            steady_timer(self, 1.0 / p["context_rate_hz"], self._tell_circumstances)
        if p["wire_faults_hz"]:
            self._chance = np.random.default_rng([p["seed"], 1])
            steady_timer(self, 1.0 / p["wire_faults_hz"], self._spoil_reply)
        if p["damping"]:
            # Between two steps of the arm's vibration, s: a small part of the first modes' periods
            steady_timer(self, 0.01, lambda: self._plant.ring(self._t_s))
        self.health.parts["plant"] = self._report_plant
        self._plant.start()

    def close(self) -> bool:
        ended = super().close()
        self._plant.stop()
        return ended

    def _set_play(self, text: str) -> None:
        play = numbers("more_play", text, 1, "joint=rad, for instance joint4=0.002")
        self._plant.wear({joint: more for joint, (more,) in play.items()})

    def _unplug_servos(self, text: str) -> None:
        ids = {joint.name: joint.servo_id for joint in self._plant.config.servos.joints}
        names = _check_names("unplugged", text, ids)
        self._plant.emulator.faults.silent = {ids[name] for name in names}

    def _cover_cameras(self, text: str) -> None:
        self._covered = _check_names("covered", text, SIDES)

    def _on_set(self, parameters: list[Parameter]) -> SetParametersResult:
        """Try values, and put the old ones back: others are set with them and may be refused."""
        before = [self.get_parameter(parameter.name) for parameter in parameters]
        try:
            self._take_live(parameters)
        except InputError as error:
            return SetParametersResult(successful=False, reason=str(error))
        finally:
            self._take_live(before)
        return SetParametersResult(successful=True)

    def _take_live(self, parameters: list[Parameter]) -> None:
        for parameter in parameters:
            if parameter.name in self._live:
                self._live[parameter.name](parameter.value)

    @property
    def _t_s(self) -> float:
        """Time since the start, s."""
        return time.monotonic() - self._started

    def _expose_cameras(self) -> None:
        if not self._worker.submit(self._publish_frame):
            self._late += 1

    def _publish_frame(self) -> None:
        """Publish true tip, camera calibrations and images (if anybody looks), of one time."""
        ns = self.get_clock().now().nanoseconds
        t_s = self._t_s
        looked_at = any(image.get_subscription_count() for image in self._images)
        images = self._plant.look(t_s) if looked_at else ()
        prefix = prefix_of(self)
        header = Header(stamp=stamp_of(ns), frame_id=f"{prefix}base")
        tip = pose_message(self._plant.tip_pose(t_s)).position
        self._truth.publish(PointStamped(header=header, point=tip))
        infos = self._plant.config.cameras.camera_infos()
        frames = [f"{prefix}{side}_optical" for side in SIDES]
        for k, frame in enumerate(frames):
            self._infos[k].publish(info_message(infos[k], ns, frame))
        for k, image in enumerate(images):
            seen = image * (SIDES[k] not in self._covered)
            self._images[k].publish(image_message(seen, ns, frames[k]))
        self._frames += 1

    def _spoil_reply(self) -> None:
        """Let the next reply of a random servo be lost, damaged or cut short."""
        faults = self._plant.emulator.faults
        ways = (faults.drops, faults.corrupt, faults.cuts)
        servos = [joint.servo_id for joint in self._plant.config.servos.joints]
        ways[int(self._chance.integers(len(ways)))][int(self._chance.choice(servos))] += 1

    def _tell_circumstances(self) -> None:
        header = Header(stamp=self.get_clock().now().to_msg())
        warm = self._plant.temperature_c(self._t_s)
        self._temperature.publish(Temperature(header=header, temperature=warm))
        self._payload.publish(Float64(data=self._plant.payload_kg))

    def _tell_contact(self) -> None:
        self._contact.publish(String(data=self._plant.contact(self._t_s)))

    def _report_plant(self) -> Report:
        emulator = self._plant.emulator
        facts = {
            "frames": self._frames,
            "frames left out": self._late,
            "bus": emulator.port,
            "instructions heard": emulator.frames_heard,
            "servos that drive": sum(emulator.torques_on().values()),
        }
        return Report(OK, "simulating", facts)


main = program(_SimulatedArm)

if __name__ == "__main__":
    main()
