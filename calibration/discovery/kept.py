"""File of the refitted robot, and the time budget of a loop."""

from __future__ import annotations

#: File of the robot as fitted, without effects that were found; it is written as soon as it is known.
REFIT_FILE = "fitted.toml"


class OutOfTime(KeyboardInterrupt):
    """Raised if the time budget is spent before a verdict. The loop then ends as if interrupted."""
