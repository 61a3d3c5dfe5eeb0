"""Every report in a headless browser, on a phone, a laptop, a wide screen and paper: nothing is cut off or printed over,
nothing scrolls sideways but tables and figures in themselves, nothing is asked of a network, and all can be read."""

import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from browser import MEASURE, PAPER, Browser, found
from test_loop_command import commanded, few_effects, mmrjax, starts_churning
from test_settle import made as made_log
from test_time_overlay import overlay

from sweeps.report import loop_report
from sweeps.report.document import Document, Figure, Section
from sweeps.report.page_renderer import write_report_page
from tests.commands import ROOT, text_file

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(found() is None, reason="NO BROWSER: pages are not looked at; install chromium"),
]

#: Width [px], medium, and whether the reader wants it dark.
VIEWS = [
    (390, "screen", False),
    (1280, "screen", False),
    (1920, "screen", False),
    (PAPER, "print", False),
    (1280, "screen", True),
]
GRID = "--configurations 4W2T,6T2A --voltages 15,33 --payloads 0,8 --slopes 0,10,20"
PAGES = {
    "run": "simulate --configuration 6T2A --voltage 24 --slope 10",
    "start": "simulate --model drive --slope 10",
    "mission": "simulate --profile patrol --battery --payload 5",
    "sweep": f"sweep {GRID}",
    "comparison": "compare measured",
    "calibration": "calibrate measured --starts 2 --no-profiles",
    "check": "check paper",
    "sensitivity": "sensitivity --outputs speed --payloads 3 --voltages 24 --slopes 10 --method local",
    "paper": "reproduce",
    "resonance": "resonance",
    "size": "size",
    "store": f"sweep {Path(__file__).parent / 'record' / 'commands' / 'plan.toml'}",
    "track": "simulate --model track --slope 5",
    "turn": "simulate --left 33 --right 15",
    "climb": "climb --gap 60 --levers-front 45 --voltage 24 --duration 2 --time-step 4e-4",
    "found": "climb --find gap --levers-front 45 --voltage 24 --duration 2 --time-step 4e-4",
    "path": "simulate --left 24 --right -12 --slope 10 --heading 30 --model drive --duration 2",
}
#: Tables of a phone, but for long ones, that scroll sideways, by name.
SIDEWAYS = """innerWidth > 600 ? [] : [...document.querySelectorAll(".scroll > table")].filter(
  t => t.rows.length < 60 && t.scrollWidth > t.parentElement.clientWidth + 1).map(t => t.id)"""
FAULTY = """<html><body style="margin:0"><p style="white-space:nowrap">{long}</p>
<p style="color:#bbb">faint</p><p style="font-size:7px">tiny</p>
<div style="position:relative;height:40px"><span style="position:absolute;top:0">one text</span>
<span style="position:absolute;top:2px;left:10px">over another</span></div>
<div style="overflow:hidden;width:60px;white-space:nowrap">what is cut off at its end</div>
<figure id="f"><svg width="100" height="50"><text x="70" y="20">beyond the edge</text></svg></figure>
<script>console.error("no"); fetch("http://localhost:1234/x").catch(() => 0); undefinedThing()</script></body></html>"""


@pytest.fixture(scope="module")
def browser():
    with Browser() as one:
        yield one


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    return tmp_path_factory.mktemp("browser")


def made(folder, name, command):
    """The page of a command."""
    answer = mmrjax(folder, *command.split(), "--out", name)
    assert answer.code == 0, answer.err
    return folder / name / "report.html"


def wrong(browser, page):
    """What is wrong with a page, by view."""
    seen = {}
    for width, media, dark in VIEWS:
        browser.open(page, width, media=media, dark=dark)
        kinds = {kind: where for kind, where in browser.value(MEASURE).items() if where}
        if tables := browser.value(SIDEWAYS):
            kinds["tables"] = tables
        if said := browser.complaints():
            kinds["complaints"] = said
        if kinds:
            seen[f"{width} {media}{' dark' * dark}"] = kinds
    return seen


def test_a_faulty_page_is_found(folder):
    """Or none of what follows means anything. In a browser of its own: its request may fail late."""
    page = folder / "faulty.html"
    page.write_text(FAULTY.replace("{long}", "a line that never ends, " * 20))
    with Browser() as browser:
        kinds = wrong(browser, page)["390 screen"]
    assert set(kinds) == {"sideways", "outside", "clipped", "overlapping", "contrast", "small", "complaints"}
    assert len(kinds["clipped"]) == 2 and len(kinds["complaints"]) >= 3


@pytest.mark.parametrize("name", PAGES)
def test_a_page_can_be_read_everywhere(browser, folder, name):
    assert wrong(browser, made(folder, name, PAGES[name])) == {}


def test_the_page_of_settled_runs_can_be_read_everywhere(browser, tmp_path):
    made_log(tmp_path)
    assert wrong(browser, made(tmp_path, "found", "settle log.csv --robot rig.toml")) == {}


def test_the_page_of_the_loop_can_be_read_everywhere(browser):
    assert wrong(browser, commanded().folder / "found/report.html") == {}


def test_the_page_of_nothing_missing_can_be_read_everywhere(browser, tmp_path):
    found = commanded().found
    summary = replace(found.summary, verdict="none")
    none = replace(found, verdict="none", effects=(), support=None, summary=summary)
    assert wrong(browser, write_report_page(tmp_path, loop_report.loop_document(none, "nominal", {}))) == {}


def test_the_page_of_histories_can_be_read_everywhere(browser, tmp_path):
    with few_effects():
        assert starts_churning(tmp_path).answer.code == 0
    assert wrong(browser, tmp_path / "found/report.html") == {}


def test_a_page_from_disk_has_a_worker(browser, tmp_path):
    """As the search of the docs' site needs one, and browsers refuse it."""
    shutil.copy(ROOT / "docs/assets/iframe-worker.js", tmp_path)
    (tmp_path / "double.js").write_text('addEventListener("message", e => postMessage(2 * e.data))')
    browser.open(text_file(tmp_path / "page.html", '<body><script src="iframe-worker.js"></script></body>'), 1280)
    answer = """new Promise(done => {
      const worker = new Worker("double.js");
      worker.addEventListener("message", e => done(e.data));
      worker.postMessage(21);
    })"""
    assert browser.value(answer) == 42 and browser.complaints() == []


def test_a_table_is_sorted_by_its_headings(browser, folder):
    page = folder / "sweep/report.html"
    browser.open(page if page.exists() else made(folder, "sweep", PAGES["sweep"]), 1280)
    texts = "[...document.querySelectorAll('#extremes tr td:nth-child(2)')].map(c => parseFloat(c.textContent))"
    head = "document.querySelector('#extremes th:nth-child(2)')"
    assert browser.value(f"{head}.click(), {texts}") == sorted(browser.value(texts))
    assert browser.value(f"{head}.click(), {texts}") == sorted(browser.value(texts), reverse=True)


def drag(browser, element, begin, end):
    """Press the mouse in an element and release it elsewhere. Both are shares of its width."""
    x, y, width, height = browser.value(f"""(() => {{
      const e = document.querySelector("{element}");
      e.scrollIntoView({{block: "center"}});
      const box = e.getBoundingClientRect();
      return [box.x, box.y, box.width, box.height];
    }})()""")
    steps = [("mouseMoved", 0), ("mousePressed", 0), ("mouseMoved", 0.5), ("mouseMoved", 1), ("mouseReleased", 1)]
    for kind, part in steps:
        share = begin + part * (end - begin)
        browser(
            "Input.dispatchMouseEvent", type=kind, x=x + share * width, y=y + height / 2, button="left", clickCount=1
        )


def test_a_time_overlay_zooms_and_its_residual_follows(browser, tmp_path):
    figure = Figure("histories", "The simulated speed is off by 5.", "**Over time.**", overlay)
    made = Document("Overlay", "The simulated speed is off by 5 rpm.", (), (Section("Over time", (figure,)),))
    page = write_report_page(tmp_path, made)
    assert wrong(browser, page) == {}
    browser.open(page, 1280)
    ranges = "document.querySelector('.overlay').ranges()"
    before = browser.value(ranges)
    drag(browser, ".overlay .u-over", 0.25, 0.75)
    after = browser.value(f"new Promise(done => setTimeout(() => done({ranges}), 100))")
    assert len(before) == len(after) == 2  # readings and their residual
    assert before[0] == before[1] == pytest.approx([0, 10], abs=0.2)
    assert after[0] == after[1] == pytest.approx([2.5, 7.5], abs=0.3)
