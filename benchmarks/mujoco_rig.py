"""A drive as a model of MuJoCo, for its identification toolbox: a hinge that is the output shaft.

Back-EMF is the bias of an actuator. In a log the winding's lag is a filter of the actuator's voltage. Viscous losses
are the joint's damping, dry ones its frictionloss, weights further actuators with known controls. MuJoCo has neither
a gear that loses a share of its load in both directions nor a slip of this kind: the efficiency is that of a driving
motor, and a vehicle rolls. Free constants are parameters of the toolbox in sds of their tolerances, within three of
them.
"""

from __future__ import annotations

import contextlib
import dataclasses
import io
import logging
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import plain_drives
from mujoco import sysid
from plain_drives import Unable
from worlds.paper import G

#: Bound of a parameter in sds of its tolerance.
BOUND = 3.0
#: Steps for which each settled row is held, and their length [s]; longest step of a log [s].
HOLD, STEP, LONGEST = 40, 1e-3, 0.001
#: Gain of a servo that imposes a speed, over the damping of the shaft.
SERVO = 1e6

MODEL = """
<mujoco model="shaft">
  <compiler inertiafromgeom="false"/>
  <option timestep="{step}" integrator="implicitfast" gravity="0 0 0"><flag contact="disable"/></option>
  <worldbody>
    <body name="shaft">
      <inertial pos="0 0 0" mass="1" diaginertia="1e-9 1e-9 1e-9"/>
      <joint name="shaft" type="hinge" axis="0 1 0" armature="1" damping="1" frictionloss="1"
             solreffriction="{twice} 1" solimpfriction="0.9999 0.9999 0.001 0.5 2"/>
    </body>
  </worldbody>
  <actuator>
    <general name="motor" joint="shaft" biastype="affine" dyntype="{lag}"/>
    <general name="slope" joint="shaft"/>
    <general name="ground" joint="shaft"/>
    <general name="pull" joint="shaft"/>
    <general name="brake" joint="shaft"/>
  </actuator>
  <sensor><jointvel name="speed" joint="shaft"/><actuatorfrc name="torque" actuator="motor"/></sensor>
</mujoco>
"""


@dataclasses.dataclass(frozen=True)
class Sequence:
    """Rows that are simulated in sequence.

    Attributes:
        rows: of the table, in order.
        configuration: name.
        step: [s].
        at: instants of the rows since the start [s].
        control: of every step, shape (steps, 5).
        settled: True if each row is held until it has settled.
        speed: of the output shaft at the start [rad/s].
    """

    rows: np.ndarray
    configuration: str
    step: float
    at: np.ndarray
    control: np.ndarray
    settled: bool
    speed: float


@dataclasses.dataclass(frozen=True)
class Rig:
    """A table's rig as models of MuJoCo, by `plain_drives.Drive`."""

    drive: plain_drives.Drive
    sequences: tuple[Sequence, ...]

    def fitted(
        self, measured: np.ndarray, sd: np.ndarray, counts: np.ndarray, start: np.ndarray | None = None
    ) -> np.ndarray:
        """Parameters found by the toolbox from `start` [prior sds], arrays of shape (rows, channels)."""
        free = sysid.ParameterDict()
        begin = np.zeros(self.drive.constants) if start is None else start
        for name, z in zip(self.drive.coordinates.names, begin, strict=True):
            free.add(sysid.Parameter(name, nominal=float(z), min_value=-BOUND, max_value=BOUND))
        parts = [self._part(s, measured, sd, counts) for s in self.sequences]

        def residual(x: np.ndarray, params: Any, **options: Any) -> Any:
            every = [part(x, params, **options) for part in parts]
            return [r for residuals, _, _ in every for r in residuals], [], []

        logging.getLogger("absl").setLevel(logging.ERROR)  # suppresses a warning for each start on a bound
        with contextlib.redirect_stdout(io.StringIO()):
            found, _ = sysid.optimize(free, residual, optimizer="mujoco", verbose=False)
        return np.asarray(found.as_vector())

    def readings(self, z: np.ndarray) -> np.ndarray:
        """Readings of every row [SI], shape (rows, channels), at parameters [prior sds]."""
        shown = np.full((len(self.drive.runs), len(self.drive.runs.channels)), np.nan)
        for s in self.sequences:
            spec = _spec(s)
            model = self._model(s, z, spec)
            rolled = sysid.sysid_rollout([model], [mujoco.MjData(model)], [_control(s)], [_begin(s, model)])
            shown[s.rows] = self._shown(s, z, np.asarray(rolled[0].sensordata.data))
        return shown

    def _part(self, s: Sequence, measured: np.ndarray, sd: np.ndarray, counts: np.ndarray) -> Any:
        """The toolbox's residual function of a sequence."""
        spec = _spec(s)
        model = spec.compile()
        silent = sysid.TimeSeries.from_names(_times(s), np.zeros((len(s.control), 2)), model)
        runs = sysid.ModelSequences("shaft", spec, "rows", _begin(s, model), _control(s), silent)
        kept = counts[s.rows]

        def off(params: Any, shown: Any, silent: Any, model: Any, every: bool, **more: Any) -> Any:
            left = self._shown(s, params.as_vector(), np.asarray(shown.data)) - measured[s.rows]
            left = np.nan_to_num(left / sd[s.rows], nan=1e3, posinf=1e3, neginf=-1e3)
            return left[kept], silent, silent

        return sysid.build_residual_fn(
            models_sequences=[runs],
            build_model=lambda params, spec: self._model(s, params.as_vector(), spec),
            modify_residual=off,
            resample_true=False,
            n_threads=1,
        )

    def _constants(self, s: Sequence, z: np.ndarray) -> SimpleNamespace:
        values = self.drive.values(z)
        own = {n.removeprefix(f"{s.configuration}."): x for n, x in values.items()}
        vehicle, eta, i = self.drive.given.mass is not None, own["gearbox.efficiency_load"], own["gearbox.ratio"]
        load = "track." if vehicle else ""
        dry = own["motor.friction_coulomb"] + own["gearbox.friction_coulomb"]
        viscous = own["motor.friction_viscous"] + own["gearbox.friction_viscous"]
        radius = own.get("radius", 1.0)
        rubs = 0.0
        if vehicle:
            rubs = own["ground.rolling_resistance"] + own["track.guide_friction"] * own["track.guide_share"]
        return SimpleNamespace(
            C=own["motor.torque_constant"], R=own["motor.resistance"], i=i, eta=eta, radius=radius,
            rubs=radius * rubs,
            damping=i * i * eta * viscous + own[f"{load}loss_viscous"],
            friction=i * eta * dry + own[f"{load}loss_coulomb"], load_dry=own[f"{load}loss_coulomb"],
            load_viscous=own[f"{load}loss_viscous"], pull=0.0 if vehicle else own.get("torque_constant", 0.0),
            inertia=i * i * eta * own["motor.inertia"] + own["inertia"]
            + (own["mass"] / self.drive.given.sides * radius**2 if vehicle else 0.0),
            late=own.get("rig.delay", 0.0), lag=own["motor.inductance"] / own["motor.resistance"],
        )  # fmt: skip

    def _model(self, s: Sequence, z: np.ndarray, spec: Any) -> Any:
        c, joint = self._constants(s, z), spec.joint("shaft")
        motor = spec.actuator("motor")
        if self.drive.given.motor_speed is None:
            gain, bias = c.i * c.eta * c.C / c.R, c.i**2 * c.eta * c.C**2 / c.R
        else:
            gain = bias = SERVO * max(c.damping, c.i**2 * c.eta * c.C**2)
        motor.gainprm[0], motor.biasprm[2] = gain, -bias
        if not s.settled:
            motor.dynprm[0] = max(c.lag, 1e-9)
        for name, value in (("slope", -c.radius), ("ground", -c.rubs), ("pull", -c.pull), ("brake", -1.0)):
            spec.actuator(name).gainprm[0] = value
        joint.damping = np.array([[c.damping], [0], [0]])
        joint.frictionloss = c.friction
        joint.armature = 0.5 * s.step * (c.damping + bias) if s.settled else c.inertia
        return spec.compile()

    def _shown(self, s: Sequence, z: np.ndarray, sensors: np.ndarray) -> np.ndarray:
        """Readings of a sequence's rows [SI] from the sensors of every step."""
        c, given = self._constants(s, z), self.drive.given
        if s.settled:
            at = HOLD * np.arange(1, len(s.rows) + 1) - 2  # the toolbox leaves out the last step
            speed, torque = sensors[at, 0], sensors[at, 1]
        else:
            time = np.arange(len(sensors)) * s.step
            speed, torque = (np.interp(s.at - c.late, time, sensors[:, k]) for k in (0, 1))
        w = c.i * speed
        current = torque / (c.i * c.eta * c.C)
        duty = given.duty[s.rows]
        shown = {
            "motor_speed": w, "output_speed": speed, "speed": c.radius * speed, "motor_current": current,
            "total_current": given.sides * current * duty, "motor_voltage": c.C * w + c.R * current,
            "output_torque": c.load_dry * np.sign(speed) + c.load_viscous * speed + c.pull
            + given.load_torque[s.rows],
        }  # fmt: skip
        if given.mass is not None:
            weight = given.mass[s.rows] / given.sides * G
            shown["output_torque"] = shown["output_torque"] + c.radius * weight * np.sin(given.slope[s.rows])
            shown["output_torque"] += c.rubs * weight * np.cos(given.slope[s.rows]) * np.sign(speed)
        names = [channel.name for channel in self.drive.runs.channels]
        unsigned = self.drive.robot.rig.magnitudes
        return np.stack([np.abs(shown[n]) if n in unsigned else shown[n] for n in names], 1)


def _spec(s: Sequence) -> Any:
    return mujoco.MjSpec.from_string(
        MODEL.format(step=s.step, twice=2 * s.step, lag="none" if s.settled else "filterexact")
    )


def _times(s: Sequence) -> np.ndarray:
    return s.step * np.arange(len(s.control))


def _control(s: Sequence) -> Any:
    return sysid.TimeSeries(_times(s), s.control)


def _begin(s: Sequence, model: Any) -> np.ndarray:
    return np.asarray(sysid.create_initial_state(model, np.zeros(1), np.array([s.speed]), np.zeros(model.na)))


def rig(runs: Any, robot: Any, coordinates: Any) -> Rig:
    """The rig of a table as models of MuJoCo.

    Raises:
        Unable: a rig that a hinge cannot express.
    """
    drive = plain_drives.drive(runs, robot, coordinates)
    if robot.driver.decay == "fast":
        raise Unable("MuJoCo has no actuator for a driver in fast decay")
    given = drive.given
    ratio = drive.known["gearbox.ratio"]
    sequences = []
    if runs.sampled:
        if given.motor_speed is not None or given.load_torque.any():
            raise Unable("an imposed speed, or a brake, over time")
        for name in dict.fromkeys(runs.run_names.tolist()):
            sequences.append(_log(drive, runs.in_order(name), runs.whole.in_order(name)))
        return Rig(drive, tuple(sequences))
    driven = given.motor_speed / ratio if given.motor_speed is not None else given.supply * given.duty
    for k, name in enumerate(robot.configurations.names):
        rows = np.flatnonzero(given.configuration == k)
        if len(rows):
            control = np.repeat(_controls(given, driven)[rows], HOLD, 0)
            first = (
                0.9
                * driven[rows[0]]
                / (1.0 if given.motor_speed is not None else drive.known["motor.torque_constant"] * ratio)
            )
            sequences.append(Sequence(rows, name, STEP, np.zeros(0), control, True, float(first)))
    return Rig(drive, tuple(sequences))


def _controls(given: SimpleNamespace, driven: np.ndarray) -> np.ndarray:
    """Controls of every row: imposed input, weight along and across the slope of one side [N], one, and a brake."""
    weight = np.zeros(len(driven)) if given.mass is None else given.mass / given.sides * G
    across = weight * np.cos(given.slope) * given.d
    return np.stack([driven, weight * np.sin(given.slope), across, np.ones(len(driven)), given.load_torque], 1)


def _log(drive: plain_drives.Drive, rows: np.ndarray, every: np.ndarray) -> Sequence:
    whole = plain_drives.conditions_of(drive.runs.whole, drive.robot)
    time = drive.runs.whole["time_s"][every]
    begin, apart = time[0], float(np.median(np.diff(time)))
    step = apart / np.ceil(apart / LONGEST)
    clock = begin + step * np.arange(int(np.ceil((time[-1] - begin) / step)) + 2)
    held = np.clip(np.searchsorted(time, clock + 1e-9, side="right") - 1, 0, len(time) - 1)
    control = _controls(whole, whole.supply * whole.duty)[every][held]
    name = drive.robot.configurations.names[int(whole.configuration[every[0]])]
    speed = plain_drives.first_speed(drive, every[0]) / drive.known["gearbox.ratio"]
    return Sequence(rows, name, step, drive.runs["time_s"][rows] - begin, control, False, speed)
