"""Bases of smooth curves over the rows. They describe a discrepancy that no effect explains."""

from __future__ import annotations

import dataclasses
import itertools
import re
from collections.abc import Callable, Sequence
from typing import TypeVar

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float
from numpy.polynomial import legendre

from calibration.data import Columns, Names
from calibration.data.columns import CURRENT, LOAD, SPEED, Layout
from calibration.inference.linearization import Linearization
from mmrjax.effects.curve import DRIFT, EVERY_VARIABLE, READ_BY, direction_signal, in_travel_frame, sign_factor
from mmrjax.model import channels
from mmrjax.model.balances import absent_balances
from mmrjax.model.robot import Robot

T = TypeVar("T")

#: Balances that carry curves: one for each equation that the channels close, and the ground's, whose defect
#: also loads the contact. And the balances that each represents, because a defect has the same shape in them.
BALANCES = ("electrical", "track", "ground", "slip")
STANDS_FOR = {"electrical": ("supply",), "track": ("gearbox", "motor")}
#: Variables of a curve, fields of `Signals` (and the time of histories and the order of runs), with the column that
#: measures each.
VARIABLES = {name: variable.column for name, variable in EVERY_VARIABLE.items()}
#: Balances of turns that carry curves, beside those of straight travel.
OF_TURNS = ("yaw",)
#: Terms of a curve of one variable (Legendre polynomials), and degree of the polynomial in all conditions.
TERMS, DEGREE = 5, 2
CONDITIONS = "conditions"
#: Axes along which a temporary change may occur (the first that a table has is used); lengths of its windows as
#: shares of the range, where each window starts in the middle of the one before; fewest rows in a window.
AXES, WINDOWS, FEWEST = DRIFT, (1 / 4, 1 / 8, 1 / 16), 3
#: Conditions of which a level may differ from the others, the SI value of their column's unit, and the unit; most
#: levels that each may have.
LEVELS = {name: (v.shown, v.unit_shown) for name, v in EVERY_VARIABLE.items() if v.levels}
#: Columns of conditions that a run may have.
EVERY_AXIS = ("supply_voltage_V", "slope_deg", "payload_kg")
MOST_LEVELS = 6
#: Share of the variance of the order or the time explained by the conditions, from which drift cannot be separated
#: from them. Steps of a log tell 0.92 to 0.96 of its time, but within each step a curve over time still differs.
COLLINEAR = {"order": 0.9, "time": 0.99}
#: Number of combinations of conditions over the number of runs, up to which each combination is a level there.
FEW_CELLS = 1 / 3
#: Waves of histories: order per turn of the driving pulley or wheel, and True for waves of the belt (168 teeth,
#: 24 grousers around a pulley of 48 teeth).
ORDERS: dict[str, tuple[float, bool]] = {
    "order 1 of the driving shaft": (1.0, False),
    "order 2 of the driving shaft": (2.0, False),
    "order 3 of the driving shaft": (3.0, False),
    "order 1 of the belt": (48 / 168, True),
    "order 2 of the belt": (96 / 168, True),
    "order of the grousers": (24 * 48 / 168, True),
    "order of the teeth": (48.0, True),
}
#: Largest angle of a wave between two knots [rad]: two and a half knots a period.
RESOLVED = 2.5


class Basis(eqx.Module):
    """Families of smooth curves. Each curve of a family is a combination of the family's columns over the rows.

    A curve is a defect of one balance, or an error of one channel's readings. All families of one `Basis` have the
    same number of columns.

    Attributes:
        columns: columns of each family, shape (families, rows, terms).
        places: place of each family. All are balances, or all are channels.
        variables: independent variable of each family.
    """

    columns: Float[Array, "families rows terms"]
    places: Names = eqx.field(static=True)
    variables: Names = eqx.field(static=True)

    @staticmethod
    def of(columns: np.ndarray, names: Sequence[tuple[str, str]]) -> Basis:
        """Basis of columns, shape (families, rows, terms), with the (place, variable) of each family."""
        places, variables = zip(*names, strict=True)
        return Basis(jnp.asarray(columns), places, variables)

    @property
    def names(self) -> tuple[tuple[str, str], ...]:
        """(place, variable) of each family."""
        return tuple(zip(self.places, self.variables, strict=True))

    def for_equations(self) -> Basis:
        """Copy without the names of the variables. The name of a window depends on the table, which would prevent
        reuse of compiled programs.
        """
        return dataclasses.replace(self, variables=())

    def of_signatures(self, linear: Linearization, function: Callable[[Array], T]) -> T:
        """Function of the change of the whitened readings per unit of each column, shape (readings, terms), for each
        family.

        Families are computed one at a time to save memory.
        """
        of_channels = is_channel_place(self.places[0])
        place_names, columns_of_place = (
            (linear.channels, linear.channel_columns) if of_channels else (linear.probed, linear.columns)
        )
        places = jnp.asarray([place_names.index(place) for place in self.places])
        return jax.lax.map(lambda family: function(columns_of_place(*family)), (places, self.columns))


Bases = tuple[Basis, ...]


def is_channel_place(place: str) -> bool:
    """True if a place is a channel (whose readings are in error), False if it is a balance."""
    return place not in (*BALANCES, *OF_TURNS) and place in channels.channel_names(channels.EVERY)


def balance_of(place: str) -> str:
    """Balance of a place, or `sensor` if the place is a channel."""
    return "sensor" if is_channel_place(place) else place


def place_in_words(place: str) -> str:
    """Name of a place in words, such as `slip balance` or `reading of motor speed`. The track balance is called
    output shaft.
    """
    words = "output shaft" if place == "track" else place
    return f"reading of {place}".replace("_", " ") if is_channel_place(place) else f"{words} balance"


def variable_in_words(variable: str) -> str:
    """Name of a variable of a curve in words, such as `motor speed`."""
    return (
        EVERY_VARIABLE[variable].label
        if "_" in variable and variable in EVERY_VARIABLE
        else variable.replace("_", " ")
    )


def place_signature(linear: Linearization, place: str, shapes: np.ndarray) -> np.ndarray:
    """Change of the readings caused by errors in one place, shape (readings, terms). The errors have shape (rows,
    terms).
    """
    if is_channel_place(place):
        return np.asarray(linear.channel_columns(linear.channels.index(place), shapes))
    return np.asarray(linear.columns(linear.probed.index(place), shapes))


def scale_to_unit_range(x: np.ndarray, weight: np.ndarray) -> np.ndarray:
    """x mapped linearly so that rows of positive weight span -1 to 1. Zeros if x does not vary."""
    included = x[weight > 0]
    low = included.min()
    high = included.max()
    return np.clip((2 * x - low - high) / (high - low), -1, 1) if high - low > 1e-9 * max(abs(high), 1e-9) else 0 * x


def balances_of(robot: Robot, among: Sequence[str] = BALANCES) -> Names:
    """Balances of `among` that a robot has."""
    return tuple(b for b in among if b not in absent_balances(robot))


def axes_of(robot: Robot) -> Names:
    """Columns of conditions over which a robot's curves are defined."""
    axes = Layout.of(robot).axes
    return tuple(c for c in (SPEED, CURRENT, *EVERY_AXIS) if c in axes)


@dataclasses.dataclass(frozen=True)
class CurveScope:
    """Balances, condition columns and channels in which smooth curves are searched.

    Attributes:
        unsigned: channels whose readings have no sign.
    """

    balances: Names
    axes: Names
    channels: Names
    unsigned: frozenset[str]

    @classmethod
    def of(cls, robot: Robot, columns: Columns) -> CurveScope:
        """Scope of a robot that travels straight. The brake torque is a condition if the table has that column."""
        axes = (*axes_of(robot), *(c for c in (LOAD,) if c in columns))
        names = channels.channel_names(robot.channels)
        return cls(balances_of(robot), axes, names, robot.rig.magnitudes)


#: Signals of `effects.curve.WAYS`, by point; and a balance of the shafts.
Ways = Columns
SHAFTS = "electrical"


def families_of_table(columns: Columns, weight: np.ndarray, ways: Ways, scope: CurveScope) -> Bases:
    """Curves and windows. Arguments as in `curve_families`."""
    return (*curve_families(columns, weight, ways, scope), *window_families(columns, weight, ways, scope))


def curve_families(columns: Columns, weight: np.ndarray, ways: Ways, scope: CurveScope) -> Bases:
    """Curves of one variable, and polynomials in all conditions, in each balance, and curves of each channel's error.

    Each configuration has its own polynomials. The error of a channel is a curve over its reading, and over time or
    order.

    Args:
        columns: columns of the table, with fitted readings.
        weight: 0 for excluded rows or points (see `Linearization`), shape (rows,).
        ways: direction of travel of each point, shape (rows,).
        scope: balances, conditions and channels.
    """
    substitutes: dict[str, str] = {}  # a variable, and the one that takes its place
    for variable, column in VARIABLES.items():
        if column not in columns or (column in EVERY_AXIS and column not in scope.axes):
            continue
        drift = variable in AXES and order_collinearity(columns, weight, scope.axes, column) > COLLINEAR[variable]
        if drift and not substitutes:
            continue
        # A skipped variable is replaced by another, so that tables of one size share compiled programs.
        substitutes[variable] = next(iter(substitutes)) if drift else variable

    def curve(place: str, variable: str) -> np.ndarray:
        x, way = in_travel_frame(
            place, variable, np.asarray(columns[VARIABLES[variable]]), ways.__getitem__, scope.unsigned
        )
        return (
            way[:, None]
            * legendre.legvander(scale_to_unit_range(x, weight), TERMS - 1)
            * np.exp(-0.35 * np.arange(TERMS))
        )

    names = [(balance, variable) for variable in substitutes.values() for balance in scope.balances]
    channel_variables = [(c, v) for c in scope.channels for v in substitutes if v in AXES or v == READ_BY.get(c)]
    new = [n for n in channel_variables if substitutes[n[1]] == n[1]]
    # As above: a skipped curve is replaced by another of its channel, or else by the first.
    channel_curves = (
        [n if n in new else next((m for m in new if m[0] == n[0]), new[0]) for n in channel_variables] if new else []
    )
    groups = [
        (names, [curve(*n) for n in names]),
        (
            [(balance, CONDITIONS) for balance in scope.balances],
            [condition_polynomials(columns, weight, scope, ways, balance) for balance in scope.balances],
        ),
        (channel_curves, [curve(*n) for n in channel_curves]),
    ]
    return tuple(Basis.of(np.stack(curves), names_of_group) for names_of_group, curves in groups if names_of_group)


def condition_polynomials(
    columns: Columns, weight: np.ndarray, scope: CurveScope, ways: Ways, place: str
) -> Float[np.ndarray, "points terms"]:
    """Polynomials in all conditions, for each configuration. Arguments as in `curve_families`."""
    of_column = {column: variable for variable, column in VARIABLES.items()}
    of_column |= {CURRENT: "current", LOAD: "current"}  # its sign is also that of the torque that drives the shafts
    values_in_travel = (
        in_travel_frame(place, of_column[c], np.asarray(columns[c]), ways.__getitem__)[0] for c in scope.axes
    )
    spans = [scale_to_unit_range(x, weight) for x in values_in_travel]
    powers = [p for p in itertools.product(range(DEGREE + 1), repeat=len(spans)) if sum(p) <= DEGREE]
    terms = [
        np.prod([a**k for a, k in zip(spans, p, strict=True)], 0) * (columns["configuration"] == name)
        for name in np.unique(columns["configuration"])
        for p in powers
    ]
    return ways[direction_signal(place)][:, None] * np.stack(terms, 1)


@dataclasses.dataclass(frozen=True)
class Window:
    """Interval of an axis, `time` [s] or `order` [-], with a temporary change, or one level of a condition [SI]."""

    axis: str
    low: float
    high: float

    def __str__(self) -> str:
        return f"{self.axis} {self.low:.5g} to {self.high:.5g}"

    def holds(self, x: np.ndarray) -> np.ndarray:
        """True for points of the axis within the window. The ends are rounded to five digits."""
        slack = 1e-4 * max(abs(self.low), abs(self.high), 1e-9)
        return (x >= self.low - slack) & (x <= self.high + slack)

    @property
    def words(self) -> str:
        """The window in words, such as `15 deg of slope`."""
        factor, unit = LEVELS.get(self.axis, (1.0, ""))
        return f"{self.low / factor:.4g} {unit} of {self.axis}"


def window_from_name(variable: str) -> Window | None:
    """Window that the name of a variable describes. None if the name describes no window."""
    match = re.fullmatch(rf"({'|'.join((*AXES, *LEVELS))}) (\S+) to (\S+)", variable)
    return None if match is None else Window(match[1], float(match[2]), float(match[3]))


def window_families(columns: Columns, weight: np.ndarray, ways: Ways, scope: CurveScope) -> Bases:
    """Windows of time or of the order of runs, and levels of conditions, in each balance and channel.

    Windows of time are at the same instants in all runs. They are omitted if the conditions determine time or order.
    Arguments as in `curve_families`.
    """
    is_included = weight > 0
    signs = {name: np.where(way < 0, -1.0, 1.0) for name, way in ways.items()}  # also for starts from rest
    windows: list[tuple[str, np.ndarray, np.ndarray]] = []  # axis, its values, which rows are inside
    axis = next((a for a in AXES if VARIABLES[a] in columns), None)
    if axis is not None:
        x = np.asarray(columns[VARIABLES[axis]], float)
        low = x[is_included].min()
        high = x[is_included].max()
        # Consecutive runs then have similar conditions, and conditions have windows of their own.
        sorted_runs = order_collinearity(columns, weight, scope.axes, VARIABLES[axis]) > COLLINEAR[axis]
        for share in WINDOWS:
            size = share * (high - low)
            for k in range(round(2 / share) - 1):
                window_start = low + k * size / 2
                is_inside = (x >= window_start) & ((x < window_start + size) | (k == round(2 / share) - 2))
                windows.append((axis, x, is_included & is_inside & (not sorted_runs)))
    for condition, (factor, _) in LEVELS.items():
        if VARIABLES[condition] not in scope.axes:
            continue
        values = factor * np.asarray(columns[VARIABLES[condition]], float)
        x, _ = in_travel_frame(SHAFTS, condition, values, signs.__getitem__)
        levels = np.unique(x[is_included])
        levels = levels if 2 < len(levels) <= MOST_LEVELS else levels[:0]
        windows += [(condition, x, is_included & (x == level)) for level in levels]
        windows += [(condition, x, np.zeros_like(is_included))] * (MOST_LEVELS - len(levels))
    shapes = [
        (is_inside.astype(float), str(Window(axis, float(x[is_inside].min()), float(x[is_inside].max()))))
        for axis, x, is_inside in windows
        if FEWEST <= is_inside.sum() <= 0.5 * is_included.sum()
    ]
    if not shapes:
        return ()
    # The first again for windows with too few or too many rows: tables of one size share compiled programs.
    shapes += shapes[:1] * (len(windows) - len(shapes))
    return tuple(
        Basis.of(
            np.stack(
                [s * sign_factor(place, ways.__getitem__, scope.unsigned) for place in places for s, _ in shapes]
            )[:, :, None],
            [(place, name) for place in places for _, name in shapes],
        )
        for places in (scope.balances, scope.channels)
        if places
    )


def order_collinearity(columns: Columns, weight: np.ndarray, axes: Sequence[str], column: str) -> float:
    """Share of the variance of the order of runs, or of their time, that their conditions explain (R²).

    If it is 1, drift from run to run cannot be separated from effects of the conditions. Conditions enter as a
    polynomial of the slope and a level for each combination of configuration, imposed quantity, duty and payload.
    With many combinations for the number of runs, they enter as a level for each configuration and direction.
    Polynomials of the other conditions and of their ranks are then added.

    Args:
        columns, weight: as in `curve_families`.
        axes: columns of the conditions.
        column: `order` or `time_s`.
    """
    is_included = weight > 0
    order_or_time = np.asarray(columns[column], float)[is_included]
    if len(order_or_time) < 4 or np.ptp(order_or_time) == 0:
        return 1.0
    _, configuration = np.unique(np.asarray(columns["configuration"])[is_included], return_inverse=True)
    conditions = (*axes, *(["duty"] if "duty" in columns else []))
    other_conditions = [c for c in conditions if c != VARIABLES["slope"]]
    values = np.stack([configuration, *(np.asarray(columns[c], float)[is_included] for c in other_conditions)], 1)
    _, group_index = np.unique(np.c_[configuration, np.sign(values[:, 1:])], axis=0, return_inverse=True)
    _, cell_index = np.unique(values, axis=0, return_inverse=True)
    has_few_cells = cell_index.max() + 1 <= FEW_CELLS * len(order_or_time)
    smooth = [VARIABLES["slope"]] * (VARIABLES["slope"] in conditions) if has_few_cells else conditions
    level = cell_index.ravel() if has_few_cells else group_index.ravel()
    spans = [scale_to_unit_range(np.asarray(columns[c], float), weight)[is_included] for c in smooth]
    polynomials = [legendre.legvander(span, DEGREE)[:, 1:] for span in spans]
    for span in spans:  # a sorted table's order is the rank
        rank = np.searchsorted(np.sort(span), span, "left") + np.searchsorted(np.sort(span), span, "right")
        polynomials.append(rank[:, None] / (2 * len(order_or_time)))
    terms = np.concatenate([np.zeros((len(order_or_time), 1)), *polynomials], 1)
    # Without the means of each level: a matrix with a column for each level would be rows times rows.
    count = np.bincount(level)
    centred_terms, unexplained = (
        v - (np.stack([np.bincount(level, c) for c in v.T], 1) / count[:, None])[level]
        for v in (terms, order_or_time[:, None])
    )
    directions, size, _ = np.linalg.svd(centred_terms, full_matrices=False)
    directions = directions[:, size > len(order_or_time) * np.finfo(float).eps * np.linalg.norm(terms)]
    unexplained = unexplained - directions @ (directions.T @ unexplained)
    terms_used = len(count) + directions.shape[1]
    freedom = (len(order_or_time) - 1) / max(len(order_or_time) - terms_used, 1)
    return float(1 - freedom * np.sum(unexplained**2) / np.sum((order_or_time - order_or_time.mean()) ** 2))


def wave_families(
    on_tracks: np.ndarray, angle: np.ndarray, rows: np.ndarray, knots: np.ndarray, balances: Names
) -> Bases:
    """Waves of the orders that the samples of histories resolve, in each balance.

    A wave has its own amplitude and phase in each run of at least two periods, because the angle at the start of a
    run is unknown. Shorter runs are left out: part of a wave with a free phase could fit any level and trend. If all
    runs are shorter, a wave has one amplitude and phase, as if all runs began at the same angle.

    Args:
        on_tracks: True for rows of a run on tracks.
        angle: angle of the driving shaft [rad], shape (rows,).
        rows: indices of each run's rows in order of time, padded with -1, shape (runs, samples).
        knots: rows between which an error is linear, shape (runs, knots).
        balances: balances with waves.
    """
    bases, wave_names = [], []
    for wave_name, (order, of_belt) in ORDERS.items():
        wave, short_waves = np.zeros((2, len(angle), 2 * len(rows)))
        for k, padded_rows in enumerate(rows):
            rows_of_wave = padded_rows[padded_rows >= 0]
            if len(rows_of_wave) < 8 or (of_belt and not on_tracks[rows_of_wave[0]]):
                continue
            phase = order * angle[rows_of_wave]
            step = np.abs(np.diff(order * angle[knots[k]]))
            if not step.any() or np.median(step[step > 0]) > RESOLVED:
                continue
            shape = np.stack([np.cos(phase), np.sin(phase)], 1)
            short_waves[rows_of_wave, :2] = shape
            if np.ptp(phase) >= 4 * np.pi:
                wave[rows_of_wave, 2 * k : 2 * k + 2] = shape
        if short_waves.any():
            bases.append(wave if wave.any() else short_waves)
            wave_names.append(wave_name)
    if not wave_names:
        return ()
    # The first again for orders that these samples do not resolve: logs of one size share compiled programs.
    possible = sum(1 for _, of_belt in ORDERS.values() if np.any(on_tracks) or not of_belt)
    bases += bases[:1] * (possible - len(bases))
    wave_names += wave_names[:1] * (possible - len(wave_names))
    return (Basis.of(np.stack(bases * len(balances)), [(b, w) for b in balances for w in wave_names]),)


def family_names(bases: Bases) -> tuple[tuple[str, str], ...]:
    """(place, variable) of every family, in order."""
    return tuple(n for basis in bases for n in basis.names)
