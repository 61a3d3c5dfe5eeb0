"""Pictures of the track model, and its MJCF in MuJoCo's viewer."""

from types import SimpleNamespace

import jax
import numpy as np
import pytest
from PIL import Image

from mmrjax.fidelities.track import _simulate_batch
from mmrjax.model.conditions import Conditions
from mmrjax.undercarriage.rendering import render, scene_of_run

RUNS = Conditions(voltage=[33.0, 24.0, np.nan], slope_deg=np.degrees(0.1), configuration=[0, 1, 0])


def _member(runs, k):
    """Run `k` of a batch, of the track model's or in closed form."""
    if isinstance(runs, SimpleNamespace):
        return SimpleNamespace(**{name: _member(value, k) for name, value in vars(runs).items()})
    return jax.tree.map(lambda x: x[k], runs)


def rolling():
    """Runs in closed form, in the shapes of the track model's: 0.9 m/s with equal loads. The last has no numbers."""
    time = np.tile(1e-3 * np.arange(1, 41), (3, 1))
    way, wheel = 0.9 * time, 0.9 * time / 0.05
    q = np.stack([way, 0.05 + 0 * time, 0 * time, wheel, wheel], -1)
    q[2] = np.nan
    names = ("total_current", "speed", "speed_theoretical", "traction", "resistance", "mass")
    grousers = np.broadcast_to(0.035 * np.arange(24), (3, 40, 24))
    reactions = SimpleNamespace(
        place=(grousers + way[..., None]) % 0.84, grouser=5 + 0 * grousers, guided=1 + 0 * grousers,
        support=np.full((3, 40, 2), 30.0),
    )  # fmt: skip
    return SimpleNamespace(
        time=time, q=q, reactions=reactions, signals=SimpleNamespace(**dict.fromkeys(names, 10 + 0 * time))
    )


KINDS = ["rolling", pytest.param("track", marks=pytest.mark.slow)]


@pytest.fixture(scope="module", params=KINDS)
def scenes(request, robot):
    runs = rolling() if request.param == "rolling" else _simulate_batch(robot, RUNS, 0.04, 1e-4, 1e-3, True)

    def one(k):
        return scene_of_run(robot, jax.tree.map(lambda x: x[k], RUNS), _member(runs, k))

    return one


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 1])
def test_picture_shows_robot_and_forces(scenes, tmp_path, k):
    file = render(scenes(k), tmp_path / "robot.png", 0.03)
    with Image.open(file) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    for colour in ((0x5B, 0x8D, 0xB8), (0xD1, 0x49, 0x5B), (0x2E, 0x93, 0x3C)):  # body, reactions, traction
        assert (np.abs(pixels - colour).sum(axis=1) < 90).sum() > 50


@pytest.mark.parametrize(
    "name, time, message",
    [
        ("robot.bmp", 0.0, "file: got robot.bmp; expected a name that ends in .png"),
        ("robot.png", 5.0, "time: got 5 s; expected a time within the run, 0 to 0.04 s"),
    ],
)
def test_what_cannot_be_written_is_refused(scenes, tmp_path, name, time, message):
    with pytest.raises(ValueError, match=message):
        render(scenes(0), tmp_path / name, time)


def test_failed_run_is_not_drawn(scenes):
    with pytest.raises(ValueError, match="not finite"):
        scenes(2)
