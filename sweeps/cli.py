"""The command line `mmrjax`: options only. Each command imports its module in `commands` when it runs."""

from __future__ import annotations

import contextlib
import functools
import importlib
import inspect
import os
import re
import signal
import sys
import threading
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from calibration.data import Names
from calibration.data.input_errors import BadConfiguration, InputError
from mmrjax import OLDER_EMITTERS, SOUND_AT_LEVEL_0, WORKER, __version__, fidelities
from mmrjax.errors import printable, shorten
from sweeps import config, config_campaign, options

INTERRUPTED = 130

app = typer.Typer(
    name="mmrjax", add_completion=False, pretty_exceptions_enable=False,
    rich_markup_mode="rich",
    help=(
        "Simulate a small robot's drive and compare it with measured data.\n\n[bold]Exit codes[/bold]: 0 done, "
        "whatever the answer. 1 internal error. 2 usage or configuration. 3 done, but a solver failed. 4 bad "
        "data. 130 interrupted, and the same command continues."
    ),
)  # fmt: skip


_NoCache = Annotated[
    bool,
    typer.Option("--no-cache", help="Do not use the cache of compiled programs.", hidden=True),
]
_Config = Annotated[
    Path | None,
    typer.Option(
        "--config",
        hidden=True,
        help="TOML file with the keys of a config.resolved.toml. Options override it.",
    ),
]
_Trust = Annotated[
    bool,
    typer.Option("--trust", hidden=True, help="Allow the file of --config to name effects, whose code is run."),
]
_Effects = Annotated[
    list[str] | None, typer.Option("--effects", help="Python file with your own effects. Repeatable.")
]
_Columns = Annotated[
    str | None,
    typer.Option("--columns", help="Preset for the column names, or its file (docs/howto/formats.md)."),
]


def _command(
    config_kind: type[config.Part],
    invocation_kind: type[config.Part],
    *,
    group: str,
    common: str,
    example: str,
    module: str = "",
    failure: str = "the solver failed at some runs. Runs that stall or slide give 0",
    resolve: Callable[..., config.Part] | None = None,
) -> Callable[[Callable[[], None]], None]:
    """Decorator for the name and help of a command whose options are the fields of two configurations.

    The command is the function `execute` of its module in `commands`, called with both once jax is ready.

    Args:
        config_kind: type of the configuration.
        invocation_kind: type of the inputs, output folder and other options that are not part of it.
        group: heading in `--help`.
        common: options that `--help` shows, in this order. `--help-all` shows all.
        module: name of the module, if it is not that of the command.
        failure: meaning of exit code 3.
        resolve: function to use instead of `config.resolve_configuration`.
    """

    def decorate(described_command: Callable[[], None]) -> None:
        name = described_command.__name__

        def run(**arguments: Any) -> int:
            from sweeps.console import report_working

            file = arguments["config_file"]
            plan = arguments.get("plan")
            trust = arguments["trust"]
            if plan is not None and file is not None:
                raise InputError(f"--config: got {file} in addition to {plan}; give one of them")
            file = plan if file is None else file
            if "plan" in arguments:
                arguments["plan"] = file
            config_values = options.take_options(config_kind, arguments)
            invocation_values = options.take_options(invocation_kind, arguments)
            invocation = config.resolve_configuration(invocation_kind, None, invocation_values)
            if resolve is None:
                resolved_config = config.resolve_configuration(config_kind, file, config_values, trust)
            else:
                resolved_config = resolve(file, config_values, trust)
            with report_working(name):
                _prepare_environment(resolved_config, arguments["no_cache"])
                code: int = importlib.import_module(f"sweeps.commands.{module or name}").execute(
                    resolved_config, invocation
                )
                return code

        keyword = functools.partial(inspect.Parameter, kind=inspect.Parameter.KEYWORD_ONLY)
        parameters = [
            *options.option_parameters((invocation_kind, config_kind), common.split()),
            keyword("config_file", annotation=_Config, default=None),
            keyword("trust", annotation=_Trust, default=False),
            keyword("no_cache", annotation=_NoCache, default=False),
            options.help_all(),
        ]
        help_text = re.sub(r"(?<!\n)\n(?!\n)", " ", inspect.getdoc(described_command) or "")
        run.__name__, run.__doc__ = name, help_text
        run.__signature__ = inspect.Signature(parameters)  # type: ignore[attr-defined]
        run.__annotations__ = {p.name: p.annotation for p in parameters}
        app.command(epilog=f"Example: {example}\n\nExit code 3: {failure}.", rich_help_panel=group)(run)

    return decorate


#: Headings of commands in `--help`, in their order there.
MODEL, DATA, DESIGN, ELSEWHERE = "Model", "Data", "Design", "Export and reference"
_AT_CORNER = "the solver failed at the worst corner"

#: What `mmrjax` alone prints.
FIRST_HOUR = """mmrjax simulates a small robot's drive and compares it with measured data. Begin with:

  mmrjax simulate --configuration 6T2A --voltage 24 --slope 10    one run of the packaged robot
  mmrjax inspect log.csv                                          what a data file contains
  mmrjax loop measured --out found                                what the model lacks, from the packaged runs

mmrjax --help lists all commands."""


@app.callback(invoke_without_command=True)
def _root(
    context: typer.Context,
    version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False,
    check: Annotated[
        bool, typer.Option("--check", help="Check the installation: versions, devices, cache, one solved run.")
    ] = False,
) -> None:
    if version or check:
        print(f"mmrjax {__version__}")
    if check:
        _start_jax(no_cache=False)
        from sweeps.commands import installation

        raise typer.Exit(installation.check_installation())
    if version:
        raise typer.Exit
    if context.invoked_subcommand is None:
        print(FIRST_HOUR)


@_command(
    config.Simulate,
    config.GivenRuns,
    group=MODEL,
    common="robot configuration voltage slope payload runs model out",
    example="mmrjax simulate --configuration 4W2T --voltage 24 --slope 10 --payload 5 --model drive; "
    "mmrjax simulate --profile patrol --battery --payload 5; mmrjax simulate --left 33 --right 15",
)
def simulate() -> None:
    """Simulate operating points, a start, a mission or a turn.

    The options describe one operating point, and --runs FILE.csv gives several. With --model drive or track the run
    starts from standstill. history.csv then holds current and speeds over time. With track, reactions.csv also holds
    the loads inside the running gear. With --profile the robot follows a mission, and segments.csv holds energy (Wh,
    Wh/m), distance, peaks, temperatures and charge of each segment. With --left and --right the two sides have
    different voltages, and the robot turns (docs/howto/turn.md).
    """


@_command(
    config.Sweep,
    config_campaign.StoreOptions,
    group=MODEL,
    common="robot set configurations voltages payloads slopes export out",
    resolve=config_campaign.resolve_campaign,
    example="mmrjax sweep --slopes 0:20:0.5 --payloads 0,4,8 --voltages 24 --configurations 6T2A "
    "--set 6T2A.ground.friction.static=0.6",
)
def sweep() -> None:
    """Simulate every combination of a grid in one batch.

    The default grid is the paper's Table 8. An axis is a list such as 0,5,10, or a range first:last:step such as
    0:20:0.5. Up to 100 000 runs are written to runs.csv. Larger sweeps write a Zarr store. --export csv writes
    runs.csv too. In a CONFIG.toml any parameter or condition can vary, on a grid or by sampling
    (docs/reference/plans.md). An interrupted sweep continues with the same command and the same --out.
    """


@_command(
    config.Compare,
    config.ComparedRuns,
    group=DATA,
    common="robot against columns model out",
    example="mmrjax compare measured --robot found/robot.toml --against nominal",
)
def compare() -> None:
    """Simulate measured runs and report the errors.

    Errors are reported for each row and channel, with rms, largest error and R². --against compares two robots on the
    same rows.
    """


@_command(
    config.Reproduce,
    config.FolderPart,
    group=MODEL,
    common="robot model out",
    example="mmrjax reproduce --robot found/robot.toml --model track",
)
def reproduce() -> None:
    """Reproduce the paper's tables and figures with a robot.

    The rows of the paper's bench and Figs. 5a-29 are compared one by one. --model track adds the loads inside the
    running gear (Figs. 23-27).
    """


@_command(
    config.Render,
    config.Picture,
    group=MODEL,
    common="robot configuration voltage slope payload time",
    example="mmrjax render start.png --slope 10 --payload 5 --time 0.4",
)
def render() -> None:
    """Draw a picture of the track model.

    The picture shows the robot on its slope, its track and the contact forces. The run starts from standstill. The
    command works without a display.
    """


@_command(
    config.Calibrate,
    config.FittedRuns,
    group=DATA,
    common="robot columns noise prior free fix verbose out",
    example="mmrjax calibrate measured --noise current=2%,motor_speed=0.5%,speed=1% --out fitted",
    failure=(
        "a fit did not converge, or the solver failed for a row. An inadequate fit, or a row that slides, gives 0"
    ),
)
def calibrate() -> None:
    """Fit parameters to measured runs, with intervals.

    The search follows gradients through the simulation. By default it fits friction, slip and data-sheet values.
    Writes result.json and robot.toml, which every command accepts as --robot. Logs are fitted with the drive model,
    settled runs with the steady model unless --model is given. With drive or track the search starts at the optimum
    of steady, and intervals are linear unless --profiles is given. track takes minutes. If parameters of the running
    gear are free (--model track --free running_gear.guide_recess,...), a gradient-free search with a population comes
    first.
    """


@_command(
    config.Settle,
    config.SettledLog,
    group=DATA,
    common="robot columns shortest drift out",
    example="mmrjax settle log.csv --robot rig.toml --out settled, then "
    "mmrjax loop settled/settled.csv --robot rig.toml",
    failure="does not occur",
)
def settle() -> None:
    """Extract the settled runs of a log as a table.

    The table is input for loop and calibrate. The page lists the parts of the log that were left out, with reasons.
    Writes settled.csv (means and their standard deviations), stretches.csv (every stretch, and which channel still
    changes) and report.html.
    """


@_command(
    config.Loop,
    config.LoopBeside,
    group=DATA,
    common="robot columns noise prior forbid within verbose out",
    example="mmrjax loop measured --out found, then mmrjax sweep --robot found/robot.toml",
    failure=(
        "the proposed fit did not converge, or --within ran out before a verdict (the same command continues). "
        "Every verdict gives 0"
    ),
)
def loop() -> None:
    """Find the effect that the model lacks, and add it.

    The model is fitted, the residual is traced to an effect, and errors are reported before and after. The answer
    may be that nothing is missing, or that no effect of the library explains the residual. Writes result.json,
    report.html, and robot.toml, which every command accepts as --robot.
    """


@_command(
    config.Sensitivity,
    config.FolderPart,
    group=DESIGN,
    common="robot method outputs parameters voltages slopes evaluations out",
    example="mmrjax sensitivity --outputs speed,peak_current --slopes 0,5 --evaluations 200000",
)
def sensitivity() -> None:
    """Rank parameters by influence.

    Every method includes local derivatives and elasticities at every operating point. With sobol and morris, each
    condition that you do not give takes only the two ends of its usual range, and the slope also its middle. Writes
    result.json, report.html, points.csv and indices.csv.
    """


@_command(
    config.Resonance,
    config.FolderPart,
    group=MODEL,
    common="robot configuration voltages payloads slope set out",
    example="mmrjax resonance --configuration 6T2A --voltages 10:40:0.5 --payloads 0,4,8 "
    "--set running_gear.guide_recess=1e-4",
)
def resonance() -> None:
    """Find the speeds at which the tracks excite the chassis.

    The track model gives the ripple of ground reaction, current and speed over speed and payload. A Campbell diagram
    compares the grouser-passing frequency and its harmonics with the bounce and pitch modes of the robot on its
    contacts. An axis is a list such as 0,5,10, or a range first:last:step. Writes result.json, report.html,
    points.csv, modes.csv and peaks.csv. The operating points of Table 8 are included. The command takes about a
    minute on two cores.
    """


@_command(
    config.Climb,
    config.FolderPart,
    group=MODEL,
    common="robot step stairs gap find levers-front levers-rear out",
    example="mmrjax climb --step 120 --levers-front 45 --levers-rear -8.5 --voltage 6; mmrjax climb --find step",
    failure="the simulation broke down. A robot that does not get over gives 0",
)
def climb() -> None:
    """Simulate a climb over a step, stairs, a gap or a terrain.

    Reports what stops the robot. The robot starts on level ground and meets the obstacle at a right angle. Levers
    keep their angles or follow a --sequence. --find searches for the largest obstacle by bisection. Writes
    result.json, report.html and history.csv with posture, currents of all four drives, tipping margin and energy over
    time (docs/howto/climb.md).
    """


@_command(
    config.Check,
    config.FolderPart,
    group=DESIGN,
    common="robot set changes out",
    example="mmrjax check requirements.toml --robot found/robot.toml --set gearbox.ratio=40",
    failure=f"{_AT_CORNER}. A missed requirement gives 0",
)
def check() -> None:
    """Check a robot against requirements.

    Each requirement passes or fails, with the margin at the worst corner of its envelope. For each missed requirement
    the command reports the change of one parameter that would meet it.
    """


@_command(
    config.Size,
    config.VerbosePart,
    group=DESIGN,
    common="robot objective pareto motors verbose out",
    example="mmrjax size requirements.toml --pareto mass,energy",
    failure=f"{_AT_CORNER} of the best design. Missed requirements give 0",
)
def size() -> None:
    """Choose motor, gearbox and cells that meet requirements.

    The search covers motors and gearboxes of makers, the ratio, the wheel radius and the number of cells. Writes the
    best design as robot.toml, the alternatives, and the requirement that limits each motor.
    """


@_command(
    config.Export,
    config.FolderPart,
    group=ELSEWHERE,
    common="to data configuration joint out",
    example="mmrjax export found/robot.toml --to mujoco --data runs.csv --out exported",
    failure="does not occur",
    module="export_drive",
)
def export() -> None:
    """Write the drive for MuJoCo, JAX, ONNX and others.

    A page reports what the format cannot represent. The parameters of the format are refitted to this model over the
    runs of --data. LAW.md documents the law by itself: equations, constants with intervals, conditions covered by
    the data, and what was not tested.
    """


rig = typer.Typer(
    no_args_is_help=True, rich_markup_mode="rich",
    help="Describe your bench or robot in a file.",
)  # fmt: skip
app.add_typer(rig, name="rig", rich_help_panel=DATA)


_SHEET = "Data sheet"


@rig.command(
    epilog="Example: mmrjax rig new my-rig.toml --from robot.urdf --joint left_wheel_joint --voltage 24V "
    "--no-load-speed 8810rpm --no-load-current 164mA --stall-torque 1020mNm --stall-current 39.3A "
    "--resistance 0.611ohm"
)
def new(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="File to write.")],
    kind: Annotated[
        str | None,
        typer.Option(
            help=(
                "tracked, wheeled, bench, dyno, pendulum, servo, linear or carriage.  \\[default: from --from, "
                "otherwise bench]"
            )
        ),
    ] = None,
    source: Annotated[Path | None, typer.Option("--from", help="URDF or MuJoCo model.")] = None,
    joint: Annotated[str | None, typer.Option(help="The revolute joint.  \\[default: the only driven one]")] = None,
    from_sheet: Annotated[
        bool,
        typer.Option("--from-sheet", help="Read a motor. The options below imply it.", rich_help_panel=_SHEET),
    ] = False,
    voltage: Annotated[
        str | None, typer.Option(help="Voltage of the data below: V or mV.", rich_help_panel=_SHEET)
    ] = None,
    no_load_speed: Annotated[
        str | None, typer.Option(help="No-load speed: rpm, 1/min or rad/s.", rich_help_panel=_SHEET)
    ] = None,
    no_load_current: Annotated[
        str | None, typer.Option(help="No-load current: A or mA. Required.", rich_help_panel=_SHEET)
    ] = None,
    stall_torque: Annotated[
        str | None,
        typer.Option(help="Stall torque: Nm, mNm, Ncm, kg·cm, g·cm, oz·in or lb·in.", rich_help_panel=_SHEET),
    ] = None,
    stall_current: Annotated[str | None, typer.Option(help="Stall current: A or mA.", rich_help_panel=_SHEET)] = None,
    resistance: Annotated[
        str | None, typer.Option(help="Terminal resistance: ohm or mohm.", rich_help_panel=_SHEET)
    ] = None,
    force: Annotated[bool, typer.Option("--force", help="Overwrite the file.")] = False,
) -> int:
    """Write a rig's file to fill in.

    Each number has its unit and source. The file is valid as written, but its numbers are examples. Units are SI
    unless a comment states another.

    --kind chooses the kind of rig. --from reads mass, inertia, radius, ratio, friction, damping and armature of a
    joint from a model. --from-sheet reads a motor from four to six numbers with units. It refuses numbers that
    contradict each other by more than 10 %. Both can be combined. Each number gets its source and a wide ±. The
    command lists what is missing.
    """
    from sweeps.commands import rig_new

    sheet_options = {
        "voltage": voltage, "no-load-speed": no_load_speed, "no-load-current": no_load_current,
        "stall-torque": stall_torque, "stall-current": stall_current, "resistance": resistance,
    }  # fmt: skip
    sheet = {name: text for name, text in sheet_options.items() if text is not None}
    return rig_new.write_new_rig(file, kind, force, source, joint, sheet if sheet or from_sheet else None)


@rig.command("check", epilog="Example: mmrjax rig check my-rig.toml my-runs.csv")
def rig_check(
    file: Annotated[Path, typer.Argument(metavar="FILE.toml", help="The rig's file.")],
    data: Annotated[
        str | None,
        typer.Argument(metavar="[DATA]", help="Table or log (docs/howto/formats.md)."),
    ] = None,
    columns: _Columns = None,
    effects: _Effects = None,
    json: Annotated[bool, typer.Option("--json", help="Print JSON (mmrjax.rig_check/1) instead of text.")] = False,
    verbose: Annotated[bool, typer.Option("--verbose", help="Print every table and remark.")] = False,
    no_cache: _NoCache = False,
) -> int:
    """Check a rig's file, and data for it.

    Lists the values with their sources and plausibility. With data, it also lists the use and range of each column,
    and the parameters that these data determine. A parameter is not determined if its posterior sd is above 0.9 of
    its prior sd. Nothing is fitted or written. Exit codes: 0 usable, 2 the file is not usable, 4 the data are not
    usable.
    """
    _start_jax(no_cache)
    from sweeps.commands import rig_check as rig_check_command

    return rig_check_command.check_rig_file(file, data, tuple(effects or ()), json, columns, verbose)


@app.command(
    "inspect", rich_help_panel=DATA, epilog="Example: mmrjax inspect log.bag; mmrjax inspect log.h5::/run1 --json"
)
def inspect_file(
    file: Annotated[str, typer.Argument(metavar="FILE", help="Data file. ::PATH selects a part.")],
    json: Annotated[bool, typer.Option("--json", help="Print JSON (mmrjax.inspect/1) instead of text.")] = False,
) -> int:
    """List the signals of a data file, and propose column names.

    Signals have units, rates, ranges and gaps. Exit codes: 0 readable, 4 not readable.
    """
    from sweeps.commands import inspect as inspect_command

    return inspect_command.inspect_file(file, json)


@app.command(rich_help_panel=ELSEWHERE, epilog="Example: mmrjax explain series_resistance")
def explain(
    name: Annotated[
        list[str] | None,
        typer.Argument(help="Effect, status, output, parameter or other name. None: list all."),
    ] = None,
    effects: _Effects = None,
    no_cache: _NoCache = False,
) -> int:
    """Explain the name of an effect, status, output or parameter.

    Prints its equation, source, typical size, signature in data and a test for it.
    """
    _start_jax(no_cache)
    from sweeps.commands import explain as explain_command

    return explain_command.explain_name(" ".join(name) if name else None, tuple(effects or ()))


def _prepare_environment(config_of_command: Any, no_cache: bool = False) -> None:
    """Prepares the process before a command with this configuration imports jax.

    With several threads, one sweep of the track model in seven hung forever on two cores, with every thread asleep in
    XLA's CPU executor (jax 0.10.2). With one thread none of twelve did (docs/lab/figures.md). XLA_FLAGS set by the
    user, even if empty, takes precedence.
    """
    model = getattr(config_of_command, "model", None)  # None for a calibration whose model depends on the data
    one_thread = isinstance(model, str) and fidelities.fidelity_facts(model).one_thread
    compiler_options = (
        LOOP_COMPILER_OPTIONS
        if isinstance(config_of_command, config.Loop)
        else (OLDER_EMITTERS,) * isinstance(config_of_command, config.Calibrate)
    )
    _start_jax(no_cache, ("--xla_cpu_multi_thread_eigen=false",) * one_thread, compiler_options)


#: Compiler options of `loop`. XLA compiles a loop of a program as one function up to this size [bytes]. For larger
#: loops, each iteration passes some hundred operations to the executor, which takes most of the time of a run.
LOOP_COMPILER_OPTIONS = ("xla_cpu_small_while_loop_byte_threshold=1000000", OLDER_EMITTERS)


def _start_jax(no_cache: bool, flags: Names = (), compiler_options: Names = ()) -> None:
    """Imports jax with double precision, XLA flags and, unless `no_cache`, the compilation cache.

    Compiler options are added to that of `SOUND_AT_LEVEL_0`.
    """
    _refuse_little_memory()
    if "jax" not in sys.modules:  # jax reads the flag when it is imported
        flags = ",".join((SOUND_AT_LEVEL_0, *compiler_options)), *flags
    if flags:
        os.environ.setdefault("XLA_FLAGS", " ".join(flags))
    from sweeps import compilation_cache

    if not no_cache:
        compilation_cache.keep_programs()
    import jax

    if no_cache:
        jax.config.update("jax_enable_compilation_cache", False)
    jax.config.update("jax_enable_x64", True)


#: Smallest limit of the address space [bytes]. With less, libraries abort the process.
LEAST_MEMORY = 2_000_000_000


def _refuse_little_memory() -> None:
    try:
        import resource
    except ImportError:  # a system without such limits
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < LEAST_MEMORY:
        raise InputError(
            f"memory: got a limit of {limit / 1e9:.2g} GB of address space (ulimit -v); expected at least "
            f"{LEAST_MEMORY / 1e9:g} GB"
        )


def main() -> None:
    """Runs the command line. Every failure is one sentence on stderr and a documented exit code."""
    # NumPy reads this when it is imported. With several threads, a small factorisation takes 3 s instead of 0.04 s
    # under load, because the threads wait for each other.
    os.environ.setdefault("OPENBLAS_NUM_THREADS", "1")
    for number in (signal.SIGTERM, signal.SIGALRM):  # handled like Ctrl-C, so that the command can be resumed
        signal.signal(number, signal.default_int_handler)
    previous_hook = sys.unraisablehook
    sys.unraisablehook = _raise_lost_interrupt
    _replace_closed_streams()
    try:
        # Names that are not UTF-8 are rejected, because neither pages nor JSON could show them
        for argument in sys.argv[1:]:
            if not argument.isprintable() and any("\ud800" <= c <= "\udfff" for c in argument):
                readable = argument.encode("utf-8", "replace").decode()
                raise BadConfiguration(f"{readable}: is not in UTF-8; rename the file or folder")
        code = app(standalone_mode=False)
        if code == INTERRUPTED:  # the option parser has caught the interrupt
            raise KeyboardInterrupt
    except BaseException as error:
        code = _report_failure(error)
    signal.setitimer(signal.ITIMER_REAL, 0)
    sys.unraisablehook = previous_hook
    code = code if isinstance(code, int) else 0
    failed_streams = []
    for stream in (sys.stderr, sys.stdout):
        try:
            stream.flush()
        except OSError as error:  # Python would flush again at exit
            failed_streams.append(stream)
            if code == 0 and stream is sys.stdout:
                code = (
                    1 if isinstance(error, BrokenPipeError) else _print_failure(f"{stream.name}: {error.strerror}", 2)
                )
    has_worker = any(t.name.startswith(WORKER) for t in threading.enumerate())  # daemon threads
    is_loop_out_of_time = code == 3 and "loop" in sys.argv[1:2]  # possibly interrupted in a step by --within
    # XLA may still be running, and has crashed while Python was shutting down
    if code == INTERRUPTED or is_loop_out_of_time or has_worker or failed_streams:
        os._exit(code)
    sys.exit(code)


def _raise_lost_interrupt(ignored: Any) -> None:
    """Repeats an interrupt shortly afterwards, because an interrupt inside a callback (such as garbage collection)
    is lost."""
    if issubclass(ignored.exc_type, KeyboardInterrupt):
        signal.setitimer(signal.ITIMER_REAL, 0.01)
    else:
        sys.__unraisablehook__(ignored)


def _replace_closed_streams() -> None:
    """Reopens closed standard streams. Otherwise a file could get their numbers, and with them the output of
    libraries."""
    for number in range(3):
        with contextlib.suppress(OSError):
            os.fstat(number)
            continue
        os.open(os.devnull, os.O_RDWR)  # the lowest free number
    sys.stdout = sys.stdout or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115
    sys.stderr = sys.stderr or open(os.devnull, "w", encoding="utf-8")  # noqa: SIM115


def _report_failure(error: BaseException) -> int:
    """Reports why a command failed. Returns its exit code."""
    if isinstance(error, typer.Abort) and isinstance(error.__context__, EOFError):
        error = error.__context__  # raised by a file, but the option parser mistakes it for the end of its own input
    if isinstance(error, InputError):
        return _print_failure(str(error), error.exit_code)
    if isinstance(error, typer.Abort | KeyboardInterrupt):
        resume_point = {
            "sweep": "after the last complete chunk",
            "calibrate": "a population after its last generation",
            "loop": "after the last complete stage",
        }
        points = [resume_point[command] for command in sys.argv[1:2] if command in resume_point]
        advice = f"the same command with --out continues {points[0]}" if points else "no run folder was written"
        return _print_failure(f"interrupted; {advice}", INTERRUPTED)
    if _memory_exhausted(error):
        return _print_failure("out of memory; use a smaller --chunk, fewer rows, or more memory", 2)
    if isinstance(error, OSError):
        from sweeps.console import OUTPUT

        place = str(error.filename or OUTPUT)  # run folders and tables name their file
        remaining = (
            "" if place == OUTPUT else "; no run folder was written; finished parts are in the .partial folder"
        )
        return _print_failure(f"{place}: {error.strerror}{remaining}", 2)
    if isinstance(error, SystemExit) and isinstance(error.__context__, BrokenPipeError):
        return 1  # the reader of the output has closed it, for example head or a pager
    if isinstance(error, SystemExit):
        return _print_failure("--effects: a file's code ended the program; remove that call", 2)
    if hasattr(error, "format_message") and hasattr(error, "exit_code"):  # a usage error of the option parser
        return _print_failure(_not_a_number_message(error) or error.format_message(), error.exit_code)
    import traceback

    with contextlib.suppress(OSError):
        print(printable("".join(traceback.format_exception(error))), end="", file=sys.stderr)
    return _print_failure(f"internal error: {error}", 1)


def _memory_exhausted(error: BaseException | None) -> bool:
    """True if an error, or one of its causes, is a lack of memory in Python, XLA or the library loader."""
    while error is not None:
        is_memory_error = isinstance(error, MemoryError) or "RESOURCE_EXHAUSTED" in str(error)
        if is_memory_error or (isinstance(error, ImportError) and "failed to map segment" in str(error)):
            return True
        error = error.__cause__ or error.__context__
    return False


def _not_a_number_message(error: Any) -> str:
    """Error message for a text in place of a number. Often the text includes a unit."""
    option = getattr(error, "param", None)
    if option is None or not re.search(r"valid (number|float|integer)", str(getattr(error, "message", ""))):
        return ""
    help_text = " ".join(str(option.help or "").replace("\\[", "[").split())
    return f"{option.opts[0]}: got no number; expected one without its unit. {help_text}"


def _print_failure(message: str, code: int) -> int:
    with contextlib.suppress(OSError):  # standard error is closed or its disk is full
        print(f"mmrjax: {shorten(printable(' '.join(message.splitlines())))}", file=sys.stderr)
    return code
