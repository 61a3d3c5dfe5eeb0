"""Energy of a run from standstill, and how averages depend on step and contact stiffness."""

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mmrjax.fidelities.track import track
from mmrjax.model import params
from mmrjax.model.conditions import Conditions
from mmrjax.model.signals import GRAVITY
from mmrjax.undercarriage.half_robot import advance, build_system, centre_of_mass, instant, stand
from mmrjax.undercarriage.running_gear import belt_travel

RUNS = Conditions(
    voltage=[33.0, 15.0, 24.0, 33.0],
    slope_deg=[0.0, 5.0, 5.0, 0.0],
    payload=[0.0, 8.0, 3.0, 8.0],
    configuration=[0.0, 0.0, 1.0, 1.0],
)


@pytest.fixture(scope="module")
def ledger(robot):
    """Energies [J] of one side over 0.6 s from standstill, each run."""

    @jax.jit
    @jax.vmap
    def run(command):
        setup = build_system(robot, command, 1e-4)
        radius, gear = setup.path.radius, setup.path.gear
        chassis = robot.chassis(command.configuration)

        def step(motion, _):
            signals, at, pulled = instant(setup, motion)
            after = advance(setup, motion)[0]
            mean = (motion.v + after.v) / 2  # of the step: forces act over the way actually gone
            belt = radius * (mean[3] * (1 - at.weight) + mean[4] * at.weight)
            speed_x = mean[0] + mean[2] * at.lever_z + at.rate_x * belt
            speed_z = mean[1] - mean[2] * at.lever_x + at.rate_z * belt
            stretch = belt_travel(radius, motion.q[3])[1] * mean[3] - belt_travel(radius, motion.q[4])[1] * mean[4]
            loss = chassis.track.torque_loss(signals.speed_wheel, signals.direction)
            out = {
                "in": signals.voltage * (signals.current + after.current) / 2,
                "winding": signals.voltage_drop * (signals.current + after.current) / 2,
                "motor": signals.torque_motor_loss * signals.speed_motor,
                "gearbox": signals.torque_input * signals.speed_motor - signals.torque_gear * signals.speed_wheel,
                "track": loss * signals.speed_wheel,
                "guide": jnp.sum(pulled.guide * belt),
                "sliding": -jnp.sum(pulled.force * speed_x),
                "contact": -jnp.sum(at.force * speed_z),
                "belt": 2 * gear.span_damping * stretch**2,
                "rolling": signals.resistance * (mean[0] - motion.q[1] * mean[2]),
            }
            return after, out

        start = stand(setup)
        end, powers = jax.lax.scan(step, start, None, length=6000)
        energy = jax.tree.map(lambda p: jnp.sum(p) * 1e-4, powers)

        def stored(m):
            forward, up, mass = centre_of_mass(setup)
            sin, cos = jnp.sin(command.slope), jnp.cos(command.slope)
            place_x = m.q[0] + forward * jnp.cos(m.q[2]) + up * jnp.sin(m.q[2])
            place_z = m.q[1] - forward * jnp.sin(m.q[2]) + up * jnp.cos(m.q[2])
            drawn = belt_travel(radius, m.q[3])[0] - belt_travel(radius, m.q[4])[0]
            kinetic = 0.5 * mass * (m.v[0] ** 2 + m.v[1] ** 2)  # pitch rates are of the order of 0.01 rad/s
            rotor = 0.5 * robot.motor.inertia * (robot.gearbox.ratio * m.v[3]) ** 2
            pulleys = 0.5 * setup.half.inertia_pulley * jnp.sum(m.v[3:5] ** 2)
            coil = 0.5 * robot.motor.inductance * m.current**2
            lift = mass * GRAVITY * (sin * place_x + cos * place_z)
            return kinetic + rotor + pulleys + coil + lift + gear.span_stiffness * drawn**2

        return energy | {"stored": stored(end) - stored(start)}

    return {name: np.asarray(value) for name, value in run(RUNS).items()}


@pytest.mark.slow
@pytest.mark.parametrize("k", range(4))
def test_energy_in_is_lost_or_stored(ledger, k):
    """To 0.5 % of what the supply gave."""
    spent = sum(value[k] for name, value in ledger.items() if name != "in")
    assert ledger["in"][k] > 5.0
    assert spent == pytest.approx(ledger["in"][k], rel=5e-3)


@pytest.mark.slow
def test_every_loss_takes_energy(ledger):
    for name in set(ledger) - {"in", "stored", "contact", "guide"}:
        assert (ledger[name] > 0).all(), name
    assert (ledger["guide"][:2] > 0.5).all() and (ledger["contact"][:2] > 0).all()


@pytest.fixture(scope="module")
def averages():
    runs = Conditions(
        voltage=[33.0, 33.0, 15.0, 33.0],
        slope_deg=[0.0, 10.0, 5.0, 10.0],
        payload=[0.0, 8.0, 0.0, 8.0],
        configuration=[0.0, 0.0, 0.0, 1.0],
    )

    @eqx.filter_jit
    def settled(robot, step):
        reading = jax.vmap(lambda run: track(robot, run, duration=0.8, step=step, rolling=True).result.reading)(runs)
        return jnp.stack([reading["total_current"], reading["motor_speed"], reading["speed"]])

    return lambda robot, step: np.asarray(settled(robot, step))


@pytest.mark.slow
def test_averages_do_not_depend_on_the_step(averages, robot):
    """Halved: less than 0.3 %."""
    assert_allclose(averages(robot, 5e-5), averages(robot, 1e-4), rtol=3e-3)


@pytest.mark.slow
def test_averages_hardly_depend_on_the_contact_stiffness(averages, robot):
    """Doubled: less than 0.3 %."""
    stiffer = params.replace(robot, {"running_gear.contact_stiffness": 2 * robot.running_gear.contact_stiffness})
    assert_allclose(averages(stiffer, 1e-4), averages(robot, 1e-4), rtol=3e-3)
