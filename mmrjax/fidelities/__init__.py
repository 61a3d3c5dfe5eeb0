"""Fidelities of one robot (a stand-in until the registry is merged)."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

NAMES = ("steady", "drive", "track")


def get(name: str) -> Any:
    """A fidelity by its name."""
    import jax
    import jax.numpy as jnp

    def settled(robot: Any, conditions: Any) -> Any:
        if name == "steady":
            from mmrjax.fidelities.steady import operating_point

            return jax.vmap(lambda c: operating_point(robot, c)[0])(conditions)
        if name == "drive":
            from mmrjax.fidelities.drive import drive

            times = jnp.asarray([0.0, 4.0])
            return jax.vmap(lambda c: drive(robot, c, times, rolling=True).result)(conditions)
        from mmrjax.fidelities.track import track

        return jax.vmap(lambda c: track(robot, c, duration=0.6, rolling=True).result)(conditions)

    return SimpleNamespace(name=name, settled=settled, rollout=name != "steady")
