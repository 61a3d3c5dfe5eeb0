# ruff: noqa: E402 (double precision is set before anything is imported)
"""The paper remade by `mmrjax reproduce`: complete, offline, true to the paper's tables and to the model's numbers."""

import dataclasses

import jax

jax.config.update("jax_enable_x64", True)

import numpy as np
import pytest
from commands import command
from numpy.testing import assert_allclose
from pages import Tables, drawn, outside

from mmrjax.effects import BY_NAME
from mmrjax.model import params
from mmrjax.model.paper_tables import TRACKED, WHEELED
from sweeps.paper import data

FIGURES = {
    "fig28_current_over_slope",
    "fig29_model_errors",
    "fig23_24_from_standstill",
    "fig05a_gearbox_efficiency",
    "fig10_battery",
    "fig11_motor_friction",
    "fig18_idle_track",
}


@pytest.fixture(scope="module")
def reproduced(tmp_path_factory):
    """A function that runs the command and returns its exit code and folder."""

    def of(*arguments):
        folder = tmp_path_factory.mktemp("reproduced") / "p"
        return command(["reproduce", "--out", folder, *arguments]), folder

    return of


@pytest.fixture(scope="module")
def paper(reproduced):
    """Folder, page and tables of the nominal robot's."""
    code, folder = reproduced()
    assert code == 0
    page = (folder / "report.html").read_text(encoding="utf-8")
    return folder, page, Tables(page)


@pytest.mark.slow
def test_page_has_every_figure_and_refers_to_nothing_outside(paper):
    folder, page, _ = paper
    assert drawn(page) == FIGURES == {p.stem for p in (folder / "figures").glob("*.svg")}
    assert outside(folder) == []
    assert 'id="gear"' not in page and "#gear" not in page  # it is not resolved by this fidelity
    assert (folder / "report.html").stat().st_size < 5e6


@pytest.mark.slow
def test_robot_of_another_kind_is_shown_and_not_set_against_the_bench(reproduced, tmp_path, capsys):
    (tmp_path / "crawler.toml").write_text('configurations = ["crawler"]\n[crawler]\nlike = "6T2A"\n')
    code, folder = reproduced("--robot", tmp_path / "crawler.toml")
    assert code == 0
    assert (
        "the paper's runs use the configurations 6T2A, 4W2T; this robot has none of them" in capsys.readouterr().err
    )
    page = (folder / "report.html").read_text()
    assert drawn(page) == FIGURES - {"fig28_current_over_slope", "fig29_model_errors"}
    assert "Against the bench" not in page and not (folder / "rows.csv").exists()


@pytest.mark.slow
def test_raised_adhesion_makes_every_measured_row_climb(robot):
    rows = data.simulate_measured_rows(robot)
    assert (rows.plain["status"] == "slides").sum() == 6
    assert (rows.raised["status"] == "converged").all()
    assert rows.ratio["6T2A"] * 0.32 == pytest.approx(0.45) and rows.ratio["4W2T"] * 0.38 == pytest.approx(0.60)


def test_raised_adhesion_leaves_a_robot_that_climbs_alone(robot):
    values = {f"{c}.ground.friction.static": 0.9 for c in (TRACKED, WHEELED)}
    rows = data.simulate_measured_rows(params.replace(robot, values))
    assert rows.ratio == {"6T2A": 1.0, "4W2T": 1.0}


@pytest.mark.slow
def test_energy_split_sums_to_the_supply(robot):
    effects = (BY_NAME["series_resistance"](amplitude=0.4), BY_NAME["churning"](amplitude=1e-3))
    for member in (robot, dataclasses.replace(robot, effects=effects)):
        kind = np.array(["6T2A", "4W2T", "6T2A"])
        points, split = data.energy_split(
            member, data.batch_conditions(member, kind, slope_deg=np.array([0.0, 10.0, 10.0]))
        )
        assert all((split[item] >= 0).all() for item in data.SPLIT)
        assert_allclose(split["other"] / points["power_supply_W"], 0, atol=1e-9)


def test_idle_current_balances_the_losses_by_hand(robot):
    speed = np.array([5.0, 20.0])
    motor = speed * 48.0
    for kind, coulomb, viscous in (("6T2A", 0.350, 0.016), ("4W2T", 0.070, 0.003)):
        at_motor = (coulomb + viscous * speed) / 48.0 / 0.74 + 0.3e-3 + 1.4e-6 * motor + 2.7e-3 + 5.5e-7 * motor
        found = data.idle_current(robot, kind, speed)
        assert_allclose(found, at_motor / 25.9e-3, rtol=1e-9)


@pytest.mark.slow
def test_stages_follow_the_slide(robot):
    for start in data.simulate_starts(robot):
        assert 0 < start.stages.starting < start.stages.slipping < start.time[-1]
        sliding = start.theoretical - start.speed
        assert np.all(sliding[start.time > start.stages.slipping] <= 20.0 + 1e-6)  # V_s [mm/s]
        assert sliding[np.searchsorted(start.time, start.stages.starting)] == sliding.max()
