"""Result of the command `size`: a design, its alternatives and the limits that bind."""

from __future__ import annotations

import dataclasses

from calibration.data import Json, Names, writing
from calibration.data.requirements_file import Requirements
from calibration.sizing.chart import Chart
from calibration.sizing.design import OBJECTIVES
from calibration.sizing.design_search import SizedDesign, Sizing
from calibration.sizing.sheet import Outcome
from mmrjax.errors import count_noun
from mmrjax.model.robot import Robot
from sweeps.results.check_results import requirement_label


@dataclasses.dataclass(frozen=True)
class SizeResult:
    """Designs for some requirements.

    Attributes:
        asked: the requirements; robot: where the search started; sizing: its result; objectives: minimised numbers.
        outcomes: results of `check` for the best design; empty without one.
        charts: limits over payload and slope of the best design, if any, and of `robot`; empty without a page.
    """

    asked: Requirements
    robot: Robot
    sizing: Sizing
    objectives: Names
    outcomes: tuple[Outcome, ...]
    charts: tuple[Chart, ...] = ()

    def statement(self) -> str:
        """The answer: the best design and its binding limits, or the nearest one and its misses."""
        s = self.sizing
        left_out = f" No parts meet the requirement on {' or '.join(s.unmeetable)}; dropped." if s.unmeetable else ""
        if s.best is None:
            nearest = min(s.motors.values(), key=margin_shortfall, default=None)
            why = (
                f" The nearest, {describe_design(nearest)}, misses {', '.join(missed_limits(nearest))}."
                if nearest
                else ""
            )
            return f"No design of these parts meets the requirements.{why}{left_out}"
        missing = [requirement_label(o) for o in self.outcomes if not (o.met or requirement_label(o) in s.unmeetable)]
        binds = f" Binding limits: {', '.join(s.best.binds) or 'none'}."
        binds += f" It misses {', '.join(missing)}." if missing else ""
        return f"{describe_design(s.best)}: {objective_text(s.best, s.objective)}.{binds}{left_out}"

    def to_json(self) -> Json:
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
            "requirements": writing.json_value(self.outcomes),
            "starts": s.starts,
            "evaluated": s.evaluated,
        }


def design_verdict(found: SizedDesign, unmeetable: Names) -> str:
    """Verdict on a design; `unmeetable`: requirements that no choice of parts meets, which were dropped."""
    return "misses" if not found.feasible else "meets the others" if unmeetable else "meets"


def margin_shortfall(found: SizedDesign) -> float:
    """Sum of the margins that a design misses [-]."""
    return sum(max(-m, 0.0) for m in found.margins.values())


def missed_limits(found: SizedDesign) -> list[str]:
    """Limits that a design misses, with their margins."""
    return [f"{label} ({100 * m:+.1f} %)" for label, m in sorted(found.margins.items(), key=lambda x: x[1]) if m < 0]


def describe_design(found: SizedDesign) -> str:
    """Motor, gearbox, ratio, radius and cells of a design."""
    stages = count_noun(found.drive.stages, "stage")
    return (
        f"{found.drive.motor.name}, {found.drive.family} with {stages}, ratio {found.ratio:.4g}, radius "
        f"{1000 * found.radius:.1f} mm, {found.in_series} × {found.parallel:.3g} {found.cell.name}"
    )


def objective_text(found: SizedDesign, name: str) -> str:
    """An objective with its unit, or `not stated` if no sheet states it."""
    unit, words = OBJECTIVES[name]
    return f"{words} {found.objectives[name]:.4g} {unit}" if name in found.objectives else f"{words} not stated"
