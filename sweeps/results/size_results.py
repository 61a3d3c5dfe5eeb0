"""What the command `size` found: a design, its alternatives, and what binds."""

from __future__ import annotations

import dataclasses
from typing import Any

from calibration.data.requirements_file import Requirements
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign, Sizing
from calibration.sizing.sheet import Outcome
from mmrjax.model.robot import Robot


@dataclasses.dataclass(frozen=True)
class SizeResult:
    """What the command found.

    Attributes:
        asked: the requirements; robot: that was changed; sizing: what the search found; objectives: that were asked
            for; outcomes: the best held against the requirements as `check` does, empty where there is none.
    """

    asked: Requirements
    robot: Robot
    sizing: Sizing
    objectives: tuple[str, ...]
    outcomes: tuple[Outcome, ...]

    def statement(self) -> str:
        """The answer in a sentence."""
        s = self.sizing
        left_out = f" No choice of parts meets {', '.join(s.unmeetable)}, left out." if s.unmeetable else ""
        if s.best is None:
            nearest = min(s.motors.values(), key=short, default=None)
            why = f" The nearest, {described(nearest)}, misses {', '.join(missed(nearest))}." if nearest else ""
            return f"No design of these parts meets the requirements.{why}{left_out}"
        binds = f" What binds: {', '.join(s.best.binds)}." if s.best.binds else " Nothing binds."
        return f"{described(s.best)}: {objective(s.best, s.objective)}.{binds}{left_out}"

    def to_json(self) -> dict[str, Any]:
        """`result.json`."""
        s = self.sizing
        return {
            "schema": "mmrjax.size/1",
            "statement": self.statement(),
            "source": self.asked.source,
            "objectives": list(self.objectives),
            "unmeetable": list(s.unmeetable),
            "best": None if s.best is None else s.best.to_json(),
            "ideal": None if s.ideal is None else s.ideal.to_json(),
            "alternatives": [f.to_json() for f in s.alternatives],
            "motors": [{"motor": name, **f.to_json()} for name, f in s.motors.items()],
            "pareto": [f.to_json() for f in s.front],
            "requirements": [o.to_json() for o in self.outcomes],
            "starts": s.starts,
            "evaluated": s.evaluated,
        }


def verdict(found: SizedDesign, unmeetable: tuple[str, ...]) -> str:
    """Whether a design meets the requirements; `unmeetable`: those that no choice of parts meets, left out of it."""
    return "misses" if not found.feasible else "meets the others" if unmeetable else "meets"


def short(found: SizedDesign) -> float:
    """By how much a design misses, all margins together [-]."""
    return sum(max(-m, 0.0) for m in found.margins.values())


def missed(found: SizedDesign) -> list[str]:
    """What a design misses, by how much."""
    return [f"{label} ({100 * m:+.1f} %)" for label, m in sorted(found.margins.items(), key=lambda x: x[1]) if m < 0]


def described(found: SizedDesign) -> str:
    """A design in words."""
    stages = f"{found.drive.stages} stage{'s' if found.drive.stages > 1 else ''}"
    return (
        f"{found.drive.motor.name}, {found.drive.family} with {stages}, ratio {found.ratio:.4g}, radius "
        f"{1000 * found.radius:.1f} mm, {found.in_series} × {found.parallel:.3g} {found.cell.name}"
    )


def objective(found: SizedDesign, name: str) -> str:
    """An objective with its unit; what no sheet states is said."""
    unit, words = OBJECTIVES[name]
    return f"{words} {found.objectives[name]:.4g} {unit}" if name in found.objectives else f"{words} not stated"
