"""Effects from a user's file: usable by name, and refused in one sentence."""

from pathlib import Path

import pytest
from numpy.testing import assert_allclose

from calibration.data.effect_file import _check_effect, effect_library
from calibration.data.input_errors import BadConfiguration
from calibration.data.robot_file import load_robot, read_robot, write_robot
from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from tests.commands import read_rig, text_file

GOOD = '''
from mmrjax.effects import Effect, amplitude
from mmrjax.model.params import Scalar
from mmrjax.model.robot import Robot
from mmrjax.model.signals import Signals


class SealDrag(Effect):
    """ΔM_t = a: a seal that drags. Source: none, an example."""

    balance = "track"
    dissipative = True

    amplitude: Scalar = amplitude(
        unit="N·m", meaning="drag of the seal", bounds=(-1.0, 1.0), sd=0.1, source="example"
    )

    def term(self, robot: Robot, signals: Signals) -> Scalar:
        return self.amplitude * signals.direction
'''
#: The same, everything stated and nothing derived.
EXPLICIT = '''
from typing import ClassVar
from mmrjax.effects import Effect
from mmrjax.model.params import Scalar, parameter


class Drag(Effect):
    """ΔM_t = a: a seal that drags. Source: none, an example."""

    name: ClassVar[str] = "seal_drag"
    balance: ClassVar[str] = "track"
    dissipative: ClassVar[bool] = True

    amplitude: Scalar = parameter(
        0.0, unit="N·m", meaning="drag of the seal", bounds=(-1.0, 1.0), sd=0.1, source="example", amplitude=True
    )

    def term(self, robot, signals):
        return self.amplitude * signals.direction
'''


def written(tmp_path, text, name="mine.py"):
    path = tmp_path / name
    path.write_text(text)
    return path


def stating(*lines):
    """The good effect with these class attributes too."""
    return GOOD.replace("    dissipative = True\n", "    dissipative = True\n" + "".join(f"    {x}\n" for x in lines))


@pytest.mark.slow
@pytest.mark.parametrize("text", [GOOD, EXPLICIT], ids=["derived", "explicit"])
def test_user_effect_is_usable_by_name_in_a_robot_file(tmp_path, text):
    library = effect_library([written(tmp_path, text)])
    assert list(library) == [*BY_NAME, "seal_drag"] and "seal_drag" not in BY_NAME
    robot = load_robot(text_file(tmp_path / "robot.toml", "[effects.seal_drag]\namplitude = 0.05\n"), library)
    more = params.replace(load_robot("nominal"), {"6T2A.track.loss_coulomb": 0.4})
    run = Conditions(voltage=[15.0])
    got, expected = (steady_batch(r, run).total_current for r in (robot, more))
    assert_allclose(got, expected, rtol=1e-10)
    write_robot(robot, tmp_path / "again.toml")
    again = load_robot(str(tmp_path / "again.toml"), library)
    assert float(again.effects[0].amplitude) == 0.05


def test_user_effect_states_what_the_library_states(tmp_path):
    text = stating(
        "transient = True", 'settles_to = "churning"', "odd_in_travel = True", 'configurations = ("4W2T",)'
    )
    drag = effect_library([written(tmp_path, text)])["seal_drag"]
    assert (drag.transient, drag.settles_to, drag.odd_in_travel, drag.needs_battery) == (
        True,
        "churning",
        True,
        False,
    )
    assert drag().configurations == ("4W2T",)
    power = GOOD.replace("signals.direction", "signals.direction * signals.battery")
    text = power.replace("    dissipative = True\n", "    needs_battery = True\n")
    assert effect_library([written(tmp_path, text, "on_battery.py")])["seal_drag"].needs_battery


REFUSED = {
    "code fails": ("import nothing_of_this_name", r"mine\.py: its code fails \(ModuleNotFoundError"),
    "syntax": ("def (", r"mine\.py: its code fails \(SyntaxError"),
    "no effect": ("x = 1", r"mine\.py: contains no effect; expected a class derived from mmrjax\.effects\.Effect$"),
    "no term": (GOOD.replace("def term", "def other"), r"contains no effect; .*; SealDrag defines no term"),
    "name": (stating('name = "seal drag"'), r"name: got 'seal drag'; expected lower-case words"),
    "no name": (stating("name = None"), r"mine\.py, SealDrag, name: got None"),
    "name taken": (GOOD.replace("SealDrag", "Churning"), r"name: churning is already used; choose another"),
    "no balance": (GOOD.replace('    balance = "track"\n', ""), r"SealDrag, balance: got None; expected a str"),
    "balance": (GOOD.replace('"track"', '"trak"'), r"balance: got trak; did you mean track\? allowed: mass,"),
    "no channel": (
        GOOD.replace('"track"', '"sensor"'),
        r"channel: got ''; expected one of total_current, motor_speed",
    ),
    "channel": (
        GOOD.replace('"track"', '"sensor"\n    channel = "sped"'),
        r"channel: got sped; did you mean speed\? allowed: total_current, motor_speed",
    ),
    "channel of no sensor": (
        stating('channel = "speed"'),
        r"channel: got 'speed'; expected .* for sensor, else none",
    ),
    "dissipative": (GOOD.replace("= True\n", "= 1\n"), r"dissipative: got 1; expected a bool"),
    "transient": (stating('transient = "yes"'), r"transient: got yes; expected a bool as class attribute"),
    "settles": (
        stating('settles_to = "churnin"'),
        r"settles_to: got churnin; did you mean churning\? allowed: mass_",
    ),
    "settles to itself": (stating('settles_to = "seal_drag"'), r"settles_to: got seal_drag; .*allowed: mass_"),
    "battery": (
        stating("needs_battery = True"),
        r"needs_battery: its term is 0\.1 on an external supply; expected 0",
    ),
    "odd": (stating("odd_in_travel = None"), r"odd_in_travel: got None; expected a bool"),
    "reverse": (stating("needs_reverse = 1"), r"needs_reverse: got 1; expected a bool"),
    "movers": (
        stating('movers = "track"'),
        r"movers: got track; did you mean tracks\? allowed: tracks, wheels, or none",
    ),
    "configurations": (stating('configurations = "4W2T"'), r"configurations: got '4W2T'; expected a tuple of names"),
    "configuration": (stating("configurations = (4,)"), r"configurations: got \(4,\); expected a tuple of names"),
    "memory": (stating("memory_size = True"), r"memory_size: got True; expected a positive number, or None"),
    "no rate": (stating("memory_size = 1.0"), r"cannot be computed \(NotImplementedError: seal_drag has a memory"),
    "source": (
        GOOD.replace("Source: none, an example.", ""),
        r"its docstring must give the equation and its «Source:»",
    ),
    "no default": (EXPLICIT.replace("        0.0, unit", "        unit"), r"its code fails \(TypeError: .*'default'"),
    "no field": (
        GOOD.replace("amplitude: Scalar", "size: Scalar"),
        r"cannot be created without arguments \(.*amplitude.*\); give every field a default",
    ),
    "present at rest": (EXPLICIT.replace("        0.0, unit", "        0.1, unit"), r"amplitude: got default 0\.1"),
    "no amplitude": (EXPLICIT.replace(", amplitude=True", ""), r"its amplitudes are none; expected one field"),
    "no sd": (EXPLICIT.replace(" sd=0.1", " relative_sd=0.1"), r"amplitude: expected a prior with sd > 0"),
    "fails": (GOOD.replace("signals.direction", "signals.dirction"), r"its term cannot be computed \(AttributeError"),
    "reads ahead": (
        GOOD.replace("signals.direction", "signals.torque_net"),
        r"its term reads a signal that is computed after its balance; see balances\.moving_signals$",
    ),
    "reads ahead unseen": (
        GOOD.replace("signals.direction", "(1.0 if signals.torque_net > 0 else 2.0)"),
        r"its term reads a signal that is computed after its balance",
    ),
    "corner at rest": (
        GOOD.replace("signals.direction", "abs(signals.speed_wheel) ** 0.5"),
        r"derivatives of its term are not finite at rest, where drive and track start",
    ),
    "there at zero": (GOOD.replace("self.amplitude *", "0.1 +"), r"its term is 1\.1 at amplitude 0"),
    "not linear": (GOOD.replace("self.amplitude *", "self.amplitude**2 *"), r"its term is not proportional"),
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
        effect_library([written(tmp_path, text)])
    assert "\n" not in str(refusal.value)


def test_an_effect_may_read_the_torque_that_the_gearbox_transmits():
    """The check compared the first guess of that torque with the final one."""
    _check_effect(Path("library"), BY_NAME["gear_load_loss"])


@pytest.mark.slow
def test_packaged_effects_pass_the_users_checks():
    for effect in BY_NAME.values():
        _check_effect(Path("library"), effect)


# --- configurations in robot files ----------------------------------------------------------------------


def test_robot_file_names_the_configurations_of_an_effect(tmp_path):
    robot = read_rig(
        tmp_path,
        '[effects.churning]\nconfigurations = ["4W2T"]\namplitude = 1e-4\n[effects.mass_offset]\n',
        "robot.toml",
    )
    assert [e.configurations for e in robot.effects] == [("4W2T",), ()]
    assert float(robot.effects[0].amplitude) == 1e-4
    write_robot(robot, tmp_path / "again.toml")
    assert "configurations" in (tmp_path / "again.toml").read_text()
    again = read_robot(tmp_path / "again.toml")
    assert [e.configurations for e in again.effects] == [("4W2T",), ()]
