"""Missions beside FASTSim (benchmarks/fastsim_comparison.py): beside the integral of rolling, climb and acceleration."""

import importlib.util
import sys

import fastsim_comparison as comparison
import numpy as np
import pytest

from mmrjax.fidelities.steady import steady_batch
from mmrjax.model.conditions import Conditions

INSTALLED = importlib.util.find_spec("fastsim") is not None


@pytest.fixture(scope="module")
def missions():
    """Both vehicles, by one compiled mission."""
    return {vehicle.name: comparison.mmrjax_of(vehicle, asked) for vehicle, asked in comparison.CASES}


@pytest.mark.nightly
@pytest.mark.parametrize("case", range(len(comparison.CASES)))
def test_mission_follows_the_integral(case, missions):
    """Work at the wheel both ways, distance and Wh/km. The rest is what windings and sliding take."""
    vehicle, asked = comparison.CASES[case]
    ours, exact = missions[vehicle.name], comparison.integral_of(vehicle, asked)
    for name in ("wheel_J", "wheel_back_J", "distance_m", "Wh_per_km"):
        assert ours[name] == pytest.approx(exact[name], rel=3e-4), name
    assert ours["wheel_J"] - ours["wheel_back_J"] == pytest.approx(ours["wheel_net_by_sinks_J"], rel=1e-4)
    assert abs(ours["unaccounted_J"]) < 1e-6 * ours["battery_J"]


@pytest.mark.slow
@pytest.mark.parametrize("slope_deg", [0.0, 4.0])
@pytest.mark.parametrize("case", range(len(comparison.CASES)))
def test_vehicle_travels_by_the_force_and_the_power_of_the_integral(case, slope_deg):
    """Settled travel of the robot that missions are made of: rolling, climb, the transmission and the windings."""
    vehicle, _ = comparison.CASES[case]
    run = Conditions(np.array([1]), np.array([4.0 * vehicle.cells]), np.array([slope_deg]))
    found = steady_batch(comparison.robot_of(vehicle), run)
    slope, current = np.radians(slope_deg), float(found.reading["total_current"][0])
    force = vehicle.mass * comparison.GRAVITY * (np.sin(slope) + vehicle.rolling * np.cos(slope))
    assert float(found.traction[0]) == pytest.approx(force, rel=1e-6)
    winding = vehicle.resistance * current**2 / 2  # of two motors
    taken = 4.0 * vehicle.cells * current - winding
    assert force * float(found.theoretical_speed[0]) == pytest.approx(vehicle.efficiency * taken, rel=1e-6)
    expected = (4.0 * vehicle.cells - vehicle.resistance * current / 2) / vehicle.torque_constant
    assert float(found.theoretical_speed[0]) == pytest.approx(expected / vehicle.ratio * vehicle.radius, rel=1e-9)


def test_integral_of_a_plain_ramp():
    """m v²/2 and rolling over the way, wheels turning included."""
    vehicle = comparison.CAR
    ramp = comparison.Trace(np.array([0.0, 10.0]), np.array([0.0, 5.0]), np.zeros(2))
    work = 0.5 * (vehicle.mass + vehicle.inertia / vehicle.radius**2) * 25
    work += vehicle.rolling * vehicle.mass * comparison.GRAVITY * 25
    assert comparison.integral_of(vehicle, ramp)["wheel_J"] == pytest.approx(work, rel=1e-6)


@pytest.mark.skipif(INSTALLED, reason="fastsim is installed")
def test_without_fastsim_it_says_how_to_install_it(capsys, monkeypatch):
    monkeypatch.setattr(sys, "argv", ["fastsim_comparison.py"])
    with pytest.raises(SystemExit) as ended:
        comparison.main()
    assert ended.value.code == 2
    assert "pip install fastsim" in capsys.readouterr().err


@pytest.mark.skipif(not INSTALLED, reason="fastsim is not installed")
@pytest.mark.parametrize("case", range(len(comparison.CASES)))
def test_fastsim_agrees(case, missions):
    vehicle, asked = comparison.CASES[case]
    apart = comparison.percent(missions[vehicle.name], comparison.fastsim_of(vehicle, asked, 1.0))
    assert abs(apart["wheel_J"]) <= 0.5
    assert abs(apart["Wh_per_km"]) <= 1.0
