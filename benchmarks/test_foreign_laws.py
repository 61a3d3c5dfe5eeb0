"""The foreign laws of campaigns are sound physics in form: finite, linear in their amplitude, losses where they claim to be, new."""

import itertools
from types import SimpleNamespace

import numpy as np
import pytest
from worlds import foreign as f
from worlds import histories, laws, settled

LAWS = f.FOREIGN | f.FOREIGN_SERIES


KNOWN = laws.LIBRARY | laws.VARIANTS | laws.OUTSIDE


TABLE = settled.table8()


INSTRUMENTS = settled.Instruments()


def shapes(law, values):
    """Every shape on a grid over its bounds."""
    axes = [np.linspace(*bounds, values) for bounds in law.shapes.values()]
    return [dict(zip(law.shapes, map(float, point), strict=True)) for point in itertools.product(*axes)]


def middle(law):
    return {k: (low + high) / 2 for k, (low, high) in law.shapes.items()}


def experiments():
    """Further experiments: every way of setting up either configuration, down slopes too."""
    voltages = {"stall": (1.0, 2.0)}
    return [
        SimpleNamespace(
            name=how, setup=SimpleNamespace(__name__=setup), configuration=wheeled, sides=None, brake=0.06,
            voltage=voltages.get(how, (15.0, 24.0, 33.0)), payload=np.zeros(len(voltages.get(how, (0, 0, 0)))),
            slope=np.array((-10.0, 0.0, 10.0))[: len(voltages.get(how, (0, 0, 0)))],
        )
        for setup, how in settled.HOW.items()
        for wheeled in (0, 1)
    ]  # fmt: skip


def signature(name, law, q, share=1e-3):
    term = laws.Term(name, share * law.size, q, law)
    return settled.signature(TABLE, settled.CLIMBING, [term], INSTRUMENTS) / share


def test_count_and_names():
    assert len(f.FOREIGN) == 20
    assert len(f.FOREIGN_SERIES) == 10
    assert not set(LAWS) & (set(laws.FORMS) | set(laws.SERIES))
    assert all(law.cls == "" and law.size > 0 for law in LAWS.values())
    balances = {law.balance for law in f.FOREIGN.values()}
    assert balances >= {"supply", "electrical", "motor", "gearbox", "track", "ground", "slip"}
    assert set(f.DISSIPATIVE) <= set(f.FOREIGN)
    assert set(f.DISSIPATIVE_SERIES) <= set(f.FOREIGN_SERIES)


@pytest.mark.parametrize("name", f.FOREIGN)
def test_finite(name):
    """On the whole table at ordinary size, and faintly in every further experiment, standstill and descent included."""
    law = f.FOREIGN[name]
    for q in shapes(law, 3):
        for share in (1e-3, 1.0):
            y, sound = settled.readings(TABLE, settled.CLIMBING, [laws.Term(name, share * law.size, q, law)])
            assert np.isfinite(y).all() and sound.all()
    term = laws.Term(name, 1e-3 * law.size, middle(law), law)
    for run in experiments():
        before, well = settled.carried_out(run, settled.CLIMBING)
        after, sound = settled.carried_out(run, settled.CLIMBING, [term])
        assert np.isfinite(after[sound]).all()
        np.testing.assert_array_equal(sound, well)
        assert np.abs(after - before)[sound].max(initial=0) < 1.0


@pytest.mark.parametrize("name", f.FOREIGN)
def test_linear_in_its_amplitude(name):
    law = f.FOREIGN[name]
    for q in shapes(law, 3):
        one, two = (signature(name, law, q, share) for share in (1e-4, 2e-4))
        assert np.linalg.norm(one) > 1  # it shows
        assert np.linalg.norm(two - one) < 2e-3 * np.linalg.norm(one)


@pytest.mark.parametrize("name", f.DISSIPATIVE)
def test_losses_take(name):
    """Climbing, level and downhill: what is lost has the sign of a loss wherever the motor drives."""
    law = f.FOREIGN[name]
    for c in (TABLE, settled.table8(slopes=(-10.0, -5.0, -2.0))):
        s, sound = settled.solve(c, settled.CLIMBING)
        driving = sound & (s.I > 0)
        assert driving.sum() > 20
        for q in shapes(law, 5):
            assert (law.of(s, q) * np.ones_like(s.I) >= 0)[driving].all()


def test_like_no_known_law():
    def unit(v):
        return v / np.linalg.norm(v)

    known = [
        (name, signature(name, law, q))
        for name, law in KNOWN.items()
        for q in shapes(law, 7 if name in laws.OUTSIDE else 4)
    ]
    known = [(name, unit(v)) for name, v in known if np.linalg.norm(v) > 0]
    for name, law in f.FOREIGN.items():
        for q in shapes(law, 5):
            mine = unit(signature(name, law, q))
            cos, other = max((abs(float(mine @ v)), known_as) for known_as, v in known)
            assert cos < 0.999, f"{name} {q} looks like {other}"


def test_unlike_each_other():
    units = {}
    for name, law in f.FOREIGN.items():
        rows = np.array([signature(name, law, q) for q in shapes(law, 4)])
        units[name] = rows / np.linalg.norm(rows, axis=1, keepdims=True)
    for a, b in itertools.combinations(units, 2):
        assert np.abs(units[a] @ units[b].T).max() < 0.999, f"{a} looks like {b}"


def test_series_losses_take():
    rng = np.random.default_rng(0)
    n = 500
    w = rng.uniform(-300, 1300, n)
    s = SimpleNamespace(
        I=rng.uniform(-3, 50, n), w=w, w_k=w / 48, V=0.038 * w / 48, V_teor=0.038 * w / 48, r=0.038, i=48.0, R=0.6,
        d=np.sign(w), theta=rng.uniform(-50, 2000, n), T=rng.uniform(0, 20, n), q=rng.uniform(0, 2, n),
        time=rng.uniform(0, 3, n), wheeled=rng.integers(0, 2, n), C_b=0.0 * w, z=0.0 * w, battery=0.0 * w,
    )  # fmt: skip
    for name in f.DISSIPATIVE_SERIES:
        law = f.FOREIGN_SERIES[name]
        flow = s.I if law.balance in ("supply", "electrical") else w
        for q in shapes(law, 3):
            assert (law.of(s, q) * flow >= 0).all()


def test_a_seam_gives_back_what_it_takes():
    law, r = f.FOREIGN_SERIES["floor_seam"], 0.038
    theta = np.linspace(0, 1.0, 20001) / r * 48
    force = law.of(SimpleNamespace(r=r, i=48.0, theta=theta), {"at": 0.15})
    assert abs(np.trapezoid(force, r * theta / 48)) < 1e-3 * np.trapezoid(abs(force), r * theta / 48)


@pytest.mark.slow
def test_histories():
    """All laws, known ones too, as one batch of starts, each alone in its six runs at ordinary size: finite and new."""
    every = f.FOREIGN_SERIES | laws.SERIES
    six, members = histories.starts(settled.CLIMBING), 1 + len(every)
    wide = six.at(np.tile(np.arange(6), members))
    owner = np.arange(6 * members) // 6
    terms = [
        laws.Term("", np.where(owner == k, law.size, 0.0), middle(law), law)
        for k, law in enumerate(every.values(), 1)
    ]
    times, y = histories.histories(wide, 0.9, 0.02, settled.CLIMBING, terms)
    assert y.shape == (3, 6 * members, len(times))
    assert np.isfinite(y).all()
    assert (y[1, :, -1] > 0).all()  # every robot still drives
    white = (y * settled.SHOWN[:, :, None] / INSTRUMENTS.stated[:, None, None]).reshape(3, members, -1)
    change = np.moveaxis(white[:, 1:] - white[:, :1], 1, 0).reshape(members - 1, -1)
    left = np.linalg.norm(change, axis=1)
    mine = len(f.FOREIGN_SERIES)
    assert (left[:mine] > 3).all(), dict(zip(every, left, strict=True))  # each shows
    units = change / np.maximum(left, 1e-9)[:, None]  # `battery_sag` does not show off the battery
    cos = np.abs(units[:mine] @ units.T) - np.eye(mine, len(every))
    assert cos.max() < 0.99, [list(every)[k] for k in np.unravel_index(cos.argmax(), cos.shape)]
