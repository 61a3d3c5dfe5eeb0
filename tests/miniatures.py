"""Small records of own numbers with the columns, units, formats and faults of public ones, and their rigs."""

import numpy as np

_HEAD = 'schema = "mmrjax.robot/2"\nbase = "none"\nsides = 1\n'
_DRIVE = """
[motor]
resistance = "{0} ± 30 %"
torque_constant = "{1} ± 30 %"
friction_coulomb = "{2} ± 100 %"
inertia = "{3} ± 100 %"
[gearbox]
ratio = {4}
efficiency_load = "{5} ± 5 %"
"""
_SHAFT = '[bench]\nload = "shaft"\ninertia = 1e-6\nloss_coulomb = 0.0\n'
_WHEELS = '[car]\nload = "vehicle"\nmovers = "wheels"\nmass = "{} ± 10 %"\nradius = "{} ± 3 %"\n[car.track]\nloss_coulomb = 0.0\n'
_WHEELS += '[car.ground]\nrolling_resistance = "0.02 ± 100 %"\n[car.ground.friction]\nstatic = "0.8 ± 30 %"\n'


def _speed(time, drive, gain, constant, dry):
    """Speed of a first-order drive with a dead band [units of gain], held drive from row to row."""
    speed = np.zeros(len(time))
    for k, step in enumerate(np.diff(time)):
        target = gain * np.sign(drive[k]) * max(abs(drive[k]) - dry, 0.0)
        speed[k + 1] = target + (speed[k] - target) * np.exp(-step / constant)
    return speed


def _integral(time, speed):
    return np.concatenate([[0.0], np.cumsum(0.5 * np.diff(time) * (speed[1:] + speed[:-1]))])


def step_in_ticks(path):
    """Step of voltage. Ticks of 8 kHz, comments with %, rows that end with a semicolon, unwritten rows."""
    random = np.random.default_rng(1)
    ticks = 3 + np.cumsum(random.integers(40, 60, 400))
    time = ticks / 8000
    volts = np.where(time > 1.0, 0.3, 0.0)
    speed = np.round(_speed(time, volts, 21.0, 0.02, 0.002) * 131) / 131
    turns = _integral(time, speed) + 0.4
    rows = [",".join(map(str, row)) + ";" for row in zip(ticks.astype(float), volts, turns, speed, strict=True)]
    rows[50:50] = ["nan,nan,nan,nan;"]
    rows = ["nan,nan,nan,nan;", *rows, *["0.0,0.0,9.0,6.2;"] * 5]
    head = ["%A motor on a bench", "%", "%timestep (8kHz),voltage,position,velocity", "%[#],[V],[turns],[turns/s]"]
    path.write_text("\n".join([*head, *rows]) + "\n")
    return path


def force_and_place(path):
    """Carriage with its force and place at 200 Hz, back and forth."""
    time = np.arange(1200) / 200
    speed, mass, place = 0.15 * np.sin(2.1 * time), 80.0, 0.15 / 2.1 * (1 - np.cos(2.1 * time))
    force = mass * np.gradient(speed, time) + 150 * speed + 15 * np.tanh(speed / 1e-3)
    random = np.random.default_rng(2)
    noise = random.normal(0, [[2.0], [5e-6]], (2, len(time)))
    return _csv(path, {"time_s": time, "force_N": force + noise[0], "position_m": place + noise[1]})


def four_tests_of_sides(path):
    """Drive of both sides: tests by name, a clock that runs on, voltage, place and speed without units."""
    random, parts = np.random.default_rng(3), []
    for k, (name, top) in enumerate((("slow-forward", 5.0), ("slow-back", -5.0), ("fast-forward", 6.0))):
        time = np.arange(200) / 100
        volts = top * (time / 2 if name.startswith("slow") else np.minimum(time * 50, 1.0))
        speed = _speed(time, volts, 0.8, 0.25, 0.6)
        columns = {"run_id": np.full(200, name), "timestamp": 120.0 + 10 * k + time}
        for side, one in (("l", 1.0), ("r", 0.99)):
            columns |= {
                f"{side}_voltage": one * volts, f"{side}_position": 4 + _integral(time, one * speed),
                f"{side}_velocity": one * speed + random.normal(0, 0.01, 200),
            }  # fmt: skip
        parts.append(columns | {"angle": 0.02 * np.sin(time), "rate": 0.02 * np.cos(time)})
    return _csv(path, {name: np.concatenate([p[name] for p in parts]) for name in parts[0]})


def throttle_and_odometer(path):
    """Model car: stamps in ns since 1970, throttle, speed and distance without units, current that stays raw."""
    random = np.random.default_rng(4)
    time = np.arange(500) * 0.05
    throttle = np.repeat(random.uniform(-0.5, 0.7, 25), 20)
    speed = _speed(time, throttle, 3.2, 0.2, 0.06)
    return _csv(path, {
        "stamp_ns": [str(1_600_000_000_000_000_000 + round(t * 1e9)) for t in time],
        "motor_throttle": throttle, "speed": speed + random.normal(0, 0.02, 500),
        "battery_voltage": 8.2 - 0.1 * np.abs(throttle), "motor_current": np.round(90 * np.abs(throttle)),
        "odometer_distance": 0.3 + _integral(time, speed),
    })  # fmt: skip


def brake_table(path):
    """Brake dyno at one voltage, the torque in a column of its own."""
    random = np.random.default_rng(5)
    torque = np.linspace(2.4, 0.0, 13)
    current = (torque + 0.04) / 0.02
    speed = (12 - 0.05 * current) / 0.02 * 30 / np.pi
    noise = 1 + random.normal(0, 0.003, (2, 13))
    return _csv(path, {
        "supply_voltage_V": np.full(13, 12.0), "motor_speed_rpm": speed * noise[0],
        "load_torque_Nm": torque, "total_current_A": current * noise[1],
    })  # fmt: skip


def command_sweep(path):
    """Wheel motors over a command of -255 to 255, a point each 1.1 s, with blanks after commas."""
    random = np.random.default_rng(6)
    command = np.concatenate([np.arange(-254, 0, 6), np.arange(255, 0, -6)])
    duty = command / 255
    speed = np.sign(duty) * np.maximum(800 - 120 / np.abs(duty), 0.0)
    speed = speed[None] * [[1.0], [1.05]] + random.normal(0, 4, (2, len(duty)))
    columns = {
        "time": 15_400 + 1100 * np.arange(len(duty)), "batteryVoltage": random.integers(7800, 7950, len(duty)),
        "motorCommand": command, "leftSpeedRpm": np.round(speed[0], 2), "rightSpeedRpm": np.round(speed[1], 2),
    }  # fmt: skip
    return _csv(path, columns, ", ")


def _csv(path, columns, between=","):
    lines = [between.join(columns), *(between.join(map(str, row)) for row in zip(*columns.values(), strict=True))]
    path.write_text("\n".join(lines) + "\n")
    return path


#: Record → (function that writes it, robot's file without its columns, lines of `[columns]` that a user corrects).
RECORDS = {
    "odrive": (
        step_in_ticks,
        f'{_HEAD}imposed = "voltage"\nchannels = ["output_speed"]\nstart = "measured"\n'
        + _DRIVE.format(0.1, 0.008, 0.001, 1e-5, 1, 1) + _SHAFT,
        {},
    ),
    "emps": (
        force_and_place,
        f'{_HEAD}imposed = "current"\nchannels = ["position"]\nstart = "measured"\n'
        '[motor]\ntorque_constant = "1 ± 0"\ninertia = "1e-9 ± 0"\n[gearbox]\nratio = 1.0\nefficiency_load = "1 ± 0"\n'
        '[carriage]\nload = "linear"\nmass_kg = "100 ± 30 %"\nlead_mm = 5.0\nforce_coulomb_N = "20 ± 100 %"\n'
        'force_viscous_N_s_m = "200 ± 100 %"\n',
        {"motor_current_A": '{column = "force_N", factor = 0.000795774715}'},
    ),
    "drivetrain": (
        four_tests_of_sides,
        _HEAD.replace("sides = 1", "sides = 2") + 'imposed = "voltage"\nchannels = ["speed"]\nstart = "rest"\n'
        + _DRIVE.format(0.03, 0.02, 0.01, 1e-4, 8.45, 0.9) + _WHEELS.format(50, 0.0776),
        {},
    ),
    "car": (
        throttle_and_odometer,
        f'{_HEAD}imposed = "voltage"\nchannels = ["speed"]\nstart = "rest"\n'
        + _DRIVE.format(1.0, 0.006, 0.001, 1e-6, 10, 0.8) + _WHEELS.format(0.5, 0.035),
        {},
    ),
    "neo_dyno": (
        brake_table,
        f'{_HEAD}imposed = "voltage"\nchannels = ["total_current", "motor_speed"]\n'
        + _DRIVE.format(0.06, 0.02, 0.03, 1e-4, 1, 1) + _SHAFT,
        {},
    ),
    "micromouse": (
        command_sweep,
        f'{_HEAD}imposed = "voltage"\nchannels = ["output_speed"]\nstart = "measured"\n[driver]\ndecay = "fast"\n'
        + _DRIVE.format(10, 0.004, 0.0003, 1e-7, 20, 0.8) + _SHAFT,
        {"output_speed_rpm": '"leftSpeedRpm"'},
    ),
}  # fmt: skip
