"""A drive as an actuator of mjlab: a file in PyTorch with a configuration class."""

from __future__ import annotations

from collections.abc import Sequence

from sweeps.export.joint import Joint
from sweeps.export.law_source import Constant, torch_source

_IMPORTS = """from dataclasses import dataclass, field

import torch
from mjlab.actuator.actuator import Actuator, ActuatorCfg"""
_CLASSES = '''


class DriveActuator(Actuator):
    """Evaluates the law for each joint of each environment; its command is the effort target, as a voltage [V]."""

    def edit_spec(self, spec, target_names):
        """Adds a motor of gear 1 to each joint, and the rotor's inertia."""
        import mujoco

        for name in target_names:
            motor = spec.add_actuator(name=name, target=name, trntype=mujoco.mjtTrn.mjTRN_JOINT)
            motor.set_to_motor()
            spec.joint(name).armature = float(armature(self.cfg.params))
            self._mjs_actuators.append(motor)

    def initialize(self, mj_model, model, data, device):
        """Makes parameters and states of all environments on a device."""
        super().initialize(mj_model, model, data, device)
        self.dt = float(mj_model.opt.timestep)
        shape = (data.nworld, len(self._target_ids_list))
        self.params = {n: torch.full(shape, float(v), device=device) for n, v in self.cfg.params.items()}
        self.state = initial_state(shape, device)

    def compute(self, cmd):
        """Torque of each joint [N·m], shape (environments, joints)."""
        torque, self.state, self.info = actuator(
            self.params, self.state, cmd.effort_target, cmd.pos, cmd.vel, self.dt
        )
        return torque

    def reset(self, env_ids=None):
        """Sets the state of some environments to rest."""
        super().reset(env_ids)
        rows = slice(None) if env_ids is None else env_ids
        self.state = {n: x.clone() for n, x in self.state.items()}
        for value in self.state.values():
            value[rows] = 0.0


@dataclass(kw_only=True)
class DriveActuatorCfg(ActuatorCfg):
    """Configuration: the joints by `target_names_expr`, and the law's numbers, which randomization may change."""

    params: dict = field(default_factory=lambda: dict(PARAMS))

    def build(self, entity, target_ids, target_names):
        """Returns the actuator of these joints."""
        return DriveActuator(self, entity, target_ids, target_names)
'''


def mjlab_files(joint: Joint, constants: Sequence[Constant], notes: Sequence[str]) -> dict[str, str | bytes]:
    """The source of the law in PyTorch with the classes of mjlab."""
    return {"mjlab_actuator.py": torch_source(joint, constants, notes, imports=_IMPORTS) + _CLASSES}
