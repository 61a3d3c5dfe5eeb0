"""Numbers for the paper's figures and tables, all computed by mmrjax."""

from __future__ import annotations

import dataclasses
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from calibration.data import Columns, Json, Names, runs
from calibration.inference import simulation_errors
from mmrjax.fidelities import outputs
from mmrjax.fidelities.base import History
from mmrjax.fidelities.steady import results_of_rows, steady_batch
from mmrjax.model.channels import Channel
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_tables import CONFIGURATIONS, SURFACES, TRACKED, adhesion_ratio
from mmrjax.model.robot import Robot
from sweeps.pages import history_figures
from sweeps.pages.history_figures import StartRun

#: Runs per call of `steady`, so that all calls of the report share one compiled program.
_CHUNK = 256
#: Surface of Table 5 for "adhesion raised": the first on which all 20 measured rows climb.
RAISED_SURFACE = "smooth_concrete_floor"
#: Smallest ratio of the raised adhesion to the largest demand, for robots that need more than this surface.
RAISED_MARGIN = 1.06
FIG_23, FIG_24 = "Fig. 23: total current", r"Fig. 24: $V_x$ and $V_{x\,teor}$"  # titles
#: Loading modes of Fig. 28: supply voltage [V] and payload [kg].
MODES = {1: (15.0, 0.0), 2: (33.0, 0.0), 3: (33.0, 5.0), 4: (33.0, 8.0)}


def paper_configurations(robot: Robot) -> Names:
    """The paper's configurations that a robot has. Only these can be compared with the paper's bench runs."""
    return tuple(c for c in CONFIGURATIONS if c in robot.configurations)


def shown_configurations(robot: Robot) -> Names:
    """Configurations to show for a robot: those of the paper, or its own if it has none of these."""
    return paper_configurations(robot) or robot.configurations.names


def batch_conditions(robot: Robot, configuration: Any, **values: Any) -> Conditions:
    """Batch of conditions with configurations by name. The default total mass is that of the robot."""
    conditions = Conditions(np.asarray(configuration), **values).resolved(robot)
    if conditions.total_mass is not None:
        return conditions
    unloaded_mass = np.array([float(chassis.mass) for chassis in robot.configurations.members])
    return dataclasses.replace(
        conditions, total_mass=unloaded_mass[np.asarray(conditions.configuration)] + conditions.payload
    )


def operating_points(robot: Robot, conditions: Conditions) -> Columns:
    """Steady operating points of a batch, in the columns of `runs.csv`."""
    rows = conditions.shape[0]
    parts = []
    for first in range(0, rows, _CHUNK):
        index = np.minimum(np.arange(first, first + _CHUNK), rows - 1)
        parts.append(jax.device_get(steady_batch(robot, jax.tree.map(lambda x, i=index: x[i], conditions))))
    results = jax.tree.map(lambda *x: np.concatenate(x)[:rows], *parts)
    return {**outputs.output_columns(results, robot.channels), "total_mass_kg": results.mass}


def channels_of_paper() -> tuple[Channel, ...]:
    """Channels in the paper's tables."""
    table = runs.read_runs("measured")
    return tuple(c for c in table.channels if table.has(c.column))


def stack_channels(table: Columns) -> np.ndarray:
    """The paper's channels in a table, in the units of their columns, shape (rows, channels)."""
    return np.stack([np.asarray(table[c.column], float) for c in channels_of_paper()], 1)


@dataclasses.dataclass(frozen=True)
class PaperRows:
    """Rows of Tables A1 and A2 with a configuration of the robot, and the robot's result for each.

    Attributes:
        conditions: the measured table.
        measured, paper: readings of the bench and of the paper's own simulation, shape (rows, channels).
        plain: this robot with its own adhesion and the printed mass.
        raised: the same with raised adhesion.
        weighed: with raised adhesion and the robot's own mass.
        ratio: factor by which adhesion is raised, by configuration.
    """

    conditions: runs.Runs
    measured: np.ndarray
    paper: np.ndarray
    plain: Columns
    raised: Columns
    weighed: Columns
    ratio: dict[str, float]

    @property
    def errors(self) -> Columns:
        """Errors (35) against the bench [%] of the three variants and of the paper's simulation, as `measured`."""
        variants = {"plain": self.plain, "raised": self.raised, "weighed": self.weighed}
        simulated = {name: stack_channels(table) for name, table in variants.items()} | {"paper": self.paper}
        return {name: simulation_errors.relative_error(x, self.measured) for name, x in simulated.items()}


def simulate_measured_rows(robot: Robot) -> PaperRows | None:
    """Simulates the measured rows with `robot`: unchanged, with raised adhesion, and also with its own mass. None if
    the robot has none of their configurations.
    """
    if not paper_configurations(robot):
        return None
    table, paper = (
        table.where(np.isin(table["configuration"], paper_configurations(robot)))
        for table in map(runs.read_runs, ("measured", "simulated_by_paper"))
    )
    configurations = table["configuration"]
    request: Json = {
        "configuration": configurations,
        "voltage": table["supply_voltage_V"],
        "payload": table["payload_kg"],
        "slope_deg": table["slope_deg"],
    }
    mass = table["total_mass_kg"]
    plain = operating_points(robot, batch_conditions(robot, total_mass=mass, **request))
    ratio = {}
    for c in paper_configurations(robot):
        largest_use = float(np.max(np.abs(plain["adhesion_used"][configurations == c])))
        surface_ratio = adhesion_ratio(RAISED_SURFACE, c == TRACKED)
        ratio[c] = max(surface_ratio, RAISED_MARGIN * largest_use) if largest_use > 1 else 1.0
    adhesion = np.array([ratio[c] for c in configurations])
    raised = operating_points(robot, batch_conditions(robot, total_mass=mass, adhesion=adhesion, **request))
    weighed = operating_points(robot, batch_conditions(robot, adhesion=adhesion, **request))
    return PaperRows(
        table, stack_channels(table.columns), stack_channels(paper.columns), plain, raised, weighed, ratio
    )


def raised_adhesion_words(robot: Robot, ratio: dict[str, float]) -> str:
    """Raised adhesion coefficients in words, with their source."""
    surface = SURFACES[RAISED_SURFACE]
    parts = []
    for c, factor in ratio.items():
        adhesion = float(robot.configurations[c].ground.friction.static)
        if factor == 1.0:
            parts.append(f"{c} unchanged at {adhesion:.2f}")
            continue
        printed_adhesion = surface.tracked_x if c == TRACKED else surface.wheeled_x
        source_text = " (Table 5, smooth concrete floor)" if abs(adhesion * factor - printed_adhesion) < 1e-6 else ""
        parts.append(f"{c} from {adhesion:.2f} to {adhesion * factor:.2f}{source_text}")
    return "; ".join(parts)


# --- components ---------------------------------------------------------------------------------------


def idle_current(robot: Robot, configuration: str, speed_wheel: np.ndarray) -> np.ndarray:
    """Current of one motor [A] that keeps a lifted side turning at pulley speed [rad/s].

    Without ground and weight on the guides, normal load and traction are zero. The net torque is linear in the
    current while the motor drives, so two currents give the root.
    """
    from mmrjax.model import balances
    from mmrjax.model.signals import State

    conditions = batch_conditions(robot, np.full(speed_wheel.shape, configuration))
    chassis = robot.configurations[configuration]
    wheel = jnp.asarray(speed_wheel)
    zero = jnp.zeros_like(wheel)

    def torque_net(current: float) -> np.ndarray:
        state = State(zero + current, wheel * robot.gearbox.ratio, chassis.radius * wheel, zero)
        signals = balances.begin_signals(robot, conditions, state, direction=zero + 1.0)
        signals = dataclasses.replace(signals, normal=zero, traction=zero)
        signals = balances.motor(
            robot, balances.electrical(robot, conditions, balances.supply(robot, conditions, signals))
        )
        return np.asarray(balances.gearbox(robot, chassis, balances.track(robot, chassis, signals)).torque_net)

    low, high = 5.0, 10.0
    at_low, at_high = torque_net(low), torque_net(high)
    return low - at_low * (high - low) / (at_high - at_low)


def fit_line(x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, float]:
    """Least-squares line through the points, evaluated at them, and its R² (A1)."""
    line = np.polyval(np.polyfit(x, y, 1), x)
    return line, simulation_errors.r_squared(y, line)


# --- runs ---------------------------------------------------------------------------------------------


def simulate_starts(robot: Robot) -> list[StartRun]:
    """Starts from standstill on the flat with `drive`, for each of the paper's configurations."""
    from mmrjax.fidelities.drive import drive_batch

    times = np.concatenate([np.linspace(0, 0.04, 161), np.linspace(0.04, 1.5, 440)[1:]])
    run = drive_batch(robot, batch_conditions(robot, shown_configurations(robot), voltage=33.0), jnp.asarray(times))
    return starts_from_standstill(robot, History(run.time, run.distance, run.signals, {}), run.result.status)


def starts_from_standstill(robot: Robot, history: Any, status: Any) -> list[StartRun]:
    """Runs of the paper's configurations from standstill, for any fidelity with histories.

    Args:
        history: time, signals and reactions (None where contacts are not resolved).
        status: codes of how runs ended.
    """
    names = shown_configurations(robot)
    return history_figures.start_runs(robot, history, status, [robot.configurations.index(c) for c in names], names)


def current_over_slope(robot: Robot, ratio: dict[str, float], slopes: np.ndarray) -> dict[tuple[str, int], Any]:
    """Current [A] over slope for the loading modes: (configuration, mode) → (own adhesion, raised)."""
    cases = [(c, mode, factor) for c in ratio for mode in MODES for factor in (1.0, ratio[c])]
    configuration, voltage, payload, adhesion = (
        np.repeat(np.array(values), len(slopes))
        for values in zip(*((c, *MODES[mode], factor) for c, mode, factor in cases), strict=True)
    )
    conditions = batch_conditions(
        robot,
        configuration,
        voltage=voltage.astype(float),
        payload=payload.astype(float),
        slope_deg=np.tile(slopes, len(cases)),
        adhesion=adhesion.astype(float),
    )
    current = operating_points(robot, conditions)["total_current_A"].reshape(len(cases), len(slopes))
    return {(c, mode): (current[2 * k], current[2 * k + 1]) for k, (c, mode, _) in enumerate(cases[::2])}


def rows_of_mode(rows: PaperRows, configuration: str, mode: int) -> np.ndarray:
    """Mask of the measured rows of a configuration in a loading mode."""
    table = rows.conditions
    (voltage, payload) = MODES[mode]
    return np.asarray(
        (table["configuration"] == configuration)
        & (table["supply_voltage_V"] == voltage)
        & (table["payload_kg"] == payload)
    )


def slope_certainty(rows: PaperRows) -> list[tuple[Any, ...]]:
    """R² (A1) of the current over slope, for each configuration and loading mode with measured rows.

    Returns:
        Configuration, mode, R² of a straight line through the points, and R² of the robot with its own adhesion.
        Then the number of rows that settle with it, and R² with raised adhesion and with the robot's own mass.
    """
    table_rows = []
    for configuration in rows.ratio:
        for mode in MODES:
            is_row = rows_of_mode(rows, configuration, mode)
            if is_row.any():
                measured = rows.measured[is_row, 0]
                plain, *others = (
                    table["total_current_A"][is_row] for table in (rows.plain, rows.raised, rows.weighed)
                )
                line_r_squared = fit_line(rows.conditions["slope_deg"][is_row], measured)[1]
                table_rows.append(
                    (
                        configuration, mode, line_r_squared, simulation_errors.r_squared(measured, plain),
                        int(np.isfinite(plain).sum()), *(simulation_errors.r_squared(measured, x) for x in others),
                    )
                )  # fmt: skip
    return table_rows


def supply_errors(robot: Robot, rows: PaperRows, voltage: float, battery: bool) -> np.ndarray:
    """Errors (35) over the five slopes of 6T2A at a voltage of Fig. 29, with raised adhesion, shape (5, 3)."""
    is_row = (rows.conditions["configuration"] == TRACKED) & (rows.conditions["supply_voltage_V"] == voltage)
    table = rows.conditions.where(is_row)
    conditions = batch_conditions(
        robot, table["configuration"], voltage=voltage, payload=table["payload_kg"],
        slope_deg=table["slope_deg"], total_mass=table["total_mass_kg"], adhesion=rows.ratio[TRACKED],
        battery=float(battery),
    )  # fmt: skip
    return simulation_errors.relative_error(
        stack_channels(operating_points(robot, conditions)), rows.measured[is_row]
    )


#: Uses of the supply's power, from the motor to the ground, with their names in the figure.
SPLIT = ("winding", "motor friction", "gearbox", "track and guides", "slip", "rolling resistance", "lift")


def energy_split(robot: Robot, conditions: Conditions) -> tuple[Columns, Columns]:
    """Operating points, and the power [W] of each item of `SPLIT`.

    Returns:
        Points, and item → power. `other` is the power of effects beyond the paper's terms.
    """
    points, (_, signals) = operating_points(robot, conditions), results_of_rows(robot, conditions)
    sides = robot.sides
    parts = {
        "winding": sides * signals.voltage_drop * signals.current,
        "motor friction": sides * signals.torque_motor_loss * signals.speed_motor,
        "gearbox": points["power_motor_W"] - points["power_gear_W"],
        "track and guides": sides * signals.torque_track_loss * signals.speed_wheel,
        "slip": sides * signals.traction * (signals.speed_theoretical - signals.speed),
        "rolling resistance": sides * signals.resistance * signals.speed,
        "lift": points["power_lift_W"],
    }
    split = {k: np.asarray(v) for k, v in parts.items()}
    split["other"] = points["power_supply_W"] - sum(split.values())
    return points, split


def energy_use(robot: Robot, ratio: dict[str, float]) -> list[tuple[Any, ...]]:
    """Power of the supply and of each item of `SPLIT` [W] at twelve operating points.

    A star marks a point at which the robot would slide. Its adhesion is raised.

    Args:
        ratio: factor by which adhesion is raised if the robot would slide, by configuration.
    """
    cases = [(c, u, p, s) for c in ratio for u, p in ((15.0, 0.0), (33.0, 8.0)) for s in (0.0, 10.0, 20.0)]
    configurations, voltage, payload, slope = (np.array(values) for values in zip(*cases, strict=True))

    def points_and_power(adhesion: np.ndarray) -> tuple[Columns, Columns]:
        quantities = {"voltage": voltage, "payload": payload, "slope_deg": slope, "adhesion": adhesion}
        return energy_split(robot, batch_conditions(robot, configurations, **quantities))

    slides = points_and_power(np.ones(len(cases)))[0]["status"] == "slides"
    points, power = points_and_power(np.where(slides, [ratio[k] for k in configurations], 1.0))
    return [
        (
            f"{c}  {u:.0f} V  {p:.0f} kg  {s:.0f}°" + " *" * bool(slides[k]),
            *(watts[k] for watts in (points["power_supply_W"], *(power[item] for item in SPLIT))),
        )
        for k, (c, u, p, s) in enumerate(cases)
    ]


def paper_rows_table(rows: PaperRows) -> Columns:
    """The paper's rows side by side: measured, the paper's simulation, and three variants of the robot."""
    conditions = rows.conditions
    columns = {key: conditions[key] for key in ("configuration", *runs.CONDITIONS)}
    for k, channel in enumerate(channels_of_paper()):
        columns[channel.column] = rows.measured[:, k]
        columns[f"paper_{channel.column}"] = rows.paper[:, k]
        for name in ("plain", "raised", "weighed"):
            columns[f"{name}_{channel.column}"] = getattr(rows, name)[channel.column]
    return columns | {"status": rows.plain["status"]}


def bench_error_summary(rows: PaperRows) -> dict[str, Json]:
    """Errors (35) of every channel against the bench: of three robot variants and of the paper's simulation."""
    return {
        name: {c.name: simulation_errors.error_summary(values[:, k]) for k, c in enumerate(channels_of_paper())}
        for name, values in rows.errors.items()
    }
