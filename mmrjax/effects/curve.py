"""Smooth curves in a balance or in a reading: discrepancies with a place and a shape, but no name."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable, Container
from types import SimpleNamespace
from typing import Any, ClassVar

import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from mmrjax.effects.base import THE_SIDE, Effect, EffectClasses, Periodic, amplitude, name_class, phase_parameter
from mmrjax.model import channels
from mmrjax.model.params import Index, Scalar, parameter
from mmrjax.model.quantities import DEG, MM, RPM, TRAVEL, TURN
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals

#: Balances that a curve may enter: unit, plausible amplitude, and the signal of its direction.
BALANCES = {
    "electrical": ("V", 1.0, "direction"),
    "track": ("N·m", 0.2, "direction"),
    "ground": ("N", 4.0, "direction_travel"),
    "slip": ("m/s", 0.05, "direction"),
}
#: The same for balances that only a robot with turns has.
ROUND = {"yaw": ("N·m", 0.5, "direction_turn")}
#: Channels with readings that a curve may change, in the same form; 1 % of the range is a plausible instrument error.
#: The channel `yaw`, a heading, has none: its curve is the one of the balance `yaw`.
READINGS = {
    c.name: (
        c.unit_si,
        0.01 * c.range[1] * c.factor,
        "direction_turn" if c in channels.OF_TURNS and c.side is None else "direction",
    )
    for c in channels.EVERY
    if c.name not in {**BALANCES, **ROUND}
}
PLACES = {**BALANCES, **ROUND, **READINGS}


@dataclasses.dataclass(frozen=True)
class Variable:
    """Abscissa of a curve: a signal of every balance above, or the time, the order or the side of a run.

    Attributes:
        unit: SI.
        low, high: usual range of the variable [unit].
        column: column of tables, or of points that stand for one.
        label: words of figures.
        unit_shown: unit shown in figures.
        shown: SI value of it.
        symbol: symbol in formulas. Empty: no formula has it.
        driver: word for it as the driver of an effect. Empty: its name.
        sign: what reverses its sign, see `quantities.Quantity`.
        levels: True if a person sets it, so that one of its levels may differ from the rest.
    """

    unit: str
    low: float
    high: float
    column: str
    label: str
    unit_shown: str = ""
    shown: float = 1.0
    symbol: str = ""
    driver: str = ""
    sign: str = TRAVEL
    levels: bool = False


#: Variables of curves.
VARIABLES = {
    "voltage": Variable("V", 10.0, 35.0, "supply_voltage_V", "voltage at the motors", "V", symbol="U", levels=True),
    "current": Variable("A", 0.0, 6.0, "total_current_A", "current of one motor", "A", symbol="I"),
    "speed_motor": Variable(
        "rad/s", 100.0, 1000.0, "motor_speed_rpm", "motor speed", "rpm", RPM, "ω_m", "speed", levels=True
    ),
    "slope": Variable("rad", 0.0, 0.35, "slope_deg", "slope", "deg", DEG, "sin α", levels=True),
    "payload": Variable("kg", 0.0, 8.0, "payload_kg", "payload", "kg", symbol="m_c", sign="", levels=True),
    "speed": Variable("m/s", 0.1, 1.0, "speed_mm_s", "speed", "mm/s", MM),
    "time": Variable("s", 0.0, 2.0, "time_s", "time since the start", "s", sign=""),
    "order": Variable("-", 0.0, 100.0, "order", "order of the runs", sign=""),
}
#: The same for a robot that turns only; and the variables above that turns have too.
VARIABLES_ROUND = {
    "yaw_rate": Variable("rad/s", 0.0, 4.0, "yaw_rate", "yaw rate", "rad/s", 1.0, "ω", "speed", TURN),
    "side": Variable("-", -1.0, 1.0, "side", "side: 1 left, -1 right", driver=THE_SIDE, sign=""),
}
EVERY_VARIABLE = VARIABLES | VARIABLES_ROUND
IN_TURNS = ("voltage", "current", "speed_motor", "payload", "speed", "order")
#: The variable of the curves of each channel, and the axes of a drift.
READ_BY = {
    "total_current": "current", "motor_current": "current", "output_torque": "current", "motor_speed": "speed_motor",
    "output_speed": "speed_motor", "speed": "speed", "motor_voltage": "voltage", "yaw_rate": "yaw_rate",
}  # fmt: skip
DRIFT = ("time", "order")
ORDINATES = tuple(f"y{k}" for k in range(6))
#: Share of the range over which a curve levels out beyond each end.
LEVEL = 0.05


#: Signals of a direction, -1 to 1.
WAYS = ("direction", "direction_travel", "direction_turn")


def direction_signal(place: str) -> str:
    """The signal of `WAYS` that gives the direction of a discrepancy in a place."""
    return PLACES[place][2]


def sign_factor(place: str, direction_of: Callable[[str], Any], magnitudes: Container[str]) -> Any:
    """Sign factor of a discrepancy in a place: a run in mirror image shows it in mirror image.

    For instruments that show only magnitudes the factor is 1.

    Args:
        direction_of: returns the signal of `WAYS` of a name.
        magnitudes: channels of such instruments.
    """
    factor = direction_of(direction_signal(place))
    return abs(factor) if place in magnitudes else factor


def in_travel_frame(
    place: str, variable: str, x: Any, direction_of: Callable[[str], Any], magnitudes: Container[str] = ()
) -> tuple[Any, Any]:
    """A variable of a curve in the frame of travel, and its sign factor, see `sign_factor`.

    A variable that is not in `VARIABLES`, such as the angle of a wave, is returned unchanged.

    Args:
        x: the variable [its unit], an array of NumPy or JAX.
        direction_of, magnitudes: as for `sign_factor`.
    """
    if variable not in EVERY_VARIABLE:
        return x, 1.0
    factor = sign_factor(place, direction_of, magnitudes)
    sign = EVERY_VARIABLE[variable].sign
    if not sign:
        return x, factor
    signal_name = "direction_turn" if sign == TURN else "direction" if place in ROUND else direction_signal(place)
    return x * direction_of(signal_name), factor


_LAST = len(ORDINATES) - 1
# Keys's points beyond the ends continue a parabola: y_-1 = 3 y_0 - 3 y_1 + y_2, and one more for y_-2.
_EXTENDED = np.zeros((_LAST + 5, _LAST + 1))
_EXTENDED[2:-2] = np.eye(_LAST + 1)
_EXTENDED[1, :3] = _EXTENDED[-2, :-4:-1] = 3.0, -3.0, 1.0
_EXTENDED[0, :3] = _EXTENDED[-1, :-4:-1] = 6.0, -8.0, 3.0


def _level_below_zero(u: Scalar) -> Float[Array, "..."]:
    """u if positive. Below 0 a parabola with slope 1 at 0 that is level from u = -LEVEL _LAST on."""
    width = LEVEL * _LAST
    negative_part = jnp.clip(u, -width, 0.0)
    return jnp.maximum(u, 0.0) + negative_part + negative_part**2 / (2 * width)


def ordinate_weights(x: Scalar, low: Scalar, high: Scalar) -> Float[Array, "... 6"]:
    """Weights of the ordinates at x: cubic convolution, Keys (1981) eq. (15). They sum to 1.

    Args:
        x: the variable.
        low, high: position of the first and the last ordinate [its unit].
    """
    u = _level_below_zero((x - low) / (high - low) * _LAST)
    u = _LAST - _level_below_zero(_LAST - u)
    t = jnp.abs(u[..., None] - jnp.arange(-2, _LAST + 3))
    near = 1.5 * t**3 - 2.5 * t**2 + 1
    far = -0.5 * t**3 + 2.5 * t**2 - 4 * t + 2
    return jnp.where(t < 1, near, jnp.where(t < 2, far, 0.0)) @ _EXTENDED


def _ordinate() -> Scalar:
    return parameter(1.0, "-", "ordinate, over the amplitude", (-1e3, 1e3), "flat until fitted", sd=1.0)


def _size(unit: str, size: float) -> Scalar:
    return amplitude(
        unit, "size of the discrepancy", (-100 * size, 100 * size), "remainder of the fit; no cause is known", sd=size
    )


def _curve_docstring(place: str, over: str) -> str:
    """Docstring of a curve: its equation with its units, and its source."""
    place_phrase = f"the readings of `{place}`" if place in READINGS else f"the balance `{place}`"
    unit, unit_x = PLACES[place][0], EVERY_VARIABLE[over].unit
    return f"""Δ = a y(x) along the travel in {place_phrase} [{unit}], x = {over} [{unit_x}].

    y is smooth through six ordinates equally spaced from `low` to `high`, and levels out beyond.

    Source: none, a discrepancy without a name; Keys, Cubic convolution interpolation for digital image
    processing, IEEE Trans. ASSP 29 (1981) 1153, eqs. (15), (19), (25) of the interpolation.
    """


def _curve_class(place: str, over: str) -> type[Effect]:
    """The curve of one variable in one balance, or in the readings of one channel."""
    is_reading = place in READINGS
    unit, size, _ = PLACES[place]
    abscissa = EVERY_VARIABLE[over]
    unit_x, first, last = abscissa.unit, abscissa.low, abscissa.high

    class Curve(Effect):
        name = f"curve_{place}_{over}"
        balance = "sensor" if is_reading else place
        channel = place if is_reading else ""
        driver = THE_SIDE if over == "side" else ""
        variable: ClassVar[str] = over
        memory_size = 1.0 if over == "time" else None
        memory_unit = unit_x

        amplitude: Scalar = _size(unit, size)
        low: Scalar = parameter(
            first, unit_x, f"{over} at the first ordinate", (-1e4, 1e4), "lower end of the range of the data",
            sd=0.1 * (last - first),
        )  # fmt: skip
        high: Scalar = parameter(
            last, unit_x, f"{over} at the last ordinate", (-1e4, 1e4), "upper end of the range of the data",
            sd=0.1 * (last - first),
        )  # fmt: skip
        y0: Scalar = _ordinate()
        y1: Scalar = _ordinate()
        y2: Scalar = _ordinate()
        y3: Scalar = _ordinate()
        y4: Scalar = _ordinate()
        y5: Scalar = _ordinate()

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            x = self.recall(robot, signals) if over == "time" else getattr(signals, over)
            direction_of = lambda name: jnp.asarray(getattr(signals, name))  # noqa: E731
            x, factor = in_travel_frame(place, over, x, direction_of, robot.rig.magnitudes)
            y = jnp.stack(jnp.broadcast_arrays(*(getattr(self, n) for n in ORDINATES)), -1)
            return self.amplitude * jnp.sum(ordinate_weights(x, self.low, self.high) * y, -1) * factor

        def rate(self, robot: Robot, signals: Signals) -> Scalar:
            """Rate of time [s/s]. Only a curve over time has a memory."""
            return jnp.ones_like(signals.speed_motor)

        def settled(self, robot: Robot, signals: Signals) -> Scalar:
            """The memory long after the start, at the curve's last value."""
            return self.high + jnp.zeros_like(signals.speed_motor)

    Curve.__doc__ = _curve_docstring(place, over)
    return name_class(Curve, "".join(w.capitalize() for w in Curve.name.split("_")))


def _wave_class(place: str) -> type[Effect]:
    """The wave of one balance."""
    unit, size, _ = BALANCES[place]

    class Wave(Periodic):
        name = f"wave_{place}"
        balance = place

        amplitude: Scalar = _size(unit, size)
        phase: Scalar = phase_parameter()
        order_shaft: Scalar = parameter(
            1.0, "-", "waves per turn of driving pulley or wheel k", (0.01, 1000.0), "the order that the data show",
            relative_sd=0.01,
        )  # fmt: skip
        y_sin: Scalar = _ordinate()
        y_cos: Scalar = _ordinate()

        def order(self, robot: Robot, configuration: Index) -> Scalar:
            return self.order_shaft / robot.gearbox.ratio

        def term(self, robot: Robot, signals: Signals) -> Scalar:
            if self.name not in signals.memory:
                return self.amplitude * jnp.zeros_like(signals.speed_motor)
            angle = signals.memory[self.name] + self.phase
            return self.amplitude * (self.y_sin * jnp.sin(angle) + self.y_cos * jnp.cos(angle))

    Wave.__doc__ = f"""Δ = a (y_s sin(k θ_k + φ) + y_c cos(k θ_k + φ)) in the balance `{place}` [{unit}].

    θ_k is the angle of the driving pulley or wheel; the wave does not show in steady travel.

    Source: none, a discrepancy without a name that repeats with the angle of a shaft.
    """
    return name_class(Wave, f"Wave{place.capitalize()}")


#: The wave of every balance that has curves; a time series shows it as an order.
WAVES: EffectClasses = {effect.name: effect for effect in map(_wave_class, BALANCES)}

#: Every curve by name. Robot files accept them; the library that is scored does not contain them.
CURVES: EffectClasses = {
    effect.name: effect
    for effect in (_curve_class(place, over) for place in (*BALANCES, *channels.USUAL) for over in VARIABLES)
}
#: Curves of the readings of all other channels, over the variables that the loop tries for them.
CURVES_SHOWN: EffectClasses = {
    effect.name: effect
    for effect in (
        _curve_class(place, over)
        for place in READINGS
        for over in (*DRIFT, READ_BY.get(place))
        if over is not None and place not in channels.USUAL
    )
}
#: Curves of a robot that turns only.
CURVES_ROUND: EffectClasses = {
    effect.name: effect
    for effect in (
        *(_curve_class(place, over) for place in (*BALANCES, *ROUND) for over in VARIABLES_ROUND),
        *(_curve_class(place, over) for place in ROUND for over in IN_TURNS),
    )
}
#: All of them by class name, see `made`.
Made = SimpleNamespace(
    **{e.__name__: e for some in (WAVES, CURVES, CURVES_SHOWN, CURVES_ROUND) for e in some.values()}
)
