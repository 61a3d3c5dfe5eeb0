"""Free parameters, their priors, and the coordinates in which they are fitted."""

from __future__ import annotations

import functools
import math
import re
from collections.abc import Iterable, Sequence
from typing import Any

import equinox as eqx
import jax
import jax.numpy as jnp
import numpy as np
from jaxtyping import Array, Float

from calibration.data import Names, Priors
from calibration.data.configuration_tables import GROUND
from calibration.data.input_errors import BadConfiguration, allowed_words
from mmrjax.compile.compiling import SELDOM, compiled
from mmrjax.model import params
from mmrjax.model.params import Parameter, parameters_by_name
from mmrjax.model.robot import Robot
from mmrjax.numerics.elementary import value_and_slope

#: Free by default in each configuration with rows: friction. The makers' electrical values, the gearbox and motor
#: losses of Table 2, the ratio and radii and masses stay at the values of their tables.
FRICTION = (
    "track.loss_coulomb",
    "track.loss_viscous",
    "ground.rolling_resistance",
    "ground.friction.static",
    "ground.friction.speed_static",
)
#: Free by default for a load on a shaft.
SHAFT = ("loss_coulomb", "loss_viscous", "torque_constant", "torque_gravity", "angle_zero")
#: Ends of the names of parameters that settled travel does not show.
OVER_TIME = (".inertia", ".inductance", ".backlash", ".stiffness", ".damping")
#: Free in addition for configurations on tracks, after the losses; guide friction μ_t stays at Table 4 because only
#: its product with the share of the guides matters.
GUIDE_SHARE, GUIDE_FRICTION = "track.guide_share", "track.guide_friction"
#: Share of the weight on the guides in the track model, where it is an output (docs/explanation/track-model.md).
GUIDED = 0.98
#: Free for configurations with independently driven sides; the rule of direction is correlated with the ratio of
#: frictions, and the moment of inertia shows only over time.
OF_TURNS = ("turning.width", "turning.lateral")
#: Parameters of a chassis with a ratio to another one in their source, which they keep unless they are free:
#: follower, leader.
TIED = (
    ("ground.friction.dynamic", "ground.friction.static"),
    ("ground.friction.speed_dynamic", "ground.friction.speed_static"),
)
#: Priors of an unspecified surface: relative sds around the robot's friction that contain dry grounds of all kinds
#: (μ_s from 0.2 to 1, V_s from 2 to 60 mm/s) within two sds. The fields' own priors are for the surface of Table 5.
SURFACE = {
    "ground.friction.static": 0.7,
    "ground.friction.dynamic": 0.7,
    "ground.friction.speed_static": 3.0,
    "ground.friction.speed_dynamic": 3.0,
}

#: Priors of each of several surfaces of one robot, which differ in their rolling resistance too.
SURFACE_OF_RIGS = {**SURFACE, "ground.rolling_resistance": 1.0}

#: Relative sds of parameters without a tolerance in a rig's file, by the ends of their names. Frictions of rigs agree
#: within a factor of two or three, windings without a stated inductance within five. The fields' own are those of
#: Tables 1 to 4.
RELATIVE_OF_RIGS = {
    **dict.fromkeys(
        (".friction_coulomb", ".friction_viscous", ".loss_coulomb", ".loss_viscous", ".rolling_resistance"), 0.5
    ),
    ".inductance": 1.0,
}  # fmt: skip

DELAY = "rig.delay"

SOFTNESS = 0.05  # of a prior sd: the width over which a bound is rounded


def clip_softly(u: Array, low: Array | np.ndarray, high: Array | np.ndarray, width: Array | np.ndarray) -> Array:
    """Smooth clip of u to the range from low to high: u + w S((low - u)/w) - w S((u - high)/w) with S softplus. A
    sharp clip for w = 0.
    """
    xp = np if isinstance(u, np.ndarray) else jnp
    w = xp.where(xp.asarray(width) > 0, width, 1.0)
    soft = u + w * xp.logaddexp((low - u) / w, 0.0) - w * xp.logaddexp((u - high) / w, 0.0)
    return xp.clip(xp.where(xp.asarray(width) > 0, soft, u), low, high)  # also removes rounding errors far outside


class Coordinates(eqx.Module):
    """Free parameters θ as coordinates z with a standard normal prior.

    u = location + spread · z, and θ = clip(u), or exp(clip(u)) for a scale parameter. The clip is smooth: clip(u) = u
    + w S((low - u)/w) - w S((u - high)/w), S softplus, w = spread / 20.

    A parameter is a scale if its field states a relative sd and it cannot be negative: its prior is log-normal with
    the nominal value as median. Every other one is normal. The clip is the identity inside the bounds (to e^-20 an sd
    away), has slope ½ on a bound, and is never flat. So an amplitude with prior mean zero, or a share with its
    nominal value on its bound, starts with a live gradient. Beyond a bound, a parameter is held by its prior, which
    is on z and acts everywhere.

    Attributes:
        location, spread, low, high: location, spread, lower limit and upper limit in units of θ, or of log θ for a
            scale, shape (parameters,).
        names, units, scale: names, units and scale of each parameter.
        ratios: for each parameter that is tied to a free one, its ratio to that one, shape (followers,).
        followers: name of each tied parameter, and index of the free one.
    """

    location: Float[Array, " parameters"]
    spread: Float[Array, " parameters"]
    low: Float[Array, " parameters"]
    high: Float[Array, " parameters"]
    names: Names = eqx.field(static=True)
    units: Names = eqx.field(static=True)
    scale: tuple[bool, ...] = eqx.field(static=True)
    ratios: Float[Array, " followers"]
    followers: tuple[tuple[str, int], ...] = eqx.field(static=True, default=())

    def __len__(self) -> int:
        return len(self.names)

    @property
    def tied(self) -> tuple[tuple[str, int, float], ...]:
        """For each tied parameter: its name, the index of the free one, and the ratio."""
        ratios = np.asarray(self.ratios)
        return tuple((name, k, float(ratios[n])) for n, (name, k) in enumerate(self.followers))

    def value(self, z: Float[Array | np.ndarray, "... parameters"]) -> Any:
        """Parameters θ [SI] at coordinates z. The result is a NumPy array if z is one."""
        xp, arrays = (np, jax.tree.map(np.asarray, self)) if isinstance(z, np.ndarray) else (jnp, self)
        u = clip_softly(arrays.location + arrays.spread * z, arrays.low, arrays.high, SOFTNESS * arrays.spread)
        return xp.where(xp.asarray(self.scale), xp.exp(u), u)

    @property
    def stated(self) -> np.ndarray:
        """Stated value of each parameter [SI]. `value` at 0 differs from it within `SOFTNESS` of a bound."""
        location = np.asarray(self.location)
        return np.where(self.scale, np.exp(np.where(self.scale, location, 0.0)), location)

    @property
    def prior_sd(self) -> np.ndarray:
        """Prior sd of each parameter [SI], as written in files.

        For a log-normal prior with median m it is m √(e^s² - 1), as for "m ± sd" in a file.
        """
        arrays = jax.tree.map(np.asarray, self)
        return np.where(arrays.scale, self.stated * np.sqrt(np.expm1(arrays.spread**2)), arrays.spread)

    def slope(self, z: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
        """Derivative dθ/dz [SI]."""
        return _slope(self, jnp.asarray(z))

    def robot(self, base: Robot, z: Float[Array, " parameters"]) -> Robot:
        """Robot with the free parameters, and those tied to them, at coordinates z."""
        names = (*self.names, *(follower for follower, _ in self.followers))
        return params.replace(base, dict(zip(names, _parameter_values(self, z), strict=True)))

    def beyond(self, z: np.ndarray) -> np.ndarray:
        """-1 if a parameter is at or below its lower bound, 1 if at or above its upper bound, otherwise 0. Shape
        (parameters,).
        """
        arrays = jax.tree.map(np.asarray, self)
        u = arrays.location + arrays.spread * z
        return np.where(u <= arrays.low, -1, np.where(u >= arrays.high, 1, 0))


@functools.partial(compiled, options=SELDOM)
def _slope(coordinates: Coordinates, z: Float[Array, " parameters"]) -> Float[Array, " parameters"]:
    return value_and_slope(coordinates.value, z)[1]


@functools.partial(compiled, options=SELDOM)
def _parameter_values(coordinates: Coordinates, z: Float[Array, " parameters"]) -> tuple[Array, ...]:
    """Free and tied parameters at coordinates z, as scalars [SI]."""
    theta = coordinates.value(z)
    tied = coordinates.ratios * theta[np.array([k for _, k in coordinates.followers], int)]
    return (*params.split_numbers(theta), *params.split_numbers(tied))


def friction_names(robot: Robot, configuration: str) -> Names:
    """Friction parameters of a configuration that are fitted by default.

    Parameters that are zero, or that no channel shows, are not fitted. In straight travel, ground friction shows only
    in the speed, as slip. In turns it shows in all channels.
    """
    names = [*FRICTION, *SHAFT]
    if float(robot.configurations[configuration].on_tracks) > 0.5:
        names.insert(2, GUIDE_SHARE)
    if not (robot.rig.inherits or robot.rig.turns or "speed" in robot.rig.channels):
        names = [n for n in names if not n.startswith("ground.friction.")]
    return _uncertain_names(robot, (f"{configuration}.{name}" for name in names))


def _uncertain_names(robot: Robot, names: Iterable[str]) -> Names:
    """Names of those parameters that are uncertain: neither stated as exact nor zero.

    A zero is uncertain if the file states its sd. The delay of a rig is uncertain unless stated as exact, because a
    log may be late without the knowledge of its author.
    """
    parameters = parameters_by_name(robot)
    exact = robot.rig.exact
    file_names = robot.rig.stated if robot.rig.inherits else {*robot.rig.stated, DELAY}
    candidates = (n for n in names if n in parameters and n not in exact)
    return tuple(n for n in candidates if float(parameters[n].value) != 0.0 or n in file_names)


def names_to_fit(robot: Robot, configurations: Iterable[str], idle: Names = ()) -> Names:
    """Parameters that the robot file states with a nonzero ±, which requests a fit.

    Only parameters that the robot has, whose configuration is in the data, that the data can show, and that are not
    tied to another parameter.

    Args:
        idle: endings of the names of parameters that the data do not show.
    """
    other_configurations = set(robot.configurations) - set(configurations)
    parameters = parameters_by_name(robot)  # a prior may be of an effect that the robot no longer has
    stated_names = [
        n
        for n, _, sd in robot.rig.priors
        if sd > 0 and n in parameters and n.partition(".")[0] not in {"rig", *other_configurations}
    ]
    return _drive_names(
        robot, (n for n in stated_names if _leading_parameter(robot, n) is None and not n.endswith(idle))
    )


def default_names(
    configurations: Iterable[str], robot: Robot, *, computed: Sequence[str] = (), turns: bool = False
) -> Names:
    """Names of the parameters that are fitted by default, for data of these configurations.

    Args:
        computed: parameters of a configuration that the fidelity computes, see `fidelities.Facts`. The guide friction
            μ_t is then fitted in place of the guide load share.
        turns: True for data of turns.
    """
    present = set(configurations)
    names = [n for c in robot.configurations if c in present for n in friction_names(robot, c)]
    if turns:
        names += _uncertain_names(robot, (f"{c}.{n}" for c in robot.configurations if c in present for n in OF_TURNS))
    names = [n for n in names if _leading_parameter(robot, n) is None]
    if GUIDE_SHARE in computed:
        names = [n.replace(GUIDE_SHARE, GUIDE_FRICTION) for n in names]
    return (*names, *(f"effects.{e.name}.amplitude" for e in robot.effects), *initial_state_names(robot))


def initial_state_names(robot: Robot) -> Names:
    """Names of the initial speeds and angles of histories, if the rig leaves them free."""
    if robot.rig.begins is None or robot.rig.start != "free":
        return ()
    state_names = (f"rig.{run}.{field}" for run in robot.rig.begins.names for field in ("motor_speed", "angle"))
    return tuple(name for name in state_names if name in robot.rig.stated)


#: Freed by the loop in addition to friction: values from benches and makers, with their tolerances.
BENCH = (
    "motor.resistance",
    "motor.torque_constant",
    "motor.friction_coulomb",
    "motor.friction_viscous",
    "gearbox.efficiency_load",
    "gearbox.friction_coulomb",
    "gearbox.friction_viscous",
)


def loop_parameter_names(
    robot: Robot,
    configurations: Iterable[str],
    drive: Sequence[str] = (),
    chassis: Sequence[str] = (),
    idle: Names = OVER_TIME,
) -> Names:
    """Parameters that the loop fits for data of these configurations, including all that the file states with ±.

    Args:
        drive, chassis: further parameters that the data determine, see `Observer.free`.
        idle: as in `names_to_fit`.
    """
    present = set(configurations)
    parameters = parameters_by_name(robot)
    names = [
        name
        for c in robot.configurations
        if c in present
        for name in (
            *friction_names(robot, c),
            *([f"{c}.radius"] if robot.shows_travel else []),
            *(f"{c}.{n}" for n in chassis if f"{c}.{n}" in parameters and float(parameters[f"{c}.{n}"].value) != 0.0),
        )
    ]
    names = [n for n in names if _leading_parameter(robot, n) is None]
    ends_above = (*(f".{n}" for n in (*SHAFT, *OF_TURNS)), ".radius")  # above, by what the channels show
    stated_names = names_to_fit(robot, present, idle)
    further_names = (
        n for n in stated_names if not n.endswith(ends_above) and ".track." not in n and f".{GROUND}" not in n
    )
    return tuple(
        dict.fromkeys(
            [
                *_uncertain_names(robot, (*_drive_names(robot, (*BENCH, *drive)), *names)),
                *further_names,
                *initial_state_names(robot),
            ]
        )
    )


def _leading_parameter(robot: Robot, name: str) -> str | None:
    """Parameter of another configuration to which this one is tied, because the configurations differ only by their
    surface.
    """
    configuration, _, key = name.partition(".")
    leader = dict(robot.rig.surfaces).get(configuration)
    return None if leader is None or key.startswith(GROUND) else f"{leader}.{key}"


#: Parameters of the drive that act only on the voltage.
ELECTRICAL = ("motor.resistance", "motor.inductance")


def _drive_names(robot: Robot, names: Iterable[str]) -> Names:
    """Names of drive parameters. Electrical ones are left out if the voltage is neither imposed nor measured."""
    if robot.rig.shows_voltage:
        return tuple(names)
    return tuple(n for n in names if n not in ELECTRICAL)


def with_guide_share(robot: Robot, configuration: str) -> tuple[Robot, Priors]:
    """Robot with the guide load share of the track model, and the prior of its guide friction that follows from it.

    The prior keeps the product of friction and share, on which all fidelities agree. Table 4 measured the friction
    only. With all of the weight on the guides, its value of 0.20 contradicts every measured current.

    Args:
        configuration: a configuration on tracks.

    Returns:
        The robot, and (mean, sd) of the guide friction by its name.
    """
    parameters = parameters_by_name(robot)
    share_name, friction_name = f"{configuration}.{GUIDE_SHARE}", f"{configuration}.{GUIDE_FRICTION}"
    friction, share = float(parameters[friction_name].value), float(parameters[share_name].value)
    sd = friction * parameters[share_name].spec.prior_sd(share) / GUIDED
    return params.replace(robot, {share_name: jnp.asarray(GUIDED)}), {friction_name: (friction * share / GUIDED, sd)}


def choose_free_names(
    robot: Robot, default: Sequence[str], free: Sequence[str] = (), fix: Sequence[str] = ()
) -> Names:
    """Names of the free parameters: `free` if given, otherwise the default ones, in both cases without `fix`.

    In `free`, `default` stands for the default names. A name that ends in `.*` stands for all parameters below it.

    Raises:
        BadConfiguration: a name is unknown (the message lists the choices), a name is both freed and fixed, or
            nothing is left to fit.
    """
    known_names = list(parameters_by_name(robot))
    free_names: list[str] = []
    for word in free:
        free_names += default if word == "default" else expand_name(word, known_names, "--free")
    fixed = [n for word in fix for n in expand_name(word, known_names, "--fix")]
    conflicting = [word for word in free if word in fix]
    if conflicting:
        raise BadConfiguration(f"--free and --fix both name {conflicting[0]}; name it once")
    names = [n for n in dict.fromkeys(free_names if free else default) if n not in fixed]
    if not names and not fix:
        raise BadConfiguration(
            "no parameter to fit: every loss is zero or exact, and no value has a ±; give values a ±, or name a "
            "parameter with --free"
        )
    if not names:
        raise BadConfiguration("--fix leaves no parameter to fit; name at least one with --free")
    return tuple(names)


def expand_name(word: str, names: list[str], option: str) -> list[str]:
    """Parameters that a word stands for: one parameter or, if it ends in `.*`, all below that name.

    Raises:
        BadConfiguration: there is no such parameter. The message names the option and the choices.
    """
    if word.endswith(".*"):
        names_below = [n for n in names if n.startswith(word[:-1])]
        if names_below:
            return names_below
        groups = sorted({n.rsplit(".", 1)[0] + ".*" for n in names})
        raise BadConfiguration(f"{option} {word}: no parameters below it; {allowed_words(word, groups)}")
    if word not in names:
        raise BadConfiguration(
            f"{option} {word}: no such parameter; {allowed_words(word, _similar_names(word, names))}"
        )
    return [word]


def _similar_names(word: str, names: list[str]) -> list[str]:
    """Names to suggest for an unknown one: those with the same last part, or of the same group, or all."""
    last_part = word.rsplit(".", 1)[-1]
    similar = [n for n in names if last_part and (n.endswith(f".{last_part}") or last_part in n)]
    return similar or [n for n in names if n.split(".")[0] == word.split(".")[0]] or names


_PRIOR = re.compile(r"^(?P<name>[\w.-]+)=(?P<value>[^±]+?)(?:±|\+-|\+/-)(?P<sd>.+)$")


def parse_prior(text: str) -> tuple[str, float, float]:
    """Reads `name=value±sd` (also `+-`, and an sd in %) as name, mean and sd in SI units.

    Raises:
        BadConfiguration: the form is different, a number is missing, or the sd is not positive.
    """
    form = "expected name=value±sd in SI units, e.g. 6T2A.ground.friction.static=0.45±0.05 or ...=0.45±10%"
    match = _PRIOR.match(text.strip())
    if match is None:
        raise BadConfiguration(f"--prior {text}: {form}")
    try:
        mean = float(match["value"])
        sd_text = match["sd"].strip()
        sd = abs(mean) * float(sd_text[:-1]) / 100 if sd_text.endswith("%") else float(sd_text)
    except ValueError:
        raise BadConfiguration(f"--prior {text}: {form}") from None
    if not (math.isfinite(mean) and math.isfinite(sd) and sd > 0):
        raise BadConfiguration(f"--prior {text}: expected a positive sd; {form}")
    return match["name"], mean, sd


def parse_priors(texts: Sequence[str]) -> Priors:
    """Reads stated priors as name → (mean, sd). Each text is in the format of `parse_prior`.

    Raises:
        BadConfiguration: for the same reasons as `parse_prior`, or if a name is given twice.
    """
    priors: dict[str, tuple[float, float]] = {}
    for text in texts:
        name, mean, sd = parse_prior(text)
        if name in priors:
            raise BadConfiguration(f"--prior {name}: given twice; expected once")
        priors[name] = (mean, sd)
    return priors


def parameter_coordinates(
    robot: Robot,
    names: Sequence[str],
    stated: Priors | None = None,
    *,
    any_surface: bool = False,
) -> Coordinates:
    """Coordinates of parameters, with priors as stated or from their fields, around the values of the robot.

    Args:
        robot: robot whose values are the prior means (medians for log-normal priors).
        names: names of the free parameters, from `choose_free_names`.
        stated: name → (mean, sd) [SI]. They take precedence over priors of the file (`Rig.priors`), and these over
            those of the fields.
        any_surface: True to use the priors of `SURFACE` for ground friction without a stated prior.

    Raises:
        BadConfiguration: a stated prior belongs to an unknown or fixed parameter, or a mean is out of bounds. Also if
            the prior of a free parameter has zero width (value 0 with a relative sd, or stated as exact).
    """
    stated = stated or {}
    parameters = parameters_by_name(robot)
    for name in names:
        if name in robot.rig.exact and name not in stated:
            raise BadConfiguration(f"--free {name}: the robot's file states ± 0; state its ± with --prior")
    for name in stated:
        if name not in parameters:
            raise BadConfiguration(
                f"--prior {name}: no such parameter; {allowed_words(name, _similar_names(name, list(parameters)))}"
            )
        if name not in names:
            raise BadConfiguration(f"--prior {name}: it is not free; add --free {name} (with --free default)")
    relative_sds = {n: SURFACE[n.split(".", 1)[-1]] for n in names if any_surface and n.split(".", 1)[-1] in SURFACE}
    surface_configurations = {c for pair in robot.rig.surfaces for c in pair}
    surface_sds = {
        n: SURFACE_OF_RIGS.get(n.split(".", 1)[-1]) for n in names if n.split(".")[0] in surface_configurations
    }
    relative_sds |= {n: share for n, share in surface_sds.items() if share is not None}
    if not robot.rig.inherits:
        relative_sds = {
            n: sd for n in names for end, sd in RELATIVE_OF_RIGS.items() if n.endswith(end)
        } | relative_sds
    means_and_sds = {
        n: (float(parameters[n].value), float(parameters[n].value) * share) for n, share in relative_sds.items()
    }
    means_and_sds |= {**{n: (mean, sd) for n, mean, sd in robot.rig.priors if n in names}, **stated}
    rows = [_coordinate_of_parameter(parameters[name], means_and_sds.get(name)) for name in names]
    *numbers, scale = zip(*rows, strict=True)
    pairs = [(f"{c}.{follower}", f"{c}.{leader}") for c in robot.configurations for follower, leader in TIED]
    pairs += [(n, leader) for n in parameters if (leader := _leading_parameter(robot, n)) is not None]
    tied = tuple(
        (follower, names.index(leader), float(parameters[follower].value / parameters[leader].value))
        for follower, leader in pairs
        if leader in names and follower not in names
    )
    location, spread, low, high = map(jnp.asarray, numbers)
    return Coordinates(
        location,
        spread,
        low,
        high,
        tuple(names),
        tuple(parameters[name].spec.unit for name in names),
        scale,
        jnp.asarray([ratio for _, _, ratio in tied]),
        tuple((follower, k) for follower, k, _ in tied),
    )


def _coordinate_of_parameter(
    parameter: Parameter, stated: tuple[float, float] | None
) -> tuple[float, float, float, float, bool]:
    """Location, spread, low and high [θ or log θ] of a parameter, and True for a scale."""
    spec = parameter.spec
    low, high = spec.bounds
    mean, sd = stated or (float(parameter.value), spec.prior_sd(float(parameter.value)))
    if not low <= mean <= high:
        raise BadConfiguration(f"--prior {parameter.name}: got {mean:g}; expected {low:g} to {high:g} {spec.unit}")
    if stated is not None and not 0 < sd < math.inf:
        raise BadConfiguration(f"--prior {parameter.name}: got an sd of {sd:g}; expected more than 0")
    if sd <= 0:
        raise BadConfiguration(
            f"--free {parameter.name}: its prior has no width (value 0 with a relative sd); state one with "
            f"--prior {parameter.name}=value±sd"
        )
    if spec.relative_sd is None or low < 0 or mean <= 0:
        return mean, sd, low, high, False
    spread = math.sqrt(math.log1p((sd / mean) ** 2))
    return math.log(mean), spread, math.log(low) if low > 0 else -math.inf, math.log(high), True
