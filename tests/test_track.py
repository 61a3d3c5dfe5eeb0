"""Track losses, eqs. (24), (26)."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import paper

from mmrjax.model.contact import Track

RNG = np.random.default_rng(24)


@pytest.mark.parametrize("sign", [-1.0, 0.0, 1.0])
def test_track_laws_match_reference(sign):
    for _ in range(50):
        M0, K, mu, share, size, normal = RNG.uniform((0, 0, 0, 0, 0, 10), (1, 0.1, 1, 1, 30, 200))
        track = Track(loss_coulomb=M0, loss_viscous=K, guide_friction=mu, guide_share=share)
        w = sign * size
        assert_allclose(track.torque_loss(w, sign), paper.track_loss(w, M0, K, sign), rtol=1e-9)
        expected = paper.guide_force(share * normal, mu, sign)
        assert_allclose(track.force_guide(normal, sign), expected, rtol=1e-9)


def test_track_loss_of_three_and_one_is_table3(robot):
    # 350 + 16 ω and 70 + 3 ω mN·m at 20 rad/s
    assert_allclose(robot.configurations["6T2A"].track.torque_loss(20.0, 1.0), 0.670, rtol=1e-12)
    assert_allclose(robot.configurations["4W2T"].track.torque_loss(20.0, 1.0), 0.130, rtol=1e-12)
