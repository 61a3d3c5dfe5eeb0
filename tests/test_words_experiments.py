"""What to do next, in words: acts, runs of the menu, what to watch, more runs."""

import dataclasses

import pytest
from pages import recorded

from calibration.described import describe
from calibration.discovery import menu
from calibration.discovery.experiments import denser_runs_instruction
from calibration.discovery.reach import Reach, UsedConditions
from calibration.inference.fit_notes import Remark
from calibration.words import experiment_words as words

TRACKED = UsedConditions("6T2A", 0, (15.0, 24.0, 33.0), (0.0, 10.0, 20.0), (0.0, 8.0), 21.1)
WHEELED = dataclasses.replace(TRACKED, configuration="4W2T", index=1)
REACH = Reach(
    (TRACKED, WHEELED), ("total_current", "motor_speed", "speed"), 36.0, 32.5, 33.4, 1.9, 760.0, 0.71, 1250.0, 1290.0, 2,
    0.61, 0.0259, 125.0,
)  # fmt: skip
ONE = Reach(
    (UsedConditions("rover", 0, (6.0, 9.0, 12.0), (0.0, 8.0), (0.0, 1.0), 4.0),), ("speed",), 12.0, 12.0, 12.0, 0.9, 760.0, 0.3,
    1250.0, 1290.0, 1, 1.2, 0.012, 125.0,
)  # fmt: skip
LEVEL = dataclasses.replace(ONE, used=(UsedConditions("rover", 0, (12.0,), (0.0,), (0.0,), 4.0),))
BENCH = dataclasses.replace(LEVEL, has_ground=False)
DRIVEN = dataclasses.replace(BENCH, imposed="motor_speed", levels=(52.36, 209.44))
BRAKED = dataclasses.replace(BENCH, measured=("motor_current", "motor_speed"), torques=(0.0, 0.4, 0.8))
HELD = dataclasses.replace(DRIVEN, torques=(0.0, 0.0412))


def on(reach):
    return {e.name: words.experiment_sentences(e) for e in menu.experiment_menu(reach)}


#: Who asks for experiments → what is within reach.
REACHES = {
    "robot": REACH, "rover": ONE, "level": LEVEL, "bench": BENCH, "driven": DRIVEN, "braked": BRAKED, "held": HELD,
    "three configurations": dataclasses.replace(REACH, used=(TRACKED, WHEELED, dataclasses.replace(TRACKED, index=2))),
    "bench with duties": dataclasses.replace(BENCH, duties=(0.3, 0.9)), "rover with duties": dataclasses.replace(ONE, duties=(0.3, 0.9)),
}  # fmt: skip
#: Variables over which more runs are asked for, windows of them and waves among them.
OVER = (
    "voltage", "speed", "speed_motor", "slope", "payload", "current", "time", "air_humidity", "order 2 of the driving shaft",
    "order 3 to 17", "slope 0.17453 to 0.17453", "time 0.1 to 0.45",
)  # fmt: skip
WATCHED = (
    Remark("held_motor", temperature=90.0, allowed=125.0, current=1.58),
    Remark("braked_motor", temperature=float("inf"), allowed=None),
    Remark("hot_motor", temperature=118.2, allowed=125.0),
    Remark("overspeed", speed=1250.0, limit=1290.0, voltage=32.0), Remark("overvoltage", voltage=18.0, used=12.0),
)  # fmt: skip
CRAWL, REVERSE = (e for e in menu.experiment_menu(ONE) if e.name in ("crawl, rover", "reverse, rover"))
INSTRUCTIONS = (
    Remark("carry_out", experiments=(CRAWL, REVERSE)),
    Remark("nothing_possible"),
    Remark("nothing_tells", names=("a", "b"), sigma=2.0),
    Remark("too_weak", variable="slope", sigma=1.23),
)


def told():
    """Lines of all that is said: each experiment, more runs over each variable, what to watch, what else there is."""
    for name, reach in REACHES.items():
        yield from (f"{name}, {e}: {sentence}" for e, sentence in on(reach).items())
        for variable in OVER:
            more = denser_runs_instruction("slip", variable, reach, by_duty=bool(reach.duties))
            yield f"{name}, over {variable}: {describe(more)}"
    for part in WATCHED:
        yield f"watch: {describe(part)}"
    yield words.experiment_sentences(dataclasses.replace(CRAWL, watch=WATCHED[-1:]))
    yield from map(describe, INSTRUCTIONS)


def test_what_to_do_next_is_said_as_recorded():
    text = "\n".join(told()) + "\n"
    assert text == recorded("experiments", text)


def test_every_instruction_and_every_risk_has_a_sample():
    instructions = [*INSTRUCTIONS, denser_runs_instruction("slip", "speed", ONE), Remark("no_menu", word="turns")]
    assert {note.code for note in (*instructions, *WATCHED)} == set(words.SAID)
    assert describe(instructions[-1]) == "The menu has no experiments for turns"


def test_the_zero_of_every_meter_is_read_at_rest():
    """Of whatever shows a value that is none: not of what counts, nor of a temperature."""
    shown = ("motor_speed", "motor_current", "position", "output_torque", "winding_temperature")
    said = {n: text for n, text in on(dataclasses.replace(BENCH, measured=shown)).items() if n.startswith("zero")}
    assert said == {
        f"zero of {label}": f"With the motors off and the shaft unloaded, read the {label}"
        for label in ("motor current", "output torque")
    }


def test_runs_of_one_motor_and_of_many_name_the_shafts():
    one = dataclasses.replace(ONE, measured=("total_current", "motor_speed"))
    assert on(one)["stall"].startswith("Hold the motor's shaft in a vice") and "stall, one motor" not in on(one)
    assert on(one)["bare motor"].startswith("Uncouple the gearbox and")
    four = on(dataclasses.replace(REACH, motors=4))
    assert four["stall"].startswith("Hold all 4 motor shafts in a vice")
    assert "all motors but one disconnected" in four["stall, one motor"]


def test_every_kind_of_runs_has_words():
    reaches = (REACH, ONE, BENCH, DRIVEN)
    assert {e.doing for r in reaches for e in menu.experiment_menu(r) if isinstance(e, menu.ProposedRuns)} == set(
        words.DOING
    )
    metered = dataclasses.replace(BENCH, measured=("motor_current", "output_torque"))
    acts = {
        k
        for r in (REACH, metered)
        for e in menu.experiment_menu(r)
        if isinstance(e, menu.CalibrationAct)
        for k in e.kinds
    }
    assert acts == {"weigh", *words.ACTS} and set(words.ACTS) == {*words.UNITS, "zero reading"}


@pytest.mark.parametrize(
    "span, count, step",
    [(17.178, 15, 1.0), (199.0, 15, 10.0), (12.0, 14, 1.0), (0.9, 15, 0.05), (3e4, 14, 2000.0)],
)
def test_steps_are_those_that_a_person_sets(span, count, step):
    assert menu.step_of_settings(span, count) == pytest.approx(step)
    last = menu.last_setting(span, step)
    assert last <= span * (1 + menu.SETTING_TOLERANCE) < last + step and last / step == pytest.approx(
        round(last / step)
    )


@pytest.mark.parametrize("reach", [ONE, BENCH, DRIVEN, BRAKED, HELD])
@pytest.mark.parametrize(
    "variable", ["voltage", "current", "speed_motor", "speed", "slope", "payload", "time", "order"]
)
def test_more_runs_are_said_of_a_table_that_varied_nothing(reach, variable):
    """Where a speed is imposed the table has no voltage at all."""
    used = tuple(dataclasses.replace(u, voltages=(0.0,), slopes=(0.0,), payloads=(0.0,)) for u in reach.used)
    assert describe(denser_runs_instruction("track", variable, dataclasses.replace(reach, used=used))).startswith(
        "Re"
    )
