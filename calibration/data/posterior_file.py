"""Posterior of a calibrated robot: the uncertainty of the fitted parameters, and its file `posterior.nc`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from calibration.data import Names
from calibration.data.input_errors import BadData, allowed_words

if TYPE_CHECKING:
    from mmrjax.model.robot import Robot

SCHEMA = "mmrjax.posterior/1"
FILE = "posterior.nc"
#: Kinds of parameters: equal to the coordinate u, its exponential, or an angle within half a turn.
NORMAL, LOG, ANGLE = "normal", "log-normal", "angle"
#: Largest difference, in posterior sds, between the centre of a posterior and its robot.
APART = 0.05


@dataclass(frozen=True)
class Posterior:
    """Joint posterior of parameters: a normal distribution of coordinates z, and the parameters as functions of z.

    u = location + spread · z, clipped to the range from low to high. The clip is smooth over `softness` times the
    spread, as in `calibration.inference.priors.Coordinates`, or sharp if `softness` is 0. The parameter is θ = u, exp
    u, or u wrapped to half a turn.

    Attributes:
        coordinates: name of the parameter of each coordinate.
        units: units of these parameters.
        mean, covariance: mean and covariance of z, shape (coordinates,) and (coordinates, coordinates).
        location, spread, low, high: location, spread, lower limit and upper limit of u, in the parameter's unit or
            its logarithm.
        softness: width of the smooth clip, relative to the spread [-].
        kinds: kind of each parameter: `NORMAL`, `LOG` or `ANGLE`.
        tied: for each tied parameter: its name, the index of its coordinate, and the ratio.
    """

    coordinates: Names
    units: Names
    mean: np.ndarray
    covariance: np.ndarray
    location: np.ndarray
    spread: np.ndarray
    low: np.ndarray
    high: np.ndarray
    softness: np.ndarray
    kinds: Names
    tied: tuple[tuple[str, int, float], ...] = ()

    def __len__(self) -> int:
        """Number of coordinates."""
        return len(self.coordinates)

    @property
    def names(self) -> Names:
        """Names of all parameters: those of the coordinates, then tied ones."""
        return (*self.coordinates, *(follower for follower, _, _ in self.tied))

    @property
    def root(self) -> np.ndarray:
        """L with L Lᵀ = covariance, even if a coordinate does not vary."""
        values, vectors = np.linalg.eigh((self.covariance + self.covariance.T) / 2)
        return vectors * np.sqrt(np.maximum(values, 0.0))

    def at(self, z: Any) -> Any:
        """Parameters [SI] at coordinates z, in the order of `names`. z has the shape (..., coordinates).

        A NumPy array is computed with NumPy, without compilation. Anything else can be traced by JAX.
        """
        import jax.numpy as jnp

        from calibration.inference.priors import clip_softly

        xp = np if isinstance(z, np.ndarray) else jnp
        u = xp.asarray(self.location) + xp.asarray(self.spread) * z
        u = clip_softly(u, self.low, self.high, self.softness * self.spread)
        kinds = np.asarray(self.kinds)
        theta = xp.where(xp.asarray(kinds == LOG), xp.exp(xp.where(kinds == LOG, u, 0.0)), u)
        theta = xp.where(xp.asarray(kinds == ANGLE), xp.remainder(u + np.pi, 2 * np.pi) - np.pi, theta)
        tied_values = [ratio * theta[..., k] for _, k, ratio in self.tied]
        return xp.concatenate([theta, xp.stack(tied_values, -1)], -1) if tied_values else theta

    def values(self, normal_scores: Any) -> Any:
        """Parameters [SI] of draws.

        Args:
            normal_scores: independent standard normal numbers, shape (draws, coordinates).

        Returns:
            Shape (draws, names).
        """
        return self.at(np.asarray(self.mean) + normal_scores @ self.root.T)

    def draw(self, draws: int, seed: int) -> np.ndarray:
        """Parameters [SI] of random draws, shape (draws, names)."""
        return self.values(np.random.default_rng(seed).standard_normal((draws, len(self))))

    def check(self, robot: Robot, where: str) -> None:
        """Rejects a posterior that belongs to another robot.

        Args:
            where: beginning of the error message.

        Raises:
            BadData: the robot lacks a parameter, or its value is far from the centre of the posterior.
        """
        from mmrjax.model import params

        values = params.values_by_name(robot)
        for name in self.names:
            if name not in values:
                alike = [n for n in values if n.rpartition(".")[2] == name.rpartition(".")[2]]
                raise BadData(
                    f"{where}: this robot has no {name}, so the posterior is another robot's; "
                    f"{allowed_words(name, alike or values)}"
                )
        with np.errstate(invalid="ignore"):  # NaN from a damaged file is rejected below
            robot_at_mean = self.at(np.asarray(self.mean))
        for name, value, width in zip(self.names, robot_at_mean, self.sd, strict=True):
            if not abs(values[name] - value) <= APART * width + 1e-6 * abs(value):  # also if one is NaN
                raise BadData(
                    f"{where}: {name} is {values[name]:.6g} in the robot; expected {value:.6g}, the centre of "
                    "its posterior: use the robot.toml of its folder, unchanged"
                )

    @property
    def sd(self) -> np.ndarray:
        """Standard deviation of each parameter in `names`, to first order [SI]."""
        import jax

        slopes = np.asarray(jax.jit(jax.jacfwd(self.at))(np.asarray(self.mean)))
        return np.sqrt(np.einsum("ij,jk,ik->i", slopes, self.covariance, slopes))


def write_posterior(posterior: Posterior, path: Path | str) -> None:
    """Writes a posterior as NetCDF 3, which `xarray.open_dataset` reads with units and long names."""
    from scipy.io import netcdf_file

    p = posterior
    square = ("coordinate", "coordinate_2")
    long_names = {
        "mean": "of z",
        "location": "u at z = 0, the parameter or its logarithm",
        "spread": "du/dz",
        "low": "least u",
        "high": "greatest u",
        "softness": "width of the smooth transition at the bounds, as a fraction of the spread",
        "value": "parameter at the mean [SI]",
        "sd": "standard deviation of the parameter, to first order [SI]",
        "covariance": "covariance of z",
    }
    computed = {"value": p.at(p.mean)[: len(p)], "sd": p.sd[: len(p)]}
    with netcdf_file(path, "w", version=2) as file:
        file.schema = SCHEMA
        file.title = "posterior of a calibrated robot, normal in z: u = location + spread z"

        def write_variable(name: str, values: Any, kind: str, long_name: str, *dimensions: str) -> None:
            values = np.asarray([x.encode() for x in values] if kind == "S" else values, kind)
            if kind == "S":  # strings as rows of characters
                dimensions = (*dimensions, f"string{values.itemsize}")
                values = values.view("S1").reshape(len(values), -1)
            for dimension, size in zip(dimensions, values.shape, strict=True):
                if dimension not in file.dimensions:
                    file.createDimension(dimension, size)
            variable = file.createVariable(name, values.dtype, dimensions)
            variable[:] = values
            if long_name:
                variable.long_name = long_name

        write_variable("coordinate", p.coordinates, "S", "", "coordinate")
        for name, long_name in long_names.items():
            values = computed[name] if name in computed else getattr(p, name)
            write_variable(name, values, "f8", long_name, *square[: np.ndim(values)])
        write_variable("kind", p.kinds, "S", "transformation of u", "coordinate")
        write_variable("units", p.units, "S", "of the parameter", "coordinate")
        if p.tied:
            followers, indices, ratios = zip(*p.tied, strict=True)
            write_variable("tied", followers, "S", "follows another", "follower")
            write_variable("tied_to", indices, "i4", "its index", "follower")
            write_variable("tied_ratio", ratios, "f8", "ratio to that", "follower")


def read_posterior(path: Path | str) -> Posterior:
    """Reads a `posterior.nc`.

    Raises:
        BadData: there is no such file, or it is damaged or no posterior.
    """
    import xarray as xr

    path = Path(path)
    if not path.is_file():
        raise BadData(f"{path}: no such file; expected the {FILE} next to robot.toml")
    try:
        with xr.open_dataset(path, engine="scipy") as data:
            data.load()
        p = _posterior_of_dataset(data)
    except Exception as error:  # a damaged file can make the reader raise anything
        why = f"{type(error).__name__}: {error}".splitlines()[0]
        raise BadData(f"{path}: not a readable posterior ({why})") from error
    size, ratios = len(p), [ratio for *_, ratio in p.tied]
    is_valid = (
        p.covariance.shape == (size, size)
        and all(
            np.isfinite(x).all() for x in (p.covariance, p.mean, p.location, p.spread, p.softness, np.array(ratios))
        )
        and not np.isnan([p.low, p.high]).any()
        and all(0 <= k < size for _, k, _ in p.tied)
        and np.linalg.eigvalsh(p.covariance).min() >= -1e-9 * max(np.abs(p.covariance).max(), 1e-300)
        and set(p.kinds) <= {NORMAL, LOG, ANGLE}
    )
    if not is_valid:
        raise BadData(f"{path}: a number is missing, invalid or out of range; write the file again")
    return p


def _words(values: Any) -> Names:
    return tuple(v.decode() if isinstance(v, bytes) else str(v) for v in np.asarray(values).tolist())


def _posterior_of_dataset(data: Any) -> Posterior:
    if data.attrs.get("schema") != SCHEMA:
        raise ValueError(f"schema {data.attrs.get('schema')}, expected {SCHEMA}")
    tied: tuple[tuple[str, int, float], ...] = ()
    if "tied" in data:
        tied = tuple(
            zip(
                _words(data["tied"]), data["tied_to"].values.tolist(), data["tied_ratio"].values.tolist(), strict=True
            )
        )
    return Posterior(
        coordinates=_words(data["coordinate"]),
        units=_words(data["units"]),
        kinds=_words(data["kind"]),
        tied=tied,
        **{name: np.asarray(data[name].values, float) for name in ("covariance", *_NUMBERS)},
    )


#: Arrays with a number for each coordinate.
_NUMBERS = ("mean", "location", "spread", "low", "high", "softness")


def join_posteriors(parts: Sequence[Posterior], covariance: np.ndarray) -> Posterior:
    """Joint posterior of several sets of coordinates. `covariance`: of all coordinates."""
    tied: list[tuple[str, int, float]] = []
    offset = 0
    for p in parts:
        tied += [(name, offset + k, ratio) for name, k, ratio in p.tied]
        offset += len(p)
    return Posterior(
        coordinates=tuple(n for p in parts for n in p.coordinates),
        units=tuple(u for p in parts for u in p.units),
        covariance=covariance,
        kinds=tuple(k for p in parts for k in p.kinds),
        tied=tuple(tied),
        **{name: np.concatenate([getattr(p, name) for p in parts]) for name in _NUMBERS},
    )
