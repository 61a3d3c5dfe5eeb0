"""What is installed works without the repository, and says what it is."""

import os
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).resolve().parents[1]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text("utf-8"))["project"]


def test_citation_is_complete_and_of_this_version():
    text = (ROOT / "CITATION.cff").read_text("utf-8")
    known = dict(re.findall(r"^([\w-]+): *(.*)$", text, re.M))
    assert {"cff-version", "title", "message", "abstract", "authors", "date-released", "keywords"} <= set(known)
    assert (known["version"], known["license"]) == (PROJECT["version"], PROJECT["license"])


def test_dockerfile_has_the_program_s_python_and_copies_what_it_needs():
    text = (ROOT / "Dockerfile").read_text("utf-8")
    assert f"python:{PROJECT['requires-python'].removeprefix('>=')}" in text and 'ENTRYPOINT ["mmrjax"]' in text
    away = (ROOT / ".dockerignore").read_text("utf-8").split()
    assert not {"mmrjax", "calibration", "sweeps", "pyproject.toml", "requirements.lock", "README.md"} & set(away)


def test_hosted_checks_run_targets_that_there_are_and_name_no_address():
    hosted = [ROOT / ".pre-commit-config.yaml", *(ROOT / ".github").rglob("*.yml")]
    checks = (ROOT / ".github" / "workflows" / "checks.yml").read_text("utf-8")
    makefile = (ROOT / "Makefile").read_text("utf-8")
    (tests,) = re.findall(r"tests: \[(.*?)\]", checks)
    targets = {*re.findall(r"run: make (\w+)", checks), *tests.split(", ")}
    assert {"lint", "quick", "docs", "slow", "nightly"} == targets
    assert all(re.search(rf"^{target}:", makefile, re.M) for target in targets)
    (versions,) = re.findall(r"python: \[(.*?)\]", checks)
    assert f'"{PROJECT["requires-python"].removeprefix(">=")}"' == versions.split(", ")[0] and len(hosted) >= 5
    assert not any("://" in path.read_text("utf-8") for path in hosted)


@pytest.mark.slow
def test_a_wheel_works_outside_of_the_repository(tmp_path):
    """With its templates, tables, rigs, parts and profiles."""

    def run(*words, **options):
        done = subprocess.run(
            [sys.executable, *words], capture_output=True, text=True, timeout=600, check=False, **options
        )
        assert done.returncode == 0, done.stderr[-2000:]
        return done.stdout

    run("-m", "pip", "wheel", ".", "--no-deps", "--no-build-isolation", "--quiet", "-w", tmp_path, cwd=ROOT)
    (wheel,) = tmp_path.glob("*.whl")
    run("-m", "pip", "install", "--no-deps", "--no-index", "--quiet", "--target", tmp_path / "there", wheel)
    environment = {**os.environ, "PYTHONPATH": str(tmp_path / "there")}
    main = "import sys; from sweeps.cli import main; sys.argv[0] = 'mmrjax'; sys.exit(main())"
    where = run("-c", "import sweeps; print(sweeps.__file__)", cwd=tmp_path, env=environment)
    assert where.startswith(str(tmp_path))
    for words in ("simulate --out a", "compare measured --out b", "rig new r.toml --kind bench", "explain windage"):
        run("-c", main, *words.split(), cwd=tmp_path, env=environment)
    assert "<svg" in (tmp_path / "a" / "report.html").read_text("utf-8")
