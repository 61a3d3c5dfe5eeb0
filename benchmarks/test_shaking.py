"""A gear that shakes does so in MuJoCo's own C code (shaking.py)."""

import pytest


@pytest.mark.slow
def test_c_mujoco_shakes_alike():
    """Set S at 33 V, 5 deg, 8 kg: 12 000 steps in which contacts open and close. Goal a fifth, found 1e-13."""
    import shaking

    found = shaking.native(33.0, 5.0, 8.0)
    theirs, ours = found["std over mean"].values()
    assert ours > 0.5 and theirs == pytest.approx(ours, rel=1e-6)
    assert found["mean speed"]["C MuJoCo"] == pytest.approx(found["mean speed"]["MJX"], rel=1e-6)
