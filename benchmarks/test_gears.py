"""The study of gears: a generated log with a loss by torque gives that loss back, one without gives none."""

import json
import re
from pathlib import Path

import gears
import numpy as np
import pytest

SHELF = Path(gears.__file__).resolve().parent.parent / "docs" / "actuators"
MASS, LENGTH, C, K, J, DRY = 0.5, 0.1, 0.08, 0.03, 1.5e-3, 0.02


def write(folder, name, seed, share):
    """A swing of bam's pendulum in an XL330's raw numbers, with a share of the torque lost in both directions."""
    random, time = np.random.default_rng(seed), np.arange(0, 6, 0.005)
    rates = random.uniform(1.5, 5.0, 3)
    angle = sum(0.35 * np.sin(w * time) for w in rates)
    speed = sum(0.35 * w * np.cos(w * time) for w in rates)
    turning = -sum(0.35 * w**2 * np.sin(w * time) for w in rates)
    torque = MASS * LENGTH**2 * turning + MASS * gears.GRAVITY * LENGTH * np.sin(angle)
    way = np.sign(speed)
    volts = (torque + K * speed + J * turning + DRY * way + share * np.abs(torque) * way) / C
    raw = np.round(885 * volts / 7.4 + 5 * random.standard_normal(len(time))).astype(int)
    entries = [
        {
            "timestamp": t,
            "position": a,
            "goal_position": a,
            "input_volts": 7.4,
            "torque_enable": True,
            "load": n % 2**16,
        }
        for t, a, n in zip(time.tolist(), angle.tolist(), raw.tolist(), strict=True)
    ]
    entries[300]["position"] = -np.pi  # a lost reading
    text = {"mass": MASS, "length": LENGTH, "kp": 100, "trajectory": name, "entries": entries}
    (folder / f"{name}.json").write_text(json.dumps(text))


@pytest.mark.nightly
@pytest.mark.parametrize("page", sorted(SHELF.glob("*.md")), ids=lambda p: p.stem)
def test_an_actuator_of_the_shelf_is_what_its_robot_exports(page):
    text = page.read_text("utf-8")
    robot, drive = (text.split(f"```{kind}\n")[1].split("```")[0] for kind in ("toml", "xml"))
    ours, law = gears.actuator(robot)
    number = re.compile(r"-?\d+\.?\d*(?:e-?\d+)?")
    for made, kept in ((ours, drive), (law, "## LAW.md" + text.split("## LAW.md")[1])):
        assert number.sub("#", made).split() == number.sub("#", kept).split()
        mine, theirs = (np.array(number.findall(x), float) for x in (made, kept))
        np.testing.assert_allclose(mine, theirs, rtol=1e-3, atol=1e-7)
    assert "<dcmotor" in drive


@pytest.mark.parametrize("share", [0.0, 0.3])
def test_a_loss_by_torque_is_found_where_there_is_one(tmp_path, share):
    for k in range(4):
        write(tmp_path, f"log{k}", k, share)
    logs = [gears.read_log(p) for p in sorted(tmp_path.glob("*.json"))]
    plain, loaded = (gears.study(logs, law) for law in ("Coulomb and viscous", "load loss"))
    value = loaded["values"]["gear_load_loss"][0]
    assert value == pytest.approx(share, abs=0.02)
    assert loaded["values"]["c"][0] == pytest.approx(C, rel=0.03)
    lower = np.mean(loaded["errors"]) < 0.7 * np.mean(plain["errors"])
    assert lower == bool(share)
