"""How the code hangs together. Ruff checks the order of the layers (ruff.toml of each) and `global` statements."""

import ast
import fnmatch
import functools
import graphlib
import re
import subprocess
import sys
from collections import Counter
from pathlib import PurePosixPath

import pytest

from tests.commands import ROOT

LAYERS = ("mmrjax", "calibration", "sweeps")
HEAVY = ("jax", "jaxlib", "equinox", "optimistix", "lineax", "diffrax", "matplotlib", "scipy", "numpy")


@functools.cache
def sources(*folders):
    """Text of every module below these folders, by path."""
    files = (file for folder in folders for file in sorted((ROOT / folder).rglob("*.py")))
    return {file.relative_to(ROOT).as_posix(): file.read_text(encoding="utf-8") for file in files}


PREPARATION = (
    r"(?<!def )\b(with_inferred_instruments|with_surface_configurations|measure_initial_states|check_start)\("
)
#: What only some modules do: a pattern of their text, and these modules.
RULES = {
    "effects are summed in the balances": (r"\.term\(", ["mmrjax/model/balances.py"]),
    "observers know the kind of data": (
        r"(isinstance|issubclass)\([^()]*\b(Histories|SettledRuns)\b|\bis (not )?(Histories|SettledRuns)\b"
        r"|\.has\(\"time_s\"\)|\bis_series\b",
        ["calibration/inference/observers/*"],
    ),
    "loads state what they can do": (
        r"\bisinstance\([^\n]*\b(Shaft|Chassis)\b",
        ["mmrjax/model/balances.py", "sweeps/commands/rig_check.py"]
        + [f"calibration/data/{name}.py" for name in ("configuration_tables", "rig_facts", "robot_file")],
    ),
    "stages of the loop take what stages make": (
        r":[^=\n]*\b(CandidateSpace|Screening)\b[^\n]*[,)]", ["calibration/discovery/*"],
    ),
    "the paper's configurations are data": (
        r"\"(6T2A|4W2T)\"|\b(TRACKED|WHEELED)\b",
        ["*/paper*", "mmrjax/__init__.py", "mmrjax/effects/base.py", "calibration/data/effect_file.py"],  # of texts
    ),
    "commands import figures once they draw": (
        r"\n(from|import) sweeps\.(pages(\.| import (?!words))|report\.page_renderer)", ["sweeps/[!c]*"],
    ),
    "a table is prepared in one place": (
        PREPARATION, ["calibration/inference/preparation.py", "sweeps/commands/compare.py"],
    ),
    "campaigns and notebooks prepare tables as users do": (
        PREPARATION[:-3] + r"|with_table_mass|scale_library|remove_copies|pose|build_candidate_space|fit_base|LoopInput)\(",
        ["[!bn]*", *(f"benchmarks/{name}.py" for name in ("loop_baselines", "loop_findings", "track_table", "test_*"))],
    ),
    "TOML is read in one place": (
        "import tomllib", ["calibration/data/input_files.py", "calibration/data/profiles.py"],
    ),
}  # fmt: skip


@pytest.mark.parametrize("rule", RULES)
def test_only_these_modules_do_it(rule):
    pattern, allowed = RULES[rule]
    folders = LAYERS + ("benchmarks", "notebooks") * rule.startswith("campaigns")
    found = [path for path, text in sources(*folders).items() if re.search(pattern, text)]
    assert [path for path in found if not any(fnmatch.fnmatch(path, name) for name in allowed)] == []
    assert found, "the pattern fits nothing"


def test_modules_have_base_names_of_their_own():
    """Two modules of one name are told apart by their folders alone, which imports and messages leave out."""
    names = Counter(PurePosixPath(path).stem for path in sources(*LAYERS))
    assert {name for name, count in names.items() if count > 1} <= {"__init__", "result", "base"}


def test_front_door_loads_nothing_heavy():
    code = "import sys, sweeps.cli; print(sorted({m.partition('.')[0] for m in sys.modules} & set(sys.argv[1:])))"
    answer = subprocess.run(
        [sys.executable, "-c", code, *HEAVY], cwd=ROOT, capture_output=True, text=True, check=True, timeout=60
    )
    assert answer.stdout.strip() == "[]"


def imported(tree):
    """Names that a module imports, in functions too, but not for annotations alone: modules, or `module.name`."""
    guards = [n for n in ast.walk(tree) if isinstance(n, ast.If) and ast.unparse(n.test) == "TYPE_CHECKING"]
    aside = {inner for guard in guards for inner in guard.body}
    for node in {*ast.walk(tree)} - aside:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_no_module_imports_itself_by_way_of_others():
    trees = {
        path.removesuffix(".py").removesuffix("/__init__").replace("/", "."): ast.parse(text)
        for path, text in sources(*LAYERS).items()
    }
    names = {module: {*imported(tree)} for module, tree in trees.items()}
    graph = {
        module: {n if n in trees else n.rpartition(".")[0] for n in found} & set(trees) - {module}
        for module, found in names.items()
    }
    graphlib.TopologicalSorter(graph).prepare()  # raises


#: Most names of the project that a module imports. A module counts as one name, and so does each name of a module.
NAMES = 25
#: Modules that import more, and why. The numbers may only fall: split a module, or import modules and not their names.
MORE_NAMES = {
    # Readers of files know every kind of entry.
    "calibration/data/profiles.py": 34,
    "calibration/data/robot_file.py": 30,
    "calibration/data/runs.py": 37,
    "calibration/data/sources/reading.py": 28,
    # Observers join a kind of data with its fidelity and its solver; calibration and sizing join all steps of a fit.
    "calibration/inference/calibration.py": 47,
    "calibration/inference/observers/settled.py": 49,
    "calibration/inference/observers/time_histories.py": 53,
    "calibration/inference/observers/turns.py": 32,
    "calibration/sizing/sheet.py": 30,
    # Models join all parts of a robot in one set of equations.
    "mmrjax/climbing/climb_simulation.py": 34,
    "mmrjax/fidelities/drive.py": 32,
    "mmrjax/fidelities/simulation.py": 28,
    "mmrjax/fidelities/steady.py": 36,
    "mmrjax/fidelities/track.py": 30,
    "mmrjax/missions/mission.py": 30,
    "mmrjax/model/balances.py": 27,
    "mmrjax/turning/circling.py": 33,
    "mmrjax/undercarriage/both_sides.py": 29,
    "mmrjax/undercarriage/half_robot.py": 44,
    # Commands read options and input, compute, write and report.
    "sweeps/commands/climb.py": 35,
    "sweeps/commands/loop.py": 35,
    "sweeps/commands/loop_joints.py": 30,
    "sweeps/commands/missions.py": 33,
    "sweeps/commands/resonance.py": 36,
    "sweeps/commands/rig_check.py": 44,
    "sweeps/commands/sensitivity.py": 34,
    "sweeps/commands/simulate.py": 36,
    "sweeps/commands/sweep.py": 49,
    "sweeps/commands/turn.py": 27,
    "sweeps/inputs.py": 36,
    # Reports, stores and exports show every part of a result.
    "sweeps/paper/report.py": 32,
    "sweeps/points/axes.py": 27,
    "sweeps/points/run.py": 36,
    "sweeps/points/tasks.py": 33,
    "sweeps/points/zarr_store.py": 29,
    "sweeps/report/loop_report.py": 28,
    "sweeps/report/mission_report.py": 28,
    "sweeps/report/runs_report.py": 29,
    "sweeps/report/sweep_report.py": 26,
}


def test_modules_import_few_names_of_the_project():
    counts = {}
    for path, text in sources(*LAYERS).items():
        nodes = [n for n in ast.walk(ast.parse(text)) if isinstance(n, ast.Import | ast.ImportFrom)]
        names = {f"{getattr(n, 'module', '')}.{alias.name}".lstrip(".") for n in nodes for alias in n.names}
        counts[path] = sum(name.partition(".")[0] in LAYERS for name in names)
    assert {path: count for path, count in counts.items() if count > MORE_NAMES.get(path, NAMES)} == {}
    assert [path for path in MORE_NAMES if counts[path] <= NAMES] == [], "no longer crowded"
