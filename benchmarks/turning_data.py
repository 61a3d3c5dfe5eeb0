"""Turning robots of other groups: currents of a Husky by side, slips of a tracked robot, against force balances.

    python benchmarks/turning_data.py FOLDER           # with husky_turning.csv and tracked_turning.csv
    python benchmarks/turning_data.py FOLDER --brief   # without the variants of the balance

The force balance is that of tests/worlds/turning.py with both sides' speeds imposed: v_x and ω for which forces and
yaw moments of ground and rolling resistance vanish. Centripetal accelerations (below 0.1 m/s²) are left out, so the
instantaneous centre is amidships. The current of a side is |Q|, Q = k F_x + I_0 σ, times `returned` if the ground
drives it. Held out by run (Husky) or by sixths of the left side's speeds (tracked). Percentages are rms errors over
the rms of the predicted quantity. NumPy and SciPy only.
"""

from __future__ import annotations

import argparse
import csv
import json
import sys
from pathlib import Path
from types import SimpleNamespace

import numpy as np
from scipy.optimize import least_squares

sys.path.insert(0, str(Path(__file__).resolve().parents[1] / "tests"))
from worlds.turning import friction_share, spot_coulomb

Table = dict[str, np.ndarray]
SURFACES = ("flooring", "asphalt", "ice")
HUSKY = SimpleNamespace(length=0.512, width=0.555)  # wheelbase and track, from its maker [m]
TRACKED = SimpleNamespace(width=0.606, radius=0.0856, gear=34.45)  # from its repository
WINDOW, SAMPLE = 2.0, 0.1538  # [s]
SMALL = 0.02  # speed within which friction changes its sign [m/s]
WHEELS = np.array([-0.5, 0.5]), np.array([0.5, 0.5])  # positions over the length, shares of the load
_NODES = np.polynomial.legendre.leggauss(10)
TRACK = _NODES[0] / 2, _NODES[1] / 2


def read(path: Path, words: tuple[str, ...] = ("surface", "run_id")) -> Table:
    """Columns of a table. Text in the columns `words`."""
    with path.open() as lines:
        rows = list(csv.DictReader(lines))
    return {c: np.array([r[c] if c in words else float(r[c]) for r in rows]) for c in rows[0]}


def percent(error: np.ndarray, size: np.ndarray) -> float:
    """Rms of the error over rms of the size [%]."""
    return round(100 * float(np.sqrt((error**2).mean() / (size**2).mean())), 1)


def by_surface(error: np.ndarray, size: np.ndarray, surface: np.ndarray) -> list[float]:
    return [percent(error[..., surface == s], size[..., surface == s]) for s in SURFACES]


# --- force balance ------------------------------------------------------------------------------------------


def balance(v, ratio, V_s, f, length, width, contacts=WHEELS, rule=1.0, fall=1.0, left=0.5):
    """Traction of both sides over φ_x W, v_x, ω and the residual, at speeds v (2, n) of the movers.

    Args:
        v: left and right [m/s].
        ratio: φ_y/φ_x.
        V_s: of Fig. 7 [m/s].
        f: rolling resistance over φ_x.
        contacts: positions over the length and shares.
        rule: a of the direction rule.
        fall: μ_d/μ_s.
        left: share of the weight on the left side.
    """
    y = np.array([width / 2, -width / 2])[:, None, None]
    x, share, side = contacts[0] * length, contacts[1], np.array([[left], [1 - left]])
    w, V_s, f = v[:, :, None], np.broadcast_to(V_s, v.shape)[:, :, None], np.broadcast_to(f, v.shape)
    law = [np.ones_like(V_s), fall, V_s, 10 * V_s]
    robot = SimpleNamespace(law=law, ratio=np.broadcast_to(ratio, v.shape)[:, :, None], rule=rule)

    def forces(z):
        v_x, omega = z[0][None, :, None], z[1][None, :, None]
        F_x, F_y = friction_share(robot, w - v_x + omega * y + 0 * x, -omega * x + 0 * w)
        P = side * (F_x @ share)
        net = P - side * f * np.tanh((z[0] - z[1] * y[..., 0]) / SMALL)
        turn = (net[1] - net[0]) + (side * (F_y @ (share * x))).sum(0) * 2 / width
        return P, np.stack([net.sum(0), turn])

    z = np.stack([v.mean(0), (v[1] - v[0]) / (width + np.mean(ratio) ** rule * length**2 / width)])
    step = np.array([1e-7, 2e-7 / width])
    for _ in range(30):
        r = forces(z)[1]
        if np.abs(r).max() < 1e-9:
            break
        J = np.stack([(forces(z + (step * np.eye(2)[k])[:, None])[1] - r) / step[k] for k in range(2)], 1)
        det = J[0, 0] * J[1, 1] - J[0, 1] * J[1, 0]
        det = np.where(np.abs(det) < 1e-12, 1e-12, det)
        dz = -np.stack([J[1, 1] * r[0] - J[0, 1] * r[1], J[0, 0] * r[1] - J[1, 0] * r[0]]) / det
        limit = np.array([0.5, 1.0])[:, None] * (np.abs(v).max(0) + 0.05)
        dz, size, part = np.clip(dz, -limit, limit), np.abs(r).max(0), np.ones(v.shape[1])
        for _ in range(6):  # halve the steps that make it worse
            worse = np.abs(forces(z + part * dz)[1]).max(0) > size
            if not worse.any():
                break
            part = np.where(worse, part / 2, part)
        z = z + part * dz
    P, r = forces(z)
    return P, z[0], z[1], np.abs(r).max(0)


# --- the Husky -----------------------------------------------------------------------------------------------


def windows(d: Table) -> list[np.ndarray]:
    """Rows of each window that is at least three quarters full."""
    out = []
    for run in np.unique(d["run_id"]):
        of = np.flatnonzero(d["run_id"] == run)
        n = (d["time_s"][of] // WINDOW).astype(int)
        out += [of[n == k] for k in np.unique(n) if (n == k).sum() >= 0.75 * WINDOW / SAMPLE]
    return out


def means(d: Table) -> Table:
    """Means over windows."""
    rows = windows(d)
    return {c: np.array([v[i[0]] if v.dtype.kind == "U" else v[i].mean() for i in rows]) for c, v in d.items()}


def sides(d: Table) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Speeds and currents (left and right, samples), yaw rates."""
    pair = ("left", "right")
    speeds, currents = ([d[c.format(s)] for s in pair] for c in ("wheel_speed_{}_m_s", "current_{}_A"))
    return np.stack(speeds), np.stack(currents), d["yaw_rate_rad_s"]


def features(own, other, yaw, basis: str) -> np.ndarray:
    """Inputs of a regression of a side's current. Yaw is positive if it loads this side more."""
    one, total, apart = np.ones_like(own), own + other, own - other
    f = [one, abs(own), abs(total)]
    if basis == "linear":
        return np.stack([one, abs(own), abs(other), abs(yaw)], 1)
    if basis == "tanh":
        for q in (0.02, 0.1):
            for z in (apart, yaw):
                f += [np.tanh(z / q) * np.tanh(total / 0.05), abs(np.tanh(z / q))]
        return np.stack(f, 1)
    way = np.where(total < 0, -1.0, 1.0)
    curve = np.clip((apart if basis == "wheels" else yaw) * way / np.maximum(abs(total) / 2, 0.05), -3, 3)
    for q in (0.1, 0.3, 1.0):
        f += [np.tanh(curve / q), abs(np.tanh(curve / q))]
    return np.stack(f, 1)


def regressed(d: Table, basis: str, ridge: float = 1e-3) -> np.ndarray:
    """Currents (2, samples) held out by run, each surface and side separately."""
    v, current, yaw = sides(d)
    out = np.zeros_like(current)
    for s in range(2):
        X = features(v[s], v[1 - s], yaw * (1 if s else -1), basis)
        for run in np.unique(d["run_id"]):
            test = d["run_id"] == run
            use = (d["surface"] == d["surface"][test][0]) & ~test
            A = X[use]
            gram = A.T @ A + ridge * len(A) * np.eye(A.shape[1])
            out[s, test] = X[test] @ np.linalg.solve(gram, A.T @ current[s, use])
    return out


#: Parameters of the robot, then of each surface: start, lower, upper bound.
OF_ROBOT = {
    "friction_left_A": (1.0, 0.0, 5.0), "friction_right_A": (2.0, 0.0, 5.0), "gain_asymmetry": (0.0, -0.5, 0.5),
    "blur_A": (0.3, 0.01, 2.0), "returned": (0.7, 0.05, 1.0), "log_stiffness": (6.6, 4.0, 11.5),
    "left_share": (0.5, 0.2, 0.8),
}  # fmt: skip
OF_SURFACE = {
    "k_phi_W_A": (15.0, 1.0, 150.0), "ratio": (0.55, 0.05, 3.0), "log_V_s": (-4.0, -9.2, -1.2),
    "k_f_W_A": (0.5, 0.0, 5.0),
}  # fmt: skip
NAMES = [*OF_ROBOT, *(f"{s}.{p}" for s in SURFACES for p in OF_SURFACE)]
START, LOW, HIGH = np.array([*OF_ROBOT.values(), *(list(OF_SURFACE.values()) * len(SURFACES))]).T


def kind(fixed: dict[str, float | None] | None = None, **changes) -> SimpleNamespace:
    """A variant of the balance.

    Args:
        fixed: parameters with their values, None for free ones.
        changes: `rule`, `fall`, `width` of the balance. `yaw`: weight of yaw rates against currents [A s/rad].
            `tied`: one creep stiffness k φ_x W / V_s [A s/m] and `one_ratio`: one φ_y/φ_x for all surfaces.
            `by_speed`: V_s is proportional to the rolling speed. `every`: see `fit`.
    """
    base = {"rule": 1.0, "fall": 1.0, "width": HUSKY.width, "yaw": 30.0}
    base |= {"tied": False, "one_ratio": False, "by_speed": False, "every": 0}
    return SimpleNamespace(fixed=fixed or {}, **(base | changes))


def predicted(
    p: np.ndarray, v: np.ndarray, surface: np.ndarray, of: SimpleNamespace
) -> tuple[np.ndarray, np.ndarray]:
    """Currents (2, n) and yaw rates (n,)."""
    own = p[len(OF_ROBOT) :].reshape(len(SURFACES), -1)[[SURFACES.index(s) for s in surface]].T
    if of.one_ratio:
        own[1] = p[NAMES.index("flooring.ratio")]
    V_s = own[0] / np.exp(p[5]) if of.tied else np.exp(own[2])
    if of.by_speed:  # creep proportional to rolling, as for tyres
        V_s = V_s * (np.abs(v) + 0.03) / 0.236
    share, _, yaw, _ = balance(
        v, own[1], V_s, own[3] / own[0], HUSKY.length, of.width, WHEELS, of.rule, of.fall, p[6]
    )
    way = np.tanh(v / SMALL)
    load = own[0] * np.array([[1 + p[2]], [1 - p[2]]]) * share + np.array([[p[0]], [p[1]]]) * way
    signed = load * np.where(load * way < 0, 1 + (p[4] - 1) * np.abs(way), 1.0)
    return np.sqrt(signed**2 + p[3] ** 2), yaw


def fit(d: Table, m: Table, use: np.ndarray, of: SimpleNamespace, start: np.ndarray = START):
    """All parameters by least squares on the means of currents [A] and, times `of.yaw`, of yaw rates.

    A window's mean is compared with the balance at its mean speeds or, with `of.every`, with the mean of the
    balances at every n-th of its samples. Magnitudes and saturation make the two different.

    Returns:
        Parameters, result of `least_squares`, mask of the free parameters.
    """
    v, current, yaw = (c[..., use] for c in sides(m))
    surface, count = m["surface"][use], np.ones(use.sum(), int)
    if of.every:
        rows = [i[:: of.every] for i, used in zip(windows(d), use, strict=True) if used]
        v, surface, count = (
            sides(d)[0][:, np.concatenate(rows)],
            d["surface"][np.concatenate(rows)],
            np.array([len(i) for i in rows]),
        )
    first = np.concatenate([[0], np.cumsum(count)[:-1]])
    fixed = {"left_share": 0.5} | of.fixed | ({"log_V_s": -4.0} if of.tied else {"log_stiffness": 6.6})
    fixed |= {"asphalt.ratio": 0.5, "ice.ratio": 0.5} if of.one_ratio else {}
    fixed = {n: x for n, x in fixed.items() if x is not None}
    whole = np.array([fixed.get(n, fixed.get(n.split(".")[-1], s)) for n, s in zip(NAMES, start, strict=True)])
    free = np.array([n not in fixed and n.split(".")[-1] not in fixed for n in NAMES])

    def residual(q):
        p = whole.copy()
        p[free] = q
        amps, w = (np.add.reduceat(c, first, axis=-1) / count for c in predicted(p, v, surface, of))
        return np.concatenate([(amps - current).ravel(), of.yaw * (w - yaw)])

    found = least_squares(
        residual, np.clip(whole, LOW + 1e-9, HIGH - 1e-9)[free], bounds=(LOW[free], HIGH[free]),
        x_scale=np.maximum(np.abs(START[free]), 0.3), xtol=1e-5, ftol=1e-5, diff_step=1e-5, max_nfev=40,
    )  # fmt: skip
    whole[free] = found.x
    return whole, found, free


def held_out(d: Table, m: Table, of: SimpleNamespace, start: np.ndarray) -> dict[str, list[float]]:
    """Errors [%] by surface of runs that the fit (to the means of the others) has not seen."""
    (v, seen, _), (v_m, seen_m, w_m) = sides(d), sides(m)
    out, out_m, yaw, fits = np.zeros_like(seen), np.zeros_like(seen_m), np.zeros_like(w_m), []
    for run in np.unique(d["run_id"]):
        p = fit(d, m, m["run_id"] != run, of, start)[0]
        fits.append(p)
        a, b = d["run_id"] == run, m["run_id"] == run
        out[:, a] = predicted(p, v[:, a], d["surface"][a], of)[0]
        out_m[:, b], yaw[b] = predicted(p, v_m[:, b], m["surface"][b], of)
    averaged = sides(means(d | {"current_left_A": out[0], "current_right_A": out[1]}))[1]
    n, p = len(fits), np.array(fits)
    spread = np.sqrt((n - 1) / n * ((p - p.mean(0)) ** 2).sum(0))
    return {
        "means": by_surface(out_m - seen_m, seen_m, m["surface"]),
        "means_of_samples": by_surface(averaged - seen_m, seen_m, m["surface"]),
        "samples": by_surface(out - seen, seen, d["surface"]),
        "yaw": by_surface(yaw - w_m, w_m, m["surface"]),
        "jackknife_sd": dict(zip(NAMES, spread.round(3).tolist(), strict=True)),
    }


def husky(path: Path, brief: bool) -> None:
    d = read(path)
    m = means(d)
    (v, current, w), (_, current_d, _) = sides(m), sides(d)
    print(json.dumps({"husky": {"samples": len(d["time_s"]), "windows": len(w)}, "surfaces": SURFACES}))
    for basis in ("linear", "tanh", "yaw", "wheels"):
        row = {
            n: by_surface(regressed(t, basis) - c, c, t["surface"])
            for n, t, c in (("means", m, current), ("samples", d, current_d))
        }
        print(json.dumps({"regression": basis} | row), flush=True)
    variants = {"base": kind(), "one creep stiffness": kind(tied=True)}
    if not brief:
        variants |= {
            "mu_d = 0.8 mu_s": kind(fall=0.8),
            "maximum dissipation": kind(rule=2.0),
            "creep by rolling speed": kind(by_speed=True),
            "one ratio, creep by rolling speed": kind(one_ratio=True, by_speed=True),
            "phi_y = phi_x": kind({"ratio": 1.0}),
            "no creep": kind({"log_V_s": np.log(1e-3)}),
            "returned = 1": kind({"returned": 1.0}),
            "sides alike but for friction": kind({"gain_asymmetry": 0.0}),
            "share of the weight, not gain": kind({"gain_asymmetry": 0.0, "left_share": None}),
            "no asymmetry": kind({"gain_asymmetry": 0.0, "friction_right_A": 2.0, "friction_left_A": 2.0}),
            "no rolling resistance": kind({"k_f_W_A": 0.0}),
            "currents alone": kind(yaw=0.0),
            "width 0.50 m": kind(width=0.50),
            "width 0.61 m": kind(width=0.61),
            "through samples": kind(every=3),
            "through samples, one ratio, creep by rolling speed": kind(every=3, one_ratio=True, by_speed=True),
            "through samples, creep by rolling speed": kind(every=3, by_speed=True),
        }
    for name, of in variants.items():
        p, found, free = fit(d, m, np.ones(len(w), bool), of)
        c, y = predicted(p, v, m["surface"], of)
        row = {
            "cost": round(found.cost, 1),
            "fitted": by_surface(c - current, current, m["surface"]),
            "yaw": by_surface(y - w, w, m["surface"]),
        }
        row["parameters"] = dict(zip(NAMES, p.round(3).tolist(), strict=True))
        print(json.dumps({"balance": name} | row), flush=True)
        if name == "base":
            trades(found, free)
        print(json.dumps({"held out": name} | held_out(d, m, of, p)), flush=True)


def trades(found, free: np.ndarray) -> None:
    """Prints standard deviations for independent windows, and strongly correlated pairs of parameters."""
    J = found.jac
    inner = np.array(found.active_mask) == 0
    names = np.array(NAMES)[free][inner]
    cov = np.linalg.pinv(J[:, inner].T @ J[:, inner]) * 2 * found.cost / (len(J) - inner.sum())
    sd = np.sqrt(np.diag(cov))
    corr = cov / np.outer(sd, sd)
    pairs = [
        (names[i], names[j], round(corr[i, j], 2)) for i in range(len(sd)) for j in range(i) if abs(corr[i, j]) > 0.8
    ]
    print(json.dumps({"sd": dict(zip(names.tolist(), sd.round(3).tolist(), strict=True)), "trade": pairs}))


# --- the tracked robot ------------------------------------------------------------------------------------


TRACKED_START = {
    "length": (0.5, 0.05, 3.0), "log_V_s": (-4.0, -9.0, 0.0), "f_over_phi": (0.02, 0.0, 0.9),
    "left": (1.0, 0.8, 1.2), "right": (1.0, 0.8, 1.2), "ahead": (0.04, -0.3, 0.3),
    "left_share": (0.5, 0.2, 0.8), "by_speed": (0.0, 0.0, 50.0), "askew": (0.01, -0.1, 0.1),
}  # fmt: skip


def slips(p: np.ndarray, v: np.ndarray, ratio: float, rule: float) -> np.ndarray:
    """Slip of left and right and lateral speed (3, n) [m/s] at nominal track speeds v (2, n).

    `left`, `right`: true over nominal speed. `ahead`: distance of the instantaneous centre before the measured point.
    `askew`: angle of the instrument [rad]. `by_speed`: growth of V_s with the rolling speed [per 0.2 m/s].
    """
    true = v * p[3:5, None]
    V_s = np.exp(p[1]) * (1 + p[7] * np.abs(true).mean(0) / 0.2)
    _, v_x, omega, _ = balance(true, ratio, V_s, p[2], p[0], TRACKED.width, TRACK, rule, left=p[6])
    half = TRACKED.width / 2
    return np.stack([v[0] - (v_x - omega * half), v[1] - (v_x + omega * half), -omega * p[5] + v_x * p[8]])


def tracked(path: Path) -> None:
    d = read(path)
    speed = TRACKED.radius / TRACKED.gear
    nominal = np.stack([d["wheel_left"], d["wheel_right"]])
    for unit, rad in (("rpm", 2 * np.pi / 60), ("rad/s", 1.0)):
        v = nominal * speed * rad
        body = v - np.stack([d["slip_left_m_s"], d["slip_right_m_s"]])
        q = np.abs(v[1] - v[0]) > 0.05 * np.abs(v[1] - v[0]).max()
        width = (v[1] - v[0])[q] / (body[1] - body[0])[q] * TRACKED.width
        print(json.dumps({"tracked": unit, "effective_width_m": np.percentile(width, [5, 50, 95]).round(3).tolist()}))
    v_x = body.mean(0)
    seen = np.stack([*(v - body), v_x * np.tan(d["side_slip_rad"])])
    steep = np.abs(np.cos(d["side_slip_rad"])) > 0.3  # otherwise the angle does not give the lateral speed
    level = d["wheel_left"]
    low, high = np.array(list(TRACKED_START.values())).T[1:]
    begin = np.array([s[0] for s in TRACKED_START.values()])

    reached = ~((level >= 60) & (d["wheel_right"] == -160))  # there it turns three times slower than mirrored

    def fitted(use, ratio, rule, fixed, begin=begin):
        free = np.array([n not in fixed for n in TRACKED_START])
        whole = np.array([fixed.get(n, s) for n, s in zip(TRACKED_START, begin, strict=True)])

        def residual(q):
            p = whole.copy()
            p[free] = q
            e = slips(p, v[:, use], ratio, rule) - seen[:, use]
            return np.concatenate([e[0], e[1], e[2][steep[use]]])

        found = least_squares(
            residual, np.clip(whole, low + 1e-9, high - 1e-9)[free], bounds=(low[free], high[free]), x_scale=0.1,
            diff_step=1e-5, max_nfev=30,
        )  # fmt: skip
        whole[free] = found.x
        return whole, found.cost

    order = np.unique(level)
    folds = [np.isin(level, order[k::6]) for k in range(6)]

    def errors(out, on):
        e = out - seen
        return [*(percent(e[k, on], seen[k, on]) for k in range(2)), percent(e[2][steep & on], seen[2][steep & on])]

    rows = {"points": len(level), "not_reached": int((~reached).sum()), "steep": int(steep.sum())}
    rms = np.sqrt([(c**2).mean() for c in (seen[0, reached], seen[1, reached], seen[2][steep & reached])])
    print(json.dumps(rows | {"rms_m_s": rms.round(4).tolist()}))
    radius = np.abs(v.mean(0)) / np.maximum(np.abs(v[1] - v[0]), 1e-9) * TRACKED.width
    for a, b in ((0, 0.1), (0.1, 0.3), (0.3, 0.6), (0.6, 1.0), (1.0, 2.0), (2.0, 4.0)):
        on = reached & (radius >= a) & (radius < b) & (np.abs(v[1] - v[0]) > 0.02)
        wide = (v[1] - v[0])[on] / (body[1] - body[0])[on]
        print(
            json.dumps(
                {
                    "radius_m": [a, b],
                    "points": int(on.sum()),
                    "effective_over_true_width": np.percentile(wide, [25, 50, 75]).round(3).tolist(),
                }
            )
        )
    for name, X in {
        "linear": np.stack([np.ones_like(v[0]), *v], 1),
        "linear and magnitudes": np.stack(
            [np.ones_like(v[0]), *v, *np.abs(v), np.abs(v[0] - v[1]), np.abs(v.sum(0))], 1
        ),
    }.items():
        out = np.zeros_like(seen)
        for test in folds:
            for k in range(3):
                use = ~test & reached & (steep if k == 2 else True)
                out[k, test] = X[test] @ np.linalg.lstsq(X[use], seen[k, use], rcond=None)[0]
        print(json.dumps({"regression": name, "held_out": errors(out, reached)}))
    alike = {"left": 1.0, "right": 1.0, "by_speed": 0.0}
    for name, ratio, rule, fixed in (
        ("base", 1.0, 1.0, alike),
        ("sides alike", 1.0, 1.0, alike | {"left_share": 0.5}),
        ("speeds of the sides scaled, not loads", 1.0, 1.0, {"left_share": 0.5, "by_speed": 0.0}),
        ("both", 1.0, 1.0, {"by_speed": 0.0}),
        ("creep by rolling speed too", 1.0, 1.0, {"left": 1.0, "right": 1.0}),
        ("no creep", 1.0, 1.0, alike | {"log_V_s": np.log(1e-3)}),
        ("ratio 0.7", 0.7, 1.0, alike),
        ("ratio 0.7, maximum dissipation", 0.7, 2.0, alike),
    ):
        p, cost = fitted(reached, ratio, rule, fixed)
        out = np.zeros_like(seen)
        for test in folds:
            out[:, test] = slips(fitted(~test & reached, ratio, rule, fixed, p)[0], v[:, test], ratio, rule)
        row = {
            "cost": round(cost, 5),
            "held_out": errors(out, reached),
            "parameters": dict(zip(TRACKED_START, p.round(4).tolist(), strict=True)),
        }
        row["spot_coulomb"] = round(spot_coulomb(p[0], TRACKED.width, ratio, p[2], rule) or np.nan, 3)
        print(json.dumps({"balance": name} | row), flush=True)


if __name__ == "__main__":
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path)
    parser.add_argument("--brief", action="store_true", help="without the variants of the balance")
    given = parser.parse_args()
    tracked(given.folder / "tracked_turning.csv")
    husky(given.folder / "husky_turning.csv", given.brief)
