"""Steps of long computations, one row each."""

from __future__ import annotations

from mmrjax.errors import count_noun

STEPS = {
    # the loop
    "base": "fitting the base model",
    "sds": "refitting with the sds of the residuals",
    "bootstrap": "bootstrap of {} tables",
    "effects": "something is missing: fitting every effect",
    "more effects": "{}: fitting further effects",
    "alone": "fitting again without outliers",
    "mechanism": "mechanisms of the misfit",
    "alike": "effects that explain as much as {}",
    "held out": "predictions of held-out runs",
    "confirm": "simulation of the chosen model",
    "factors": "meanwhile, the verdict with {} times the {} noise",
    "shape": "the shape of the missing term",
    "errors": "errors on held-out data",
    "next": "the next experiment",
    "others": "the verdicts at other noise levels",
    # a sensitivity study
    "points": "derivatives at every operating point",
    "evaluations": "{:,} model evaluations so far, {:,.0f} a second",
    # requirements and sizing
    "requirement": "requirement {} of {}: {}",
    "changes": "changes for missed requirement {} of {}: {}",
    "designs": "1 of 3, random designs of every combination",
    "whole": "2 of 3, makers' ratios and whole cells",
    "refined": "3 of 3, the best {} designs, with continuous numbers",
    # a calibration
    "optimum": "optimum found, now {}",
    "steady": "fitting the steady model first",
    "delay": "fitting again with a delay",
    "derivatives": "checking derivatives at the best member",
    "search": "  step {}: objective {:.4f}, {:.1f} min",
    "round": "round {}: objective {:.4f} after {} steps, {:.1f} min",
    "start": "start {} of {}: objective {:.4f} after {} steps, {:.1f} min",
    "basin": "a lower minimum in {}: objective {:.4f}",
    "members": "generation {}: {} of {} members, {:.1f} min",
    "generation": "generation {}: lowest objective {:.4g}, median {:.4g}, {} failed",
}


#: Stage of the loop to which each step belongs, counted from 1, and number of stages.
STAGES = {
    **{"base": 1, "sds": 1, "bootstrap": 2, "effects": 3, "more effects": 3, "alone": 3},
    **{
        "held out": 4,
        "confirm": 4,
        "mechanism": 4,
        "alike": 4,
        "factors": 5,
        "shape": 5,
        "errors": 5,
        "next": 6,
        "others": 7,
    },
}
OF = max(STAGES.values())
#: Share of a loop's time that has passed when a stage begins. Measured for logs without stored results, a guess for
#: others.
OVER = {2: 0.45, 3: 0.5, 4: 0.7, 5: 0.75, 6: 0.8, 7: 0.9}


def step_sentence(name: str, about: tuple[object, ...]) -> str:
    """Progress message on a step, with the number of its stage of the loop."""
    text = STEPS[name].format(*(" and ".join(x) if isinstance(x, tuple) else x for x in about))
    return f"{STAGES[name]} of {OF}, {text}" if name in STAGES else text


def expected_time(text: str, seconds: float) -> float | None:
    """Expected remaining time of a loop [s], from the time of its earlier stages. None if it is unknown.

    Args:
        text: line of a stage that begins.
        seconds: seconds since the loop began.
    """
    stage, _, detail = text.partition(f" of {OF}, ")
    share_done = OVER.get(int(stage)) if detail and stage.isdigit() else None
    return None if share_done is None else seconds * (1 - share_done) / share_done


def still_running_sentence(doing: str, seconds: float, compiled: int) -> str:
    """Message on a step that is still running: its duration and the number of compiled programs."""
    programs = f", {count_noun(compiled, 'program')} compiled" if compiled else ""
    return f"still {doing} ({seconds:.0f} s{programs})"
