"""The table of all topics and services of the graph: name, type, quality of service.

All names are relative, so that arms can be separated by namespaces; only /diagnostics is shared.
Programs that talk to the graph use this table too, so that their QoS is compatible: for instance
``TARGET_POSE.publisher(node)`` or ``TIP_MEASURED.subscription(node, callback)``.
"""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus
from geometry_msgs.msg import PoseStamped, PoseWithCovarianceStamped, Vector3Stamped, WrenchStamped
from rclpy.action import ActionServer, CancelResponse
from rclpy.callback_groups import CallbackGroup, ReentrantCallbackGroup
from rclpy.event_handler import PublisherEventCallbacks, SubscriptionEventCallbacks
from rclpy.node import Node
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from sensor_msgs.msg import CameraInfo, CompressedImage, Image, Imu, JointState, Temperature
from std_msgs.msg import Float64, String
from std_srvs.srv import SetBool, Trigger
from trajectory_msgs.msg import JointTrajectory
from visualization_msgs.msg import MarkerArray

from longarm_interfaces.action import Reach
from longarm_interfaces.msg import Compensation, DriverState, Motion
from longarm_interfaces.srv import Compensate, PredictError

try:
    from control_msgs.action import FollowJointTrajectory
except ImportError:  # no package registry has it, nor tf2_msgs: a sourced ROS does
    FollowJointTrajectory = None
try:
    from tf2_msgs.msg import TFMessage
except ImportError:
    TFMessage = None

RELIABLE = ReliabilityPolicy.RELIABLE
BEST_EFFORT = ReliabilityPolicy.BEST_EFFORT

_UNHEARD_PUBLISHER = PublisherEventCallbacks(use_default_callbacks=False)
_UNHEARD_SUBSCRIPTION = SubscriptionEventCallbacks(use_default_callbacks=False)
"""No QoS events: rclpy's default events only log an incompatible QoS, as the other side does too.
The executor would check two events per topic before every callback, its largest cost."""

_PATIENT = QoSProfile(depth=200)
"""QoS of services: 200 requests can wait on either side. ROS's default of 10 loses requests."""


@dataclass(frozen=True)
class Topic:
    """One topic of the graph.

    Publishers are always reliable, which suits subscriptions of both kinds.
    """

    name: str  # relative to the namespace of the arm unless it begins with /
    type: Any  # of its messages
    depth: int  # number of messages that are kept on either side
    listens: ReliabilityPolicy  # of subscriptions
    latched: bool = False  # a later subscriber also receives the last messages

    def publisher(self, node: Node) -> Any:
        return node.create_publisher(
            self.type, self.name, self._make_qos(RELIABLE), event_callbacks=_UNHEARD_PUBLISHER
        )

    def _make_qos(self, reliability: ReliabilityPolicy, depth: int | None = None) -> QoSProfile:
        kept = DurabilityPolicy.TRANSIENT_LOCAL if self.latched else DurabilityPolicy.VOLATILE
        return QoSProfile(depth=depth or self.depth, reliability=reliability, durability=kept)

    def subscription(
        self,
        node: Node,
        callback: Callable[..., None],
        group: CallbackGroup | None = None,
        listens: ReliabilityPolicy | None = None,
        depth: int | None = None,
        *,
        raw: bool = False,
    ) -> Any:
        """Subscribe to the topic on a node, by default with the topic's reliability and depth.

        ``raw``: whether the callback gets each message as bytes.
        """
        return node.create_subscription(
            self.type,
            self.name,
            callback,
            self._make_qos(listens or self.listens, depth),
            callback_group=group,
            event_callbacks=_UNHEARD_SUBSCRIPTION,
            raw=raw,
        )


@dataclass(frozen=True)
class Action:
    name: str
    type: Any  # with Goal, Result and Feedback

    def server(self, node: Node, serve: Callable[[Any], Any]) -> Any:
        """Offer the action on a node. Every goal runs ``serve`` and accepts to be cancelled."""
        return ActionServer(
            node,
            self.type,
            self.name,
            serve,
            callback_group=ReentrantCallbackGroup(),
            cancel_callback=lambda goal: CancelResponse.ACCEPT,
        )


@dataclass(frozen=True)
class Service:
    """One service. A name that begins with ``~/`` is private to the node that offers it."""

    name: str
    type: Any  # with Request and Response

    def server(
        self, node: Node, callback: Callable[..., Any], group: CallbackGroup | None = None
    ) -> Any:
        return node.create_service(
            self.type, self.name, callback, qos_profile=_PATIENT, callback_group=group
        )

    def client(self, node: Node, group: CallbackGroup | None = None, of: str = "") -> Any:
        """Make a client of the service; ``of``: name of the node that offers a private service."""
        name = self.name.replace("~", of) if of else self.name
        return node.create_client(self.type, name, qos_profile=_PATIENT, callback_group=group)


# pose that the tip shall reach, base frame; the latest wins
TARGET_POSE = Topic("target_pose", PoseStamped, 2000, RELIABLE)
# compensated joints, rad and m
JOINT_TRAJECTORY = Topic("joint_trajectory", JointTrajectory, 200, RELIABLE)
# full record of one target, also of a refused one
COMPENSATION = Topic("compensation", Compensation, 2000, RELIABLE)
# joints as the servos report them, rad and m
JOINT_STATES = Topic("joint_states", JointState, 10, BEST_EFFORT)
# the joints as a planner for the declared arm should see them
PLANNED_JOINTS = Topic("planned_joint_states", JointState, 10, RELIABLE)
# what happens to every trajectory, from the driver
MOTION = Topic("motion", Motion, 2000, RELIABLE)
# id of a trajectory that must not move the arm any more; empty: every target that waits
WITHDRAWN = Topic("withdrawn", String, 10, RELIABLE)
DRIVER_STATE = Topic("servo_driver/state", DriverState, 1, RELIABLE, latched=True)
PREDICTED_ERROR = Topic("predicted_error", Vector3Stamped, 20, RELIABLE)
# SHA-256 and path of the predictor file that is served, five times a second; empty: none
SERVED = Topic("error_predictor/serves", String, 1, RELIABLE)
# path of the file with the model that `kinematics` learned at work, at every write; empty: none
LEARNED = Topic("kinematics/learned", String, 1, RELIABLE, latched=True)
# tip as cameras or a tracker see it, in the frame of its header; position NaN: marker lost
TIP_MEASURED = Topic("tip_measured", PoseWithCovarianceStamped, 20, RELIABLE)
# the same in the base frame; unchanged if the pose of its frame is not known
TIP_SEEN = Topic("tip_seen", PoseWithCovarianceStamped, 20, RELIABLE)
# tip computed from the joints' readings, with its covariance, base frame
TIP_BY_READINGS = Topic("tip_by_readings", PoseWithCovarianceStamped, 20, RELIABLE)
LEFT_IMAGE = Topic("left/image_raw", Image, 5, BEST_EFFORT)
RIGHT_IMAGE = Topic("right/image_raw", Image, 5, BEST_EFFORT)
LEFT_COMPRESSED = Topic("left/image_raw/compressed", CompressedImage, 5, BEST_EFFORT)
RIGHT_COMPRESSED = Topic("right/image_raw/compressed", CompressedImage, 5, BEST_EFFORT)
LEFT_INFO = Topic("left/camera_info", CameraInfo, 5, BEST_EFFORT)
RIGHT_INFO = Topic("right/camera_info", CameraInfo, 5, BEST_EFFORT)
TEMPERATURE = Topic("temperature", Temperature, 5, BEST_EFFORT)  # of the arm, degrees Celsius
PAYLOAD = Topic("payload", Float64, 5, BEST_EFFORT)  # mass carried at the tool, kg
# name of the socket that the ball sits in, or blank
CONTACT = Topic("contact", String, 5, RELIABLE)
# tilt of a frame; frame_id is the row's number, 0 the base
INCLINATION = Topic("inclination", Imu, 5, BEST_EFFORT)
# load on a wrist sensor, N; frame_id: the row's number
WRENCH = Topic("wrench", WrenchStamped, 5, BEST_EFFORT)
# for RViz: arm as declared and as it hangs, target, tip
MARKERS = Topic("markers", MarkerArray, 5, RELIABLE)
ROBOT_DESCRIPTION = Topic("robot_description", String, 1, RELIABLE, latched=True)
TF = Topic("/tf", TFMessage, 100, RELIABLE)  # links, declared, expected and measured tip
TF_STATIC = Topic("/tf_static", TFMessage, 100, RELIABLE, latched=True)  # cameras, foot of the arm
"""TF and TF_STATIC need tf2_msgs (`HAS_TF`). All arms share them."""

HAS_TF = TFMessage is not None

COLLECT_PROGRESS = Topic("collect/progress", DiagnosticStatus, 1, RELIABLE, latched=True)
DIAGNOSTICS = Topic("/diagnostics", DiagnosticArray, 50, RELIABLE)

COMPENSATE = Service("compensate", Compensate)  # joints for one target, executed or not
PREDICT_ERROR = Service("predict_error", PredictError)  # learned error at given joints
RELOAD = Service("~/reload", Trigger)  # read the node's files again
# true: torque off now, commands refused, also by a restarted driver; false: ready again
ESTOP = Service("~/estop", SetBool)
# true: stop, stay with torque on, refuse commands, also by a restarted driver; false: ready again
HOLD = Service("~/hold", SetBool)
FREEZE = Service("~/freeze", SetBool)  # true: learn no more at work; false: learn again
# go back to the version before the last learned change, and freeze
UNDO = Service("~/undo", Trigger)
RESET = Service("~/reset", Trigger)  # end a stop, a hold, and a fault whose cause is gone

REACH = Action("reach", Reach)  # move the tip to a target and report where it came to rest
# joint_trajectory as an action; where control_msgs is installed (`HAS_FOLLOW`)
FOLLOW = Action("servo_driver/follow_joint_trajectory", FollowJointTrajectory)

# a planned trajectory, compensated and forwarded by `trajectory_compensator`
FOLLOW_PLANNED = Action("follow_joint_trajectory", FollowJointTrajectory)

HAS_FOLLOW = FollowJointTrajectory is not None


def compensate_by(method: str) -> Service:
    """Return the service that answers as `COMPENSATE`, but with a method of the caller's choice."""
    return Service(f"{COMPENSATE.name}/{method}", COMPENSATE.type)


TOPICS = tuple(held for held in list(vars().values()) if isinstance(held, Topic) and held.type)
SERVICES = tuple(held for held in list(vars().values()) if isinstance(held, Service))
"""TOPICS and SERVICES: all of the graph; the transforms only if their message is installed."""
