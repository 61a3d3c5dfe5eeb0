"""Instructions for an engineer: calibration acts, runs of the menu, readings to take and limits to watch."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from types import SimpleNamespace

from calibration.described import describe
from calibration.discovery import menu
from calibration.inference import bases
from mmrjax.effects import OF_TURNS, Effect
from mmrjax.effects.base import THE_SIDE
from mmrjax.model import channels
from mmrjax.model.channels import find_channel
from mmrjax.model.quantities import RPM

# --- amounts --------------------------------------------------------------------------------------------


def join_words(words: Sequence[str]) -> str:
    """«a, b and c»."""
    *others, last = words
    return f"{', '.join(others)} and {last}" if others else last


def join_amounts(values: Sequence[float], unit: str) -> str:
    """«15 and 33 V», each once, in order."""
    return f"{join_words([f'{v:g}' for v in sorted(set(values), key=abs)])} {unit}"


#: Torque below which it is in mN·m [N·m].
SMALL = 0.1


def join_torques(values: Sequence[float]) -> str:
    """«0, 0.2 and 0.4 N·m». In mN·m where all are below `SMALL`."""
    factor, unit = (1e3, "mN·m") if max(map(abs, values)) < SMALL else (1.0, "N·m")
    return join_amounts([menu.round_significant(factor * v, 3) for v in values], unit)


def join_slopes(angles: Sequence[float]) -> str:
    """«on the level and up 10 and 20 deg»."""
    words = ["on the level"] if any(s == 0 for s in angles) else []
    for word, sign in (("up", 1), ("down", -1)):
        some = [abs(s) for s in angles if s * sign > 0]
        words += [f"{word} {join_amounts(some, 'deg')}"] if some else []
    return join_words(words)


# --- the menu -------------------------------------------------------------------------------------------

#: Instructions for each calibration act, by its name; the setting fills the gap.
ACTS = {
    "zero current": "Switch the motors off and read the ammeter",
    "zero reading": "Switch the motors off, with the shaft at rest and unloaded, and read the {}",
    "shunt": (
        "Replace the robot with a load and a precision shunt in series, set {} on the shunt, and read the ammeter"
    ),
    "strobe": "Set the motor to {} with a stroboscope and read the tachometer",
    "timing": "Drive at {} between two light gates a measured distance apart, and compare both speeds",
}
#: Units of what they set.
UNITS = {"shunt": "A", "strobe": "rad/s", "timing": "m/s", "zero current": ""}
#: Instructions for each kind of runs.
DOING = {
    "travel": "travel",
    "run": "run",
    "backwards": "travel backwards",
    "other way": "run in the other direction",
    "about": "reverse the slope, set with the same inclinometer, and travel forwards",
    "laden": "travel with {payload:g} kg",
    "lifted": "put the robot on stands, the movers in the air, and run",
    "one lifted": "put the robot on stands, {others}, and run",
    "alone": "Uncouple the {gears} and run the motors alone",
    "braked": "Uncouple the {gears} and put a brake of {brake:g} mN·m on each motor shaft, and run",
    "held": "Hold {shafts} in a vice and switch on for a moment,",
    "one held": "Hold one motor's shaft in a vice, {others}, and switch on for a moment,",
}


def experiment_sentences(e: menu.Experiment) -> str:
    """Instruction of one experiment: the run, the readings, and the limits to watch."""
    return _act(e) if isinstance(e, menu.CalibrationAct) else _run(e)


def _act(act: menu.CalibrationAct) -> str:
    if act.name == "weigh":
        configurations, payload = {k for k, _ in act.at}, max(m for _, m in act.at)
        configuration_words = {1: "", 2: "in both configurations, "}.get(
            len(configurations), "in each configuration, "
        )
        laden = f"unladen and with the payload of {payload:g} kg, " if payload > 0 else "unladen, "
        return f"Weigh the robot {configuration_words}{laden}to within 20 g, and compare with the robot file"
    (kind,) = act.kinds
    if act.channel:
        return ACTS[kind].format(channels.find_channel(act.channel).label)
    return ACTS[kind].format(join_amounts([v for (v,) in act.at], UNITS[kind]))


def _run(run: menu.ProposedRuns) -> str:
    level = (run.imposed != "voltage" or bool(run.torque)) and not any(run.slope)
    slope_words = "" if run.setup in menu.WEIGHTLESS or level else f" {join_slopes(run.slope)}"
    read = join_words([channels.find_channel(c).label for c in run.channels])
    turning = [menu.round_significant(v / RPM) for v in run.voltage]
    unit = {"voltage": "V", "motor_current": "A per motor"}.get(run.imposed)
    levels = join_amounts(turning, "rpm at the motor") if unit is None else join_amounts(run.voltage, unit)
    against = f" against a brake of {join_torques(run.torque)}" if any(run.torque) else ""
    text = f"{_doing(run)}{slope_words} at {levels}{against}. Read {read}"
    return ". ".join([text, *(f"Watch {describe(limit)}" for limit in run.watch)])


def _doing(run: menu.ProposedRuns) -> str:
    doing = DOING[run.doing].format(
        payload=run.payload[0],
        brake=1e3 * run.brake,
        others="the other motor disconnected" if run.motors == 2 else "all motors but one disconnected",
        gears="gearbox" if run.motors == 1 else "gearboxes",
        shafts={1: "the motor's shaft", 2: "both motor shafts"}.get(run.motors, f"all {run.motors} motor shafts"),
    )
    return f"{run.where}: {doing}" if run.where else doing


def heated_winding(temperature: float, allowed: float | None) -> str:
    """Phrase for how hot a winding gets that stays energised.

    Args:
        temperature: steady-state temperature, infinite if there is none [°C].
        allowed: permitted temperature, None if unknown [°C].
    """
    settles = math.isfinite(temperature)
    would = f"would reach {temperature:.0f} °C" if settles else "would burn out"
    return f"a winding that stays energised {would}{'' if allowed is None else _temperature_limit(allowed)}"


def _temperature_limit(temperature: float) -> str:
    """Temperature limit of a winding, if stated."""
    return f" (limit {temperature:.0f} °C)" if temperature < menu.UNLIMITED else ""


# --- what is proposed -----------------------------------------------------------------------------------


def instruction_for_further_runs(what: SimpleNamespace) -> str:
    """More runs along the variable of a discrepancy, from the values of `denser_runs_instruction`."""
    if what.variable in bases.ORDERS:
        three = [f"{menu.round_significant(v):g}" for v in (what.low, 0.5 * (what.low + what.high), what.high)]
        return (
            "Mark the driving shaft, start every run with it at the mark, and record steady travel at "
            f"{', '.join(three[:2])} and {three[2]} V with at least 20 samples per wave. The part that turns at "
            f"{what.variable} at every speed causes it"
        )
    happens = bases.window_from_name(what.variable)
    if happens is not None:
        return _repeat_instruction(happens)
    if what.within.imposed != "voltage":
        by_kind = _of_level(what)
    else:
        by_kind = {} if what.within.has_ground else _advice_for_shaft(what)
    last = f"Repeat, and vary the {bases.variable_in_words(what.variable)} in small, equal steps over its range"
    return (_advice_by_variable(what) | by_kind).get(what.variable, last)


def _repeat_instruction(happens: bases.Window) -> str:
    """The same runs, where something happens for a while or at one level."""
    if happens.axis == "order":
        return (
            f"Make runs {happens.low:.0f} to {happens.high:.0f} again in another order, with as many before and "
            "after. An error that returns depends on their conditions, else it was an event"
        )
    if happens.axis != "time":
        return f"Make the runs at {happens.words} again on another day, with as many slightly below and above"
    return (
        f"Repeat two runs, sampled as finely as possible from {happens.low:.3g} to {happens.high:.3g} s. In one, "
        "switch nothing in that time"
    )


def _steps(what: SimpleNamespace, first: str = "") -> str:
    """`the supply voltage in 15 even steps up to 8 V`: what drives the motors, as the table varied it."""
    top = menu.round_significant(what.top)
    if what.by_duty:
        return f"the duty{_up_to(max(what.within.duties), what.runs, first=first)} at {top:g} V"
    return f"the supply voltage{_up_to(what.top, what.runs, 'V', first)}"


def _up_to(most: float, runs: int, unit: str = "", first: str = "") -> str:
    """` from crawl to 12 V in steps of 1 V`: levels that a person can set."""
    step = menu.step_of_settings(most, runs)
    last, step_words = (f"{x:g} {unit}".rstrip() for x in (menu.last_setting(most, step), step))
    return (
        f" from a {first} to {last} in steps of {step_words}" if first else f" up to {last} in steps of {step_words}"
    )


def _advice_by_variable(what: SimpleNamespace) -> dict[str, str]:
    """Advice by variable, for a vehicle with an imposed voltage."""
    low, high, within = what.low, what.high, what.within
    load = [f"a payload up to {what.payload:g} kg"] * bool(what.payload > 0)
    load += [f"a slope up to {what.slope:g} deg"] * bool(what.slope > 0)
    loaded = " and ".join(load) or "a brake or a drawbar pull"
    volts, angle, mass = what.steps
    by_duty = what.by_duty
    driven = f"the supply voltage from {low:g} to {high:g} V in steps of {volts:g} V"
    crawl = (
        _steps(what, "crawl") if by_duty else f"the supply voltage in steps of {volts:g} V from a crawl to {high:g} V"
    )
    return {
        "voltage": f"Repeat at one slope and payload with {_steps(what) if by_duty else driven}",
        "current": (
            f"Repeat at {high:g} V with {loaded}, raised in small steps, so that the current covers no load to "
            f"about {within.current * within.motors:.2g} A evenly"
        ),
        "speed_motor": f"Repeat on the level, unladen, with {crawl}",
        "slope": (
            f"Repeat at one voltage and payload with slopes from 0 to {what.slope:g} deg in steps of {angle:g} "
            "deg, and downhill"
        ),
        "payload": (
            f"Repeat at one voltage and slope with payloads from 0 to {what.payload:g} kg in steps of {mass:g} kg"
        ),
        "speed": (
            "Repeat on the level, unladen, with the speed in equal steps from a crawl to about "
            f"{within.speed:.2g} m/s at {high:g} V"
        ),
        "time": (
            f"Record one condition for ten minutes from a cold start, at no more than {low:g} V, and again while "
            f"warm. Watch the winding's temperature{_temperature_limit(within.hot)}"
        ),
        "order": "Repeat the table in reverse order, with one condition after every fifth run",
    }


def _of_level(what: SimpleNamespace) -> dict[str, str]:
    """Advice by variable, for an imposed speed or current of the motors."""
    within_words = what.within
    level = "Repeat on the level, unladen," if within_words.has_ground else "Repeat"
    of_speed = within_words.imposed == "motor_speed"
    most = max(within_words.levels, default=within_words.motor_speed if of_speed else within_words.current)
    name, levels = ("motor speed", (most / RPM, "rpm")) if of_speed else ("motor current", (most, "A"))
    turning = f"with the {name}{_up_to(levels[0], what.runs, levels[1])}"
    words = {
        "speed_motor": f"{level} {turning}",
        "speed": f"{level} {turning}",
        "slope": f"Repeat at one {name} and payload with the slope from 0 to {what.slope:g} deg, and downhill",
        "payload": f"Repeat at one {name} and slope with the payload from 0 to {what.payload:g} kg",
        "time": f"Repeat at one {name} for ten minutes from a cold start, and again while warm",
    }
    if not within_words.has_ground:
        words["current"] = (
            f"{level} at one {name} with {_brake(what)}" if any(within_words.torques) else words["speed_motor"]
        )
    return words


def _brake(what: SimpleNamespace) -> str:
    """`the brake's torque up to 0.8 N·m in steps of 0.05 N·m`, as the table varied it."""
    most = max(what.within.torques)
    size, unit = (1e3, "mN·m") if most < SMALL else (1.0, "N·m")
    return f"the brake's torque{_up_to(size * most, what.runs, unit)}"


def _advice_for_shaft(what: SimpleNamespace) -> dict[str, str]:
    """Advice by variable, for a shaft as the load."""
    crawl, top = f"Repeat with {_steps(what, 'crawl')}", menu.round_significant(what.top)
    return {
        "voltage": f"Repeat with {_steps(what)}",
        "speed_motor": crawl,
        "speed": crawl,
        "current": f"Repeat at {top:g} V with {_brake(what)}" if any(what.within.torques) else crawl,
    }


#: Code of an instruction or of what to watch → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "nothing_possible": "Every experiment of the menu is forbidden or impossible on this bench",
    "no_menu": "The menu has no experiments for {word}",
    "nothing_tells": lambda names, sigma: (
        f"No experiment of the menu separates {' and '.join(names)} by {sigma:g} σ. Repeat the runs to average "
        "out noise, or measure one part alone"
    ),
    "too_weak": (
        "Runs over {variable} would show the missing term with only {sigma:.1f} σ. Repeat them to average out noise"
    ),
    "carry_out": lambda experiments: ". Then: ".join(map(experiment_sentences, experiments)),
    "more_runs": lambda **series: (
        f"{instruction_for_further_runs(SimpleNamespace(**series))}. Read every channel. This shows how the "
        f"missing term of the {bases.place_in_words(series['place'])} depends on it"
    ),
    "overspeed": lambda speed, limit, voltage: (
        f"the motor speed: about {speed / RPM:.0f} rpm unloaded at {voltage:g} V, at most {limit / RPM:.0f} rpm. "
        "Raise the voltage slowly"
    ),
    "overvoltage": "the supply: {voltage:g} V is above the highest voltage in the table, {used:g} V",
    "held_motor": lambda current, **heat: (
        f"the heating: {current:.2g} A flow through a stationary, uncooled motor, and {heated_winding(**heat)}. "
        "Switch off within seconds and let the motor cool"
    ),
    "braked_motor": lambda **heat: (
        f"the brake and the winding's temperature: {heated_winding(**heat)}. A few seconds suffice"
    ),
    "hot_motor": lambda **heat: f"the winding's temperature: {heated_winding(**heat)}. Keep the runs short",
}


# --- effects, and tests that distinguish them on a bench ------------------------------------------


#: Tests that isolate a balance: rows of `experiments.DOING`, `weigh`, and of a channel of `sensor` rows of `ACTS`.
ISOLATED_BY = {
    "mass": ("weigh",), "duty": ("alone",), "supply": ("held", "one held"), "electrical": ("held", "alone"),
    "motor": ("alone",),
    "gearbox": ("braked", "lifted"), "track": ("lifted",), "ground": ("laden", "about"), "slip": ("laden",),
    "inertia": ("lifted",), "inductance": ("held",),
}  # fmt: skip
CHECKED_BY = {"total_current": ("zero current", "shunt"), "motor_speed": ("strobe",), "speed": ("timing",)}
#: Test of any other channel.
COMPARE = "Compare the instrument for the {} with a second one, at several values"
#: Condition to vary, all others constant, so that a term that depends on a signal changes.
VARY = {
    "speed": "the speed (the supply voltage)", "current": "the current (slope or payload at one voltage)",
    "load": "the load (slope or payload at one voltage)", "slope": "the slope", "weight": "the payload",
    "duty": "the duty at one supply voltage",
    "configuration": "the configuration", "direction": "the direction of travel",
    "demand": "the demand on adhesion (slope or payload)", "angle": "nothing: sample fast enough for one revolution",
    THE_SIDE: "nothing: compare both sides straight and in turns both ways",
    "position": "the position: cover the whole travel in both directions at one voltage",
    "": "nothing: its share is the same in every run",
}  # fmt: skip
WEIGH = "Weigh the robot, unladen and laden, and compare with the robot file"


def effect_summary(effect: type[Effect]) -> tuple[str, str, str]:
    """Equation, meaning and source of an effect, each on one line."""
    text, _, source = (effect.__doc__ or "").partition("Source:")
    equation, meaning = ([" ".join(part.split()) for part in text.split("\n\n")] + [""])[:2]
    return equation.rstrip("."), meaning, " ".join(source.split())


def effect_declarations(effect: type[Effect]) -> Iterator[str]:
    """Declarations of an effect in addition to its equation."""
    words = [
        "dissipative" * effect.dissipative,
        "only in time histories" * effect.transient,
        "only in turns" * (effect.name in OF_TURNS),
        f"settles to `{effect.settles_to}`" * bool(effect.settles_to),
        "only on the battery" * effect.needs_battery,
        "only in runs in both directions" * effect.needs_reverse,
        "only at a duty below 1" * effect.needs_duty,
        "same direction both ways" * effect.odd_in_travel,
        f"only on {effect.movers}" * bool(effect.movers),
        f"proportional to `{', '.join(effect.rests_on)}`" * bool(effect.rests_on),
    ]
    yield from filter(None, words)


def effect_tests(effect: type[Effect]) -> Iterator[str]:
    """Bench tests that distinguish it from other effects: how to isolate its balance, and the change to make."""
    if effect.channel:
        for name in CHECKED_BY.get(effect.channel, ()):
            yield ACTS[name].format("several values")
        if effect.channel not in CHECKED_BY:
            channel_shown = find_channel(effect.channel)
            yield from [ACTS["zero reading"].format(channel_shown.label)] * channel_shown.misses_zero
            yield COMPARE.format(channel_shown.label)
        return
    for name in ISOLATED_BY.get(effect.balance, ()):
        if name == "weigh":
            yield WEIGH
        else:
            text = DOING[name].format(
                payload=8,
                brake=20,
                others="all motors but one disconnected",
                gears="gearboxes",
                shafts="the motor shafts",
            )
            yield f"{text[0].upper()}{text[1:].rstrip(',')}, at several voltages"
    variation = VARY.get(effect.driver, f"the {effect.driver}")  # one's own may go with anything
    yield f"Vary {variation}" + (", from rest, over time" if effect.transient or effect.settles_to else "")
