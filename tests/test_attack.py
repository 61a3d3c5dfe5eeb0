"""Malformed inputs at every door: each is answered in one short sentence with exit code 2, 3 or 4, and leaves nothing.

Mutations of valid files are drawn from a seeded generator. One that is still a valid input may be accepted (0).
"""

import contextlib
import re
import shutil
import time

import numpy as np
import pytest
from numpy.random import default_rng
from test_stages import OWN
from worlds import rigs

from calibration.data import posterior_file as posterior_file
from calibration.data import robot_file
from calibration.data.input_errors import BadConfiguration
from calibration.inference.identifiability import posterior_of_coordinates
from calibration.inference.priors import parameter_coordinates
from mmrjax.model import paper_robots
from tests.commands import ROOT, alarmed

pytestmark = pytest.mark.slow

#: Longest answer [characters], and most processor time that it takes [s].
SENTENCE, SECONDS = 400, 20.0
CODES = (2, 3, 4)


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A folder of valid inputs."""
    folder, data = tmp_path_factory.mktemp("valid"), ROOT / "calibration/data"
    lines = (data / "measured.csv").read_text("utf-8").splitlines()
    (folder / "runs.csv").write_text("\n".join(lines[:7]) + "\n")
    for name, source in {
        "profile.csv": "profiles/shuttle.csv", "wants.toml": "aims/paper.toml", "bench.toml": "rigs/bench.toml",
        "tracked.toml": "rigs/tracked.toml",
    }.items():  # fmt: skip
        shutil.copy(data / source, folder / name)
    rng = default_rng(5)
    world = rigs.world(rng, "bench", "voltage", rows=(16, 20))
    rigs.case(world).write(folder)
    rigs.log(world, rng, hold=1.0, rate=50.0).write(folder / "log.csv")
    robot = paper_robots.nominal()
    robot_file.write_robot(robot, folder / "robot.toml")
    at = parameter_coordinates(
        robot, ("motor.resistance", "motor.friction_coulomb", "6T2A.ground.friction.static"), {}
    )
    posterior = posterior_of_coordinates(at, np.zeros(3), np.diag(rng.uniform(0.5, 1.0, 3)))
    posterior_file.write_posterior(posterior, folder / "posterior.nc")
    for name, text in FILES.items():
        (folder / name).write_text(text)
    return folder


#: Inputs by name.
FILES = {
    "plan.toml":
        'model = "steady"\noutputs = ["speed", "flags"]\n[set]\n"motor.resistance" = 0.7\n[conditions]\npayload = 2.0\n'
        '[axes]\nconfiguration = "all"\nvoltage = { start = 15, stop = 33, number = 3 }\nslope_deg = "0:10:5"\n'
        '[samples]\ndesign = "sobol"\nnumber = 4\n[samples.over]\n"motor.friction_coulomb" = "prior"\n',
    "config.toml": 'model = "drive"\nduration_s = 0.01\n[set]\n"motor.resistance" = 0.7\n',
    "terrain.csv": "x_mm,z_mm\n0,0\n300,0\n350,40\n900,40\n",
    "sequence.csv": "x_mm,front_deg,rear_deg\n-300,45,180\n0,0,-8\n",
    "own.py": OWN,
}  # fmt: skip


#: A command for each kind of file, which takes the file in the place of `FILE`.
DOORS = {
    "runs.csv": "compare FILE --no-report",
    "table.csv": "rig check rig.toml FILE",
    "log.csv": "settle FILE --robot rig.toml --no-report",
    "profile.csv": "simulate --profile FILE --no-report",
    "robot.toml": "simulate --robot FILE --no-report",
    "bench.toml": "rig check FILE",
    "tracked.toml": "rig check FILE",
    "wants.toml": "check FILE --no-changes --no-report",
    "plan.toml": "sweep FILE --dry-run",
    "config.toml": "simulate --config FILE --no-report",
    "terrain.csv": "climb --terrain FILE --no-report",
    "sequence.csv": "climb --step 50 --sequence FILE --no-report",
    "posterior.nc": "simulate --posterior 10 --robot robot.toml --no-report",
    "own.py": "explain mine --effects FILE",
}
#: How many mutations of each.
EACH = 22

VALUES = (
    "", " ", "nan", "inf", "-inf", "-1", "0", "1e400", "1_0", "0x10", "1,5", "true", "None", "9" * 400, "\x00", "é",
    "1e-320", "--", '"', "[", "{}", "2026-01-01", "=1+1", "-0.0", "1e308", "../../etc/passwd", "𝟙", "١", "1.2.3",
)  # fmt: skip


def replaced(pattern, values):
    def mutation(text, rng):
        found = list(re.finditer(pattern, text))
        at = found[rng.integers(len(found))]
        return text[: at.start()] + str(rng.choice(values(at))) + text[at.end() :]

    return mutation


def line_of(change):
    def mutation(text, rng):
        lines = text.split("\n")
        at = int(rng.integers(len(lines)))
        return "\n".join(lines[:at] + change(lines[at], rng) + lines[at + 1 :])

    return mutation


def turned(content, rng):
    content = bytearray(content)
    for _ in range(3):
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
    return bytes(content)


OF_TEXT = {
    "a number replaced": replaced(r"-?\d+(\.\d+)?", lambda at: VALUES),
    "a word replaced": replaced(r"[A-Za-z_]{3,}", lambda at: ["xyz", "", "nan", "ſ", "a" * 3000, at[0] + "_"]),
    "a line removed": line_of(lambda line, rng: []),
    "a line twice": line_of(lambda line, rng: [line, line]),
    "a line cut": line_of(lambda line, rng: [line[: rng.integers(len(line) + 1)]]),
    "a line in the way": line_of(lambda line, rng: [line, str(rng.choice(["[[]]", ",,,,,,,,,", "x = ", "[set", "]"]))]),
    "a long line": line_of(lambda line, rng: [line + "," + "x" * 50_000]),
    "separators changed": lambda text, rng: text.replace(*[(",", ";"), (",", "\t"), ("=", ":"), ("\n", "\r")][rng.integers(4)]),
    "the first line alone": lambda text, rng: text.split("\n")[0],
}  # fmt: skip
OF_BYTES = {
    "cut short": lambda content, rng: content[: rng.integers(len(content))],
    "bits turned": turned,
    "a byte of another coding": lambda content, rng: content[:40] + b"\xff\xfe\x81" + content[40:],
    "a zero byte": lambda content, rng: content[:60] + b"\0" + content[60:],
    "empty": lambda content, rng: b"",
    "random bytes": lambda content, rng: rng.bytes(int(rng.integers(1, 400))),
}


def mutated(content, rng):
    """A mutation's name and the content of a file after it."""
    names = [*OF_BYTES]
    with contextlib.suppress(UnicodeDecodeError):
        text = content.decode()
        names = [*OF_TEXT, *OF_BYTES]
    name = names[int(rng.integers(len(names)))]
    if name in OF_BYTES:
        return name, OF_BYTES[name](content, rng)
    return name, OF_TEXT[name](text, rng).encode("utf-8", "surrogatepass")


def accepted(*_, **__):
    raise BadConfiguration("accepted")


#: Computations that take long, in the place of which a command ends: what comes before them is attacked here.
HEAVY = (
    "calibration.sizing.sheet.check_requirements", "sweeps.commands.missions.run_missions", "sweeps.commands.climb.climb_batch",
    "sweeps.commands.loop.discover", "sweeps.commands.calibrate.fit_robot", "sweeps.commands.sensitivity.analyse_sensitivity",
    "sweeps.commands.size.search_designs", "mmrjax.undercarriage.rendering.render",
)  # fmt: skip


@pytest.fixture
def asked(monkeypatch, mmrjax, base, tmp_path):
    """Run a command in a folder of the valid inputs. Returns what is wrong with its answer, empty if nothing is, and its
    exit code."""
    shutil.copytree(base, tmp_path, dirs_exist_ok=True)
    for heavy in HEAVY:
        monkeypatch.setattr(heavy, accepted)

    def ask(*arguments):
        before, began = inventory(tmp_path), time.process_time()
        with alarmed():
            code, out, err = mmrjax("", *arguments)
        took, left = time.process_time() - began, inventory(tmp_path) - before
        code = 0 if err.endswith("mmrjax: accepted\n") else code
        wrong = [f"code {code}"] * (code not in (0, *CODES)) + [f"{took:.0f} s"] * (took > SECONDS)
        wrong += ["a traceback"] * ("Traceback" in out + err)
        if code not in (0, 3):
            said = [line for line in err.splitlines() if line.startswith("mmrjax: ")]
            wrong += [f"{len(said)} sentences"] * (len(said) != 1 or not err.endswith(said[0] + "\n"))
            wrong += [f"{len(s)} characters" for s in said if len(s) > SENTENCE]
            wrong += [f"left {', '.join(sorted(left))}"] * bool(left)
        for path in map(tmp_path.joinpath, left):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return [f"{x} <- {' '.join(map(str, arguments))[:200]!r}: {err[-300:]!r}" for x in wrong], code

    return ask


def inventory(folder):
    return {p.name for p in folder.iterdir()} - {"runs"}


@pytest.mark.parametrize("name", DOORS)
def test_mutations_of_a_file_are_answered_in_a_sentence(asked, base, tmp_path, name):
    door = DOORS[name].replace("FILE", name).split()
    door += ["--out", "out"] * (door[0] not in ("rig", "explain"))
    assert asked(*door) == ([], 0)
    rng = default_rng([57, sorted(DOORS).index(name)])
    failures, refused = [], 0
    for k in range(EACH):
        what, content = mutated((base / name).read_bytes(), rng)
        (tmp_path / name).write_bytes(content)
        wrong, code = asked(*door)
        refused += code in CODES
        failures += [f"{k} ({what}): {x}" for x in wrong]
    assert not failures, "\n".join(failures)
    assert refused > EACH // 4  # else nothing was attacked


# --- options --------------------------------------------------------------------------------------------------------

OPTIONS = {
    "simulate": "--voltage --slope --payload --mass --surface --configuration --set --robot --model --duration --step "
                "--discharge --left --profile --runs --effects --config --posterior --levers-front",
    "sweep --dry-run": "--voltages --slopes --payloads --configurations --chunk --shard --outputs --export --config",
    "loop measured": "--prior --noise --seed --replicates --forbid --within --rows",
    "calibrate measured": "--free --fix --starts --population",
    "sensitivity": "--method --parameters --vary --evaluations",
    "climb": "--step --stairs --gap --terrain --sequence --find",
    "render x.png": "--time",
    "check": "--robot --set",
    "size": "--objective --pareto --motors",
}  # fmt: skip
TEXTS = (*VALUES, "=", "a=b", "motor.resistance=nan", "x" * 5000, "5,,6", "0:1:0", "5:0:1", "1/0", "0/0", ".", "..", "/",
         "/proc/self/mem", "runs.csv", "robot.toml", "a\nb", "\x1b[31m", "%s%n", "current=2%,current=3%", "10" * 20)  # fmt: skip


@pytest.mark.parametrize("command", OPTIONS)
def test_senseless_values_of_options_are_answered_in_a_sentence(asked, command):
    rng = default_rng([58, len(OPTIONS), list(OPTIONS).index(command)])
    failures = []
    for option in OPTIONS[command].split():
        for text in rng.choice(TEXTS, 3, replace=False):
            if "\x00" not in text:  # which no system passes on
                failures += asked(*command.split(), option, text, "--out", "out")[0]
    assert not failures, "\n".join(failures)
