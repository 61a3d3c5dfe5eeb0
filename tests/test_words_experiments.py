"""What to do next, in words: acts, runs of the menu, what to watch, more runs."""

import dataclasses

import pytest

from calibration.discovery import menu
from calibration.discovery.experiments import denser_runs_instruction
from calibration.discovery.instructions import CarryOut, NothingPossible, NothingTells, TooWeak
from calibration.discovery.loop_notes import Heat, Overspeed, Overvoltage
from calibration.discovery.reach import Reach, Used
from calibration.words import experiment_words as words

TRACKED = Used("6T2A", 0, (15.0, 24.0, 33.0), (0.0, 10.0, 20.0), (0.0, 8.0), 21.1)
WHEELED = dataclasses.replace(TRACKED, configuration="4W2T", index=1)
REACH = Reach(
    (TRACKED, WHEELED), ("total_current", "motor_speed", "speed"), 36.0, 32.5, 33.4, 1.9, 760.0, 0.71, 1250.0, 1290.0, 2,
    0.61, 0.0259, 125.0,
)  # fmt: skip
ONE = Reach(
    (Used("rover", 0, (6.0, 9.0, 12.0), (0.0, 8.0), (0.0, 1.0), 4.0),), ("speed",), 12.0, 12.0, 12.0, 0.9, 760.0, 0.3,
    1250.0, 1290.0, 1, 1.2, 0.012, 125.0,
)  # fmt: skip
LEVEL = dataclasses.replace(ONE, used=(Used("rover", 0, (12.0,), (0.0,), (0.0,), 4.0),))
BENCH = dataclasses.replace(LEVEL, has_ground=False)
DRIVEN = dataclasses.replace(BENCH, imposed="motor_speed", levels=(52.36, 209.44))
BRAKED = dataclasses.replace(BENCH, measured=("motor_current", "motor_speed"), torques=(0.0, 0.4, 0.8))
HELD = dataclasses.replace(DRIVEN, torques=(0.0, 0.0412))


def on(reach):
    return {e.name: words.experiment_sentences(e) for e in menu.experiment_menu(reach)}


def test_acts_say_what_to_set_and_to_read():
    said = on(REACH)
    assert said["weigh"] == (
        "Weigh the robot in both configurations, unladen and with the payload of 8 kg, on scales that are good to 20 g; "
        "read the total mass, and take the stated one from it"
    )
    assert said["zero current"] == "Switch the motors off; read the ammeter"
    assert said["shunt"] == (
        "Put a precision shunt and a load in the place of the robot, set 0.6 and 3 A by the shunt; read the ammeter"
    )
    assert said["strobe"] == "Set the motor to 190 and 490 rad/s by a stroboscope; read the tachometer"
    assert said["timing"].endswith("measured with a tape, at 0.25 and 0.57 m/s; read the speed that the bench shows")
    assert on(LEVEL)["weigh"].startswith("Weigh the robot unladen, on scales")
    three = dataclasses.replace(REACH, used=(TRACKED, WHEELED, dataclasses.replace(TRACKED, index=2)))
    assert on(three)["weigh"].startswith("Weigh the robot in each configuration, unladen and")


def test_the_zero_of_every_meter_is_read_at_rest():
    """Of whatever shows a value that is none: not of what counts, nor of a temperature."""
    shown = ("motor_speed", "motor_current", "position", "output_torque", "winding_temperature")
    said = {n: text for n, text in on(dataclasses.replace(BENCH, measured=shown)).items() if n.startswith("zero")}
    assert said == {
        f"zero of {label}": f"Switch the motors off, at rest and with no load; read the {label}"
        for label in ("motor current", "output torque")
    }


def test_a_brake_is_set_where_there_is_one():
    said = on(BRAKED)
    assert said["other torques, rover"] == (
        "rover: run at 12 V against a brake of 0.1, 0.2, 0.6 and 0.8 N·m; read motor current and motor speed"
    )
    assert said["reverse, rover"] == (
        "rover: run the other way round at -12 V against a brake of 0 and -0.2 N·m; read motor current and motor speed"
    )
    assert "brake" not in said["other voltages, rover"]
    assert not any("brake" in text for text in on(BENCH).values())
    assert "other torques, rover" not in on(dataclasses.replace(BRAKED, torques=(0.0,)))
    assert on(HELD)["other torques, rover"].startswith(
        "rover: run at 500 and 2000 rpm of the motor against a brake of 10, 21, 31 and 41 mN·m; read"
    )


def test_runs_follow_their_conditions():
    said = on(REACH)
    read = "read total current, motor speed and speed"
    assert said["payload 12 kg, 4W2T"] == (
        f"4W2T: travel with 12 kg on the level and up 10 and 20 deg at 15 and 33 V; {read}"
    )
    assert said["downhill, 6T2A"] == (
        "6T2A: turn the slope about by the same inclinometer and travel forwards down 10 deg at 15 and 33 V; " + read
    )
    assert said["one motor, 6T2A"].startswith("6T2A: put it on stands, the other motor disconnected, and run at 6.5")
    assert said["stall"].startswith("Hold both motor shafts in a vice and switch on for a moment, at ")
    assert said["bare motor"].startswith("Uncouple the gearboxes and run the motors alone at ")
    assert "put a brake of 30 mN·m on each motor shaft, and run at" in said["braked motor"]


def test_runs_of_one_motor_and_of_many_name_the_shafts():
    one = dataclasses.replace(ONE, measured=("total_current", "motor_speed"))
    assert on(one)["stall"].startswith("Hold the motor's shaft in a vice") and "stall, one motor" not in on(one)
    assert on(one)["bare motor"].startswith("Uncouple the gearbox and")
    four = on(dataclasses.replace(REACH, motors=4))
    assert four["stall"].startswith("Hold all 4 motor shafts in a vice")
    assert "all motors but one disconnected" in four["stall, one motor"]


def test_runs_of_a_shaft_are_at_what_is_imposed():
    assert on(BENCH)["reverse, rover"] == "rover: run the other way round on the level at -12 V; read speed"
    assert (
        on(DRIVEN)["reverse, rover"]
        == "rover: run the other way round at -500 and -2000 rpm of the motor; read speed"
    )


@pytest.mark.parametrize(
    ("about", "said"),
    [
        (
            Heat("held", 90.0, 125.0, 1.58),
            "current × time: 1.6 A in a motor that does not turn, and so is not cooled; a winding left on would reach "
            "90 °C (125 °C is allowed), so switch off within seconds and let it cool between readings",
        ),
        (
            Heat("braked", float("inf"), None),
            "the brake and the winding's temperature: a winding left on would burn: no temperature settles; seconds are "
            "enough for a reading",
        ),
        (
            Heat("run", 118.2, 125.0),
            "the winding's temperature: a winding left on would reach 118 °C (125 °C is allowed); keep the runs short",
        ),
        (
            Overspeed(1250.0, 1290.0, 32.0),
            "the motor speed: about 11937 rpm without load at 32 V, and no more than 12319 rpm; raise the voltage slowly",
        ),
        (Overvoltage(18.0, 12.0), "the supply: 18 V is more than the table's 12 V"),
    ],
)
def test_what_can_do_damage_is_said(about, said):
    assert words.part_to_watch(about) == said
    run = dataclasses.replace(next(e for e in menu.experiment_menu(ONE) if e.name == "crawl, rover"), watch=(about,))
    assert words.experiment_sentences(run).endswith(f"; read speed. Watch {said}")


def test_instructions_are_said():
    crawl, reverse = (
        next(e for e in menu.experiment_menu(ONE) if e.name == f"{n}, rover") for n in ("crawl", "reverse")
    )
    both = f"{words.experiment_sentences(crawl)}. And: {words.experiment_sentences(reverse)}"
    assert words.experiment_instruction(CarryOut((crawl, reverse))) == both
    assert (
        words.experiment_instruction(NothingPossible()) == "Every experiment of the menu is forbidden or beyond reach"
    )
    assert words.experiment_instruction(NothingTells(("a", "b"), 2.0)) == (
        "No experiment of the menu tells a and b apart by 2 sigma"
    )
    assert (
        words.experiment_instruction(TooWeak("slope", 1.23))
        == "A series in slope would show what is missing by 1.2 sigma"
    )


#: Reach, variable, and what is said of more runs along it.
MORE = [
    (ONE, "voltage", "Repeat at one slope and payload with the supply voltage from 6 to 12 V in steps of 0.5 V"),
    (
        ONE,
        "slope",
        "Repeat at one voltage and payload with the slope from 0 to 8 deg in steps of 0.5 deg, and downhill",
    ),
    (ONE, "payload", "Repeat at one voltage and slope with the payload from 0 to 1 kg in steps of 0.1 kg"),
    (
        ONE,
        "current",
        "Repeat at 12 V with a payload up to 1 kg and a slope up to 8 deg, raised in small steps, so that the current "
        "rises evenly from no load to its largest, some 0.9 A",
    ),
    (
        LEVEL,
        "current",
        "Repeat at 12 V with a brake or a drawbar pull, raised in small steps, so that the current rises evenly from no "
        "load to its largest, some 0.9 A",
    ),
    (
        ONE,
        "time",
        "Record one condition from a cold start for ten minutes, at 6 V rather than more, and again at once while "
        "everything is warm; watch the winding's temperature (125 °C is allowed)",
    ),
    (ONE, "air_humidity", "Repeat with air humidity in even small steps from its least to its largest"),
    (BENCH, "voltage", "Repeat with the supply voltage up to 12 V in steps of 1 V"),
    (BENCH, "speed", "Repeat with the supply voltage from crawl to 12 V in steps of 1 V"),
    (BENCH, "current", "Repeat with the supply voltage from crawl to 12 V in steps of 1 V"),  # it has no brake
    (BRAKED, "current", "Repeat at 12 V with the brake's torque up to 0.8 N·m in steps of 0.05 N·m"),
    (DRIVEN, "speed_motor", "Repeat with the motor speed up to 2000 rpm in steps of 100 rpm"),
    (DRIVEN, "current", "Repeat with the motor speed up to 2000 rpm in steps of 100 rpm"),
    (HELD, "current", "Repeat at one motor speed with the brake's torque up to 40 mN·m in steps of 2.5 mN·m"),
    (
        ONE,
        "order 2 of the driving shaft",
        "Mark the driving shaft, start every run from the mark, and record steady travel at 6, 9 and 12 V with at least "
        "20 samples a wave: what keeps its order 2 of the driving shaft at every speed turns with that part",
    ),
    (
        ONE,
        "order 3 to 17",
        "Make runs 3 to 17 again, and as many before and after them, in another order: what comes back with them hangs "
        "on their conditions, what does not happened then",
    ),
    (
        ONE,
        "slope 0.17453 to 0.17453",
        "Make the runs at 10 deg of slope again, on another day, and as many a little below and above that",
    ),
    (
        ONE,
        "time 0.1 to 0.45",
        "Make two of the runs again, sampled as finely as the instruments allow from 0.1 to 0.45 s, one of them with "
        "all that is switched in that time left as it is",
    ),
]


@pytest.mark.parametrize(("reach", "variable", "said"), MORE, ids=[v for _, v, _ in MORE])
def test_more_runs_are_said_within_reach(reach, variable, said):
    assert words.experiment_instruction(denser_runs_instruction("slip", variable, reach)) == (
        f"{said}; read every channel. What the slip balance lacks then shows its shape"
    )


@pytest.mark.parametrize(
    ("reach", "variable", "said"),
    [
        (BENCH, "voltage", "Repeat with the duty up to 0.9 in steps of 0.05 at 12 V"),
        (BENCH, "speed", "Repeat with the duty from crawl to 0.9 in steps of 0.05 at 12 V"),
        (ONE, "voltage", "Repeat at one slope and payload with the duty up to 0.9 in steps of 0.05 at 12 V"),
        (
            ONE,
            "speed_motor",
            "Repeat on the level, unladen, with the duty from crawl to 0.9 in steps of 0.05 at 12 V",
        ),
    ],
)
def test_runs_that_a_duty_drives_are_repeated_over_the_duty(reach, variable, said):
    reach = dataclasses.replace(reach, duties=(0.3, 0.9))
    assert words.experiment_instruction(denser_runs_instruction("slip", variable, reach, by_duty=True)).startswith(
        f"{said}; "
    )


def test_every_kind_of_runs_has_words():
    reaches = (REACH, ONE, BENCH, DRIVEN)
    assert {e.doing for r in reaches for e in menu.experiment_menu(r) if isinstance(e, menu.Run)} == set(words.DOING)
    metered = dataclasses.replace(BENCH, measured=("motor_current", "output_torque"))
    acts = {k for r in (REACH, metered) for e in menu.experiment_menu(r) if isinstance(e, menu.Act) for k in e.kinds}
    assert acts == {"weigh", *words.ACTS} and set(words.ACTS) == {*words.UNITS, "zero reading"}


@pytest.mark.parametrize(
    ("span", "count", "step"),
    [(17.178, 15, 1.0), (199.0, 15, 10.0), (12.0, 14, 1.0), (0.9, 15, 0.05), (3e4, 14, 2000.0)],
)
def test_steps_are_those_that_a_person_sets(span, count, step):
    assert menu.step_of_settings(span, count) == pytest.approx(step)
    last = menu.last_setting(span, step)
    assert last <= span * (1 + menu.ABOUT) < last + step and last / step == pytest.approx(round(last / step))


def test_a_temperature_that_nobody_stated_is_not_watched():
    stated, unknown = (denser_runs_instruction("slip", "time", dataclasses.replace(ONE, hot=t)) for t in (125.0, 1e9))
    assert "(125 °C is allowed)" in words.experiment_instruction(stated)
    assert words.experiment_instruction(unknown).count("watch the winding's temperature;") == 1


@pytest.mark.parametrize("reach", [ONE, BENCH, DRIVEN, BRAKED, HELD])
@pytest.mark.parametrize(
    "variable", ["voltage", "current", "speed_motor", "speed", "slope", "payload", "time", "order"]
)
def test_more_runs_are_said_of_a_table_that_varied_nothing(reach, variable):
    """Where a speed is imposed the table has no voltage at all."""
    used = tuple(dataclasses.replace(u, voltages=(0.0,), slopes=(0.0,), payloads=(0.0,)) for u in reach.used)
    assert words.experiment_instruction(
        denser_runs_instruction("track", variable, dataclasses.replace(reach, used=used))
    ).startswith("Re")
