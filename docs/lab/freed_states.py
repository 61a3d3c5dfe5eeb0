"""Share of an effect's sigmas that a short log keeps if the state of its shaft is freed within the runs.

    python docs/lab/freed_states.py --logs 6 --every 0.01

Logs as of `tests/worlds/logs.py`: a voltage in stairs both ways, current and speed read, four runs of 200 rows, dry
friction. Sensitivities are differences of simulations that locate reversals and rest. `jumps`, `reversals` (with ends
of rest) and `both` free the speed there, as methods do whose windows contain none. `noise` is white noise of the
torque, as a share of the rated one in each row, as process noise of a Kalman filter.
"""

from __future__ import annotations

import argparse

import numpy as np

RUNS, ROWS, FINE = 4, 200, 25
EFFECTS = {
    "quadratic": lambda w, i, fast, stall: np.abs(w) * w / fast,
    "stribeck": lambda w, i, fast, stall: np.exp(-np.abs(w) / (0.05 * fast)) * np.sign(w) * fast / 10,
    "by direction": lambda w, i, fast, stall: 0.1 * fast * (w != 0),
    "load": lambda w, i, fast, stall: np.abs(i) * np.sign(w) * fast / stall,
    "viscous by direction": lambda w, i, fast, stall: np.abs(w),
}
RELATIVE = {"R": 0.05, "C": 0.03, "J": 0.2, "friction": 0.3, "viscous": 0.3}


def rig(rng: np.random.Generator) -> tuple[dict[str, float], np.ndarray, float, float]:
    """Constants, voltages (runs, rows), idle speed and stall current of a random drive."""
    fast, stall = rng.uniform(300, 800), np.exp(rng.uniform(np.log(3), np.log(30)))
    constant, resistance = 12 / fast, 12 / stall
    dry = constant * stall * (rng.uniform(0.01, 0.03) + 0.3 * rng.uniform(0.1, 0.3))
    p = {
        "R": resistance, "C": constant, "J": rng.uniform(0.1, 0.3) * constant**2 / resistance, "friction": dry,
        "viscous": constant * stall * rng.uniform(0.02, 0.1) / fast,
    }  # fmt: skip
    volts = []
    for _ in range(RUNS):
        levels = rng.uniform(0.35, 1, 8) * np.where(rng.random(8) < 0.5, -12.0, 12.0)
        at = np.sort(rng.choice(np.arange(10, ROWS - 5), 7, replace=False))
        volts.append(levels[np.searchsorted(at, np.arange(ROWS), side="right")])
    return p, np.array(volts), fast, stall


def simulate(p, volts, every, amplitudes, sizes, kicks):
    """Current and speed of each member at each row, (members, runs, rows, 2), and the first member's fine speeds.

    Args:
        p: constants by member; amplitudes: of effects by member; kicks: row → changes of the speed (members, runs).
    """
    p = {k: x[:, None] for k, x in p.items()}
    count, h = len(p["R"]), every / FINE
    w, way = np.zeros((count, RUNS)), np.zeros((count, RUNS))
    rows, fine = np.zeros((count, RUNS, ROWS, 2)), np.zeros((RUNS, ROWS * FINE))

    def rate(w, way, u):
        current = (u - p["C"] * w) / p["R"]
        moving = np.where(w == 0, 1e-9 * way, w)
        torque = p["C"] * current - p["viscous"] * w - p["friction"] * way
        for name, law in EFFECTS.items():
            torque = torque - amplitudes[name][:, None] * np.where(way != 0, law(moving, current, *sizes), 0)
        return torque / p["J"], current

    def leaves(w, u):
        forward, backward = rate(w, np.ones_like(w), u)[0], rate(w, -np.ones_like(w), u)[0]
        return np.where(forward > 0, 1.0, np.where(backward < 0, -1.0, 0.0))

    for k in range(ROWS * FINE):
        row, u = k // FINE, volts[:, k // FINE][None]
        if k % FINE == 0:
            w = w + kicks.get(row, 0.0)
            rows[:, :, row, 0], rows[:, :, row, 1] = rate(w, way, u)[1], w
        fine[:, k] = w[0]
        way = np.where(way == 0, leaves(w, u), way)
        first = rate(w, way, u)[0]
        new = np.where(way == 0, 0.0, w + h * rate(w + h / 2 * first, way, u)[0])
        stops = (new * way < 0) & (way != 0)
        if stops.any():
            share, still = np.where(stops, w / np.where(stops, w - new, 1.0), 0.0), np.zeros_like(w)
            then = leaves(still, u)
            new = np.where(stops, (1 - share) * h * (then != 0) * rate(still, then, u)[0], new)
            way = np.where(stops, then, way)
        w = new
    return rows, fine


def kept(seed: int, every: float) -> dict[str, np.ndarray]:
    """Share of each effect's sigmas that remains, by what is freed."""
    p, volts, fast, stall = rig(np.random.default_rng([7, seed]))
    one = {k: np.array([x]) for k, x in p.items()}
    fine = simulate(one, volts, every, {n: np.zeros(1) for n in EFFECTS}, (fast, stall), {})[1]
    events: dict[str, list[list[int]]] = {"jumps": [], "reversals": []}
    for run in range(RUNS):
        events["jumps"].append([int(k) for k in np.flatnonzero(np.diff(volts[run])) + 1])
        moving = np.flatnonzero(fine[run] != 0)
        turns = (np.sign(fine[run][moving[1:]]) != np.sign(fine[run][moving[:-1]])) | (np.diff(moving) > 2)
        events["reversals"].append([int(k) // FINE + 1 for k in moving[1:][turns]])
    places = [
        (name, run, row) for name, x in events.items() for run in range(RUNS) for row in x[run] if row < ROWS - 1
    ]
    size, free = 1 + len(p) + len(EFFECTS), len(p)
    every_one = size + len(places)
    members, amplitudes = {k: np.full(every_one, x) for k, x in p.items()}, {n: np.zeros(every_one) for n in EFFECTS}
    for k, name in enumerate(p):
        members[name][1 + k] *= np.exp(1e-4)
    for k, name in enumerate(EFFECTS):
        amplitudes[name][1 + free + k] = 2e-4 * p["friction"] / fast
    kicks: dict[int, np.ndarray] = {}
    for k, (_, run, row) in enumerate(places):
        kicks.setdefault(row, np.zeros((every_one, RUNS)))[size + k, run] = 1e-5 * fast
    rows = simulate(members, volts, every, amplitudes, (fast, stall), kicks)[0]
    sd = np.array([0.02, 0.01]) * np.sqrt(np.mean(rows[0] ** 2, (0, 1)))
    moved = ((rows[1:] - rows[0]) / sd).reshape(every_one - 1, -1)
    base = moved[:free].T * 1e4 * np.array(list(RELATIVE.values()))
    effects, states = moved[free : size - 1].T, moved[size - 1 :].T

    def left(columns, effects, base=base):
        whole = np.concatenate([base, columns], 1)
        prior = np.diag(np.r_[np.ones(free), np.zeros(columns.shape[1])])
        q = np.linalg.qr(np.concatenate([whole, prior]))[0]
        padded = np.concatenate([effects, np.zeros((len(prior), effects.shape[1]))])
        return np.linalg.norm(padded - q @ (q.T @ padded), axis=0)

    sizes_of = np.linalg.norm(states, axis=0)
    full, found = left(states[:, :0], effects), {}
    for name, wanted in (("jumps", ("jumps",)), ("reversals", ("reversals",)), ("both", tuple(events))):
        mine = np.array([place[0] in wanted for place in places]) & (sizes_of > 0)
        found[name] = left(1e3 * states[:, mine] / sizes_of[mine], effects) / full
    fade = np.exp(-every * (p["C"] ** 2 / p["R"] + p["viscous"]) / p["J"])
    apart = np.arange(ROWS)[:, None] - np.arange(ROWS)
    responses = np.where(apart >= 0, fade ** np.maximum(apart, 0), 0.0)
    shows = np.array([-p["C"] / p["R"] / sd[0], 1 / sd[1]])
    for share in (0.002, 0.01, 0.05):
        step = share * 0.3 * p["C"] * stall / p["J"] * every
        noise = np.einsum("a,ij,b->iajb", shows, step**2 * responses @ responses.T, shows).reshape(2 * ROWS, -1)
        factor = np.linalg.inv(np.linalg.cholesky(noise + np.eye(2 * ROWS)))
        white = lambda x: np.concatenate(list(factor @ x.reshape(RUNS, 2 * ROWS, -1)))  # noqa: B023, E731
        found[f"noise {share:.1%}"] = left(states[:, :0], white(effects), white(base)) / full
    return found


def main() -> None:
    """Prints the median and the least share of each effect."""
    wanted = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    wanted.add_argument("--logs", type=int, default=6)
    wanted.add_argument("--every", type=float, default=0.01, help="time between rows [s]")
    given = wanted.parse_args()
    found = [kept(seed, given.every) for seed in range(given.logs)]
    print("median (least) share of:", ", ".join(EFFECTS))
    for name in found[0]:
        shares = np.array([x[name] for x in found])
        print(
            f"{name:12s}", *(f"{m:.2f} ({s:.2f})" for m, s in zip(np.median(shares, 0), shares.min(0), strict=True))
        )


if __name__ == "__main__":
    main()
