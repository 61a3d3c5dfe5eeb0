"""Readings over time on a page: data of the interactive figure, residuals, and figures for phones."""

import json

import numpy as np
from numpy.testing import assert_allclose

from mmrjax.model import channels
from sweeps.pages import figure_style
from sweeps.pages.comparison_figures import POINTS, time_overlay
from sweeps.report import page_renderer as page

SPEED, CURRENT = channels.find_channel("motor_speed"), channels.find_channel("motor_current")


def overlay(rows=200, offset=(1.0, 5.0)):
    """Two recordings, their rows shuffled. The simulated speed is off by a constant of each, a current is missing."""
    time = np.tile(np.linspace(0.0, 10.0, rows), 2)
    run = np.repeat(["a", "b"], rows)
    measured = 100 * np.sin(time)
    table = {
        "run_id": run, "time_s": time, SPEED.column: measured, CURRENT.column: np.full(2 * rows, np.nan),
        f"simulated_{SPEED.column}": measured + np.where(run == "a", *offset),
        f"simulated_{CURRENT.column}": np.zeros(2 * rows),
    }  # fmt: skip
    order = np.random.default_rng(0).permutation(2 * rows)
    return time_overlay({k: v[order] for k, v in table.items()}, [SPEED, CURRENT], {"simulated_": "simulated"})


def test_the_run_with_the_largest_residuals_comes_first():
    made = overlay()
    data = json.loads(made.to_json())
    assert list(data["runs"]) == ["b", "a"] and list(json.loads(overlay(offset=(5.0, 1.0)).to_json())["runs"]) == [
        "a",
        "b",
    ]
    assert [c["label"] for c in data["channels"]] == [SPEED.label]  # a channel without readings is left out
    time, ((measured, simulated),) = data["runs"]["b"]["time"], data["runs"]["b"]["channels"]
    assert np.all(np.diff(time) > 0)
    assert_allclose(np.subtract(simulated, measured), 5.0, atol=1e-3)


def test_static_figure_shows_simulated_less_measured():
    with figure_style.figure_settings():
        above, below = overlay().draw().axes
    assert_allclose(below.lines[-1].get_ydata(), 5.0)
    assert above.get_title(loc="left") == "run b" and above.get_ylabel() == figure_style.axis_label(SPEED)


def test_long_recordings_are_thinned_but_keep_their_spikes():
    made = overlay(rows=40_000)
    spike = made.rows["b"][12_345]
    made.table[SPEED.column][spike] = 1e4
    text = made.to_json()
    readings = json.loads(text)["runs"]["b"]["channels"][0][0]
    assert max(readings) == 1e4 and len(readings) < POINTS and len(text) < 700_000


def test_a_missing_reading_is_null():
    made = overlay()
    made.table[SPEED.column][made.rows["b"][3]] = np.nan
    assert json.loads(made.to_json())["runs"]["b"]["channels"][0][0][3] is None


def test_a_colour_scale_is_not_inverted_in_the_dark(tmp_path):
    album = page.FigureAlbum(tmp_path)

    def draw(scale):
        fig, grid = figure_style.new_figure(1, 1, 2.0)
        grid[0, 0].imshow(np.eye(2)) if scale else grid[0, 0].plot([0, 1])
        return fig

    for name, scale in {"map": True, "line": False}.items():
        album.add(name, lambda scale=scale: draw(scale))
    first_tags = {name: picture.split(">")[0] for name, picture in album.pictures.items()}
    assert 'class="scale"' in first_tags["map"] and 'class="scale"' not in first_tags["line"]
