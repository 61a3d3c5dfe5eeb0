"""The closed loop: the model error of a fitted robot, traced to a balance and, if one fits, to an effect."""

#: File of the fitted robot without the effects that the loop adds. It is written as soon as it is known.
REFIT_FILE = "fitted.toml"


class OutOfTime(KeyboardInterrupt):
    """Raised if the time budget is spent before a verdict. The loop then ends as if interrupted."""
