"""Solvers of optimistix and optax, by the names in `calibrate --solver`. This module does not import jax."""

from __future__ import annotations

from typing import TYPE_CHECKING

from calibration.data.input_errors import stated_word

if TYPE_CHECKING:
    import optimistix as optx

#: Name → class of optimistix.
OF_OPTIMISTIX = {
    "lm": "LevenbergMarquardt",
    "dogleg": "Dogleg",
    "gauss-newton": "GaussNewton",
    "bfgs": "BFGS",
    "dfp": "DFP",
    "lbfgs": "LBFGS",
    "nonlinear-cg": "NonlinearCG",
}
#: Functions of optax that take a learning rate, by their names there.
OF_OPTAX = ("adam", "adamw", "nadam", "radam", "adabelief", "adagrad", "rmsprop", "lion", "sgd")
NAMES = (*OF_OPTIMISTIX, *OF_OPTAX)
#: Relative and absolute tolerance on z and on the objective.
TOLERANCE = 1e-6
#: Learning rate of optax's functions [prior sds].
RATE = 0.02


def solver_by_name(name: str) -> optx.AbstractLeastSquaresSolver | optx.AbstractMinimiser:
    """Solver with one of the names in `NAMES`.

    Raises:
        BadConfiguration: the name is unknown.
    """
    stated_word(name, NAMES, "solver")
    import optax
    import optimistix as optx

    if name in OF_OPTIMISTIX:
        return getattr(optx, OF_OPTIMISTIX[name])(rtol=TOLERANCE, atol=TOLERANCE)
    return optx.OptaxMinimiser(getattr(optax, name)(RATE), rtol=TOLERANCE, atol=TOLERANCE)
