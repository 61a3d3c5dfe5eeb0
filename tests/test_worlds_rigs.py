"""Rigs: balances against mmrjax's, what their files and tables hold, tolerances, sizes of effects."""

import dataclasses

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from numpy.testing import assert_allclose
from worlds import laws, rigs

from mmrjax.effects import BY_NAME
from mmrjax.fidelities.steady import steady_batch
from mmrjax.model import paper_robots, params
from mmrjax.model.chassis import Chassis
from mmrjax.model.conditions import Conditions
from mmrjax.model.contact import Friction, Ground, Track
from mmrjax.model.rig import Rig
from mmrjax.model.robot import Configurations
from mmrjax.model.shaft import Shaft
from mmrjax.model.signals import STATUSES

ROWS = 64  # of all tables once padded, so that few programs are compiled


def robot(w):
    """The true rig of a world, as mmrjax has it."""
    r, p = w.rig, w.constants
    if r.vehicle:
        ground = Ground(Friction(static=0.5, dynamic=0.4), rolling_resistance=0.0)
        track = Track(loss_coulomb=0.0, loss_viscous=0.0, guide_share=0.0)
        load = Chassis(track, ground, float(r.kind == "tracked"), mass=1.0, radius=0.1, inertia=0.0)
    else:
        load = Shaft(inertia=0.0, loss_coulomb=0.0)
    rig = Rig(imposed="motor_speed" if r.wide else "voltage")
    blank = paper_robots.blank_robot(Configurations({"load": load}), float(r.sides), rig)
    values = {n if n.startswith(("motor.", "gearbox.")) else f"load.{n}": jnp.asarray(v) for n, v in p.items()}
    return params.replace(blank, values)


def padded(x):
    return np.resize(np.asarray(x, float), ROWS)


def steady(w, *effects):
    """mmrjax's readings of a world [SI], shape (channels, rows), and its statuses."""
    c = w.conditions
    imposed = {"motor_speed": padded(c.motor_speed)} if w.rig.wide else {}
    imposed |= {"load_torque": padded(c.load_torque)} if c.load_torque.any() else {}
    slope = np.degrees(padded(c.slope))
    asked = Conditions(0, padded(c.supply), slope, padded(c.payload), duty=padded(c.duty), **imposed)
    found = steady_batch(dataclasses.replace(robot(w), effects=effects), asked)
    names = [STATUSES[k] for k in np.asarray(found.status)[: len(c)]]
    return np.stack([np.asarray(found.reading[n])[: len(c)] for n in w.rig.channels]), names


@pytest.mark.slow
@pytest.mark.parametrize("kind", rigs.KINDS)
def test_readings_are_those_of_the_simulator(worlds, kind):
    """Rigs of every kind: voltage, duty or speed imposed, forward and backward, loads that drive the motor."""
    mine = [w for w in worlds if w.rig.kind == kind]
    assert len(mine) == 12 * len(rigs.IMPOSED)
    with jax.enable_x64(True):
        for w in mine:
            found, names = steady(w)
            s, sound = rigs.solve(w.rig, w.conditions, w.constants)
            assert sound.all()
            assert set(names) <= {"converged", "reverses", "rolls_back"}, (w.rig, names)
            size = np.abs(s.shown).max(1, keepdims=True)
            assert_allclose(found / size, s.shown / size, atol=1e-6, err_msg=str(w.rig))


@pytest.mark.nightly
@pytest.mark.parametrize("name", laws.RIGS)
def test_law_is_that_of_the_library(worlds, name):
    """A library law in mmrjax shows what the world shows, to a thousandth of a rig's largest reading."""
    rng = np.random.default_rng(7)
    form = laws.RIGS[name]
    fits = [w for w in worlds if name in w.applicable(laws.RIGS)]
    w = next((w for w in fits if not w.rig.wide), fits[0])
    law = form.at(w.scale())
    term = dataclasses.replace(laws.draw(name, rng, law), amplitude=0.2 * law.size)
    effect = BY_NAME[name]()
    assert form.cls == name
    assert form.balance == (effect.channel if effect.balance == "sensor" else effect.balance)
    mine = [p.name for p in params.walk_parameters(effect) if p.name != "amplitude"]
    shapes = dict(zip(mine, term.shapes.values(), strict=False))
    values = {"amplitude": term.amplitude, **shapes}
    effect = params.replace(effect, {k: jnp.asarray(v) for k, v in values.items()})
    found, _ = steady(w, effect)
    s, sound = rigs.solve(w.rig, w.conditions, w.constants, [term])
    for k, channel in enumerate(w.rig.channels):
        if channel == "output_torque" and term.law.balance == "gearbox":
            continue  # what a torque meter at the output shows is without the gear's own loss
        size = np.abs(s.shown[k]).max()
        assert_allclose(found[k][sound] / size, s.shown[k][sound] / size, atol=1e-6, err_msg=name)
