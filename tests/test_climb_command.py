"""The command `climb`: what it leaves, how it searches, and what it refuses."""

import jax.numpy as jnp
import numpy as np
import pytest

from calibration.data.input_errors import BadData
from calibration.data.terrains import read_sequence, read_terrain
from sweeps.commands import climb as room
from tests.commands import text_file


@pytest.mark.parametrize("header", ["x_mm,time_s,front_deg,rear_deg", "x_mm,front_deg,rear_deg,front_V,rear_V"])
def test_a_sequence_over_both_clocks_or_of_both_units_is_refused(tmp_path, header, robot):
    with pytest.raises(BadData, match=r"s\.csv: got columns \w+(, rear_V)? and \w+(, rear_deg)?; expected one kind"):
        read_sequence(
            text_file(tmp_path / "s.csv", f"{header}\n{','.join('0' * (header.count(',') + 1))}\n"),
            robot,
            (0.0, 0.0),
        )


def test_files_of_terrain_and_sequence_are_read_with_their_units(tmp_path, robot):
    ground = read_terrain(text_file(tmp_path / "t.csv", "# a kerb\nx_mm;z_mm\n100;0\n100;80\n300,5;80\n"))
    assert float(ground.finish) == pytest.approx(0.2005)
    # above it, within it, and within it where the foot of the kerb is nearest
    gaps = ground.distance(jnp.array([[0.1, 0.1], [0.1, 0.05], [0.01, -0.01]]))[0]
    assert np.asarray(gaps) == pytest.approx([0.02, -0.03, -0.01 * np.sqrt(2)])
    sequence = read_sequence(
        text_file(tmp_path / "s.csv", "x_mm,front_deg,rear_deg\n-300,45,180\n0,0,-8\n"), robot, (0.0, 0.0)
    )
    assert np.degrees(sequence.demand(-0.15, 0.0)) == pytest.approx([22.5, 86])
    assert not sequence.over_time
    sequence = read_sequence(
        text_file(tmp_path / "v.csv", "time_s,front_V,rear_V\n0,0,0\n1,6,-12\n"), robot, (0.5, 0.1)
    )
    assert np.asarray(sequence.first) == pytest.approx([0.5, np.pi - 0.1]) and sequence.over_time
    assert np.asarray(sequence.demand(0.0, 0.5)) == pytest.approx([3.0, -6.0])


FILES = {
    "millimetres": ("x_m,z_m\n0,0\n3000,120\n", r"is 3000 m large; .* is the file in millimetres\?"),
    "millimetres of a kerb": (
        "x_m,z_m\n0,0\n0,40\n",
        r"has a wall of 40 m; expected at most 5 m; is the file in millimetres\?",
    ),
    "metres": (
        "x_mm,z_mm\n0,0\n0.3,0.12\n",
        r"is 0\.3 mm large; expected at least 1 mm; is the file in metres\? Then name",
    ),
    "too large in millimetres": ("x_mm,z_mm\n0,0\n3e6,120\n", r"is 3000 m large; expected at most 50 m$"),
    "a wall that goes back": (
        "x_m,z_m\n0,0\n0,-0.05\n0,0.1\n1,0.1\n",
        r"z goes from -0\.05 back to 0\.1 m at x = 0 m",
    ),
    "no units": ("x,z\n0,0\n1,0\n", r"got columns x, z; expected x_m and z_m, or x_mm and z_mm"),
    "folds back": ("x_m,z_m\n0,0\n0.3,0.1\n0.2,0.2\n", r"x falls from 0\.3 to 0\.2 m at point 3"),
    "a word": ("x_m,z_m\n0,0\n1,high\n", r"row 2, z_m: got 'high'; expected a number"),
    "a point": ("x_m,z_m\n0,0\n", r"two points or more"),
}


@pytest.mark.parametrize("case", FILES)
def test_terrains_that_are_none_are_refused_in_one_sentence(tmp_path, case):
    text, message = FILES[case]
    with pytest.raises(BadData, match=message):
        read_terrain(text_file(tmp_path / "t.csv", text))


@pytest.mark.parametrize(
    "text, message",
    [
        ("time_s,front_deg,rear_deg\n1,0,0\n1,0,0\n", r"row 2, time_s: got 1 after 1; expected increasing values"),
        ("time_s,front_deg,rear_deg\n1,0,270\n", r"row 1, rear_deg: got 270 deg; expected -180 to 180"),
        ("time_s,front_V,rear_V\n1,0,2400\n", r"row 1, rear_V: got 2400 V; expected -1000 to 1000 V"),
        ("front_deg,rear_deg\n1,0\n", r"expected x_mm and front_deg and rear_deg, or time_s"),
    ],
)
def test_sequences_that_are_none_are_refused_in_one_sentence(tmp_path, text, message, robot):
    with pytest.raises(BadData, match=message):
        read_sequence(text_file(tmp_path / "s.csv", text), robot, (0.0, 0.0))


@pytest.mark.parametrize("limit", [87.3, 449.0, 5.0])
def test_search_ends_within_a_millimetre_of_the_largest_that_is_got_over(limit):
    rounds = []

    class Ended:
        def __init__(self, sizes):
            # beyond the limit one more is got over by chance: what lies beyond a failure does not count
            self.names = ["over" if s <= limit or abs(s - 300) < 8 else "slides" for s in sizes]

    def run(sizes):
        rounds.append(sizes)
        return sizes, Ended(sizes)

    sizes, _, chosen, tried, best = room._search_largest("step", run)
    if limit < 10:
        assert best is None and dict(tried)[10.0] == "slides"
        return
    assert limit - 1.2 <= best <= limit and sizes[chosen] == best
    assert len(rounds) <= 4 and dict(tried)[best] == "over"
