"""The command line `mmrjax`: options only; what a command does is in `commands`, imported when it is needed."""

from __future__ import annotations

import math
import os
import signal
import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.data.errors import InputError
from mmrjax import __version__, fidelities

INTERRUPTED = 130

app = typer.Typer(
    name="mmrjax", no_args_is_help=True, add_completion=False, pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help="Simulate a small tracked or wheeled robot's drive and running gear, and set it against measured runs.\n\n"
    "[bold]Exit codes[/bold]: 0 done; 1 internal error; 2 usage or configuration; 3 done, but some runs did not "
    "converge (their status says why); 4 bad data; 130 interrupted (the same command takes it up again).",
)  # fmt: skip


def _defaults(option: str, shown: float = math.inf) -> str:
    """Default of a fidelity's option by fidelity, as a help text has it; of `simulate` at most `shown`."""
    found = {name: o.default for name, facts in fidelities.TABLE.items() for o in facts.options if o.name == option}
    capped = {name: f"{v:g}" + (f", simulate {shown:g}" if v > shown else "") for name, v in found.items()}
    texts = [f"{name} {text}" for name, text in capped.items()] if len(found) > 1 else list(capped.values())
    return f"\\[default: {'; '.join(texts)}]"


_Model = Annotated[
    str | None,
    typer.Option("--model", help=f"Fidelity: {', '.join(fidelities.NAMES)}.  \\[default: {fidelities.NAMES[0]}]"),
]
_Duration = Annotated[
    float | None, typer.Option("--duration", help=f"Length of a run (s).  {_defaults('duration', shown=5.0)}")
]
_Robot = Annotated[
    str | None, typer.Option("--robot", help="nominal, sm1, sm2, or a robot's TOML file.  \\[default: nominal]")
]
_Set = Annotated[
    list[str] | None,
    typer.Option("--set", help="Change a parameter, SI units, repeatable: 6T2A.ground.friction.static=0.6."),
]
_Effects = Annotated[
    list[str] | None, typer.Option("--effects", help="A Python file with effects of your own, repeatable.")
]
_Configuration = Annotated[
    str | None,
    typer.Option(help="One of the robot's, such as 6T2A or 4W2T of the packaged one.  \\[default: its first]"),
]
_Voltage = Annotated[
    float | None,
    typer.Option(
        help="Supply voltage (V), negative backward.  \\[default: 33; of a rig its limit; none with --battery]"
    ),
]
_MotorSpeed = Annotated[
    float | None,
    typer.Option(help="Motor speed (rpm), negative backward, of a rig on whose motors it is imposed."),
]
_MotorSpeeds = Annotated[
    str | None,
    typer.Option(
        help="Motor speeds (rpm) of a rig on whose motors they are imposed.  \\[default: thirds of speed_limit]"
    ),
]
_Slope = Annotated[float | None, typer.Option(help="Slope, positive uphill (deg).  \\[default: 0]")]
_Payload = Annotated[float | None, typer.Option(help="Additional load mass (kg).  \\[default: 0]")]
_Mass = Annotated[
    float | None, typer.Option(help="Total mass (kg).  \\[default: the robot's own mass and the payload]")
]
_Surface = Annotated[
    str | None,
    typer.Option(
        help="Surface of Table 5; scales the adhesion, which a robot states for lacquered_wood. Of a rig a label of "
        "its own.  \\[default: lacquered_wood; of a rig none]"
    ),
]
_Step = Annotated[float | None, typer.Option("--step", help=f"Integration step (s).  {_defaults('step')}")]
_Out = Annotated[Path | None, typer.Option("--out", help="The run folder.  \\[default: runs/COMMAND-TIME]")]
_Force = Annotated[bool, typer.Option("--force", help="Replace an existing run folder.")]
_Report = Annotated[bool | None, typer.Option("--report/--no-report", help="Write report.html.  \\[default: report]")]
_Battery = Annotated[bool | None, typer.Option("--battery", help="Supply from the on-board battery.")]
_Discharge = Annotated[
    float | None, typer.Option("--discharge", help="Charge already taken from the battery (mAh).  \\[default: 0]")
]
_Posterior = Annotated[
    int | None,
    typer.Option(
        "--posterior",
        help="Give results with ± from so many robots drawn from the posterior.nc beside the calibrated --robot.",
    ),
]
_Profile = Annotated[
    str | None,
    typer.Option(
        "--profile",
        help="A mission over time: a CSV with time_s (s) and any of speed_mm_s, motor_speed_rpm, duty, mode, "
        "supply_voltage_V, slope_deg, payload_kg, surface, current_other_A, or stair, stop_and_go, shuttle, patrol "
        "(docs/missions.md).",
    ),
]
_NoCache = Annotated[
    bool, typer.Option("--no-cache", help="Compile anew: neither read nor keep compiled programs (see doctor).")
]
_Chunk = Annotated[
    int | None,
    typer.Option(
        "--chunk",
        help="Runs in one vmapped call.  \\[default: "
        + ", ".join(f"{name} {facts.chunk}" for name, facts in fidelities.TABLE.items())
        + "]",
    ),
]


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(f"mmrjax {__version__}")
        raise typer.Exit


@app.command(
    epilog="Example: mmrjax simulate --configuration 4W2T --voltage 24 --slope 10 --payload 5 --model drive; "
    "mmrjax simulate --profile patrol --battery --payload 5"
)
def simulate(
    context: typer.Context,
    configuration: _Configuration = None,
    voltage: _Voltage = None,
    motor_speed: _MotorSpeed = None,
    slope: _Slope = None,
    payload: _Payload = None,
    mass: _Mass = None,
    surface: _Surface = None,
    runs: Annotated[
        Path | None, typer.Option(help="CSV of runs to simulate instead; the condition columns are enough.")
    ] = None,
    profile: _Profile = None,
    model: _Model = None,
    duration: _Duration = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    battery: _Battery = None,
    discharge: _Discharge = None,
    posterior: _Posterior = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Simulate one run, or the runs of a CSV file, and write a run folder.

    With --model drive or track the run starts from standstill, and history.csv holds current and speeds over
    time; with track, reactions.csv holds every load inside the running gear too. With --profile it follows a mission:
    energy (Wh, Wh/m), distance, peaks, temperatures and charge, of the whole and in segments.csv of each segment.
    """
    from sweeps import config

    options = _options(
        model=model, duration_s=duration, step_s=step, robot=robot, set=set_, effects=effects, battery=battery,
        discharge_mAh=discharge, posterior=posterior, report=report, profile=profile,
    )  # fmt: skip
    resolved = _prepared(config.resolve(config.Simulate, None, options), no_cache)
    cells = _cells(configuration, voltage, motor_speed, slope, payload, mass, surface)
    given = cells if runs is None else str(runs)
    if resolved.profile is not None:
        from sweeps.commands import missions

        columns = {"voltage": "supply_voltage_V", "slope": "slope_deg", "payload": "payload_kg", "surface": "surface"}
        sources = {option: context.get_parameter_source(option) for option in columns}
        stated = {columns[o]: f"--{o}" for o, s in sources.items() if s is not None and s.name == "COMMANDLINE"}
        return missions.simulate(resolved, given, stated, out, force)
    from sweeps.commands import simulate as room

    return room.simulate(resolved, given, out, force)


@app.command(
    epilog="Example: mmrjax sweep --slopes 0:20:0.5 --payloads 0,4,8 --voltages 24 --configurations 6T2A "
    "--set 6T2A.ground.friction.static=0.6"
)
def sweep(
    file: Annotated[
        Path | None,
        typer.Argument(metavar="[CONFIG.toml]", help="TOML file with \\[axes] or \\[samples] (docs/sweeps.md)."),
    ] = None,
    configurations: Annotated[
        str | None, typer.Option(help="Comma-separated, of the robot's.  \\[default: all that it has]")
    ] = None,
    voltages: Annotated[
        str | None,
        typer.Option(help="Supply voltages (V), of a rig thirds of its voltage_limit.  \\[default: 15,24,33]"),
    ] = None,
    motor_speeds: _MotorSpeeds = None,
    payloads: Annotated[
        str | None, typer.Option(help="Additional load masses (kg), of a rig 0.  \\[default: 0,1.5,3,5,6.5,8]")
    ] = None,
    slopes: Annotated[
        str | None, typer.Option(help="Slopes, positive uphill (deg), of a rig 0.  \\[default: 0,5,10,15,20]")
    ] = None,
    surface: _Surface = None,
    config_file: Annotated[
        Path | None, typer.Option("--config", help="TOML file with the keys of a config.resolved.toml; options win.")
    ] = None,
    model: _Model = None,
    duration: _Duration = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    battery: _Battery = None,
    discharge: _Discharge = None,
    chunk: _Chunk = None,
    posterior: _Posterior = None,
    zarr: Annotated[
        bool, typer.Option("--zarr", help="Write a Zarr store, also of a small grid of options.")
    ] = False,
    outputs: Annotated[
        str | None,
        typer.Option(
            help="Comma-separated, what a store holds of each point.  \\[default: what its instruments show]"
        ),
    ] = None,
    dry_run: Annotated[
        bool, typer.Option("--dry-run", help="Say points, chunks, bytes and time; write nothing.")
    ] = False,
    shard: Annotated[
        str | None, typer.Option(help="Simulate the i-th of n shares, as 3/8: a process of a job array each.")
    ] = None,
    scheduler: Annotated[
        str | None, typer.Option(help="Address of a dask scheduler whose workers simulate, as tcp://host:8786.")
    ] = None,
    export: Annotated[
        list[str] | None, typer.Option(help="Write the store as csv or parquet too, repeatable.")
    ] = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Simulate every combination of a grid in vmapped batches: Table 8 in every configuration by default.

    An axis is 0,5,10 or first:last:step as 0:20:0.5. Up to 100 000 runs leave runs.csv; results of more go to a Zarr
    store, and to runs.csv too with --export csv. So do those of a CONFIG.toml, where any parameter or condition
    varies, as a grid or sampled (docs/sweeps.md). An interrupted sweep goes on with the same command and the same
    --out.
    """
    from sweeps import config, config_campaign

    options = _options(
        model=model,
        duration_s=duration,
        step_s=step,
        robot=robot,
        set=set_,
        effects=effects,
        battery=battery,
        discharge_mAh=discharge,
        chunk=chunk,
        posterior=posterior,
        report=report,
    ) | {
        "configurations": None if configurations is None else tuple(c.strip() for c in configurations.split(",")),
        "voltages_V": config.axis("--voltages", voltages),
        "motor_speeds_rpm": config.axis("--motor-speeds", motor_speeds),
        "payloads_kg": config.axis("--payloads", payloads),
        "slopes_deg": config.axis("--slopes", slopes),
        "surface": surface,
    }
    if file is not None and config_file is not None:
        raise InputError(f"--config: got {config_file} beside {file}; expected one of them")
    file = config_file if file is None else file
    how = config_campaign.how(shard, scheduler, export, dry_run)
    where = file.name if file is not None else "options"
    wanted = () if outputs is None else tuple(name.strip() for name in outputs.split(","))
    if zarr or wanted or how != config_campaign.How() or config_campaign.is_campaign(file):
        stored = _prepared(config_campaign.resolve_campaign(file, options), no_cache)
        from sweeps.commands import campaign

        return campaign.store_sweep(stored, where, out, force, how, wanted)
    resolved = _prepared(config.resolve(config.Sweep, file, options), no_cache)
    from sweeps.commands import sweep as room

    return room.sweep(resolved, where, out, force)


@app.command(epilog="Example: mmrjax compare measured --robot sm1 --set 6T2A.ground.friction.static=0.6")
def compare(
    data: Annotated[
        str, typer.Argument(help="A CSV of measured runs, or measured, or simulated_by_paper.")
    ] = "measured",
    own_mass: Annotated[
        bool, typer.Option("--own-mass", help="Take the robot's mass and the payload, not the stated total mass.")
    ] = False,
    model: _Model = None,
    duration: _Duration = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    posterior: _Posterior = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Simulate the runs of a table and compare: equation (35) per row and channel, rms, worst, R²."""
    from sweeps import config

    options = _options(
        model=model,
        duration_s=duration,
        step_s=step,
        robot=robot,
        set=set_,
        effects=effects,
        posterior=posterior,
        report=report,
    )
    resolved = _prepared(config.resolve(config.Compare, None, options), no_cache)
    from sweeps.commands import compare as room

    return room.compare(resolved, data, own_mass, out, force)


@app.command(epilog="Example: mmrjax reproduce --robot found/robot.toml --model track")
def reproduce(
    model: Annotated[
        str | None, typer.Option("--model", help="steady, or track for Figs. 23-27 too.  \\[default: steady]")
    ] = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    no_cache: _NoCache = False,
) -> int:
    """Remake the paper's figures and tables with a robot: the bench's rows, Figs. 5a-29, row by row.

    With --model track the running gear is resolved: Figs. 23-27, how the weight divides.
    """
    from sweeps import config

    options = _options(model=model, robot=robot, set=set_, effects=effects)
    resolved = _prepared(config.resolve(config.Reproduce, None, options), no_cache)
    from sweeps.commands import reproduce as room

    return room.reproduce(resolved, out, force)


@app.command(epilog="Example: mmrjax render start.mp4 --slope 10 --payload 5 --begin 0 --end 0.2 --slow 20")
def render(
    file: Annotated[Path, typer.Argument(help="What to write: its suffix is .png, .gif or .mp4.")],
    begin: Annotated[
        float | None,
        typer.Option(help="Instant of a picture, first one of a film (s).  \\[default: 0; of a picture 0.8]"),
    ] = None,
    end: Annotated[float | None, typer.Option(help="Last instant of a film (s).  \\[default: begin + 0.1]")] = None,
    slow: Annotated[float, typer.Option(help="How many times slower than life a film runs.", min=0.01)] = 20.0,
    configuration: _Configuration = None,
    voltage: _Voltage = None,
    motor_speed: _MotorSpeed = None,
    slope: _Slope = None,
    payload: _Payload = None,
    mass: _Mass = None,
    surface: _Surface = None,
    duration: _Duration = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    battery: _Battery = None,
    discharge: _Discharge = None,
    force: _Force = False,
    no_cache: _NoCache = False,
) -> int:
    """Draw a run of the track model from standstill: the robot on its slope, its track running, its forces.

    Needs no display.
    """
    from sweeps import config

    options = _options(
        duration_s=duration,
        step_s=step,
        robot=robot,
        set=set_,
        effects=effects,
        battery=battery,
        discharge_mAh=discharge,
    )
    resolved = _prepared(config.resolve(config.Render, None, options), no_cache)
    from sweeps.commands import render as room

    cells = _cells(configuration, voltage, motor_speed, slope, payload, mass, surface)
    begin = (0.8 if file.suffix == ".png" else 0.0) if begin is None else begin
    end = begin + 0.1 if end is None else end
    return room.render(resolved, cells, file, begin, end, slow, force)


@app.command(epilog="Example: mmrjax calibrate measured --noise current=2%,motor_speed=0.5%,speed=1% --out fitted")
def calibrate(
    data: Annotated[str, typer.Argument(help="A CSV of measured runs or histories, or measured.")] = "measured",
    free: Annotated[
        list[str] | None,
        typer.Option(help="Parameters to free, comma-separated; default is the default set, motor.* a group."),
    ] = None,
    fix: Annotated[list[str] | None, typer.Option(help="Parameters to hold, comma-separated.")] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(help="A prior in SI units, repeatable: 6T2A.ground.friction.static=0.45±0.05."),
    ] = None,
    noise: Annotated[
        str | None,
        typer.Option(
            help="Sd: current=2%,motor_speed=0.5%,speed=1%.  \\[default: the file's columns, else estimated]"
        ),
    ] = None,
    starts: Annotated[
        int | None, typer.Option(help="Searches.  \\[default: 64; histories 8; rows with drive or track 1]")
    ] = None,
    population: Annotated[
        int | None,
        typer.Option(
            help="Members of each generation of a search without gradients, with which one with drive or track "
            "begins.  \\[default: 256 where the running gear is free, else 0]"
        ),
    ] = None,
    generations: Annotated[int | None, typer.Option(help="Of the population, at most.  \\[default: 30]")] = None,
    members: Annotated[
        Path | None,
        typer.Option(help="File that keeps the population's runs; the same command with it goes on from there."),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the starts.  \\[default: 0]")] = None,
    profiles: Annotated[
        bool | None,
        typer.Option("--profiles/--no-profiles", help="Profile likelihood of each.  \\[default: steady only]"),
    ] = None,
    hold_out: Annotated[
        bool | None,
        typer.Option("--hold-out/--no-hold-out", help="Fit again without each block.  \\[default: steady only]"),
    ] = None,
    model: _Model = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Find friction coefficients from measured runs, with their uncertainty, by gradients through the model.

    Writes robot.toml, which every command takes with --robot, and result.json. With --model drive or track the search
    begins at the optimum of steady; track takes minutes. Intervals are linear then, unless --profiles. With the
    running gear free (--model track --free running_gear.guide_recess,...) a population is searched first.
    """
    from sweeps import config

    options = _options(model=model, robot=robot, set=set_, effects=effects, report=report) | {
        "free": config.words(free), "fix": config.words(fix), "prior": tuple(prior) if prior else None,
        "noise": noise, "starts": starts, "population": population, "generations": generations, "seed": seed,
        "profiles": profiles, "hold_out": hold_out,
    }  # fmt: skip
    resolved = _prepared(config.resolve(config.Calibrate, None, options), no_cache)
    from sweeps.commands import calibrate as room

    return room.calibrate(resolved, data, out, force, members)


@app.command(epilog="Example: mmrjax loop measured --out found, then mmrjax sweep --robot found/robot.toml")
def loop(
    data: Annotated[
        str,
        typer.Argument(help="A CSV of measured runs, or with time_s of histories from rest; or measured."),
    ] = "measured",
    noise: Annotated[
        str | None,
        typer.Option(
            help="Sd of current, motor_speed, speed in % or A, rpm, mm/s, e.g. current=2%,speed=5mm/s.  \\[default: "
            "the file's columns; else 2, 0.5, 1 % are assumed, and halved and doubled]"
        ),
    ] = None,
    prior: Annotated[
        list[str] | None,
        typer.Option(help="A prior in SI units, repeatable, e.g. motor.resistance=0.9±0.1."),
    ] = None,
    prefer: Annotated[
        str | None,
        typer.Option(
            help="By what one of several effects that these data cannot tell apart comes first: fit, or held-out "
            "(errors of blocks that a fit has not seen).  \\[default: fit]"
        ),
    ] = None,
    replicates: Annotated[int | None, typer.Option(help="Tables of the bootstrap.  \\[default: 500]")] = None,
    seed: Annotated[int | None, typer.Option(help="Of everything random.  \\[default: 0]")] = None,
    forbid: Annotated[
        list[str] | None,
        typer.Option(
            help="An experiment that cannot be done, repeatable: stall, lifted, 'one motor', or a configuration."
        ),
    ] = None,
    resolve: Annotated[
        bool,
        typer.Option(
            "--resolve",
            help="Ask the track model whether a running gear within its priors leaves what remains in slip, track or "
            "ground; tens of minutes on two cores.",
        ),
    ] = False,
    population: Annotated[
        int | None, typer.Option(help="Members of a generation of --resolve.  \\[default: 128]")
    ] = None,
    generations: Annotated[int | None, typer.Option(help="Of --resolve, at most.  \\[default: 20]")] = None,
    members: Annotated[
        Path | None, typer.Option(help="File that keeps the runs of --resolve; the same command goes on from there.")
    ] = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Find what the model lacks: fit it, trace what is left to an effect, add that, report errors before and after.

    Says that nothing is missing where nothing is, and names no effect where none of the library fits. Writes
    result.json, report.html, and robot.toml, which every command takes with --robot.
    """
    from sweeps import config

    options = _options(robot=robot, set=set_, effects=effects, report=report) | {
        "noise": noise, "prior": tuple(prior) if prior else None, "replicates": replicates, "seed": seed,
        "prefer": prefer, "forbid": config.words(forbid), "resolve": resolve or None, "population": population,
        "generations": generations,
    }  # fmt: skip
    settled = _prepared(config.resolve(config.Loop, None, options), no_cache)
    from sweeps.commands import loop as room

    return room.loop(settled, data, out, force, members)


@app.command(epilog="Example: mmrjax sensitivity --outputs speed,peak_current --slopes 0,5 --evaluations 200000")
def sensitivity(
    method: Annotated[
        str | None,
        typer.Option(
            "--method",
            help="local, sobol, morris, derivative, or shapley (of a posterior).  "
            "\\[default: sobol; with --posterior shapley]",
        ),
    ] = None,
    parameters: Annotated[
        list[str] | None,
        typer.Option(
            help="Uncertain parameters, comma-separated, motor.* a group.  \\[default: all that have a prior]"
        ),
    ] = None,
    vary: Annotated[
        list[str] | None,
        typer.Option(help="A condition that is uncertain too, repeatable: voltage=22:26, slope_deg=0:5."),
    ] = None,
    outputs: Annotated[
        list[str] | None,
        typer.Option(
            help="Outputs, comma-separated: those of a run, steepest_slope, start for the three of a start.  "
            "\\[default: current, speeds, slip, power, efficiency, steepest slope]"
        ),
    ] = None,
    evaluations: Annotated[
        int | None,
        typer.Option(
            help="Model evaluations, at least, in all.  \\[default: 1000000; shapley 300000; runs over time 100000]"
        ),
    ] = None,
    posterior: Annotated[
        bool | None,
        typer.Option("--posterior", help="The inputs are the posterior.nc beside the calibrated --robot."),
    ] = None,
    configurations: Annotated[
        str | None, typer.Option(help="Comma-separated, of the robot's.  \\[default: all that it has]")
    ] = None,
    voltages: Annotated[
        str | None,
        typer.Option(help="Supply voltages (V).  \\[default: of Table 8; of a rig thirds of its voltage_limit]"),
    ] = None,
    motor_speeds: _MotorSpeeds = None,
    payloads: Annotated[
        str | None, typer.Option(help="Additional load masses (kg).  \\[default: of Table 8; of a rig 0]")
    ] = None,
    slopes: Annotated[
        str | None, typer.Option(help="Slopes, positive uphill (deg).  \\[default: of Table 8; of a rig 0]")
    ] = None,
    surface: _Surface = None,
    candidates: Annotated[
        Path | None,
        typer.Option(
            help="CSV of runs that could be made next.  \\[default: Table 8; of a rig the operating points]"
        ),
    ] = None,
    runs: Annotated[int | None, typer.Option(help="How many of them to propose.  \\[default: 5]")] = None,
    noise: Annotated[
        str | None,
        typer.Option(help="Sd of their readings: current=2%,motor_speed=0.5%,speed=1%.  \\[default: these]"),
    ] = None,
    seed: Annotated[int | None, typer.Option(help="Of the sample.  \\[default: 0]")] = None,
    model: _Model = None,
    duration: _Duration = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    battery: _Battery = None,
    discharge: _Discharge = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Say which parameters matter where, which do not matter at all, and which runs would tell more of them.

    Writes result.json, report.html, points.csv and indices.csv. Local derivatives and elasticities at every
    operating point come with every method.
    """
    from sweeps import config

    options = _options(
        model=model, duration_s=duration, step_s=step, robot=robot, set=set_, effects=effects, battery=battery,
        discharge_mAh=discharge, report=report,
    ) | {
        "method": method or ("shapley" if posterior else None), "parameters": config.words(parameters),
        "vary": config.words(vary), "outputs": config.words(outputs), "evaluations": evaluations,
        "posterior": posterior,
        "configurations": None if configurations is None else tuple(c.strip() for c in configurations.split(",")),
        "voltages_V": config.axis("--voltages", voltages), "payloads_kg": config.axis("--payloads", payloads),
        "slopes_deg": config.axis("--slopes", slopes), "surface": surface,
        "motor_speeds_rpm": config.axis("--motor-speeds", motor_speeds),
        "candidates": None if candidates is None else str(candidates), "runs": runs, "noise": noise, "seed": seed,
    }  # fmt: skip
    resolved = _prepared(config.resolve(config.Sensitivity, None, options), no_cache)
    from sweeps.commands import sensitivity as room

    return room.sensitivity(resolved, out, force)


@app.command(
    epilog="Example: mmrjax resonance --configuration 6T2A --voltages 10:40:0.5 --payloads 0,4,8 "
    "--set running_gear.guide_recess=1e-4"
)
def resonance(
    configuration: _Configuration = None,
    voltages: Annotated[
        str | None,
        typer.Option(
            help="Supply voltages (V), by which the speed is set; at least 5.  \\[default: 10:40:1, that is 31]"
        ),
    ] = None,
    payloads: Annotated[
        str | None, typer.Option(help="Additional load masses (kg).  \\[default: 0,1.5,3,5,6.5,8, of Table 8]")
    ] = None,
    slope: _Slope = None,
    surface: _Surface = None,
    duration: Annotated[
        float | None,
        typer.Option(
            "--duration",
            help="Length of a run (s), at least 0.5; ripple is read in its second half.  \\[default: 1.5]",
        ),
    ] = None,
    step: _Step = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Say which speeds to avoid: ripple of reaction, current and speed over speed and payload, by the track model.

    A Campbell diagram sets the frequency at which grousers pass, and its harmonics, against bounce and pitch of the
    robot on its contacts. An axis is 0,5,10 or first:last:step. Writes result.json, report.html, points.csv,
    modes.csv and peaks.csv; the points of Table 8 are run too. About a minute on two cores.
    """
    from sweeps import config

    options = _options(
        duration_s=duration, step_s=step, robot=robot, set=set_, effects=effects, report=report
    ) | {
        "configuration": configuration, "voltages_V": config.axis("--voltages", voltages),
        "payloads_kg": config.axis("--payloads", payloads), "slope_deg": slope, "surface": surface,
    }  # fmt: skip
    resolved = _prepared(config.resolve(config.Resonance, None, options), no_cache)
    from sweeps.commands import resonance as room

    return room.resonance(resolved, out, force)


@app.command(epilog="Example: mmrjax check requirements.toml --robot found/robot.toml --set gearbox.ratio=40")
def check(
    requirements: Annotated[
        Path | None,
        typer.Argument(
            metavar="[REQUIREMENTS.toml]", help="TOML file (docs/requirements.md).  \\[default: the paper's aims]"
        ),
    ] = None,
    changes: Annotated[
        bool | None,
        typer.Option("--changes/--no-changes", help="Look for what would meet what is missed.  \\[default: changes]"),
    ] = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Hold a robot against requirements: pass or fail with margin, each at the worst corner of its envelope.

    Of each that is missed it says what change of one parameter would meet it. Exit code 3: one is missed.
    """
    from sweeps import config

    options = _options(robot=robot, set=set_, effects=effects, report=report) | {
        "requirements": None if requirements is None else str(requirements), "changes": changes,
    }  # fmt: skip
    resolved = _prepared(config.resolve(config.Check, None, options), no_cache)
    from sweeps.commands import check as room

    return room.check(resolved, out, force)


@app.command(epilog="Example: mmrjax size requirements.toml --pareto mass,energy")
def size(
    requirements: Annotated[
        Path | None,
        typer.Argument(
            metavar="[REQUIREMENTS.toml]", help="TOML file (docs/requirements.md).  \\[default: the paper's aims]"
        ),
    ] = None,
    objective: Annotated[
        str | None, typer.Option(help="What is made small: mass (kg), energy (Wh/m), cost (EUR).  \\[default: mass]")
    ] = None,
    pareto: Annotated[
        str | None, typer.Option(help="Two objectives, comma-separated, for a front of both instead.")
    ] = None,
    motors: Annotated[
        list[str] | None, typer.Option(help="Motors to choose from, comma-separated.  \\[default: all of the sheets]")
    ] = None,
    starts: Annotated[int | None, typer.Option(help="Searches in one batch.  \\[default: 256]")] = None,
    seed: Annotated[int | None, typer.Option(help="Of the starts.  \\[default: 0]")] = None,
    robot: _Robot = None,
    set_: _Set = None,
    effects: _Effects = None,
    out: _Out = None,
    force: _Force = False,
    report: _Report = None,
    no_cache: _NoCache = False,
) -> int:
    """Search motor, gearbox, ratio, radius and cells for a robot that meets requirements, with the makers' parts.

    Leaves the best as robot.toml, alternatives, what binds each motor. Exit code 3: no design meets all of them.
    """
    from sweeps import config

    options = _options(robot=robot, set=set_, effects=effects, report=report) | {
        "requirements": None if requirements is None else str(requirements), "objective": objective,
        "pareto": config.words([pareto]) if pareto else None, "motors": config.words(motors), "starts": starts,
        "seed": seed,
    }  # fmt: skip
    resolved = _prepared(config.resolve(config.Size, None, options), no_cache)
    from sweeps.commands import size as room

    return room.size(resolved, out, force)


rig = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich",
    help="A rig of your own, bench or robot: a file to fill in, and what the program makes of it (docs/rigs).",
)  # fmt: skip
app.add_typer(rig, name="rig")


@rig.command(epilog="Example: mmrjax rig new my-rig.toml --kind wheeled")
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The file to write.")],
    kind: Annotated[str, typer.Option(help="tracked, wheeled, bench, pendulum or linear.")] = "bench",
    force: Annotated[bool, typer.Option("--force", help="Replace the file where there is one.")] = False,
) -> int:
    """Write a rig's file to fill in, with units and where each number comes from; it asks nothing.

    As written it can be read, with numbers of an example. Units are SI but where a comment says another.
    """
    from sweeps.commands import rig_new

    return rig_new.new(file, kind, force)


@rig.command("check", epilog="Example: mmrjax rig check my-rig.toml my-runs.csv")
def rig_check(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The rig's file.")],
    data: Annotated[
        str | None, typer.Argument(metavar="[DATA.csv]", help="A table of runs, settled or over time (time_s, s).")
    ] = None,
    effects: _Effects = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON (mmrjax.rig_check/1) instead of words.")] = False,
    no_cache: _NoCache = False,
) -> int:
    """Say what was understood of a rig's file, where each number comes from, and whether it makes sense.

    With data: which columns are used for what, over what range, and which parameters these data can determine;
    one whose posterior sd is above 0.9 of its prior's is held by its prior. Nothing is fitted or written.
    Exit codes: 0 it can be used; 2 the file cannot; 4 the data cannot.
    """
    _start_jax(no_cache)
    from sweeps.commands import rig_check as room

    return room.check(file, data, tuple(effects or ()), json)


@app.command()
def doctor(no_cache: _NoCache = False) -> int:
    """Check this installation: versions, devices, the compilation cache, a solved run, a writable folder."""
    _start_jax(no_cache)
    from sweeps.commands import doctor as room

    return room.doctor()


def _options(**given: Any) -> dict[str, Any]:
    from sweeps import config

    effects = given["effects"]
    return {**given, "set": config.settings(given["set"]), "effects": tuple(effects) if effects else None}


def _prepared(resolved: Any, no_cache: bool = False) -> Any:
    """A command's configuration, once the environment is ready for the jax that the command will import.

    Runs of the track model have hung for good, one sweep in seven on two cores, with every thread asleep in
    XLA's CPU executor (jax 0.10.2); with this flag none of twelve did (docs/benchmarks.md). Whoever sets
    XLA_FLAGS, be it to nothing, is heeded.
    """
    if hasattr(resolved, "model") and fidelities.facts(resolved.model).one_thread:
        os.environ.setdefault("XLA_FLAGS", "--xla_cpu_multi_thread_eigen=false")
    _start_jax(no_cache)
    return resolved


def _start_jax(no_cache: bool) -> None:
    """Import jax with double precision, and with the compilation cache unless it is not wanted."""
    from sweeps import compilation_cache

    if not no_cache:
        compilation_cache.enable()
    import jax

    if no_cache:
        jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_enable_x64", True)


def _cells(
    configuration: str | None, voltage: float | None, motor_speed: float | None, slope: float | None,
    payload: float | None, mass: float | None, surface: str | None,
) -> dict[str, Any]:  # fmt: skip
    """One run by the columns of a table of runs; None is left to the robot."""
    return {
        "configuration": configuration, "supply_voltage_V": voltage, "motor_speed_rpm": motor_speed,
        "payload_kg": payload, "slope_deg": slope, "surface": surface, "total_mass_kg": mass,
    }  # fmt: skip


def main() -> None:
    """Run the command line; every failure is one sentence on stderr and a documented exit code."""
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # ended or interrupted: both can be taken up again
    try:
        code = app(standalone_mode=False)
        if code == INTERRUPTED:  # the option parser has caught the interrupt
            raise KeyboardInterrupt
    except InputError as error:
        code = _fail(str(error), error.exit_code)
    except (typer.Abort, KeyboardInterrupt):
        advice = "no run folder was left"
        if "sweep" in sys.argv[1:2]:
            advice = "a sweep goes on where it stopped, after its last whole chunk, with the same --out"
        code = _fail(f"interrupted; {advice}", INTERRUPTED)
    except OSError as error:
        place = error.filename or "a file"
        code = _fail(f"{place}: {error.strerror}; no run folder was left, only its .partial beside it", 2)
    except Exception as error:
        if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of the option parser
            code = _fail(error.format_message(), error.exit_code)
        else:
            import traceback

            traceback.print_exc()
            code = _fail(f"internal error: {error}", 1)
    if code == INTERRUPTED:  # XLA may still be at work, and has crashed when Python was taken down around it
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code if isinstance(code, int) else 0)


def _fail(message: str, code: int) -> int:
    print(f"mmrjax: {message}", file=sys.stderr)
    return code
