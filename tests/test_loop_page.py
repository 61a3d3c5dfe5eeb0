"""What the loop's page, its terminal output and result.json say, and that their numbers agree."""

import difflib
import json
from dataclasses import replace
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from numpy.random import default_rng
from numpy.testing import assert_allclose
from pages import Tables, as_text, drawn, recorded, tokens
from synthetic import SETTLED, table
from test_implausible import unnamed
from test_loop_command import commanded
from test_stated_values import traced as leads
from worlds import settled, tables

from calibration.data.writing import json_value
from calibration.discovery.findings import HiddenEffect, RejectedCandidate, StatedValue
from calibration.discovery.loop_notes import NameSupport, NameTest, RuledOut
from calibration.discovery.outliers import OutlierCluster
from calibration.discovery.result import WorseChannel
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference.identifiability import HELD
from calibration.words.loop_words import p_value
from mmrjax.model import channels
from sweeps.commands.loop import changes_by_effect
from sweeps.pages.figure_style import figure_settings
from sweeps.pages.loop_figures import BLUE, draw_effect_law
from sweeps.report import page_renderer
from sweeps.report.fit_tables import Change
from sweeps.report.loop_report import loop_document, rows_for_figures
from sweeps.report.terminal_renderer import print_document
from tests.commands import schema_of

SCHEMA = schema_of("loop")


def happening():
    """A clean table in random order, with the speed shown 12 mm/s too low in fifteen runs that were made one after another."""
    p = dict(settled.CLIMBING)
    c = settled.table8(p)
    columns = tables.table_of(c, *settled.readings(c, p), settled.Instruments(), default_rng(1))
    columns["order"] = default_rng(5).permutation(len(columns["slope_deg"])) + 1.0
    off = (columns["order"] >= 30) & (columns["order"] <= 44)
    columns["speed_mm_s"] = columns["speed_mm_s"] - 12.0 * off
    return table(columns)


#: A case → its result. The first two are of 24 runs and share their programs; the command has made the first.
MADE = {
    "churning": lambda: commanded().found,
    "hot": unnamed,
    "leads": lambda: SETTLED.result(*leads("many")),
    "heated": lambda: unnamed("many"),
    "happening": lambda: SETTLED.discover(happening()),
}
CASES = [n if n == "churning" else pytest.param(n, marks=pytest.mark.slow) for n in MADE]


def documented(found):
    """The report of a result, as the command makes it."""
    return loop_document(found, "nominal", changes_by_effect(found))


def page_of(folder, found):
    """The page of a result."""
    return page_renderer.write_report_page(folder, documented(found)).read_text("utf-8")


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A case → its result, result.json, page and terminal output, made once."""
    known = {}

    def of(name, capsys):
        if name not in known:
            found = MADE[name]()
            folder = tmp_path_factory.mktemp(name)
            text = page_of(folder, found)
            document = json_value(found.to_json())
            known[name] = SimpleNamespace(found=found, document=document, text=text, page=Tables(text))
        capsys.readouterr()
        print_document(documented(known[name].found))
        return SimpleNamespace(**vars(known[name]), printed=" ".join(capsys.readouterr().out.split()))

    return of


@pytest.mark.parametrize("name", CASES)
def test_result_has_its_schema(shown, capsys, name):
    got = shown(name, capsys)
    jsonschema.validate(got.document, SCHEMA)
    for field in ("standing", "cluster", "hidden"):
        less = {k: v for k, v in got.document.items() if k != field}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(less, SCHEMA)


@pytest.mark.parametrize("name", CASES)
def test_numbers_of_a_page_agree(shown, capsys, name):
    got = shown(name, capsys)
    d, found, page = got.document, got.found, got.page.text
    score = {s["name"]: s["score"] for s in d["scores"]}
    assert min(score.values()) >= 0
    # what these data cannot see explains next to nothing
    assert all(score[n] < d["settings"]["visible"] ** 2 for n in d["cannot_see"])
    # what would explain more than what is proposed is not left without a word
    assert all(a["why"] for a in d["implausible"]) and not any(a["why"] for a in d["alternatives"])
    best = min((a["rise_chi2"] for a in d["implausible"]), default=0.0)
    assert best > -d["settings"]["same"] or "ruled out only by size or sign" in page
    # one family-wise p on all of the page, each effect with a p of its own that is no larger than is allowed
    p = f"family-wise p {p_value(found.before.p_value)}"
    assert p in page and f"({p})" in d["verdict_statement"]
    assert all(e.p_value <= d["bootstrap"]["family_wise_error"] for e in found.effects)
    if len(found.effects) == 1:
        assert found.effects[0].score == pytest.approx(found.chi2[0] - found.chi2[1], abs=0.1)


@pytest.mark.slow
def test_what_happens_for_a_while_has_a_window(shown, capsys):
    got = shown("happening", capsys)
    (effect,), following = got.document["effects"], got.document["next_experiment"]
    window = effect["window"]
    runs = f"runs {window['low']:.0f} to {window['high']:.0f}"
    assert got.document["verdict"] in WITHOUT_NAME and window["axis"] == "order"
    # the place is told to within half a window
    assert window["low"] >= 25 and window["high"] <= 50 and f"in {runs}" in got.printed
    assert not any("conditions alike" in note for note in got.document["notes"])
    assert "curve" in drawn(got.text) and "order" in got.found.rows_table()
    assert following["name"] == "the same runs again" and f"Repeat {runs}" in following["description"]


def test_what_an_effect_changes_is_that_of_the_robot_without_it(shown, capsys):
    """And the law that is drawn is of the robot that is written, as the dots are."""
    found = shown("churning", capsys).found
    (effect,) = found.effects
    change = changes_by_effect(found)[effect.name]
    k = [c.name for c in found.channels].index(change.channel.name)
    here = found.included
    assert_allclose(change.with_it[here], found.readings_of_rows.after[here, k], rtol=1e-5)
    assert change.rms > 1.0 and "brush_drop" not in changes_by_effect(found)
    assert "law" in drawn(shown("churning", capsys).text)


def test_the_page_opens_with_the_law_and_the_terminal_with_five_lines(shown, capsys):
    """A stranger has to find the law, its band and whether the robot can be used before anything else."""
    got = shown("churning", capsys)
    head = got.text[: got.text.index('<nav id="contents"')]
    places = [head.index(f'id="{name}"') for name in ("answer", "law", "errors", "advice")]
    assert places == sorted(places) and "May I use it for …" in head and "new law, 95 % band" in head
    changes = changes_by_effect(got.found)
    with figure_settings():
        ((name, change),) = changes.items()
        (axes,) = draw_effect_law(got.found, rows_for_figures(got.found), name, change).axes
    size = got.found.effects[0].parameters["amplitude"]
    largest = np.abs(change.with_it - change.without).max() / change.channel.factor
    band = band_of(axes)
    assert axes.get_xlabel() == "motor speed [rpm]"
    assert_allclose(max(abs(band.y0), abs(band.y1)), largest * (1 + 1.96 * size.sd / abs(size.value)), rtol=1e-3)
    capsys.readouterr()
    print_document(documented(got.found), brief=True)
    answer, *lines = capsys.readouterr().out.splitlines()
    assert answer == got.found.statement  # the fifth is the path of the folder
    titles = ["Changed", "rms error, robot file as given → after the loop", "Next"]
    assert [line.partition(":")[0] for line in lines] == titles
    assert lines[0].index("motor.torque_constant is") < lines[0].index("Added: churning ")  # what moved comes first


def band_of(axes):
    """Extents of the band that is drawn last."""
    return axes.collections[-1].get_paths()[0].get_extents()


def test_squares_of_readings_and_of_priors_are_apart(shown, capsys):
    got = shown("churning", capsys)
    d, seen, rows = got.found.to_json()["chi2"], got.found.readings_of_rows, got.found.included
    of_readings = d["of_readings"]
    for when in ("before", "after"):
        left = ((getattr(seen, when) - seen.measured) / seen.sd)[rows]
        assert of_readings[when] == pytest.approx(float(np.nansum(left**2)), rel=1e-9)
        assert of_readings[when] < d[when]  # the rest is what parameters moved from their priors
    assert f"readings {of_readings['before']:.0f} → {of_readings['after']:.0f} σ²" in got.page.text


@pytest.mark.parametrize("name", CASES)
def test_what_is_held_by_its_prior_is_in_the_result(shown, capsys, name):
    seen = shown(name, capsys)
    made, sd = seen.found, np.sqrt(np.diag(seen.found.posterior.covariance))  # of coordinates whose prior sd is 1
    held = made.held_by_prior
    of_posterior = {n for n, x in zip(made.posterior.coordinates, sd, strict=True) if x > HELD}
    assert set(held) == {n for n in of_posterior if not n.startswith("effects.unnamed")} != set()
    shifts = seen.document["base_shift"]
    assert {n for n, p in shifts.items() if p["held_by_prior"]} == {*held} & {*made.base_shift}


def with_effect(found, **changes):
    return replace(found, verdict="class", effects=(replace(found.effects[0], **changes),))


def judged(found, established, how, **more):
    test = NameTest(found.effects[0].name, 6.0, 3.3, (), 5.0, 7, 2.5)
    return replace(found, support=NameSupport(established, how, tests=(test,)), **more)


#: The result of the command as it is, and with what it could have found besides.
TOLD = {
    "as_found": lambda found: found,
    "value": lambda found: with_effect(
        found, stated={"motor.resistance": StatedValue(1.411, 0.611, "ohm", 13.1, 0.4)}, families=("losses", "leads")
    ),
    "tentative": lambda found: judged(found, True, "beside", cluster=OutlierCluster("time", 0.6, 0.7, "", 12, 13, 1e-5)),
    "perhaps": lambda found: judged(found, False, "beside"),
    "two_of_a_kind": lambda found: judged(
        found, False, "beside", effects=(*found.effects, replace(found.effects[0], name="windage"))
    ),
    "none": lambda found: replace(
        found, verdict="none", effects=(), support=None, summary=replace(found.summary, verdict="none")
    ),
    "hidden": lambda found: replace(found, hidden=(
        HiddenEffect("brush_drop", 0.21, "V", 5.5), HiddenEffect("load_slip", 1e-4, "1/N", 5.1),
    )),
    "worse": lambda found: replace(found, held_out_worse=(WorseChannel("slope", "motor_speed", 10, 4.3, 4.7),)),
    "ruled_out": lambda found: replace(found, implausible=(RejectedCandidate(
        {"brush_drop": 0.9}, {"brush_drop": 0.9}, {"brush_drop": 2.9}, -8.0,
        (RuledOut("brush_drop", "size", 2.9, ("motor.resistance",)),),
    ),)),
}  # fmt: skip


#: Parts of result.json that are kept beside the text.
PARTS = "effects", "cluster", "hidden", "held_out_worse", "implausible"


def lines_of(found, capsys):
    """Lines of the whole document, of what a terminal shows of it, and of parts of result.json."""
    capsys.readouterr()
    print_document(documented(found))
    written = json_value(found.to_json())
    jsonschema.validate(written, SCHEMA)
    parts = json.dumps({part: written[part] for part in PARTS}, indent=1, ensure_ascii=False)
    text = f"{as_text(documented(found))}# TERMINAL\n{capsys.readouterr().out}# JSON\n{parts}"
    return [line.rstrip() for line in text.splitlines()]


@pytest.mark.parametrize("name", TOLD)
def test_text_of_each_result_is_as_recorded(shown, capsys, name):
    """What differs from the result as it is found is kept. The words are the same, the numbers to a hundredth."""
    found = shown("churning", capsys).found
    usual = [] if name == "as_found" else lines_of(found, capsys)
    lines = lines_of(TOLD[name](found), capsys)
    text = "\n".join(line for line in difflib.ndiff(usual, lines) if line[0] in "+-") + "\n"
    (words_now, numbers_now), (words_then, numbers_then) = tokens(text), tokens(recorded(f"loop_{name}", text))
    assert words_now == words_then
    assert numbers_now == pytest.approx(numbers_then, rel=1e-2, abs=1e-2)


def drawn_law(table, x_column, law, sd=0.1):
    """Axes and legend of the law of an effect of size 1 on the motor's speed, of which readings miss nothing."""
    speed = channels.find_channel("motor_speed")
    law = np.asarray(law) * speed.factor
    zero = np.zeros((len(law), 1))
    found = SimpleNamespace(
        channels=(speed,), included=np.full(len(law), True),
        readings_of_rows=SimpleNamespace(measured=law[:, None], before=zero, sd=zero + speed.factor),
        effects=[SimpleNamespace(name="ours", parameters={"amplitude": SimpleNamespace(value=1.0, sd=sd)})],
    )  # fmt: skip
    with figure_settings():
        fig = draw_effect_law(found, table, "ours", Change(speed, 1.0, 0 * law, law))
    fig.canvas.draw()
    legend = next(x for x in [*fig.legends, *(a.get_legend() for a in fig.axes)] if x)
    assert fig.axes[0].get_xlabel() == x_column
    return fig.axes[0], [text.get_text() for text in legend.get_texts()]


def curves_of(axes, colour):
    return [line for line in axes.lines if line.get_color() == colour and len(line.get_xdata()) > 2]


def test_both_directions_of_a_law_have_their_own_line():
    """Hollow dots are of backward runs, and no line crosses from one direction to the other."""
    volts = np.r_[-24:0:3, 3:25:3].astype(float)
    axes, names = drawn_law(
        {"supply_voltage_V": volts, "configuration": np.full(16, "a")}, "supply voltage [V]", np.abs(volts)
    )
    assert names.count("backward") == 1 and len([n for n in names if n.startswith("new law")]) == 1
    ways = [np.sign(line.get_xdata()) for line in curves_of(axes, BLUE)]
    assert len(ways) == 2 and all(np.ptp(way) == 0 for way in ways)


def levels(torque):
    """A table of three voltages and these torques."""
    return {"supply_voltage_V": VOLTS, "load_torque_Nm": torque, "configuration": np.full(21, "a")}


VOLTS = np.repeat([4.0, 8.0, 12.0], 7)


def test_a_law_over_two_quantities_is_a_line_for_each_level():
    """One line over the current went up and down between the levels of the voltage."""
    torque = np.tile(np.linspace(0.0, 3.0, 7), 3)
    axes, names = drawn_law(levels(torque), "load torque [N·m]", -torque * (1 + 4 / VOLTS))
    lines = curves_of(axes, BLUE)
    assert len(lines) == 3 and all(np.all(np.diff(line.get_ydata()) < 0) for line in lines)
    assert "new law by supply voltage, 95 % band (±20 %)" in names
    assert band_of(axes).y0 == pytest.approx(1.196 * min(lines[-1].get_ydata()), rel=1e-3)
