"""The command `sensitivity` and its study: against finite differences and the model itself, and what is refused."""

from types import SimpleNamespace

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from calibration.inference import priors
from calibration.inference.fit_notes import remarks_with_codes
from calibration.inference.identifiability import posterior_of_coordinates
from calibration.sensitivity import uncertain_inputs as room
from calibration.sensitivity.analyse import analyse_sensitivity
from calibration.sensitivity.model import chosen_outputs
from calibration.sensitivity.result import OperatingPoints
from calibration.sensitivity.study import Study, inert_inputs, local_studies
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from sweeps.report import sensitivity_report
from sweeps.report.document import Figure
from tests.commands import read_json, schema_of
from tests.commands import rows as table
from tests.pages import outside

SCHEMA = schema_of("sensitivity")
NAMES = ("motor.torque_constant", "6T2A.track.guide_share", "4W2T.track.loss_coulomb", "motor.inductance")
SMALL = (
    "sensitivity --parameters", ",".join(NAMES), "--voltages", "24", "--payloads", "3", "--slopes", "0,5",
    "--evaluations", "3000", "--outputs", "total_current,speed",
)  # fmt: skip


@pytest.fixture(scope="module")
def study(robot):
    inputs = room.inputs_from_priors(robot, NAMES, {})
    points = OperatingPoints(
        np.array(["6T2A", "4W2T", "6T2A", "6T2A"]), np.array([24.0, 15, 33, 24]), np.array([3.0, 0, 8, 0]),
        np.array([0.0, 5, 0, 25]),
    )  # fmt: skip
    return Study(robot, inputs, points, chosen_outputs(("total_current", "speed"), robot))


# --- the study ----------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_local_derivatives_are_finite_differences_and_zero_across_configurations(study, robot):
    found, statuses = local_studies(study)
    step = 1e-6
    fields = params.parameters_by_name(robot)
    for k, name in enumerate(NAMES):
        value = float(fields[name].value)
        up, down = (
            steady_batch(params.replace(robot, {name: jnp.asarray(value * (1 + s))}), study.conditions).total_current
            for s in (step, -step)
        )
        twice = np.asarray(up - down) / (2 * step * value)
        assert_allclose(found["total_current"].derivative[:3, k], twice[:3], rtol=1e-6, atol=1e-7)
    assert np.isnan(found["total_current"].derivative[3]).all()  # it slides at 25°
    assert found["speed"].derivative[1, 1] == 0 and found["speed"].derivative[0, 2] == 0
    assert statuses == {"steady": {"converged": 3, "slides": 1}}


def test_inputs_are_those_of_the_priors(robot, study):
    coordinates = priors.parameter_coordinates(robot, NAMES)
    u = np.random.default_rng(0).uniform(size=(50, 4))
    from scipy.stats import norm

    assert_allclose(study.inputs.values(study.inputs.scores(u))[:, :4], coordinates.value(norm.ppf(u)), rtol=1e-9)


def test_values_of_a_design_compile_nothing(study, compilations):
    """In NumPy they are the same as traced, row for row."""
    unit = np.random.default_rng(1).uniform(size=(3, len(study.inputs)))
    values = study.inputs.values(study.inputs.scores(unit))
    assert isinstance(values, np.ndarray) and not compilations
    traced = jax.jit(study.inputs.values)(study.inputs.scores(unit))
    assert_allclose(values, traced, rtol=1e-9)


def test_conditions_vary_uniformly_beside_parameters(robot):
    inputs = room.inputs_from_priors(robot, NAMES[:1], {"voltage": (20.0, 28.0)})
    values = np.asarray(inputs.values(inputs.scores(np.array([[0.5, 0.25]]))))
    assert inputs.columns == (NAMES[0], "voltage")
    assert_allclose(values, [[0.0259, 22.0]], rtol=1e-3)


def test_default_inputs_are_what_has_a_prior_and_acts_here(robot):
    names = room.default_input_names(robot, ("4W2T",), battery=False)
    assert "motor.resistance" in names and "4W2T.mass" in names
    assert not any(n.startswith(("6T2A.", "battery.")) for n in names)
    assert "4W2T.track.guide_share" not in names  # it has no guides
    assert "battery.resistance" in room.default_input_names(robot, ("4W2T",), battery=True)


@pytest.mark.slow
def test_sobol_of_a_nearly_linear_study_is_its_linear_share(study):
    found = {method: analyse_sensitivity(study, method, 40_000) for method in ("local", "sobol")}
    assert sum(found["sobol"].sampled["steady"].values()) == found["sobol"].evaluations > 0
    shares = {method: of.outputs["speed"] for method, of in found.items()}
    linear, sampled = shares["local"].share[:2], shares["sobol"].at_points["total"]
    assert_allclose(sampled.value[:2], linear, atol=0.03)
    assert np.all(sampled.low[:2] <= linear + 0.01) and np.all(linear - 0.01 <= sampled.high[:2])
    assert not shares["sobol"].studied[3] and np.isnan(sampled.value[3]).all()
    (left,) = remarks_with_codes(found["local"].remarks, "points_left_out")
    assert (left.points, left.total) == (1, 4)


@pytest.mark.slow
@pytest.mark.parametrize("variances", [(0.02, 0.01), (0.01, 0.02)])
def test_inputs_of_a_posterior_that_do_nothing_are_found_whatever_their_variance(robot, study, variances):
    coordinates = priors.parameter_coordinates(robot, (NAMES[0], NAMES[3]))
    inputs = room.inputs_from_posterior(
        robot, posterior_of_coordinates(coordinates, np.zeros(2), np.diag(variances)), {}
    )
    points = OperatingPoints(*(x[:1] for x in study.points.columns().values()))
    one = Study(robot, inputs, points, chosen_outputs(("speed",), robot))
    assert_array_equal(inert_inputs(one, local_studies(one)[0], 0), [False, True])


# --- the command ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_command_leaves_indices_as_its_schema_says(mmrjax, tmp_path):
    assert mmrjax(*SMALL[:-1], "total_current,speed,steepest_slope", "--out", "s")[0] == 0
    document = read_json(tmp_path / "s/result.json")
    jsonschema.Draft202012Validator.check_schema(SCHEMA)
    jsonschema.validate(document, SCHEMA)
    assert document["evaluations"] >= 3000 and len(document["points"]) == 4
    index = document["indices"]["speed"]["motor.torque_constant"]
    assert set(index) == {"first", "total", "first_interval", "total_interval"}
    assert index["total"] > 0.5 and index["total_interval"][0] < index["total"] < index["total_interval"][1]
    assert document["inputs"]["motor.inductance"]["inert"] and document["negligible"] == ["motor.inductance"]
    rows = table(tmp_path / "s/points.csv")
    assert len(rows) == 3 * 4 * 4 and {"derivative", "elasticity", "at_low", "at_high", "total_low"} <= set(rows[0])
    assert outside(tmp_path / "s") == []


def test_an_output_that_nothing_changes_has_no_figures(monkeypatch):
    """A yaw rate beside straight travel: one without bars leaves no room for its axes."""
    shares = {"speed": np.array([0.4, 0.6]), "yaw_rate": np.zeros(2)}
    monkeypatch.setattr(sensitivity_report, "_inputs", lambda *_: "a table")
    one = {"studied": np.array([True]), "value": np.zeros(1), "row": SimpleNamespace(label=""), "second": None}
    outputs = {k: SimpleNamespace(overall_share=v, **one) for k, v in shares.items()}
    found = SimpleNamespace(outputs=outputs, comparison={}, names=("a", "b"))
    blocks = [block for section in sensitivity_report._sections(found) for block in section.blocks]
    assert [b.name for b in blocks if isinstance(b, Figure)] == ["tornado_speed"]


# --- what is refused ------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_start_outputs_are_studied_by_drive(mmrjax, tmp_path):
    code, _, _ = mmrjax(
        "sensitivity --method local --parameters motor.resistance,6T2A.ground.friction.dynamic --voltages 24 --payloads 0 --slopes 0 --configurations 6T2A --outputs start --no-report --out t",
    )  # fmt: skip
    document = read_json(tmp_path / "t/result.json")
    assert code == 0 and set(document["outputs"]) == {"peak_current", "time_to_speed", "energy_start"}
    peak, time = (document["indices"][n] for n in ("peak_current", "time_to_speed"))
    assert peak["motor.resistance"]["elasticity"][0] < -0.5  # U / R before the motor turns
    # the tracks slip as the robot starts, so that its acceleration is μ_d g whatever its mass
    assert time["6T2A.ground.friction.dynamic"]["elasticity"][0] < -0.3
