"""Effects from a user's file: usable by name, and refused in one sentence."""

from pathlib import Path

import numpy as np
import pytest

from calibration.data import effect_file, robot_file
from calibration.data.errors import BadConfiguration
from mmrjax import params
from mmrjax.conditions import Conditions
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch

GOOD = '''
from typing import ClassVar
from mmrjax.effects import Effect
from mmrjax.params import Scalar, parameter
from mmrjax.signals import Signals


class SealDrag(Effect):
    """ΔM_t = a: a seal that drags. Source: none, an example."""

    name: ClassVar[str] = "seal_drag"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0, unit="N·m", meaning="drag of the seal", bounds=(-1.0, 1.0), sd=0.1, source="example", amplitude=True
    )

    def term(self, robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.direction
'''


def written(tmp_path, text, name="mine.py"):
    path = tmp_path / name
    path.write_text(text)
    return path


def test_user_effect_is_usable_by_name_in_a_robot_file(tmp_path):
    library = effect_file.library([written(tmp_path, GOOD)])
    assert list(library) == [*BY_NAME, "seal_drag"] and "seal_drag" not in BY_NAME
    path = tmp_path / "robot.toml"
    path.write_text("[effects.seal_drag]\namplitude = 0.05\n")
    robot = robot_file.load(str(path), library)
    more = params.replace(robot_file.load("nominal"), {"6T2A.track.loss_coulomb": 0.4})
    run = Conditions(voltage=[15.0])
    got, expected = (steady_batch(r, run).reading.total_current for r in (robot, more))
    np.testing.assert_allclose(got, expected, rtol=1e-10)
    robot_file.write(robot, tmp_path / "again.toml")
    again = robot_file.load(str(tmp_path / "again.toml"), library)
    assert float(again.effects[0].amplitude) == 0.05


def test_robot_file_without_the_users_library_says_so(tmp_path):
    path = tmp_path / "robot.toml"
    path.write_text("[effects.seal_drag]\namplitude = 0.05\n")
    with pytest.raises(BadConfiguration, match=r"effects\.seal_drag: no such effect"):
        robot_file.load(str(path))


REFUSED = {
    "code fails": ("import nothing_of_this_name", r"mine\.py: its code fails \(ModuleNotFoundError"),
    "syntax": ("def (", r"mine\.py: its code fails \(SyntaxError"),
    "no effect": ("x = 1", r"mine\.py: holds no effect; expected a class derived from mmrjax\.effects\.Effect$"),
    "no term": (GOOD.replace("def term", "def other"), r"holds no effect; .*; SealDrag defines no term"),
    "no name": (GOOD.replace('    name: ClassVar[str] = "seal_drag"\n', ""), r"mine\.py, SealDrag, name: got None"),
    "name": (GOOD.replace('"seal_drag"', '"seal drag"'), r"name: got 'seal drag'; expected lower-case words"),
    "name taken": (GOOD.replace('"seal_drag"', '"churning"'), r"name: churning is taken; choose another"),
    "balance": (GOOD.replace('"track"', '"trak"'), r"balance: got trak; did you mean track\? allowed: mass,"),
    "channel": (GOOD.replace('"track"', '"sensor"'), r"channel: got ''; expected one of total_current, motor_speed"),
    "dissipative": (GOOD.replace("= True\n", "= 1\n"), r"dissipative: got 1; expected a bool"),
    "source": (GOOD.replace("Source: none, an example.", ""), r"its docstring states no equation with its «Source:»"),
    "no default": (GOOD.replace("        0.0, unit", "        unit"), r"cannot be made without arguments"),
    "present at rest": (GOOD.replace("        0.0, unit", "        0.1, unit"), r"amplitude: got default 0\.1"),
    "no amplitude": (GOOD.replace(", amplitude=True", ""), r"its amplitudes are none; expected one field"),
    "no sd": (GOOD.replace(" sd=0.1", " relative_sd=0.1"), r"amplitude: expected a prior with sd > 0"),
    "fails": (GOOD.replace("signals.direction", "signals.dirction"), r"its term cannot be computed \(AttributeError"),
    "there at zero": (GOOD.replace("self.amplitude *", "0.1 +"), r"its term is 1\.1 at amplitude 0"),
    "not linear": (GOOD.replace("self.amplitude *", "self.amplitude**2 *"), r"its term is not linear"),
    "no gradient": (
        GOOD.replace("self.amplitude *", "abs(self.amplitude)**0.5 *"),
        r"derivative of its term at amplitude 0 is (nan|inf|-inf)",
    ),
    "shape": (
        GOOD.replace("signals.direction", "robot.sides * __import__('numpy').ones(2)"),
        r"its term (has shape \(2,\)|cannot be computed)",
    ),
}


@pytest.mark.parametrize("case", REFUSED, ids=list(REFUSED))
def test_bad_effect_files_are_refused_in_one_sentence(tmp_path, case):
    text, sentence = REFUSED[case]
    with pytest.raises(BadConfiguration, match=sentence) as refusal:
        effect_file.library([written(tmp_path, text)])
    assert "\n" not in str(refusal.value)


def test_missing_effect_file_is_refused(tmp_path):
    with pytest.raises(BadConfiguration, match=r"--effects: got .*none\.py, no such file"):
        effect_file.library([tmp_path / "none.py"])


def test_packaged_effects_pass_the_users_checks():
    for effect in BY_NAME.values():
        effect_file._check(Path("library"), effect)
