"""Calibration: accuracy on the packaged data, coverage of the intervals, and speed beside SciPy.

Run: python benchmarks/calibrate.py
"""

from __future__ import annotations

import math
import time
from typing import Any

import jax

jax.config.update("jax_enable_x64", True)

import equinox as eqx  # noqa: E402
import interval_coverage  # noqa: E402
import jax.numpy as jnp  # noqa: E402
import measure  # noqa: E402
import numpy as np  # noqa: E402
import reference  # noqa: E402  (tests/reference.py, plain NumPy and SciPy)
from scipy.optimize import least_squares, root  # noqa: E402

from calibration.data import runs as records  # noqa: E402
from calibration.inference import noise, observers, priors, problem  # noqa: E402
from calibration.inference import optimizers as fit  # noqa: E402
from calibration.inference.calibrate import calibrate  # noqa: E402
from calibration.inference.errors import relative_error, summary  # noqa: E402
from mmrjax import channels, params, robots  # noqa: E402
from mmrjax.fidelities.steady import steady_batch  # noqa: E402

STATED = "current=2%,motor_speed=0.5%,speed=1%"
CLIMBS = {"6T2A.ground.friction.static": 0.6, "4W2T.ground.friction.static": 0.6}


def accuracy(runs: records.Runs) -> dict[str, Any]:
    """rms of (35) on the packaged rows: fitted and held out, beside the paper and its simplified models."""
    measured = runs.measured()
    paper = records.read("simulated_by_paper").measured()
    lines = {"the paper's simulation": relative_error(paper, measured)}
    for name in ("nominal", "sm1", "sm2"):
        robot = params.replace(robots.ROBOTS[name](), {k: jnp.asarray(v) for k, v in CLIMBS.items()})
        shown = steady_batch(robot, runs.conditions(robot)).reading
        simulated = np.stack([shown[name] for name in channels.USUAL], 1)
        lines[f"{name}, adhesion raised to 0.6, not fitted"] = relative_error(simulated, measured)
    record: dict[str, Any] = {}
    for words, stated in (("noise estimated", None), (f"noise {STATED}", STATED)):
        found = calibrate(runs, robots.nominal(), noise=stated)
        after = np.stack([r.after for r in found.readings.values()], 1)
        lines[f"calibrated, {words}: fitted"] = relative_error(after, measured)
        for kind, held in found.held_out.items():
            with np.errstate(invalid="ignore"):
                reading = np.stack(list(held.reading.values()), 1)
                lines[f"calibrated, {words}: held out by {kind}"] = relative_error(reading, measured)
        record[words] = found.to_json()["parameters"]
    print("rms of eq. (35) [%] of current, motor speed, speed (rows that have a prediction)")
    for words, error in lines.items():
        three = [summary(error[:, k]) for k in range(3)]
        record[words] = [t["rms_percent"] for t in three] if words not in record else record[words]
        print(f"  {words:<75}" + "  ".join(f"{t['rms_percent']:5.1f}" for t in three) + f"   {three[0]['rows']} rows")
    return record


def pose(runs: records.Runs, extra: tuple[str, ...] = ()) -> problem.Problem:
    """The packaged problem with stated noise, at a robot that climbs."""
    base = params.replace(robots.nominal(), {k: jnp.asarray(v) for k, v in CLIMBS.items()})
    names = (*priors.default_names(runs["configuration"], base), *extra)
    sd = noise.of(runs, observers.kind(runs).sizes(runs), STATED).sd
    return observers.pose(runs, base, priors.coordinates(base, names), sd)


def coverage(runs: records.Runs, draws: int) -> dict[str, Any]:
    """Coverage of 95 % intervals over draws of readings and bench values, at a known truth."""
    posed = pose(runs)
    truth = jnp.asarray(0.5 * np.random.default_rng(3).standard_normal(len(posed.coordinates)))
    start = time.perf_counter()
    found = interval_coverage.coverage(posed, truth, draws, seed=1, profiles=True)
    took = time.perf_counter() - start
    print(f"coverage of 95 % intervals, {draws} draws in one batch ({took:.0f} s with compiling), "
          f"{found.converged.mean():.1%} converged")  # fmt: skip
    bias = (found.z.mean(0) - np.asarray(truth)) / found.z.std(0)
    for k, name in enumerate(posed.coordinates.names):
        print(
            f"  {name:<40} profile {found.profile[k]:6.1%}   linear {found.linear[k]:6.1%}   bias {bias[k]:+.2f} sd"
        )
    return {"profile": found.profile.tolist(), "linear": found.linear.tolist(), "draws": draws}


def timed(call: Any, repeats: int) -> float:
    """Best wall time of `call` [s]."""
    return measure.seconds(call, repeats)[0]


def speed(runs: records.Runs, starts: int) -> dict[str, Any]:
    """Jacobian of 20 rows x 12 parameters and a whole fit: ours, SciPy on our jitted model, SciPy throughout."""
    posed = pose(runs, ("6T2A.track.guide_friction",))
    size = len(posed.coordinates)
    whole = jax.jit(fit.residuals(posed, posed.data, fit.no_pin(size)))
    jacobian = jax.jit(jax.jacfwd(lambda z: posed.misfit(z, posed.data)))
    z0 = jnp.zeros(size)
    ours_jacobian = timed(lambda: jacobian(z0), 200)
    solve = eqx.filter_jit(fit.levenberg_marquardt)
    ours = solve(posed, z0, posed.data)
    ours_fit = timed(lambda: solve(posed, z0, posed.data).z, 20)

    def jitted(z: np.ndarray) -> np.ndarray:
        return np.asarray(whole(jnp.asarray(z)))

    jitted(np.zeros(size))  # compiled before it is timed
    begin = time.perf_counter()
    on_ours = least_squares(jitted, np.zeros(size), jac="2-point", method="trf", xtol=1e-8, ftol=1e-10)
    jitted_fit = time.perf_counter() - begin
    differences = timed(lambda: [whole(z0.at[k].add(1e-6)) for k in range(size)] + [whole(z0)], 20)

    plain, calls = plain_residuals(runs, posed)
    np.testing.assert_allclose(plain(np.zeros(size))[:60], jitted(np.zeros(size))[:60], rtol=1e-6, atol=1e-6)
    begin = time.perf_counter()
    base = plain(np.zeros(size))
    for k in range(size):
        plain(np.eye(size)[k] * 1e-6) - base
    plain_jacobian = time.perf_counter() - begin
    begin = time.perf_counter()
    on_plain = least_squares(plain, np.zeros(size), jac="2-point", method="trf", xtol=1e-8, ftol=1e-10)
    plain_fit = time.perf_counter() - begin

    many = jnp.asarray(np.random.default_rng(0).standard_normal((starts, size)))
    begin = time.perf_counter()
    jax.block_until_ready(fit.searches(posed, many, posed.data))
    compiling = time.perf_counter() - begin
    many_fit = timed(lambda: fit.searches(posed, many, posed.data)[0].z, 3)

    print(f"20 rows x {size} parameters; optimum's objective: ours {float(ours.cost):.6f}, "
          f"SciPy on ours {on_ours.cost:.6f}, SciPy on the plain model {on_plain.cost:.6f}")  # fmt: skip
    rows = {
        "jacobian": (ours_jacobian, differences, plain_jacobian),
        "fit": (ours_fit, jitted_fit, plain_fit),
    }
    for words, (a, b, c) in rows.items():
        print(f"  {words:<9} ours {a * 1e3:9.2f} ms   2-point on our jitted model {b * 1e3:9.1f} ms ({b / a:6.1f} x)"
              f"   SciPy throughout {c * 1e3:10.0f} ms ({c / a:8.0f} x)")  # fmt: skip
    print(f"  {starts} starts in one batch {many_fit:.2f} s after compiling ({compiling:.1f} s with); "
          f"plain model: {calls[0]} operating points")  # fmt: skip
    return {**{k: list(v) for k, v in rows.items()}, "starts_s": many_fit, "compile_s": compiling}


class Plain(reference.Side):
    """A side of the plain model that, as the fit's `steady`, is held at V_s beyond the adhesion limit."""

    def creep(self, mu: float) -> float:
        return super().creep(math.copysign(min(abs(mu), self.mu_s), mu))

    def reading(self) -> tuple[float, float, float]:
        """Total current [A], motor speed [rad/s], speed [m/s]."""
        x = root(self.steady_residual, self.start()).x
        return reference.SIDES * x[0], 1000 * x[1], x[2]

    @property
    def adhesion_used(self) -> float:
        """Demand over the adhesion limit [-]."""
        return (self.roll + self.pull) / (self.mu_s * self.N)


def plain_residuals(runs: records.Runs, posed: problem.Problem) -> tuple[Any, list[int]]:
    """The same residuals with the plain NumPy model, row by row in SciPy."""
    c, data = posed.coordinates, posed.data
    base = {p.name: float(p.value) for p in params.walk(posed.base)}
    location, spread, scale = np.asarray(c.location), np.asarray(c.spread), np.asarray(c.scale)
    low, high, width = np.asarray(c.low), np.asarray(c.high), 0.05 * np.asarray(c.spread)
    measured, sd = np.asarray(data.measured), np.asarray(data.sd)
    calls = [0]

    def residuals(z: np.ndarray) -> np.ndarray:
        u = location + spread * z
        u = u + width * np.logaddexp(0, (low - u) / width) - width * np.logaddexp(0, (u - high) / width)
        theta = np.where(scale, np.exp(np.minimum(u, 50)), u)
        values = base | dict(zip(c.names, theta, strict=True)) | {f: r * theta[k] for f, k, r in c.tied}
        out, over = np.empty_like(measured), np.zeros(len(runs))
        for k in range(len(runs)):
            side = plain_side(values, runs, k)
            out[k], over[k] = side.reading(), max(0.0, side.adhesion_used - (1 - problem.MARGIN))
        calls[0] += len(runs)
        return np.concatenate([((out - measured) / sd).ravel(), over / problem.STIFFNESS, z])

    return residuals, calls


def plain_side(values: dict[str, float], runs: records.Runs, k: int) -> Plain:
    """One row for the plain model, its mass as the table states it."""
    wheeled, payload = bool(runs["configuration"][k] == "4W2T"), float(runs["payload_kg"][k])
    mass = {f"{runs['configuration'][k]}.mass": float(runs["total_mass_kg"][k]) - payload}
    slope = math.radians(runs["slope_deg"][k])
    return Plain(float(runs["supply_voltage_V"][k]), slope, payload, wheeled, p=values | mass)


def main() -> None:
    """Everything, in one run."""
    options = measure.parser(__doc__ or "", batches="64")
    options.add_argument("--draws", type=int, default=1000, help="noise draws of the coverage")
    arguments = options.parse_args()
    runs = records.read("measured")
    record = {"machine": measure.machine(), "speed": speed(runs, 64)}
    record |= {"accuracy": accuracy(runs), "coverage": coverage(runs, arguments.draws)}
    measure.finish(record, arguments.json)


if __name__ == "__main__":
    main()
