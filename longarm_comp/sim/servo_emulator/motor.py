"""The mechanics of one emulated bus servo: speed limit, lag, dead band, droop, heat, protection."""

import math
from dataclasses import dataclass

_FRICTION = 0.2  # share of full effort to turn freely at full speed
_AMBIENT_C, _HEATING_C, _HEAT_TIME_S = 25.0, 60.0, 120.0
"""Temperature at rest, its rise at full effort, and the time constant of the rise."""
_SHUTDOWN_C = 70.0
"""Temperature above which the servo raises an alarm and lets go: the default of Feetech servos."""
_OVERLOAD = 0.8  # share of full effort, the default of Feetech servos


@dataclass(frozen=True)
class MotorSpec:
    """Constants of one servo; lengths of travel in encoder ticks."""

    ticks_per_turn: int = 4096
    max_speed_ticks_s: float = 3000.0  # no-load speed (STS3215 at 7.4 V: about 3,000)
    lag_s: float = 0.03  # time constant of the position loop near the goal
    dead_band_ticks: float = 0.0
    """Error that the controller leaves alone; beyond it the effort grows."""
    hold_share: float = 0.0
    """Share of full effort by which friction holds the gear wherever it stopped. A drive that came
    from below gives that much more than the load, one from above that much less."""
    wind_up_ticks: float = 650.0
    """Travel that winds an unwound gear train up to one side; after a reversal twice as much winds
    it up to the other."""
    droop_ticks: float = 0.0
    """Error at which the proportional controller gives its full effort; a load of that size pushes
    the horn off its goal by as much."""
    encoder_zero_ticks: float = 0.0  # by how much the encoder reads too high
    stiff_ticks: float = 200.0  # position error at which a jammed drive gives its full effort
    load_units: float = 1000.0  # reading of the register of load, or current, at full effort
    model: int | None = None  # model number that it reports; None: the protocol's usual one
    overload_s: float = 2.0  # time at `_OVERLOAD` after which it raises an alarm and lets go


class Motor:
    """One servo's mechanics. `advance` moves it on in time; between calls, read and set its fields.

    Attributes:
        follows: share of a motion that the encoder sees: 0 is frozen, less than 1 slips.
        seen: position that the encoder shows, ticks, not rounded.
    """

    def __init__(self, spec: MotorSpec, position_ticks: float) -> None:
        self.spec = spec
        self.position = float(position_ticks)
        self.seen, self.follows = self.position + spec.encoder_zero_ticks, 1.0
        self.goal = self._sent = float(position_ticks)
        self._towards = 0
        self.velocity = 0.0
        self.speed_limit = 0.0
        self.torque_on = False
        self.external_load = 0.0
        self.effort = 0.0
        self.temperature_c = _AMBIENT_C
        self.voltage_v = 7.4
        self.blocked = False
        self.approach = 0
        self.wound = 0.0
        self._stood = self.position
        self.alarms: set[str] = set()
        self._overloaded_s = 0.0

    @property
    def reading(self) -> int:
        """The encoder's reading, ticks."""
        return round(self.seen)

    def turn(self, by: float) -> None:
        """Turn the horn by some ticks; the encoder sees the share `follows` of it."""
        self.position += by
        self.seen += self.follows * by

    @property
    def moving(self) -> bool:
        """True if the horn turns faster than one tick in 20 ms."""
        return abs(self.velocity) > 50.0

    @property
    def way(self) -> float:
        """The displacement of the horn since it last stood still or reversed, ticks."""
        return self.position - self._stood

    def switch(self, on: bool) -> None:
        """Switch the torque; it stays off while there is an alarm."""
        self.torque_on = on and not self.alarms

    def clear_alarms(self) -> None:
        """Clear the alarms. A servo that is still too hot keeps its alarm."""
        self.alarms = {"overheat"} & self.alarms if self.temperature_c > _SHUTDOWN_C else set()
        self._overloaded_s = 0.0

    def advance(self, dt_s: float) -> None:
        """Move on by ``dt_s`` (exact for a constant goal and load)."""
        if dt_s <= 0.0:
            return
        start = self.position
        if self.torque_on and not self.blocked:
            self.turn(self._next_position(dt_s) - start)
        before = self.velocity if self.moving else 0.0
        self.velocity = (self.position - start) / dt_s
        if self.moving and before * self.velocity <= 0.0:
            self._stood = start
        wound = self.wound + (self.position - start) / self.spec.wind_up_ticks
        self.wound = max(-1.0, min(1.0, wound))
        if self.goal != self._sent:
            self._towards, self._sent = (1 if self.goal > self._sent else -1), self.goal
        moved = 1 if self.position > start else -1
        if abs(self.position - start) > 1e-3 and moved == self._towards:
            self.approach = moved  # giving way afterwards turns nothing round
        self._update_effort(dt_s)

    def _next_position(self, dt_s: float) -> float:
        """Return the position after ``dt_s``: constant speed, first-order lag near the goal."""
        spec = self.spec
        low, high = self._rest_range()
        if low <= self.position <= high:
            return self.position
        error = (low if self.position < low else high) - self.position
        distance = abs(error)
        speed = spec.max_speed_ticks_s
        if self.speed_limit > 0.0:
            speed = min(speed, self.speed_limit)
        slow_zone = speed * spec.lag_s
        left, time_left = distance, dt_s
        if left > slow_zone:
            cruise = min(time_left, (left - slow_zone) / speed)
            left -= speed * cruise
            time_left -= cruise
        left *= math.exp(-time_left / spec.lag_s)
        return self.position + math.copysign(distance - left, error)

    def _rest_range(self) -> tuple[float, float]:
        """Return the range (ticks) where controller and friction together hold the load."""
        spec = self.spec

        def balance_at(share: float, edge: float) -> float:
            side = math.copysign(1.0, share) if share else edge
            return self.goal + spec.droop_ticks * share + spec.dead_band_ticks * side

        load, held = self.external_load, spec.hold_share
        return balance_at(load - held, -1.0), balance_at(load + held, 1.0)

    def _update_effort(self, dt_s: float) -> None:
        """Update effort, temperature and the servo's own protection."""
        spec = self.spec
        own = _FRICTION * self.velocity / spec.max_speed_ticks_s
        own += spec.hold_share * self.approach
        if self.blocked:
            own = (self.goal - self.position) / spec.stiff_ticks
        wanted = own - self.external_load
        self.effort = max(-1.0, min(1.0, wanted)) if self.torque_on else 0.0
        warm = _AMBIENT_C + _HEATING_C * self.effort**2
        self.temperature_c = warm + (self.temperature_c - warm) * math.exp(-dt_s / _HEAT_TIME_S)
        overloaded = abs(self.effort) >= _OVERLOAD
        self._overloaded_s = self._overloaded_s + dt_s if overloaded else 0.0
        if self._overloaded_s > spec.overload_s:
            self._raise_alarm("overload")
        if self.temperature_c > _SHUTDOWN_C:
            self._raise_alarm("overheat")

    def _raise_alarm(self, name: str) -> None:
        self.alarms.add(name)
        self.torque_on = False
