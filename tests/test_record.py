"""What the project gave before its rooms were rebuilt, kept in `tests/record`: nothing of it may change unsaid.

A result that is corrected on purpose is changed there too, with a line in CHANGELOG.md. `python tests/test_record.py`
renews what the loop gives (all of its tables, or those that are named), and nothing else.
"""

import json
import sys
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.data import runs as tables
from calibration.discovery.discover import discover
from calibration.inference import priors
from mmrjax import fidelities
from mmrjax.model.conditions import Conditions
from mmrjax.model.paper_robots import nominal
from tests.commands import columns_of, read_json

RECORD = Path(__file__).parent / "record"
RESULTS = read_json(RECORD / "results.json")
#: Largest relative difference of what a fidelity gives over Table 8.
EQUAL = {"steady": 1e-9, "drive": 1e-9, "track": 1e-6}
NUMBERS = ("total_current", "motor_speed", "speed", "slip", "traction", "power_gear")


@pytest.mark.parametrize("name", ["steady", *(pytest.param(n, marks=pytest.mark.slow) for n in ("drive", "track"))])
def test_table8_is_as_recorded(name):
    was, robot = columns_of(RECORD / "table8.csv"), nominal()
    conditions = Conditions(
        was["configuration"].tolist(), was["supply_voltage_V"], was["slope_deg"], was["payload_kg"]
    ).resolved(robot)
    fidelity = fidelities.get_fidelity(name)
    result = fidelity.run(robot, conditions, fidelity.facts.resolved(), lambda share: None).result
    assert_array_equal(result.status, was[f"{name}_status"])
    for quantity in NUMBERS:
        expected = was[f"{name}_{quantity}"]
        size = np.nanmax(np.abs(expected))
        assert_allclose(
            getattr(result, quantity), expected, rtol=EQUAL[name], atol=EQUAL[name] * size, err_msg=quantity
        )


def _source(name):
    return name if name == "measured" else str(RECORD / f"{name}.csv")


SLOW = pytest.mark.slow
TABLES = [pytest.param(n, marks=SLOW) for n in RESULTS["loop"]]


def _found(name):
    stated = {} if name == "measured" else priors.parse_priors(RESULTS["priors"])
    return discover(tables.read_runs(_source(name)), nominal(), stated=stated)


def recorded(found):
    """What the record keeps of a result."""
    held = next(iter(found.errors_held_out.values()))[1]
    remains = found.to_json()["remains"]
    return {
        "verdict": found.verdict,
        "classes": [list(e.members) for e in found.effects],
        "unnamed": None if found.unnamed is None else [found.unnamed.balance, found.unnamed.variable],
        "remains": remains,
        "outliers": list(found.outliers),
        "chi2": list(found.chi2),
        "thresholds": {kind: e.threshold for kind, e in found.before.kinds.items()},
        "replicates": found.replicates,
        "base": {name: [p.after, p.sd_after] for name, p in found.base_shift.items()},
        "amplitudes": {
            e.name: [e.parameters["amplitude"].value, e.parameters["amplitude"].sd] for e in found.effects
        },
        "next_experiment": None if found.next_experiment is None else found.next_experiment.name,
        "rms_held_out": {channel: float(e["rms_percent"]) for channel, e in held.items()},
    }


@pytest.mark.parametrize("name", TABLES)
def test_loop_is_as_recorded(name):
    was, found = RESULTS["loop"][name], _found(name)
    assert found.verdict == was["verdict"]
    assert [list(e.members) for e in found.effects] == was["classes"]
    where = None if found.unnamed is None else [found.unnamed.balance, found.unnamed.variable]
    assert where == was["unnamed"]
    assert list(found.outliers) == was["outliers"]
    assert_allclose(found.chi2, was["chi2"], rtol=1e-3)
    for parameter, (value, sd) in was["base"].items():
        assert abs(found.base_shift[parameter].after - value) < 0.05 * sd, parameter
    for effect in found.effects:
        value, sd = was["amplitudes"][effect.name]
        assert abs(effect.parameters["amplitude"].value - value) < 0.05 * sd, effect.name
    # The bootstrap is of the same draws, so its thresholds move by rounding alone.
    for kind, threshold in was["thresholds"].items():
        assert found.before.threshold(kind) == pytest.approx(threshold, rel=0.02), kind
    proposed = None if found.next_experiment is None else found.next_experiment.name
    assert proposed == was["next_experiment"]
    for channel, rms in was["rms_held_out"].items():
        held = next(iter(found.errors_held_out.values()))[1]
        assert held[channel]["rms_percent"] == pytest.approx(rms, rel=5e-3), channel


if __name__ == "__main__":
    for table in sys.argv[1:] or RESULTS["loop"]:
        RESULTS["loop"][table] = recorded(_found(table))
        print(table, RESULTS["loop"][table]["verdict"], RESULTS["loop"][table]["classes"], flush=True)
        (RECORD / "results.json").write_text(json.dumps(RESULTS, indent=1, ensure_ascii=False), encoding="utf-8")
