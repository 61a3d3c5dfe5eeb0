"""Malformed inputs at every door: each is answered in one short sentence with exit code 2, 3 or 4, and leaves nothing.

Mutations of valid files are drawn from a seeded generator. One that is still a valid input may be accepted (0).
"""

import contextlib
import os
import re
import shutil
import signal
import time
from importlib import resources

import numpy as np
import pytest
from test_stages import OWN
from worlds import rigs

from calibration.data import posterior_file as posterior_file
from calibration.data import robot_file
from calibration.data.input_errors import BadConfiguration
from calibration.inference import priors
from calibration.inference.identifiability import posterior_of_coordinates
from mmrjax.model import paper_robots
from sweeps import cli

pytestmark = pytest.mark.slow

#: Longest answer [characters], and most processor time that it takes [s]; wall-clock time after which it hangs [s].
SENTENCE, SECONDS, HANGS = 400, 20.0, 60
CODES = (2, 3, 4)


class Hangs(BaseException):
    """A command has not answered."""


@pytest.fixture(scope="module")
def base(tmp_path_factory):
    """A folder of valid inputs."""
    folder = tmp_path_factory.mktemp("valid")
    data = resources.files("calibration.data")
    lines = data.joinpath("measured.csv").read_text("utf-8").splitlines()
    (folder / "runs.csv").write_text("\n".join(lines[:7]) + "\n")
    (folder / "profile.csv").write_text(data.joinpath("profiles/shuttle.csv").read_text("utf-8"))
    (folder / "wants.toml").write_text(data.joinpath("aims/paper.toml").read_text("utf-8"))
    for kind in ("bench", "tracked"):
        (folder / f"{kind}.toml").write_text(data.joinpath("rigs", f"{kind}.toml").read_text("utf-8"))
    rng = np.random.default_rng(5)
    world = rigs.world(rng, "bench", "voltage", rows=(16, 20))
    rigs.case(world).write(folder)
    rigs.log(world, rng, hold=1.0, rate=50.0).write(folder / "log.csv")
    robot = paper_robots.nominal()
    robot_file.write_robot(robot, folder / "robot.toml")
    names = ("motor.resistance", "motor.friction_coulomb", "6T2A.ground.friction.static")
    at = priors.parameter_coordinates(robot, names, {})
    spread = np.diag(rng.uniform(0.5, 1.0, 3))
    posterior_file.write_posterior(posterior_of_coordinates(at, np.zeros(3), spread), folder / "posterior.nc")
    (folder / "plan.toml").write_text(
        'model = "steady"\noutputs = ["speed", "flags"]\n[set]\n"motor.resistance" = 0.7\n[conditions]\npayload = 2.0\n'
        '[axes]\nconfiguration = "all"\nvoltage = { start = 15, stop = 33, number = 3 }\nslope_deg = "0:10:5"\n'
        '[samples]\ndesign = "sobol"\nnumber = 4\n[samples.over]\n"motor.friction_coulomb" = "prior"\n'
    )
    (folder / "config.toml").write_text('model = "drive"\nduration_s = 0.01\n[set]\n"motor.resistance" = 0.7\n')
    (folder / "terrain.csv").write_text("x_mm,z_mm\n0,0\n300,0\n350,40\n900,40\n")
    (folder / "sequence.csv").write_text("x_mm,front_deg,rear_deg\n-300,45,180\n0,0,-8\n")
    (folder / "own.py").write_text(OWN)
    return folder


#: A command for each kind of file, which takes the file in the place of `FILE`.
DOORS = {
    "runs.csv": ["compare", "FILE", "--no-report"],
    "table.csv": ["rig", "check", "rig.toml", "FILE"],
    "log.csv": ["settle", "FILE", "--robot", "rig.toml", "--no-report"],
    "profile.csv": ["simulate", "--profile", "FILE", "--no-report"],
    "robot.toml": ["simulate", "--robot", "FILE", "--no-report"],
    "bench.toml": ["rig", "check", "FILE"],
    "tracked.toml": ["rig", "check", "FILE"],
    "wants.toml": ["check", "FILE", "--no-changes", "--no-report"],
    "plan.toml": ["sweep", "FILE", "--dry-run"],
    "config.toml": ["simulate", "--config", "FILE", "--no-report"],
    "terrain.csv": ["climb", "--terrain", "FILE", "--no-report"],
    "sequence.csv": ["climb", "--step", "50", "--sequence", "FILE", "--no-report"],
    "posterior.nc": ["simulate", "--posterior", "10", "--robot", "robot.toml", "--no-report"],
    "own.py": ["explain", "mine", "--effects", "FILE"],
}
#: How many mutations of each.
EACH = 22

VALUES = (
    "", " ", "nan", "inf", "-inf", "-1", "0", "1e400", "1_0", "0x10", "1,5", "true", "None", "9" * 400, "\x00", "é",
    "1e-320", "--", '"', "[", "{}", "2026-01-01", "=1+1", "-0.0", "1e308", "../../etc/passwd", "𝟙", "١", "1.2.3",
)  # fmt: skip


def number_replaced(text, rng):
    found = list(re.finditer(r"-?\d+(\.\d+)?", text))
    at = found[rng.integers(len(found))]
    return text[: at.start()] + str(rng.choice(VALUES)) + text[at.end() :]


def word_replaced(text, rng):
    found = list(re.finditer(r"[A-Za-z_]{3,}", text))
    at = found[rng.integers(len(found))]
    return text[: at.start()] + str(rng.choice(["xyz", "", "nan", "ſ", "a" * 3000, at[0] + "_"])) + text[at.end() :]


def line_of(change):
    def mutation(text, rng):
        lines = text.split("\n")
        at = int(rng.integers(len(lines)))
        return "\n".join(lines[:at] + change(lines[at], rng) + lines[at + 1 :])

    return mutation


def bytes_of(change):
    def mutation(content, rng):
        return change(bytearray(content.encode() if isinstance(content, str) else content), rng)

    mutation.binary = True
    return mutation


def turned(content, rng):
    for _ in range(3):
        content[rng.integers(len(content))] ^= 1 << rng.integers(8)
    return bytes(content)


MUTATIONS = {
    "a number replaced": number_replaced,
    "a word replaced": word_replaced,
    "a line removed": line_of(lambda line, rng: []),
    "a line twice": line_of(lambda line, rng: [line, line]),
    "a line cut": line_of(lambda line, rng: [line[: rng.integers(len(line) + 1)]]),
    "a line in the way": line_of(lambda line, rng: [line, str(rng.choice(["[[]]", ",,,,,,,,,", "x = ", "[set", "]"]))]),
    "a long line": line_of(lambda line, rng: [line + "," + "x" * 50_000]),
    "separators changed": lambda text, rng: text.replace(*[(",", ";"), (",", "\t"), ("=", ":"), ("\n", "\r")][rng.integers(4)]),
    "the first line alone": lambda text, rng: text.split("\n")[0],
    "cut short": bytes_of(lambda content, rng: bytes(content[: rng.integers(len(content))])),
    "bits turned": bytes_of(turned),
    "a byte of another coding": bytes_of(lambda content, rng: bytes(content[:40]) + b"\xff\xfe\x81" + bytes(content[40:])),
    "a zero byte": bytes_of(lambda content, rng: bytes(content[:60]) + b"\0" + bytes(content[60:])),
    "empty": bytes_of(lambda content, rng: b""),
    "random bytes": bytes_of(lambda content, rng: rng.bytes(int(rng.integers(1, 400)))),
}  # fmt: skip


def mutated(file, rng):
    """A mutation's name and the file's content after it."""
    content = file.read_bytes()
    text = None
    with contextlib.suppress(UnicodeDecodeError):
        text = content.decode()
    names = [n for n, m in MUTATIONS.items() if text is not None or hasattr(m, "binary")]
    name = names[int(rng.integers(len(names)))]
    found = MUTATIONS[name](content if text is None else text, rng)
    return name, found if isinstance(found, bytes) else found.encode("utf-8", "surrogatepass")


def accepted(*_, **__):
    raise BadConfiguration("accepted")


#: Computations that take long, in the place of which a command ends: what comes before them is attacked here.
HEAVY = (
    "calibration.sizing.sheet.check_requirements", "sweeps.commands.missions.run_missions", "sweeps.commands.climb.climb_batch",
    "sweeps.commands.loop.discover", "sweeps.commands.calibrate.run", "sweeps.commands.sensitivity.analyse_sensitivity",
    "sweeps.commands.size.search", "mmrjax.undercarriage.rendering.render",
)  # fmt: skip


@pytest.fixture
def ended(monkeypatch, capsys, base, tmp_path):
    """Run a command in a folder that has the valid inputs. Gives its exit code, stdout, stderr and what is wrong."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XLA_FLAGS", os.environ.get("XLA_FLAGS", ""))
    monkeypatch.setattr(os, "_exit", lambda code: (_ for _ in ()).throw(SystemExit(code)))
    shutil.copytree(base, tmp_path, dirs_exist_ok=True)
    for heavy in HEAVY:
        monkeypatch.setattr(heavy, accepted)

    def hang(*_):
        raise Hangs

    def run(*arguments):
        monkeypatch.setattr("sys.argv", ["mmrjax", *map(str, arguments)])
        began, handler = time.process_time(), signal.signal(signal.SIGALRM, hang)
        signal.alarm(HANGS)
        try:
            cli.main()
            code = "no exit"
        except SystemExit as end:
            code = end.code
        finally:
            signal.alarm(0)
            signal.signal(signal.SIGALRM, handler)
        took, (out, err) = time.process_time() - began, capsys.readouterr()
        code = 0 if err.endswith("mmrjax: accepted\n") else code
        said = [line for line in err.splitlines() if line.startswith("mmrjax: ")]
        wrong = [f"code {code}"] * (code not in (0, *CODES)) + [f"{took:.0f} s"] * (took > SECONDS)
        wrong += ["a traceback"] * ("Traceback" in out + err)
        if code not in (0, 3):
            wrong += [f"{len(said)} sentences"] * (len(said) != 1 or not err.endswith(said[0] + "\n"))
            wrong += [f"{len(s)} characters" for s in said if len(s) > SENTENCE]
        return code, out, err, wrong

    return run


@pytest.fixture
def asked(ended, tmp_path):
    """Run a command. Returns what is wrong with its answer, empty if nothing is, and its exit code."""

    def ask(*arguments):
        before = inventory(tmp_path)
        code, _, err, wrong = ended(*arguments)
        left = inventory(tmp_path) - before
        wrong += [f"left {', '.join(sorted(left))}"] * (bool(left) and code not in (0, 3))
        for path in map(tmp_path.joinpath, left):
            shutil.rmtree(path) if path.is_dir() else path.unlink()
        return "; ".join(
            wrong
        ) and f"{'; '.join(wrong)} <- {' '.join(map(str, arguments))[:200]!r}: {err[-300:]!r}", code

    return ask


def inventory(folder):
    return {p.name for p in folder.iterdir()} - {"runs"}


def end(door):
    return ["--out", "out"] if door[0] not in ("rig", "explain") else []


@pytest.mark.parametrize("name", DOORS)
def test_mutations_of_a_file_are_answered_in_a_sentence(asked, base, tmp_path, name):
    door = [word if word != "FILE" else name for word in DOORS[name]]
    wrong, code = asked(*door, *end(door))
    assert not wrong and code == 0, (wrong, code)
    rng = np.random.default_rng([57, sorted(DOORS).index(name)])
    failures, refused = [], 0
    for k in range(EACH):
        what, content = mutated(base / name, rng)
        (tmp_path / name).write_bytes(content)
        wrong, code = asked(*door, *end(door))
        refused += code in CODES
        failures += [f"{k} ({what}): {wrong}"] * bool(wrong)
    assert not failures, "\n".join(failures)
    assert refused > EACH // 4  # else nothing was attacked


# --- options --------------------------------------------------------------------------------------------------------

OPTIONS = {
    ("simulate",): ["--voltage", "--slope", "--payload", "--mass", "--surface", "--configuration", "--set", "--robot",
                    "--model", "--duration", "--step", "--discharge", "--left", "--profile", "--runs", "--effects",
                    "--config", "--posterior", "--levers-front"],
    ("sweep", "--dry-run"): ["--voltages", "--slopes", "--payloads", "--configurations", "--chunk", "--shard",
                             "--outputs", "--export", "--config"],
    ("loop", "measured"): ["--prior", "--noise", "--seed", "--replicates", "--forbid", "--prefer", "--within", "--rows"],
    ("calibrate", "measured"): ["--free", "--fix", "--starts", "--population"],
    ("sensitivity",): ["--method", "--parameters", "--vary", "--evaluations"],
    ("climb",): ["--step", "--stairs", "--gap", "--terrain", "--sequence", "--find"],
    ("render", "x.png"): ["--time"],
    ("check",): ["--robot", "--set"],
    ("size",): ["--objective", "--pareto", "--motors"],
}  # fmt: skip
TEXTS = (*VALUES, "=", "a=b", "motor.resistance=nan", "x" * 5000, "5,,6", "0:1:0", "5:0:1", "1/0", "0/0", ".", "..", "/",
         "/proc/self/mem", "runs.csv", "robot.toml", "a\nb", "\x1b[31m", "%s%n", "current=2%,current=3%", "10" * 20)  # fmt: skip


@pytest.mark.parametrize("command", OPTIONS, ids=" ".join)
def test_senseless_values_of_options_are_answered_in_a_sentence(asked, command):
    rng = np.random.default_rng([58, len(OPTIONS), list(OPTIONS).index(command)])
    failures = []
    for option in OPTIONS[command]:
        for text in rng.choice(TEXTS, 3, replace=False):
            if "\x00" in text:  # which no system passes on
                continue
            wrong, _ = asked(*command, option, text, "--out", "out")
            failures += [wrong] * bool(wrong)
    assert not failures, "\n".join(failures)
