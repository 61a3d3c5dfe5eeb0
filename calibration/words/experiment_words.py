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
    """«0, 0.2 and 0.4 N·m». In mN·m if all are below `SMALL`."""
    factor, unit = (1e3, "mN·m") if max(map(abs, values)) < SMALL else (1.0, "N·m")
    return join_amounts([menu.round_significant(factor * v, 3) for v in values], unit)


def join_slopes(angles: Sequence[float]) -> str:
    """«on the level and up 10 and 20 deg»."""
    words = ["on the level"] if any(s == 0 for s in angles) else []
    for word, sign in (("up", 1), ("down", -1)):
        angles_of_sign = [abs(s) for s in angles if s * sign > 0]
        words += [f"{word} {join_amounts(angles_of_sign, 'deg')}"] if angles_of_sign else []
    return join_words(words)


# --- the menu -------------------------------------------------------------------------------------------

#: Instructions for each calibration act, by its name; the setting fills the gap.
ACTS = {
    "zero current": "Switch the motors off and read the ammeter",
    "zero reading": "With the motors off and the shaft unloaded, read the {}",
    "shunt": ("Replace the robot with a load and a precision shunt, set {} there, and read the ammeter"),
    "strobe": "Set the motor to {} by stroboscope and read the tachometer",
    "timing": "Drive at {} between two light gates, and compare both speeds",
}
#: Unit of the setting of each act.
UNITS = {"shunt": "A", "strobe": "rad/s", "timing": "m/s", "zero current": ""}
#: Instructions for each kind of runs.
DOING = {
    "travel": "travel",
    "run": "run",
    "backwards": "travel backwards",
    "other way": "run in the other direction",
    "about": "reverse the slope, with the same inclinometer, and travel forwards",
    "laden": "travel with {payload:g} kg",
    "lifted": "put the robot on stands and run",
    "one lifted": "put the robot on stands, {others}, and run",
    "alone": "Uncouple the {gears} and run the motors alone",
    "braked": "Uncouple the {gears}, brake each motor shaft with {brake:g} mN·m, and run",
    "held": "Hold {shafts} in a vice and switch on briefly,",
    "one held": "Hold one motor's shaft in a vice, {others}, and switch on briefly,",
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
        loads = f"unladen and with the payload of {payload:g} kg, " if payload > 0 else "unladen, "
        return f"Weigh the robot {configuration_words}{loads}to within 20 g, and compare with the robot file"
    (kind,) = act.kinds
    if act.channel:
        return ACTS[kind].format(channels.find_channel(act.channel).label)
    return ACTS[kind].format(join_amounts([v for (v,) in act.at], UNITS[kind]))


def _run(run: menu.ProposedRuns) -> str:
    is_level = (run.reach.imposed != "voltage" or bool(run.torque)) and not any(run.slope)
    slope_words = "" if run.setup in menu.WEIGHTLESS or is_level else f" {join_slopes(run.slope)}"
    read = join_words([channels.find_channel(c).label for c in run.channels])
    turning = [menu.round_significant(v / RPM) for v in run.voltage]
    unit = {"voltage": "V", "motor_current": "A per motor"}.get(run.reach.imposed)
    levels = join_amounts(turning, "rpm at the motor") if unit is None else join_amounts(run.voltage, unit)
    against = f" against a brake of {join_torques(run.torque)}" if any(run.torque) else ""
    text = f"{_doing(run)}{slope_words} at {levels}{against}. Read {read}"
    return ". ".join([text, *(f"Watch {describe(limit)}" for limit in run.watch)])


def _doing(run: menu.ProposedRuns) -> str:
    motors = run.reach.motors
    doing = DOING[run.doing].format(
        payload=run.payload[0],
        brake=1e3 * run.brake,
        others="the other motor disconnected" if motors == 2 else "all motors but one disconnected",
        gears="gearbox" if motors == 1 else "gearboxes",
        shafts={1: "the motor's shaft", 2: "both motor shafts"}.get(motors, f"all {motors} motor shafts"),
    )
    return doing if run.used is None else f"{run.used.configuration}: {doing}"


def heated_winding(temperature: float, allowed: float | None) -> str:
    """Phrase on the temperature of a winding that stays energised.

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


# --- proposals ------------------------------------------------------------------------------------------


#: Imposed quantity → its name, and its unit where people set it.
IMPOSED = {
    "voltage": ("voltage", "V"), "motor_speed": ("motor speed", "rpm"), "motor_current": ("motor current", "A"),
}  # fmt: skip


def instruction_for_further_runs(series: SimpleNamespace) -> str:
    """Instruction for more runs along the variable of a discrepancy, from the values of `denser_runs_instruction`."""
    (name, _), (_, slope_step, payload_step) = IMPOSED[series.within.imposed], series.steps
    if series.variable in bases.ORDERS:
        voltages = [
            f"{menu.round_significant(v):g}" for v in (series.low, 0.5 * (series.low + series.high), series.high)
        ]
        return (
            "Mark the driving shaft, start every run at the mark, and record steady travel at "
            f"{', '.join(voltages[:2])} and {voltages[2]} V with at least 20 samples per wave. The part that turns "
            f"at {series.variable} causes it"
        )
    window = bases.window_from_name(series.variable)
    if window is not None:
        return _repeat_instruction(window)
    if series.variable == "slope":
        return (
            f"Repeat at one {name} and payload with slopes from 0 to {series.slope:g} deg in steps of {slope_step:g} "
            "deg, and downhill"
        )
    if series.variable == "payload":
        return (
            f"Repeat at one {name} and slope with payloads from 0 to {series.payload:g} kg in steps of "
            f"{payload_step:g} kg"
        )
    if series.variable == "time":
        cool = f"{series.low:g} V or less" if name == "voltage" else f"one {name}"
        return (
            f"Record ten minutes at {cool} from a cold start, and again while warm. Watch the winding's "
            f"temperature{_temperature_limit(series.within.hot)}"
        )
    if series.variable == "order":
        return "Repeat the table in reverse order, and repeat one reference condition after every fifth run"
    return _advice_on_drive(series) or (
        f"Repeat, and vary the {bases.variable_in_words(series.variable)} in small, equal steps over its range"
    )


def _advice_on_drive(series: SimpleNamespace) -> str:
    """Instruction for more levels of the imposed quantity or of the load. Empty for other variables."""
    variable, within, (name, unit) = series.variable, series.within, IMPOSED[series.within.imposed]
    imposes_voltage, top = unit == "V", menu.round_significant(series.top)
    if not imposes_voltage:
        largest = {"rpm": within.motor_speed / RPM, "A": within.current}[unit]
        limit = max((x / RPM if unit == "rpm" else x for x in within.levels), default=largest)
        levels = f"the {name}{_up_to(limit, series.runs, unit)}"
    elif series.by_duty:
        levels = f"the duty{_up_to(max(within.duties), series.runs, first='crawl')} at {top:g} V"
    elif within.has_ground:
        levels = f"the supply voltage in steps of {series.steps[0]:g} V from a crawl to {series.high:g} V"
    else:
        levels = f"the supply voltage{_up_to(series.top, series.runs, 'V', 'crawl')}"
    fixed = f"{series.high:g} V" if imposes_voltage else f"one {name}"
    if variable == "voltage" and imposes_voltage:
        return f"Repeat {'at one slope and payload ' * within.has_ground}with {levels}"
    if within.has_ground and imposes_voltage and variable == "speed":
        return f"Repeat on the level, unladen, with the speed in equal steps up to {within.speed:.2g} m/s at {fixed}"
    if within.has_ground and imposes_voltage and variable == "current":
        load = [f"a payload up to {series.payload:g} kg"] * bool(series.payload > 0)
        load += [f"a slope up to {series.slope:g} deg"] * bool(series.slope > 0)
        loaded, limit = " and ".join(load) or "a brake or a drawbar pull", within.current * within.motors
        return f"Repeat at {fixed} with {loaded}, raised in small steps, up to {limit:.2g} A"
    if not within.has_ground and variable == "current" and any(within.torques):
        limit = max(within.torques)
        factor, torque_unit = (1e3, "mN·m") if limit < SMALL else (1.0, "N·m")
        brake = f"the brake's torque{_up_to(factor * limit, series.runs, torque_unit)}"
        return f"Repeat at {f'{top:g} V' if imposes_voltage else fixed} with {brake}"
    if variable in ("speed_motor", "speed", *["current"] * (not within.has_ground)):
        return f"Repeat {'on the level, unladen, ' * within.has_ground}with {levels}"
    return ""


def _repeat_instruction(window: bases.Window) -> str:
    """Instruction to repeat the runs of a temporary change, or of one level."""
    if window.axis == "order":
        return (
            f"Repeat runs {window.low:.0f} to {window.high:.0f} in a different order, mixed with as many other "
            "runs. If the error returns, their conditions cause it"
        )
    if window.axis != "time":
        return f"Repeat the runs at {window.words} on another day, with some slightly below and above"
    return (
        f"Repeat two runs, finely sampled from {window.low:.3g} to {window.high:.3g} s. In one of them, change no "
        "input during that time"
    )


def _up_to(most: float, runs: int, unit: str = "", first: str = "") -> str:
    """` from crawl to 12 V in steps of 1 V`: levels that a person can set."""
    step = menu.step_of_settings(most, runs)
    last, step_words = (f"{x:g} {unit}".rstrip() for x in (menu.last_setting(most, step), step))
    return (
        f" from a {first} to {last} in steps of {step_words}" if first else f" up to {last} in steps of {step_words}"
    )


#: Code of an instruction or of what to watch → a sentence with its values, or a function that makes one.
SAID: dict[str, str | Callable[..., str]] = {
    "nothing_possible": "Every experiment is forbidden or impossible on this bench",
    "no_menu": "The menu has no experiments for {word}",
    "nothing_tells": lambda names, sigma: (
        f"No experiment separates {' and '.join(names)} by {sigma:g} σ. Repeat the runs, or measure one part alone"
    ),
    "too_weak": ("Runs over {variable} would show the missing term with only {sigma:.1f} σ. Repeat them"),
    "carry_out": lambda experiments: ". Then: ".join(map(experiment_sentences, experiments)),
    "more_runs": lambda **series: (
        f"{instruction_for_further_runs(SimpleNamespace(**series))}. Read every channel. This shows how the "
        f"missing term of the {bases.place_in_words(series['place'])} depends on it"
    ),
    "overspeed": lambda speed, limit, voltage: (
        f"the motor speed: about {speed / RPM:.0f} rpm unloaded at {voltage:g} V, at most {limit / RPM:.0f} rpm. "
        "Raise the voltage slowly"
    ),
    "overvoltage": "the supply: {voltage:g} V is above the table's highest, {used:g} V",
    "held_motor": lambda current, **heat: (
        f"the heating: {current:.2g} A flow through a stationary motor, and {heated_winding(**heat)}. Switch off "
        "within seconds and let it cool"
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
COMPARE = "Compare the {} with a second instrument, at several values"
#: Condition to vary, all others constant, so that a term that depends on a signal changes.
VARY = {
    "speed": "the speed (the supply voltage)", "current": "the current (slope or payload)",
    "load": "the load (slope or payload)", "slope": "the slope", "weight": "the payload",
    "duty": "the duty",
    "configuration": "the configuration", "direction": "the direction of travel",
    "demand": "the demand on adhesion (slope or payload)", "angle": "nothing: sample one revolution finely",
    THE_SIDE: "nothing: compare both sides, straight and in turns",
    "position": "the position over the whole travel, in both directions",
    "": "nothing: its share is constant",
}  # fmt: skip
WEIGH = "Weigh the robot, unladen and laden"


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
            channel = find_channel(effect.channel)
            yield from [ACTS["zero reading"].format(channel.label)] * channel.misses_zero
            yield COMPARE.format(channel.label)
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
    variation = VARY.get(effect.driver, f"the {effect.driver}")  # effects of the user may have any driver
    yield f"Vary {variation}" + (", from rest, over time" if effect.transient or effect.settles_to else "")
