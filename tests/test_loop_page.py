"""What the loop's page, its terminal output and result.json say, and that their numbers agree."""

import dataclasses
import json
import re
from pathlib import Path
from types import SimpleNamespace

import jsonschema
import numpy as np
import pytest
from matplotlib.text import Text
from pages import Tables, drawn
from synthetic import SETTLED, table
from test_implausible import unnamed
from test_loop_command import commanded
from test_stated_values import traced as leads
from worlds import settled, tables

from calibration.data.writing import finite_or_null
from calibration.discovery.clusters import Cluster
from calibration.discovery.loop_notes import Asked, NameSupport, NameTest, RuledOut
from calibration.discovery.result import Alternative, Estimate, HiddenEffect, Resolved, StatedValue
from calibration.discovery.settings import WITHOUT_NAME
from calibration.inference.identifiability import HELD
from calibration.words import loop_words as words
from mmrjax.model import channels
from sweeps.commands import loop as room
from sweeps.pages import loop_figures
from sweeps.pages import page as page_room
from sweeps.report import loop_report, page_renderer
from sweeps.report.terminal_renderer import print_document

SCHEMA = json.loads((Path(__file__).parents[1] / "docs" / "schemas" / "loop.schema.json").read_text("utf-8"))


def happening():
    """A clean table in random order, with the speed shown 12 mm/s too low in fifteen runs that were made one after another."""
    p = dict(settled.CLIMBING)
    c = settled.table8(p)
    columns = tables.table_of(c, *settled.readings(c, p), settled.Instruments(), np.random.default_rng(1))
    columns["order"] = np.random.default_rng(5).permutation(len(columns["slope_deg"])) + 1.0
    off = (columns["order"] >= 30) & (columns["order"] <= 44)
    columns["speed_mm_s"] = columns["speed_mm_s"] - 12.0 * off
    return table(columns)


def test_the_legend_of_errors_hides_no_title():
    shown = tuple(
        channels.find_channel(n) for n in ("motor_current_left", "motor_current_right", "yaw_rate", "output_torque")
    )
    rows = {when: {c.name: {"rms_percent": 1.0} for c in shown} for when in (0, 1)}
    fig = loop_figures.draw_errors(SimpleNamespace(channels=shown, errors=rows, errors_held_out={"slope": rows}))
    fig.canvas.draw()
    legend = [*fig.legends, *(a.get_legend() for a in fig.axes if a.get_legend())]
    assert len(legend) == 1
    for axes in fig.axes:
        title = max(
            (t for t in axes.findobj(Text) if t.get_text() in {c.label for c in shown}),
            key=lambda t: len(t.get_text()),
        )
        assert not legend[0].get_window_extent().overlaps(title.get_window_extent())


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
    return loop_report.loop_document(found, "nominal", room.changes_by_effect(found))


def page_of(folder, found):
    """The page of a result."""
    return page_renderer.write_report_page(folder, documented(found)).read_text("utf-8")


@pytest.fixture(scope="module")
def shown(tmp_path_factory):
    """A case → its result, result.json, page and terminal output; made once."""
    known = {}

    def of(name, capsys):
        if name not in known:
            found = MADE[name]()
            folder = tmp_path_factory.mktemp(name)
            text = page_of(folder, found)
            document = finite_or_null(found.to_json())
            known[name] = SimpleNamespace(found=found, document=document, text=text, page=Tables(text))
        capsys.readouterr()
        print_document(documented(known[name].found))
        return SimpleNamespace(**vars(known[name]), printed=" ".join(capsys.readouterr().out.split()))

    return of


def written(folder, found):
    """The page of a result, without its figures: pages with them are those of `shown`."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(page_room, "figure_as_svg", lambda figure: "<svg/>")
        return page_of(folder, found)


@pytest.mark.parametrize("name", CASES)
def test_result_has_its_schema(shown, capsys, name):
    got = shown(name, capsys)
    jsonschema.validate(got.document, SCHEMA)
    for field in ("standing", "cluster", "hidden", "resolved"):
        less = {k: v for k, v in got.document.items() if k != field}
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.validate(less, SCHEMA)


@pytest.mark.parametrize("name", CASES)
def test_numbers_of_a_page_agree(shown, capsys, name):
    got = shown(name, capsys)
    d = got.document
    score = {s["name"]: s["score"] for s in d["scores"]}
    assert all(s >= 0 for s in score.values())
    # what these data cannot see explains next to nothing
    assert all(score[n] < d["settings"]["visible"] ** 2 for n in d["cannot_see"])
    # what would explain more than what is proposed is not left without a word
    assert all(a["why"] for a in d["implausible"]) and not any(a["why"] for a in d["alternatives"])
    best = min((a["rise_chi2"] for a in d["implausible"]), default=0.0)
    assert best > -d["settings"]["same"] or "ruled out by size or sign alone" in got.page.text
    # one family-wise p on all of the page, each effect with a p of its own that is no larger than is allowed
    p = words.p_value(got.found.before.p_value)
    assert f"family-wise p {p}" in got.page.text and f"(family-wise p {p})" in d["verdict_statement"]
    for e in got.found.effects:
        assert e.p_value <= d["bootstrap"]["family_wise_error"]
        fall = got.found.chi2[0] - got.found.chi2[1]
        assert e.score == pytest.approx(fall, abs=0.1) or len(got.found.effects) > 1
    assert got.text.count('id="definitions"') == 1
    for heading in ("Lowers the misfit by:", "Family-wise p:", "Rise of χ²:", "Score:"):
        assert got.page.text.count(heading) == 1


@pytest.mark.slow
def test_class_lists_family_and_stated_value(shown, capsys):
    got = shown("leads", capsys)
    (effect,) = got.document["effects"]
    assert effect["families"] == ["voltage drop that changes with current"]
    value = effect["stated_values"]["motor.resistance"]
    assert effect["class"][-1] == "motor.resistance" and value["value"] == pytest.approx(1.411, rel=0.05)
    said = f"motor.resistance is {value['value']:.3g} ohm (stated 0.611, {value['prior_sds']:+.1f} sds)"
    row = got.page.tables["effects"][1]
    assert said in row[-1] and "voltage drop that changes with current" in row
    assert said.split(" (")[0] in got.printed and "voltage drop that changes with current, one of" in got.printed
    why = words.support_sentence(got.found)
    assert why.startswith("Each by itself") and "series_resistance" in why
    assert why in got.printed and why in got.page.text and 'id="ruled_out"' not in got.text


def test_class_with_a_stated_value_is_listed_and_said(shown, capsys, tmp_path):
    found = shown("churning", capsys).found
    (effect,) = found.effects
    wrong = StatedValue(1.411, 0.611, "ohm", 13.1, 0.4)
    effect = dataclasses.replace(effect, stated={"motor.resistance": wrong}, families=("losses", "leads"))
    found = dataclasses.replace(found, verdict="class", effects=(effect,))
    document = finite_or_null(found.to_json())
    jsonschema.validate(document, SCHEMA)
    (told,) = document["effects"]
    assert told["class"] == ["churning", "motor.resistance"] and told["families"] == ["losses", "leads"]
    assert told["stated_values"]["motor.resistance"]["value"] == 1.411
    page = Tables(written(tmp_path, found))
    assert "motor.resistance is 1.41 ohm (stated 0.611, +13.1 sds)" in page.tables["effects"][1][-1]
    capsys.readouterr()
    print_document(documented(found))
    assert "motor.resistance is 1.41 ohm" in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_what_is_ruled_out_by_its_size_is_on_the_page(shown, capsys, tmp_path):
    reasons = (RuledOut("winding_heating", "size", 2.9, ("motor.resistance_thermal_housing",)),)
    why = words.why_ruled_out(reasons)
    alone = {"winding_heating": 0.9}
    found = shown("hot", capsys).found
    found = dataclasses.replace(
        found, implausible=(Alternative(alone, alone, {"winding_heating": 2.9}, 1.0, reasons),)
    )
    jsonschema.validate(finite_or_null(found.to_json()), SCHEMA)
    said = f"winding_heating would explain as much as the curve, but is ruled out by size or sign alone: {why}."
    text = written(tmp_path, found)
    page = Tables(text)
    assert said in page.text and page.tables["implausible"][1][-1] == why
    assert text.index('id="ruled_out"') < text.index('id="effects"')
    capsys.readouterr()
    print_document(documented(found))
    assert said in " ".join(capsys.readouterr().out.split())


@pytest.mark.slow
def test_what_is_too_large_is_said_beside_the_verdict(shown, capsys):
    got = shown("heated", capsys)
    (ruled_out,) = (a for a in got.document["implausible"] if list(a["effects"]) == ["winding_heating"])
    times = f"{ruled_out['sizes']['winding_heating']:.2g}"
    assert got.document["verdict"] in WITHOUT_NAME and 2.7 < float(times) < 3.3
    said = (
        "winding_heating would explain as much as the curve, but is ruled out by size or sign alone: "
        f"winding_heating at {times} times its largest plausible size; "
        "check motor.resistance_thermal_housing and motor.resistance_thermal_winding."
    )
    assert said in got.printed and said in got.page.text
    assert got.text.index('id="ruled_out"') < got.text.index('id="effects"')
    why = f"Why no name: {got.found.standing}."
    assert why in got.printed and why in got.page.text and "one smooth curve in the electrical balance" in why
    assert got.page.tables["implausible"][1][-1] == ruled_out["why"]


@pytest.mark.slow
def test_what_happens_for_a_while_has_a_window(shown, capsys):
    got = shown("happening", capsys)
    (effect,) = got.document["effects"]
    window = effect["window"]
    assert got.document["verdict"] in WITHOUT_NAME and window["axis"] == "order"
    # the place is told to within half a window
    assert window["low"] >= 25 and window["high"] <= 50
    assert f"in runs {window['low']:.0f} to {window['high']:.0f}" in got.printed
    assert not any("conditions alike" in note for note in got.document["notes"])
    assert "curve" in drawn(got.text) and "order" in got.found.rows_table()
    assert got.document["next_experiment"]["name"] == "the same runs again"
    assert f"runs {window['low']:.0f} to {window['high']:.0f} again" in got.document["next_experiment"]["description"]


def test_cluster_and_names_that_stand_beside_curves_are_said(shown, capsys, tmp_path):
    found = shown("churning", capsys).found
    cluster = Cluster("time", 0.6, 0.7, "", 12, 13, 1e-5)
    test = NameTest(found.effects[0].name, 6.0, 3.3, (), 5.0, 7, 2.5)
    found = dataclasses.replace(found, cluster=cluster, support=NameSupport(True, "beside", tests=(test,)))
    document = finite_or_null(found.to_json())
    jsonschema.validate(document, SCHEMA)
    assert document["cluster"] == {
        "axis": "time", "low": 0.6, "high": 0.7, "level": "", "inside": 12, "of": 13, "p": 1e-5
    }  # fmt: skip
    page = Tables(written(tmp_path, found))
    assert words.cluster_sentence(cluster) in page.text
    said = f"{test.effect} 6.0 σ (chance 3.3, without row 7 2.5)"
    assert f"explains more than chance would: {said}." in page.text
    told = document["effects"][0]
    assert (told["standing"], told["rests_on_row"], told["root"]) == ("tentative", 7, 6.0)
    assert "tentative: row 7" in page.tables["effects"][1]


def test_first_screen_answers_in_a_minute(shown, capsys, tmp_path):
    """Whether the model is complete, what was found and how sure that is, errors before and after, what to look at."""
    got = shown("churning", capsys)
    found, page = got.found, got.page
    (effect,) = found.effects
    assert found.statement.startswith(f"No: missing is a {effect.families[0]} (") and "churning" in found.statement
    assert found.statement in page.text and found.statement == got.document["statement"]
    assert got.document["statement"] == got.document["headline"]["statement"]
    assert list(loop_report.moved_parameters(found)) == []
    shifted = {n: dataclasses.replace(p, shift_after=3.0, shift_before=3.0) for n, p in found.base_shift.items()}
    moved = list(loop_report.moved_parameters(dataclasses.replace(found, base_shift=shifted)))
    assert len(moved) == len(shifted) and all("(+3.0 prior sds)" in line for line in moved)
    a = effect.parameters["amplitude"]
    size, change = f"{a.value:.3g} ± {a.sd:.2g} {a.unit}", room.changes_by_effect(found)[effect.name]
    size += f", which changes the {change.channel.label} by {change.rms:.2g} %"
    assert f"{effect.families[0]} ({effect.name}): {size}; {words.how_sure(found, effect)}." in page.text
    stated, again, with_it = page.tables["summary"][1:]
    assert [line[0] for line in (stated, again, with_it)] == ["as stated", "fitted again", "with what was found"]
    for k, c in enumerate(c.name for c in found.channels):
        seen, unseen = found.errors[1][c], next(iter(found.errors_held_out.values()))[1][c]
        assert with_it[1 + k].startswith(f"{seen['rms_percent']:.1f} % ({unseen['rms_percent']:.1f} %)")
        better = found.errors[1][c]["rms_percent"] < found.errors[0][c]["rms_percent"] - 0.05
        assert with_it[1 + k].endswith("↓") == better
    head = got.text[: got.text.index('<nav id="contents"')]
    assert all(line in page.text for line in words.use_it(found))
    assert len(words.use_it(found)) == 1 + len(found.errors_held_out)
    without_table = re.sub(r"<table.*?</table>|<[^>]+>", " ", head[head.index("<h1>") :], flags=re.S)
    assert len(without_table.split()) <= 120
    weak = NameTest(effect.name, 6.0, 3.3, (), 5.0, 7, 2.5)
    tentative = dataclasses.replace(found, support=NameSupport(False, "beside", tests=(weak,)))
    assert words.how_sure(tentative, effect) == "tentative: it predicts, but rests on row 7"


def test_what_an_effect_changes_is_that_of_the_robot_without_it(shown, capsys):
    """And the law that is drawn is of the robot that is written, as the dots are."""
    found = shown("churning", capsys).found
    (effect,) = found.effects
    change = room.changes_by_effect(found)[effect.name]
    k = [c.name for c in found.channels].index(change.channel.name)
    here = found.included
    np.testing.assert_allclose(change.with_it[here], found.readings_of_rows.after[here, k], rtol=1e-5)
    assert change.rms > 1.0 and "brush_drop" not in room.changes_by_effect(found)
    assert "laws" in drawn(shown("churning", capsys).text)


def test_errors_better_and_worse_are_marked_with_the_rows_that_are_reached(shown, capsys):
    got = shown("churning", capsys)
    head, *lines = got.page.tables["errors"]
    assert [line[0] for line in lines] == [
        "seen by the fit",
        *(f"unseen: another {words.blocks.kind_in_words(k)}" for k in got.found.errors_held_out),
        "unseen: another configuration",  # each has friction of its own
    ]
    assert lines.pop()[-1] == "not predictable from the others" and got.document["held_out_unpredictable"] == [
        "configuration"
    ]
    for line, (before, after) in zip(lines, [got.found.errors, *got.found.errors_held_out.values()], strict=True):
        for cell, c in zip(line[1:-1], before, strict=True):
            assert cell.startswith(f"{before[c]['rms_percent']:.1f} → {after[c]['rms_percent']:.1f}")
        assert line[-1].endswith(f" of {len(got.found.runs)}")
    assert any(cell.endswith("↓") for line in lines for cell in line) and len(head) == len(lines[0])


def test_a_page_of_nothing_missing_says_what_would_have_been_seen(shown, capsys, tmp_path):
    found = shown("churning", capsys).found
    none = dataclasses.replace(
        found, verdict="none", effects=(), support=None, summary=dataclasses.replace(found.summary, verdict="none")
    )
    text = written(tmp_path, none)
    assert "What was looked for" in text and "laws" not in drawn(text) and '<ul id="found">' not in text
    listed = loop_report.would_be_seen(none)
    assert [one[-1] for one in listed] == sorted(one[-1] for one in listed)
    strong = next(s for s in none.scores if s.name == listed[0][0].strip("`"))
    level = none.before.kinds["single"].threshold
    assert listed[0][-1] * strong.sigmas_per_prior_sd == pytest.approx(level)
    assert Tables(text).tables["would_be_seen"][1][0] == listed[0][0].strip("`")


def test_squares_of_readings_and_of_priors_are_apart(shown, capsys):
    got = shown("churning", capsys)
    d, found = got.found.to_json()["chi2"], got.found
    seen, rows = found.readings_of_rows, found.included
    for when, simulated in (("before", seen.before), ("after", seen.after)):
        left = ((simulated - seen.measured) / seen.sd)[rows]
        assert d["of_readings"][when] == pytest.approx(float(np.nansum(left**2)), rel=1e-9)
        assert d["of_readings"][when] < d[when]  # the rest is what parameters moved from their priors
    assert f"{d['of_readings']['before']:.0f} → {d['of_readings']['after']:.0f} σ², with priors" in got.page.text


def test_reading_that_weighs_most_is_named(shown, capsys):
    found = shown("churning", capsys).found
    seen, row = found.readings_of_rows, int(np.flatnonzero(found.included)[3])
    after = seen.measured + 0.5 * seen.sd
    after[row, 1] += 40 * seen.sd[row, 1]
    off = dataclasses.replace(found, written=True, readings_of_rows=dataclasses.replace(seen, after=after))
    said = words.largest_share(off)
    assert (
        said.startswith(f"Row {found.numbers[row]} ({found.runs['configuration'][row]}, ")
        and "its motor speed" in said
    )
    even = dataclasses.replace(seen, after=seen.measured + 0.5 * seen.sd)
    assert words.largest_share(dataclasses.replace(off, readings_of_rows=even)) == ""


def test_what_a_name_could_hide_is_said(shown, capsys, tmp_path):
    found = shown("churning", capsys).found
    two = (
        HiddenEffect("brush_drop", 0.21, "V", 5.5, "stall", 7.2),
        HiddenEffect("load_slip", 1e-4, "1/N", 5.1, "", 0.0),
    )
    found = dataclasses.replace(found, hidden=two)
    jsonschema.validate(finite_or_null(found.to_json()), SCHEMA)
    page = Tables(written(tmp_path, found))
    assert page.tables["hidden"][1:] == [
        ["brush_drop", "0.21 V", "5.5", "stall (expected 7.2 σ)"], ["load_slip", "0.0001 1/N", "5.1", ""]
    ]  # fmt: skip
    capsys.readouterr()
    print_document(documented(found))
    assert (
        "Could be hidden behind what was found: brush_drop up to 0.21 V (stall would show it), load_slip up to 0.0001 1/N."
        in " ".join(capsys.readouterr().out.split())
    )
    found = dataclasses.replace(found, hidden=())
    assert 'id="hidden"' not in written(tmp_path, found)


@pytest.mark.parametrize("name", CASES)
def test_what_is_held_by_its_prior_is_said_everywhere(shown, capsys, tmp_path, name):
    seen = shown(name, capsys)
    made, sd = seen.found, np.sqrt(np.diag(seen.found.posterior.covariance))  # of coordinates whose prior sd is 1
    of_posterior = {n for n, x in zip(made.posterior.coordinates, sd, strict=True) if x > HELD}
    assert set(made.held_by_prior) == {n for n in of_posterior if not n.startswith("effects.unnamed")} != set()
    held = {n for n, p in seen.document["base_shift"].items() if p["held_by_prior"]}
    assert held == {n for n in made.held_by_prior if n in made.base_shift}
    assert all("held_by_prior" in p for e in seen.document["effects"] for p in e["parameters"].values())
    (note,) = [n for n in made.notes if n.startswith("not determined ")]
    assert tuple(note.split("): ")[1].split(", ")) == made.held_by_prior
    assert " ".join(note.split()) in seen.printed
    head, *rows = seen.page.tables["base"]
    assert {row[0] for row in rows if row[head.index("determined")] == "no"} == held
    made.save(tmp_path)
    assert note in (tmp_path / "robot.toml").read_text("utf-8")


@pytest.mark.parametrize(
    ("p", "outside", "settled", "says"),
    [
        (1e-6, (), True, "a running gear within its priors leaves it"),
        (0.4, (), True, "no running gear within its priors was found to leave it"),
        (1e-6, ("running_gear.guide_gap",), True, "; running_gear.guide_gap outside)"),
        (1e-6, (), False, "1 of 2 constants; the search had not settled, go on with --members"),
    ],
)
def test_what_the_track_model_says_is_shown(shown, capsys, tmp_path, p, outside, settled, says):
    found = shown("churning", capsys).found
    resolved = Resolved(
        asked=Asked("missing", "slip", "slope"), rows=10, robot=found.robot,
        constants={
            "running_gear.guide_recess": Estimate(3.1e-4, 4e-5, "m", False), "x.static": Estimate(0.58, 0.02, "-", True)
        },
        alike=(("a", "b", -0.95),),
        outside=outside, settled=settled, fall=61.0, p=p,
        chi2=(90.0, 29.0), readings=30, rms_percent={"speed": (4.0, 1.2)}, slip_rms=(3.3, 0.6), remarks=("said too",),
    )  # fmt: skip
    found = dataclasses.replace(found, resolved=resolved)
    document = finite_or_null(found.to_json())
    jsonschema.validate(document, SCHEMA)
    assert (
        document["resolved"]["explains"] == (p < 0.01 and not outside)
        and document["resolved"]["slip_rms_points"]["after"] == 0.6
    )
    page = Tables(written(tmp_path, found))
    assert says in page.text and "slip of the 10 rows on tracks 3.3 → 0.6 points rms" in page.text
    assert page.tables["resolved_constants"][1][0] == "running_gear.guide_recess"
    assert [row[-1] for row in page.tables["resolved_constants"][1:]] == ["yes", "no"]
    capsys.readouterr()
    print_document(documented(found))
    assert says in " ".join(capsys.readouterr().out.split())
    found.save(tmp_path / "saved")
    assert (tmp_path / "saved" / "robot_track.toml").exists()
