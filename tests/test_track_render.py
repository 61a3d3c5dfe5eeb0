"""Pictures and film of the track model, and its MJCF in MuJoCo's viewer."""

import importlib.util

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from PIL import Image

from mmrjax.conditions import Conditions
from mmrjax.fidelities.track import _batch
from mmrjax.render import render, scene

RUNS = Conditions(voltage=jnp.asarray([33.0, 24.0, np.nan]), slope_deg=np.degrees(0.1), configuration=[0, 1, 0])


@pytest.fixture(scope="module")
def scenes(robot):
    runs = _batch(robot, RUNS, 0.04, 1e-4, 1e-3, True)

    def one(k):
        return scene(robot, *(jax.tree.map(lambda x: x[k], tree) for tree in (RUNS, runs)))

    return one


@pytest.mark.slow
@pytest.mark.parametrize("k", [0, 1])
def test_picture_shows_robot_and_forces(scenes, tmp_path, k):
    file = render(scenes(k), tmp_path / "robot.png", begin=0.03)
    with Image.open(file) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3).astype(int)
    for colour in ((0x5B, 0x8D, 0xB8), (0xD1, 0x49, 0x5B), (0x2E, 0x93, 0x3C)):  # body, reactions, traction
        assert (np.abs(pixels - colour).sum(axis=1) < 90).sum() > 50


@pytest.mark.slow
def test_gif_moves(scenes, tmp_path):
    file = render(scenes(0), tmp_path / "robot.gif", begin=0.02, end=0.034, slow=10, rate=20)
    with Image.open(file) as film:
        assert film.n_frames == 3
        first = np.asarray(film.convert("RGB")).astype(int)
        film.seek(2)
        last = np.asarray(film.convert("RGB")).astype(int)
    assert (np.abs(last - first).sum(axis=-1) > 60).mean() > 1e-3


@pytest.mark.skipif(importlib.util.find_spec("imageio_ffmpeg") is None, reason="the extra `video` is not installed")
def test_mp4_is_written(scenes, tmp_path):
    file = render(scenes(1), tmp_path / "robot.mp4", begin=0.02, end=0.03, slow=10, rate=20)
    assert file.read_bytes()[4:8] == b"ftyp"


@pytest.mark.parametrize(
    "name, begin, message",
    [
        ("robot.bmp", 0.0, "file: got robot.bmp; expected a name that ends in .png, .gif, .mp4"),
        ("robot.gif", 5.0, "begin, end: got 5 to 0.04 s"),
    ],
)
def test_what_cannot_be_written_is_refused(scenes, tmp_path, name, begin, message):
    with pytest.raises(ValueError, match=message):
        render(scenes(0), tmp_path / name, begin=begin)


def test_failed_run_is_not_drawn(scenes):
    with pytest.raises(ValueError, match="not finite"):
        scenes(2)
