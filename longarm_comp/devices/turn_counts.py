"""Follows the readings of servos, to know whether they still tell where the joints stand."""

from collections import Counter
from collections.abc import Collection, Iterable, Mapping

from longarm_comp.core.errors import JobError
from longarm_comp.devices.servo_bus.bus import AGREE_TICKS
from longarm_comp.devices.servo_bus.state import ServoState
from longarm_comp.devices.servo_config import ServoConfig


class TurnCounts:
    """Follows every servo from reading to reading, with the torque on or off.

    A reading tells where a joint stands only up to whole turns of its servo, except for
    `JointConfig.absolute`. The count of these turns is in doubt while the readings have jumped by
    more than half a turn, and have not jumped back: the servo lost count without power, or its horn
    passed the place where an encoder of one turn jumps. It is also in doubt from when a joint moved
    unread for so long that its servo may have made half a turn, or sank without power.

    Args:
        away: the joints that were `away` when an earlier process last read them.

    Attributes:
        stood: last readings, ticks by servo id.
        away: the joints whose servos a loss of power would bring back to another turn.
    """

    def __init__(self, config: ServoConfig, away: Collection[str] = ()) -> None:
        self._were_away = away
        self._joints, self._unmoved_ticks = config.joints, config.follower.lost_error_ticks
        self.stood: dict[int, int] = {}
        self._read_at: dict[int, float] = {}
        self._jumps: Counter[int] = Counter()  # turns by which readings have jumped, by servo id
        self._lost: set[int] = set()
        self.away: frozenset[str] = frozenset()

    def begin(self, now: float, states: Mapping[int, ServoState]) -> list[str]:
        """Note the first readings; return the joints that may have lost count before.

        Args as in `trust`.
        """
        self.trust(now, states)
        returned = []
        for name, joint in self._joints.items():
            low, high = joint.turn_at_power_on(joint.stored)
            # By so much the turn may lie elsewhere
            shift = joint.servo.ticks_per_turn - 1 - (high - low)
            if (
                name in self._were_away
                and low - shift <= self.stood[joint.servo_id] <= high + shift
            ):
                returned.append(name)
        return returned

    def trust(self, now: float, states: Mapping[int, ServoState]) -> None:
        """Note readings of servos that follow their goals: they have not jumped.

        ``now``: monotonic time, s. ``states``: read-back by servo id.
        """
        self.stood |= {i: state.position_ticks for i, state in states.items()}
        self._read_at |= dict.fromkeys(states, now)
        for name, joint in self._joints.items():
            if joint.multi_turn and joint.servo_id in states:
                low, high = joint.turn_at_power_on(joint.stored)
                at = states[joint.servo_id].position_ticks
                if not low <= at <= high:
                    self.away |= {name}
                elif low + AGREE_TICKS <= at <= high - AGREE_TICKS:
                    self.away -= {name}

    def follow(self, now: float, states: Mapping[int, ServoState]) -> None:
        """Note readings of servos without a goal to follow, or that may not follow it.

        The arguments are those of `trust`.
        """
        for joint in self._joints.values():
            i, turn = joint.servo_id, joint.servo.ticks_per_turn
            if i not in states or i not in self.stood:
                continue
            moved = states[i].position_ticks - self.stood[i]
            jumps = round(moved / turn)
            self._jumps[i] += jumps
            farthest = joint.fastest_ticks_s * (now - self._read_at[i])
            if farthest > turn / 2 and abs(moved - jumps * turn) > self._unmoved_ticks:
                self._lost.add(i)
        self.trust(now, states)

    def lose(self, ids: Iterable[int]) -> None:
        """Note servos that may have lost their power while their torque was on."""
        self._lost.update(ids)

    @property
    def doubtful(self) -> list[str]:
        """The joints that may stand whole turns of their servo from where they read."""
        in_doubt = {i for i, turns in self._jumps.items() if turns} | self._lost
        return [n for n, j in self._joints.items() if not j.absolute and j.servo_id in in_doubt]

    def check(self) -> None:
        """Raise JobError if a joint is doubtful."""
        for name in self.doubtful:
            joint = self._joints[name]
            raise JobError(
                f"{name} may have lost count of its servo's turns: see whether it stands where "
                "it says; then configure the driver again and reset it, which believes it",
                reads=f"{joint.to_si(self.stood[joint.servo_id]):.4g} {joint.unit}",
            )
