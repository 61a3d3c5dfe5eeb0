"""Steps of long computations, one row each."""

from __future__ import annotations

from mmrjax.errors import count_noun

STEPS = {
    # the loop
    "base": "fitting the base model",
    "sds": "the stated sds do not fit: the same with sds from the residuals",
    "bootstrap": "bootstrap of {} tables: what would a complete model leave?",
    "effects": "something is missing: fitting every effect that could explain it",
    "more effects": "{}: not everything is explained, fitting further effects",
    "alone": "outlying rows found: the same without them",
    "mechanism": "which mechanism explains most of it?",
    "alike": "what else explains as much as {}?",
    "held out": "which of those predicts held-out runs best?",
    "factors": "the verdict with {} times the {} noise, next to:",
    "shape": "the shape of what is missing",
    "errors": "errors on data held out",
    "next": "the next experiment",
    "others": "the verdicts with the other noises",
    "gear stated": "resolved: friction through the track model, its running gear as stated",
    "gear free": "resolved: the running gear free",
    # a sensitivity study
    "points": "derivatives at every operating point",
    "evaluations": "{:,} model evaluations so far, {:,.0f} a second",
    # requirements and sizing
    "requirement": "requirement {} of {}: {}",
    "changes": "changes that would meet missed requirement {} of {}: {}",
    "designs": "1 of 4, random designs of every choice of parts",
    "descents": "2 of 4, {} searches by gradients",
    "whole": "3 of 4, ratios of the sheets and whole cells",
    "refined": "4 of 4, the best {} with any ratio and fractions of a cell",
    # a calibration
    "optimum": "optimum found; now {}",
    "steady": "the same with steady first, to begin from its optimum",
    "derivatives": "population done; now derivatives against differences at the best",
    "search": "  step {}: objective {:.4f}, {:.1f} min",
    "round": "round {}: objective {:.4f} after {} steps, {:.1f} min",
    "start": "start {} of {}: objective {:.4f} after {} steps, {:.1f} min",
    "basin": "a lower basin of {}: objective {:.4f}",
    "members": "generation {}: {} of {} members, {:.1f} min",
    "generation": "generation {}: lowest objective {:.4g}, median {:.4g}, {} failed",
}


#: Stage of the loop that a step belongs to, from 1 on, and how many there are.
STAGES = {
    **{"base": 1, "sds": 1, "bootstrap": 2, "effects": 3, "more effects": 3, "alone": 3},
    **{"held out": 4, "mechanism": 4, "alike": 4, "factors": 5, "shape": 5, "errors": 5, "next": 6, "others": 7},
}
OF = max(STAGES.values())
#: Share of a loop's time that is over when a stage begins: of logs with nothing kept, a guess for others.
OVER = {2: 0.45, 3: 0.5, 4: 0.7, 5: 0.75, 6: 0.8, 7: 0.9}


def step_sentence(name: str, about: tuple[object, ...]) -> str:
    """A step in a sentence, a stage of the loop with its number."""
    text = STEPS[name].format(*(" and ".join(x) if isinstance(x, tuple) else x for x in about))
    return f"{STAGES[name]} of {OF}, {text}" if name in STAGES else text


def expected_time(text: str, seconds: float) -> float | None:
    """Time that a loop is expected to take yet, by what the stages before took [s], None where that is not known.

    Args:
        text: line of a stage that begins.
        seconds: since the loop began.
    """
    stage, _, rest = text.partition(f" of {OF}, ")
    over = OVER.get(int(stage)) if rest and stage.isdigit() else None
    return None if over is None else seconds * (1 - over) / over


def still_running_sentence(doing: str, seconds: float, compiled: int) -> str:
    """Progress of a running step: its duration and the number of programs compiled."""
    programs = f", {count_noun(compiled, 'program')} compiled" if compiled else ""
    return f"still {doing} ({seconds:.0f} s{programs})"
