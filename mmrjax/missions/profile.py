"""Profiles: demands on a robot and its conditions over the time of a mission."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float, Int

from mmrjax.compile.compiling import as_array
from mmrjax.errors import UsageError, count_noun
from mmrjax.model.conditions import Conditions, Number
from mmrjax.model.params import Scalar

#: A number of each row.
PerRow = Float[Array, " rows"]

#: Drive of the motors in a segment. `voltage`: by a share of the supply's voltage. `motor_speed`, `speed`: by the
#: driver's controller, at that demanded speed. `brake`: terminals shorted. `coast`: circuit open.
MODES = ("voltage", "motor_speed", "speed", "brake", "coast")
VOLTAGE, MOTOR_SPEED, SPEED, BRAKE, COAST = range(len(MODES))

#: Conditions that a profile may state for each row; a profile that does not state them uses those of the run.
CONDITIONS = (
    "voltage", "duty", "duty_left", "duty_right", "slope_deg", "payload", "adhesion", "adhesion_lateral",
    "load_torque",
)  # fmt: skip
#: Demanded yaw rate next to a ground speed.
YAW_RATE = "yaw_rate"
#: Further fields of a profile that are no conditions.
FURTHER = ("voltage_left", "voltage_right", YAW_RATE, "current_other")
#: Fields that drive the sides apart, stated for both sides or for neither.
PAIRS = (("duty_left", "duty_right"), ("voltage_left", "voltage_right"))
#: Fields that make a robot free to turn if a profile states them.
APART = (*PAIRS[0], *PAIRS[1], YAW_RATE)


class Profile(eqx.Module):
    """A mission profile: rows in time, with a segment between two rows. All numbers can be differentiated and
    batched.

    Attributes:
        time: times of the rows, increasing [s], shape (rows,). The mission ends at the last row.
        mode: mode of the segment that begins at a row, index into `MODES`, shape (rows,).
        demand: demanded motor speed [rad/s] or ground speed [m/s], shape (rows,). Unused in modes without a demand.
        voltage: voltage of the external supply [V].
        duty: share of the supply voltage [-].
        slope_deg: slope [deg].
        payload: payload [kg].
        adhesion, adhesion_lateral: adhesion along and across, relative to that of the robot's surface [-].
        load_torque: brake torque on the output of each drive, for a load on a shaft [N·m].
        current_other: current of other consumers on the battery [A]. Shape (rows,), or None: as in the conditions
            (for current_other, in the robot). duty_left, duty_right: as `duty`, of each side. voltage_left,
            voltage_right: left and right voltage at the motors of each side [V], as a share of the no-load voltage
            of the source.
        yaw_rate: demanded yaw rate together with a ground speed, positive to the left [rad/s]. If any of the last
            five is stated, the robot is free to turn.
        linear: True if values change linearly between rows, False if they hold until the next row.
        cycles: number of repetitions of the rows.
    """

    time: PerRow
    mode: Int[Array, " rows"]
    demand: PerRow
    voltage: PerRow | None = None
    duty: PerRow | None = None
    duty_left: PerRow | None = None
    duty_right: PerRow | None = None
    slope_deg: PerRow | None = None
    payload: PerRow | None = None
    adhesion: PerRow | None = None
    adhesion_lateral: PerRow | None = None
    load_torque: PerRow | None = None
    voltage_left: PerRow | None = None
    voltage_right: PerRow | None = None
    yaw_rate: PerRow | None = None
    current_other: PerRow | None = None
    linear: bool = eqx.field(default=False, static=True)
    cycles: int = eqx.field(default=1, static=True)

    @property
    def segment_count(self) -> int:
        """Number of segments of one cycle."""
        return self.time.shape[-1] - 1

    @property
    def stated(self) -> tuple[str, ...]:
        """Names of the conditions that the profile states."""
        return tuple(name for name in CONDITIONS if getattr(self, name) is not None)

    @property
    def turns(self) -> bool:
        """True if it drives the sides independently, so that the robot is free to turn."""
        return any(getattr(self, name) is not None for name in APART)

    @property
    def duration(self) -> Scalar:
        """Duration of the whole mission [s]."""
        return self.cycles * (self.time[-1] - self.time[0])

    def row(self, k: Index) -> Profile:
        """One segment as a separate profile: the rows `k` and `k + 1`."""
        return jax.tree.map(lambda x: jax.lax.dynamic_slice_in_dim(x, k, 2), self)

    def at(self, elapsed: Scalar) -> Profile:
        """Values of a profile with two rows, `elapsed` seconds after the first. Its fields are scalars."""
        share = elapsed / (self.time[1] - self.time[0]) if self.linear else 0.0

        def interpolate(x: Array) -> Array:
            return x[0] + (x[1] - x[0]) * share if self.linear else x[0]

        constant: dict[str, Any] = {"time": self.time[0], "mode": self.mode[0]}
        unset: dict[str, Any] = dict.fromkeys(constant)
        values = jax.tree.map(interpolate, replace(self, **unset))
        return replace(values, **constant)

    def conditions(self, otherwise: Conditions) -> Conditions:
        """Conditions at an instant (see `at`). Those that the profile does not state are from `otherwise`."""
        condition_values = {name: getattr(self, name) for name in CONDITIONS if getattr(self, name) is not None}
        if "payload" in condition_values and otherwise.total_mass is not None:
            condition_values["total_mass"] = otherwise.total_mass + condition_values["payload"] - otherwise.payload
        is_undriven = (self.mode == BRAKE) | (self.mode == COAST)
        for name in ("duty", "duty_left", "duty_right"):
            duty = condition_values.get(name, getattr(otherwise, name))
            condition_values[name] = None if duty is None else jnp.where(is_undriven, 0.0, duty)
        open_state = jnp.where(self.mode == COAST, 1.0, jnp.where(self.mode == BRAKE, -1.0, otherwise.open))
        return replace(otherwise, **condition_values, open=open_state)


Index = Int[Array, ""] | int


def profile(
    time: Sequence[float] | np.ndarray,
    mode: str | Sequence[str] = "voltage",
    *,
    demand: Number = 0.0,
    linear: bool = False,
    cycles: int = 1,
    **values: Number | None,
) -> Profile:
    """Profile from plain numbers, each one for all rows or one for each row.

    Args:
        time: time of the rows [s].
        mode: one of `MODES`, for all rows or one for each row.
        demand, linear, cycles: see `Profile`.
        values: other fields of the profile, by name.

    Raises:
        UsageError: fewer than two rows, a time that does not increase, an unknown mode or field. Also a length that
            differs from that of `time`, a value that is not finite, a duty beyond -1..1, cycles below 1.
    """
    times = np.asarray(time, float)
    if times.ndim != 1 or len(times) < 2:
        raise UsageError(f"profile, time: got {count_noun(times.size, 'row')}; expected two or more")
    if not np.isfinite(times).all():
        raise UsageError(f"profile, time: row {int(np.argmax(~np.isfinite(times))) + 1} is not a finite number")
    falls = np.flatnonzero(np.diff(times) <= 0)
    if falls.size:
        k = int(falls[0]) + 1
        raise UsageError(
            f"profile, time: row {k + 1} has {times[k]:g} s after {times[k - 1]:g} s; expected a later time"
        )
    if cycles < 1 or cycles != int(cycles):
        raise UsageError(f"profile, cycles: got {cycles}; expected a whole number from 1")
    modes = [mode] * len(times) if isinstance(mode, str) else list(mode)
    for k, name in enumerate(modes):
        if name not in MODES:
            raise UsageError(f"profile, mode, row {k + 1}: got {name}; expected {', '.join(MODES)}")
    allowed = (*CONDITIONS, *FURTHER)
    unknown = sorted(set(values) - set(allowed))
    if unknown:
        raise UsageError(f"profile: no field {unknown[0]}; expected one of {', '.join(allowed)}")
    columns: dict[str, Any] = {"demand": demand, **{name: v for name, v in values.items() if v is not None}}
    if reason := sides_error(list(columns), MODES[SPEED] in modes):
        raise UsageError(f"profile: {reason}")
    arrays = {}
    for name, value in columns.items():
        x = np.asarray(value, float)
        if x.ndim > 1 or (x.ndim == 1 and len(x) != len(times)):
            raise UsageError(
                f"profile, {name}: got {count_noun(x.shape[0] if x.ndim else 1, 'value')}; expected {len(times)}"
            )
        if not np.isfinite(x).all():
            raise UsageError(
                f"profile, {name}: row {int(np.argmax(~np.isfinite(np.atleast_1d(x)))) + 1} is not finite"
            )
        arrays[name] = as_array(np.broadcast_to(x, times.shape))
    for name in ("duty", *PAIRS[0]):
        duty = np.atleast_1d(np.asarray(arrays.get(name, 0.0)))
        if (np.abs(duty) > 1).any():
            raise UsageError(f"profile, {name}: got {duty[np.argmax(np.abs(duty))]:g}; expected -1 to 1")
    if len(modes) != len(times):
        raise UsageError(f"profile, mode: got {count_noun(len(modes), 'value')}; expected {len(times)}")
    mode_indices = as_array([MODES.index(name) for name in modes], int)
    return Profile(time=as_array(times), mode=mode_indices, linear=linear, cycles=int(cycles), **arrays)


def sides_error(stated: Sequence[str], speed: bool, name_of: Callable[[str], str] = str) -> str | None:
    """Message if a profile's fields for the sides contradict each other, otherwise None.

    They do for one side without the other, two kinds at once, or a yaw rate without a demanded speed.

    Args:
        stated: names of the stated fields.
        speed: True if a ground speed is demanded.
        name_of: function from a field to its name in the input.
    """
    for left, right in (pair for names in PAIRS for pair in (names, names[::-1])):
        if left in stated and right not in stated:
            return f"got {name_of(left)} without {name_of(right)}; expected both"
    stated_kinds = [name_of(name) for name in ("duty", PAIRS[0][0], PAIRS[1][0]) if name in stated]
    if len(stated_kinds) > 1:
        return f"got {stated_kinds[0]} together with {stated_kinds[1]}; expected one of the two"
    if YAW_RATE in stated and not speed:
        return f"got {name_of(YAW_RATE)} without {name_of(MODES[SPEED])}; expected a demanded ground speed too"
    return None
