"""What shows only where a robot goes both ways, or where its load drives it, through the stages of the loop."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.random import default_rng
from synthetic import Analyst

from calibration.data.runs import Runs, read_runs
from calibration.discovery.location import DiscrepancyLocation, varied_by_duty
from calibration.discovery.scales import goes_both_ways, has_partial_duty, visible_effects
from calibration.discovery.settings import settings_for
from calibration.inference.linearization import amplitude_of
from calibration.inference.observers import Histories, SettledRuns
from calibration.words import loop_words as words
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.channels import usual_channels
from mmrjax.model.conditions import Conditions

FORWARD, EITHER = (15.0, 20.0, 27.0, 33.0), (15.0, 33.0, -15.0, -33.0)
CLIMBING = {f"{c}.ground.friction.{k}": v for c in ("6T2A", "4W2T") for k, v in (("static", 0.9), ("dynamic", 0.7))}
SEARCHED = ("directional_friction", "backdriving_loss", "churning", "tension_friction", "slope_bias")
ANALYST = Analyst(
    replace(settings_for(SettledRuns, 192), slots=1),
    {name: BY_NAME[name] for name in SEARCHED},
    {f"{c}.ground.friction.static": (0.9, 0.1) for c in ("6T2A", "4W2T")},
)


def table(name, amplitude, voltages):
    """80 noisy runs up and down slopes with one effect."""
    wheeled, slope, payload, voltage = (
        x.ravel() for x in np.meshgrid([0, 1], [0.0, 5.0, 10.0, 20.0, -10.0], [0.0, 5.0], voltages, indexing="ij")
    )
    slope = slope * np.sign(voltage)
    effect = params.replace(BY_NAME[name](), {"amplitude": amplitude})
    robot = replace(params.replace(paper_robots.nominal(), CLIMBING), effects=(effect,))
    shown = steady_batch(robot, Conditions(wheeled, voltage, slope, payload)).reading
    columns = {
        "configuration": np.where(wheeled == 1, "4W2T", "6T2A"),
        "slope_deg": slope,
        "payload_kg": payload,
        "supply_voltage_V": voltage,
    }
    rng = default_rng(1)
    for channel in usual_channels():
        reading = np.asarray(shown[channel.name]) / channel.factor
        sd = channel.sd_share * np.maximum(np.abs(reading), 0.2 * np.abs(reading).max())
        columns |= {channel.column: reading + sd * rng.normal(size=sd.size), channel.sd_column: sd}
    return Runs("synthetic", columns)


def test_runs_that_go_both_ways_are_known_by_what_drives_them_or_by_a_speed():
    measured = read_runs("measured")
    assert not goes_both_ways(measured)
    columns, rows = dict(measured.columns), len(measured)
    speeds = [c.column for c in usual_channels() if c.zero_at_rest]

    def changed(**values):
        return replace(measured, columns={**columns, **values})

    turned = np.where(np.arange(rows) == 3, -1.0, 1.0)
    for name in ("supply_voltage_V", *speeds):
        assert goes_both_ways(changed(**{name: columns[name] * turned}))
        assert not goes_both_ways(changed(**{name: np.full(rows, np.nan)}))
    noise = np.where(turned < 0, -0.01, 1.0) * np.nanmax(columns[speeds[0]])  # about rest
    assert not goes_both_ways(changed(**{speeds[0]: noise}))


@pytest.mark.parametrize("kind", [SettledRuns, Histories])
def test_what_needs_runs_both_ways_is_looked_for_in_such_alone(kind, robot):
    names = [{e.name for e in visible_effects(BY_NAME, robot, kind, way)} for way in (True, False)]
    # A constant torque is directional friction in settled travel.
    only = {
        "directional_friction",
        "directional_viscous",
        "directional_stribeck",
        *(["torque_offset"] if kind is Histories else []),
    }
    assert names[0] - names[1] == only and names[1] < names[0]


@pytest.mark.parametrize(
    "supply, duty, below_one, alone",
    [
        ([8.0, 8.0, 8.0], [1.0, 0.5, -0.5], True, True),
        ([8.0, 8.0, 8.0], [-1.0, 1.0, 1.0], False, False),
        ([8.0, 6.0, 8.0], [1.0, 0.5, 0.5], True, False),
        ([8.0, 8.0, 8.0], None, False, False),
    ],
)
def test_what_a_duty_drives_is_known_and_its_effect_looked_for_in_such_alone(supply, duty, below_one, alone, robot):
    columns = {"configuration": np.full(3, "6T2A"), "supply_voltage_V": np.array(supply)}
    columns |= {} if duty is None else {"duty": np.array(duty)}
    runs = Runs("synthetic", columns)
    assert has_partial_duty(runs) is below_one and varied_by_duty(runs) is alone
    names = {e.name for e in visible_effects(BY_NAME, robot, SettledRuns, True, has_partial_duty(runs))}
    assert ("coast_decay" in names) is below_one
    where = DiscrepancyLocation("electrical", "voltage", ("electrical",), (), 9.0, 9.0, by_duty=alone)
    assert where.family.endswith("duty" if alone else "voltage")
    assert (
        words.variable_showing_discrepancy("voltage", alone)
        == f"clearest when plotted over {'duty' if alone else 'voltage'}"
    )


@pytest.mark.nightly
@pytest.mark.parametrize(
    "name, amplitude, voltages",
    [("directional_friction", 0.06, EITHER), ("backdriving_loss", 0.3, FORWARD)],
)
def test_loop_names_it(name, amplitude, voltages):
    traced = ANALYST.trace(table(name, amplitude, voltages))
    assert traced.verdict == "named" and traced.members == ((name,),)
    assert traced.best.amplitude[0] * _sd(name) == pytest.approx(amplitude, rel=0.2)


@pytest.mark.slow
def test_loop_takes_friction_of_one_direction_for_dry_friction():
    runs = table("directional_friction", 0.06, FORWARD)
    found = ANALYST.discover(runs)
    assert found.verdict == "none" and found.needs_reverse == ("directional_friction",)
    shift = found.base_shift["6T2A.track.loss_coulomb"]
    assert 0.350 + 0.02 < shift.after < 0.350 + 0.08  # beside its prior, and what else resists
    assert "directional_friction" not in {s.name for s in found.scores}


def _sd(name):
    return amplitude_of(BY_NAME[name]()).spec.prior_sd(0.0)
