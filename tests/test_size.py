"""Sizing: what a search finds meets the requirements, no grid is better, what binds, and what is refused."""

import itertools
import math

import jax
import jax.numpy as jnp
import jsonschema
import numpy as np
import pytest
from numpy.testing import assert_allclose

from calibration.data import requirements_file, robot_file
from calibration.sizing import design_search, sheet
from calibration.sizing.design import build_robot, build_sizing_task, evaluate_design
from calibration.sizing.part_options import (
    BELT_STAGE,
    MOTOR,
    drive_options,
    options_for_robot,
    packaged_sheets,
)
from mmrjax.derived.requirements import QUANTITIES
from mmrjax.model import params
from sweeps.report.check_report import design_verdict
from tests.commands import command, read_json, schema_of

SCHEMA = schema_of("size")
TEXT = """
speed_m_s = 0.9
payload_kg = 8
endurance_min = { least = 100, duty = "driving", share = 0.5, slope_deg = 0 }
winding_C = "rated"
[envelope]
payload_kg = [0, 8]
slope_deg = [0, 10]
state_of_charge = [0.1, 1]
"""


#: The same without what takes a search or an integral at every design.
FEW = "".join(line for line in TEXT.splitlines(True) if not line.startswith(("payload_kg = 8", "endurance_min")))


@pytest.fixture(
    scope="module", params=[pytest.param(FEW, id="few"), pytest.param(TEXT, id="all", marks=pytest.mark.slow)]
)
def text(request):
    return request.param


@pytest.fixture(scope="module")
def asked(text):
    return requirements_file.parse_requirements(text, "r.toml")


@pytest.fixture(scope="module")
def found(robot, asked):
    return design_search.size_robot(robot, asked, ("mass",))


@pytest.fixture(scope="module")
def folder(text, tmp_path_factory):
    """What the command leaves, for a front of two."""
    path = tmp_path_factory.mktemp("runs")
    (path / "r.toml").write_text(text)
    assert command(["size", path / "r.toml", "--pareto", "mass,energy", "--out", path / "run"]) == 0
    return path / "run"


def space(robot, asked, found):
    of = build_sizing_task(robot, asked, found.options)
    return of, design_search.enumerate_choices(robot, of, found.options)


def meets(f, asked):
    """Whether a design meets every requirement. Each is a structure of its own to compile."""
    outcomes = sheet.check_requirements(f.robot, asked, changes=False)
    assert all(o.met for o in outcomes), (f, outcomes)
    assert f.robot.chassis(0).mass == pytest.approx(f.objectives["mass"])


@pytest.mark.slow
def test_alternatives_meet_every_requirement(asked, found):
    for f in found.alternatives[:3]:
        meets(f, asked)


@pytest.mark.slow
def test_best_is_of_the_sheets(found):
    """A ratio that is made, with a gearbox that its source combines with the motor, whole cells."""
    for f in (found.best, *found.alternatives):
        made = [
            g.ratio * BELT_STAGE
            for g in packaged_sheets("gearboxes")
            if (g.family, g.stages) == (f.drive.family, f.drive.stages)
        ]
        assert f.ratio == pytest.approx(min(made, key=lambda r: abs(r - f.ratio)), rel=1e-12)
        assert f.drive.family in f.drive.motor.gearboxes
        assert f.parallel == pytest.approx(round(f.parallel), abs=1e-9)
    assert {m.name for m in packaged_sheets("motors") if m.gearboxes} == set(found.motors) and found.unmeetable == ()
    assert found.ideal.objectives["mass"] <= found.best.objectives["mass"]


@pytest.mark.slow
def test_no_design_of_a_grid_is_lighter(robot, asked, found):
    """20 000 of the lightest choices, their ratio, radius and cells in parallel on a grid."""
    of, choice = space(robot, asked, found)
    rows = np.random.default_rng(1).choice(len(choice.drive), 160, replace=False)
    ideal = found.ideal
    own = [
        k for k in range(len(choice.drive))
        if found.options.drives[choice.drive[k]] == ideal.drive and found.options.cells[choice.cell[k]] == ideal.cell
    ]  # fmt: skip
    rows = np.unique(np.concatenate([rows, own]))
    box = np.stack(np.meshgrid(*(np.linspace(0, 1, k) for k in (6, 5, 8)), indexing="ij"), -1).reshape(-1, 3)
    every = np.repeat(rows, len(box))
    x = choice.low[every] + (choice.high[every] - choice.low[every]) * np.tile(box, (len(rows), 1))
    f, g = design_search.evaluate_designs(of, choice, every, x)
    good = np.all(g >= 0, axis=1)
    assert good.sum() > 20 and f[good, 0].min() >= ideal.objectives["mass"]


@pytest.mark.slow
def test_binding_limits_are_why_it_is_no_lighter(robot, asked, found):
    """The ideal is at a limit, and fewer cells in parallel or fewer in series violate one."""
    ideal = found.ideal
    assert ideal.binds and all(
        -1e-9 <= ideal.margins[label] < design_search.BINDS for label in ideal.binds if label in ideal.margins
    )
    of, choice = space(robot, asked, found)
    (row,) = (
        k for k in range(len(choice.drive))
        if found.options.drives[choice.drive[k]] == ideal.drive
        and found.options.cells[choice.cell[k]] == ideal.cell and choice.in_series[k] == ideal.in_series
    )  # fmt: skip
    x = np.log([[ideal.ratio, ideal.radius, ideal.parallel * 0.97]])
    assert design_search.evaluate_designs(of, choice, np.array([row]), x)[1].min() < 0


def test_paper_parts_make_the_papers_robot(robot, asked):
    """Its own motor, gearbox, ratio, radius and cells give back its numbers. The sheet's where the paper's are others."""
    chosen = options_for_robot(robot)
    of = build_sizing_task(robot, asked, chosen)
    choice = design_search.enumerate_choices(robot, of, chosen)
    name = next(
        d for d in range(len(chosen.drives)) if chosen.drives[d].motor.name == MOTOR and chosen.drives[d].stages == 2
    )
    row = next(
        k for k in range(len(choice.drive)) if (choice.drive[k], choice.cell[k], choice.in_series[k]) == (name, 0, 8)
    )
    x = np.log([[48.0, float(robot.chassis(0).radius), 1.0]])
    design = jax.tree.map(lambda v: v[0], choice.designs(np.array([row]), x))
    made, _ = build_robot(of.robot, of.base_mass, of.configuration, design)
    own = {p.name: float(p.value) for p in params.walk_parameters(robot)}
    other = {p.name: float(p.value) for p in params.walk_parameters(made)}
    assert {n for n in own if not math.isclose(own[n], other[n], rel_tol=1e-9)} == set()


@pytest.mark.slow
def test_command_leaves_what_its_schema_says(folder):
    result = read_json(folder / "result.json")
    jsonschema.validate(result, SCHEMA)
    assert "NaN" not in (folder / "result.json").read_text()
    front = [(f["objectives"]["mass"], f["objectives"]["energy"]) for f in result["pareto"]]
    assert len(front) > 1 and front == sorted(front) and all(a[1] > b[1] for a, b in itertools.pairwise(front))
    assert result["best"]["objectives"]["mass"] == pytest.approx(front[0][0])
    assert all(r["met"] for r in result["requirements"])
    sized = robot_file.load_robot(str(folder / "robot.toml"))
    assert sized.gearbox.ratio == pytest.approx(result["best"]["ratio"])
    assert sized.battery.cells == result["best"]["cells"]
    assert (
        command(
            [
                "check",
                folder / "requirements.toml",
                "--robot",
                folder / "robot.toml",
                "--out",
                folder.parent / "again",
                "--no-report",
            ]
        )
        == 0
    )


@pytest.mark.slow
def test_what_no_parts_meet_is_left_out_and_said(robot):
    asked = requirements_file.parse_requirements(
        "speed_m_s = 0.5\nslope_deg = 20\n[envelope]\nstate_of_charge = [0.1, 1]", "r.toml"
    )
    found = design_search.size_robot(robot, asked, ("mass",), motors=(MOTOR,))
    assert found.unmeetable == ("steepest slope held",) and found.best is not None
    assert [design_verdict(f, found.unmeetable) for f in (found.best, *found.motors.values())] == [
        "meets the others"
    ] * 2
    assert design_verdict(found.best, ()) == "meets"
    assert set(found.motors) == {MOTOR} and len(drive_options((MOTOR,))) == 3


@pytest.mark.slow
def test_step_that_is_asked_for_decides_the_design(robot):
    """Smaller pulleys stand on higher steps: 290 mm without payload takes 3/4 of the robot's, with which it does 270."""
    text = "speed_m_s = 0.5\nstep_mm = { least = 290, payload_kg = 0 }\n[envelope]\nstate_of_charge = [0.1, 1]"
    asked = requirements_file.parse_requirements(text, "r.toml")
    best = design_search.size_robot(robot, asked, ("mass",), motors=(MOTOR,)).best
    meets(best, asked)
    assert 0.6 <= best.radius / float(robot.radius_pulley) < 0.75


@pytest.mark.quick(2)
@pytest.mark.parametrize("name", sorted(QUANTITIES))
def test_ratings_of_parts_are_asked_somewhere_whatever_else_is(robot, name):
    """Of a robot that only has to turn, climb or be light too."""
    limit = {"endurance_min": '{ least = 9, duty = "driving" }', "stairs_rise_mm": "{ least = 9, tread_mm = 290 }"}
    of = build_sizing_task(
        robot,
        requirements_file.parse_requirements(f"{name} = {limit.get(name, 9)}", "r.toml"),
        options_for_robot(robot),
    )
    assert all(rows for _, rows in of.demands) and of.demands and of.travelling


@pytest.mark.slow
def test_margins_are_differentiable(robot, asked, found):
    of, choice = space(robot, asked, found)
    f = found.best
    row = next(k for k in range(len(choice.drive)) if found.options.drives[choice.drive[k]] == f.drive)
    x = np.log([[f.ratio * 1.01, f.radius * 0.97, f.parallel * 1.1]])
    design = jax.tree.map(lambda v: v[0], choice.designs(np.array([row]), x))

    @jax.jit
    def margins(x):
        objectives, g = evaluate_design(of, type(design)(x, design.drive, design.cell, design.cells))
        return jnp.concatenate([objectives[:2], g])

    exact = np.asarray(jax.jacrev(margins)(jnp.asarray(x[0])))
    for k in range(3):
        step = 1e-5 * np.eye(3)[k]
        difference = (np.asarray(margins(x[0] + step)) - np.asarray(margins(x[0] - step))) / 2e-5
        assert_allclose(exact[:, k], difference, rtol=1e-3, atol=1e-5)
