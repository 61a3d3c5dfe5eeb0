"""Figures of a campaign: shares with their intervals, of tables and of histories.

A line holds the verdict (`verdict`, `classes`, `where`, `families`, `events`) and the truth of its case.
"""

from __future__ import annotations

import itertools
from collections import Counter
from collections.abc import Callable, Sequence

import numpy as np

#: Verdicts without an established name; `unnamed` in lines of campaigns before schema 3.
WITHOUT_NAME = ("mechanism", "place", "unnamed")

#: Channels with readings that may be wrong.
CHANNELS = ("total_current", "motor_speed", "speed")
#: Groups of balances that act on the same of the three equations of current, motor speed and speed.
EQUATION = {
    **dict.fromkeys(("duty", "supply", "electrical", "inductance"), "electrical"),
    **dict.fromkeys(("motor", "gearbox", "track", "ground", "mass", "inertia"), "torque"),
    "slip": "slip",
    **dict.fromkeys(("sensor", *CHANNELS), "sensor"),
}
#: Sigmas that the best library effect has to leave of a foreign one for it not to be a mimic.
MIMIC = 5.0
#: Least number of cases of a judged stratum; largest share of false findings.
STRATUM, FALSE = 60, 5.0
#: Drivers of each effect that has another form among the variants: possible variables of a curve.
SPEEDS = ("speed_motor", "speed", "voltage")
LOADS = ("slope", "payload", "current")
DRIVEN: dict[str, tuple[str, ...]] = {
    "supply_sag": ("current",), "brush_drop": ("current",), "winding_heating": ("current",),
    "torque_constant_saturation": ("current",), "windage": SPEEDS, "stribeck_motor": SPEEDS, "iron_loss": SPEEDS,
    "gear_quadratic_loss": LOADS, "stribeck_gear": SPEEDS, "churning": SPEEDS, "stribeck_track": SPEEDS,
    "tension_friction": LOADS, "bending_loss": SPEEDS, "speed_rolling": SPEEDS, "adhesive_drag": SPEEDS,
    "weight_transfer": ("slope",), "sinkage": ("payload",), "belt_creep": LOADS, "nonlinear_slip": LOADS,
    "speed_slip": SPEEDS, "load_slip": LOADS,
}  # fmt: skip
#: Drivers of each law outside the library, in the words of `Effect.driver`: one variable, or two that are both
#: right answers.
DRIVERS: dict[str, tuple[str, ...]] = {
    **dict.fromkeys(("resonance_bump", "root_friction", "friction_step", "rotor_whirl", "belt_flutter",
                     "heave_resonance", "lost_counts"), ("speed",)),
    **dict.fromkeys(("supply_hunting", "polyfuse", "range_switch"), ("current",)),
    **dict.fromkeys(("backlash_dither", "thrust_washer"), ("load",)), "commutation_step": ("voltage", "speed"),
    "guide_binding": ("weight", "load"), "slope_rolling": ("slope",), "ratcheting": ("demand", "speed"),
    "gear_viscosity": ("speed", "load"), "loaded_chatter": ("speed", "load"), "tooth_climb": ("slope", "speed"),
    "ammeter_two_things": ("current", "speed"), "speed_two_things": ("demand", "speed"),
    "buck_source": ("current", "voltage"), "rail_dropout": ("voltage", "current"),
    "commutation_spark": ("current", "speed"), "commutation_lag": ("speed", "load"),
    "grease_thinning": ("speed", "load"), "mixed_mesh": ("load", "speed"), "tight_side_flexing": ("load", "speed"),
    "guide_glide": ("speed", "weight"), "rear_hysteresis": ("slope", "speed"), "top_heavy": ("slope", "load"),
    "hop": ("speed", "load"), "tread_heating": ("demand", "speed"), "warming": ("time",),
    "order_two": ("order 2 of the driving shaft",),
    "supply_recovery": ("time",),
}  # fmt: skip
#: Laws of `DRIVERS` with one variable but two words for it.
ONE_DRIVER = ("commutation_step", "guide_binding")
#: Drivers that a table of settled runs varies by the same columns: load by payload and slope.
SAME_DRIVER = ({"load", "slope", "weight", "demand", "configuration"}, {"voltage", "duty"})
#: Properties for a breakdown of clean cases: name, edges of the bins.
BINS: tuple[tuple[str, tuple[float, ...]], ...] = (
    ("adhesion", (0.2, 0.35, 0.5, 0.75, 1.0)),
    ("V_s", (0.002, 0.006, 0.02, 0.06)),
    ("mass", (2, 8, 20, 60)),
    ("ratio", (10, 30, 60, 120)),
    ("radius", (0.02, 0.045, 0.08, 0.15)),
    ("supply", (6, 12, 24, 48)),
    ("rows", (15, 33, 49, 91, 129, 201)),
)


def wilson(hits: int, n: int) -> tuple[float, float]:
    """95 % interval of a share [%] (Wilson 1927)."""
    z, p = 1.96, hits / n
    middle = (p + z * z / (2 * n)) / (1 + z * z / n)
    half = z * np.sqrt(p * (1 - p) / n + z * z / (4 * n * n)) / (1 + z * z / n)
    return 100 * max(middle - half, 0.0), 100 * min(middle + half, 1.0)


def interval(hits: int, n: int) -> str:
    """A share with its 95 % interval."""
    if n == 0:
        return "none"
    low, high = wilson(hits, n)
    return f"{100 * hits / n:5.1f} %  [{low:.1f}, {high:.1f}]  of {n}"


# --- of one line ------------------------------------------------------------------------------------


def single(x: dict) -> bool:
    """True if one effect is named."""
    return x["verdict"] == "named" and len(x["classes"]) == 1


def contains(x: dict) -> bool:
    """True if one effect is found and its class contains the truth."""
    return len(x["classes"]) == 1 and x["truth"][0]["class"] in x["classes"][0]


def everything(x: dict) -> bool:
    """True if there is a class for each truth and no other."""

    def matched(truths: Sequence[str], classes: Sequence[Sequence[str]]) -> bool:
        if not truths:
            return not classes
        return any(
            truths[0] in members and matched(truths[1:], [*classes[:k], *classes[k + 1 :]])
            for k, members in enumerate(classes)
        )

    return matched([t["class"] for t in x["truth"]], x["classes"])


def placed(x: dict) -> bool:
    """True if an unnamed discrepancy is in the truth's equation."""
    return x["verdict"] in WITHOUT_NAME and _equation(x) == EQUATION[x["truth"][0]["balance"]]


def _equation(x: dict) -> str:
    return EQUATION.get(x["where"][0], x["where"][0]) if x.get("where") else ""


def false_finding(x: dict) -> bool:
    """True if a verdict reports that something is missing: a name, or a place."""
    return x["verdict"] != "none"


def located(x: dict) -> bool:
    """True if a finding has a name or a place. A noise that differs from the stated one has neither."""
    return x["verdict"] in ("named", "class") or (x["verdict"] in WITHOUT_NAME and bool(x.get("where")))


def family_right(x: dict) -> bool:
    """True if the verdict names the truth or its family: the equation it enters and its driver."""
    if contains(x):
        return True
    from mmrjax.effects import BY_NAME

    truth = x["truth"][0]
    if x["verdict"] in ("named", "class"):
        return len(x["classes"]) == 1 and BY_NAME[truth["class"]].family() in (x.get("families") or ())
    return placed(x) and x["where"][1] in DRIVEN.get(truth["class"], ())


def _equation_of(truth: dict) -> str:
    return EQUATION[truth["balance"]]


# --- mechanisms -------------------------------------------------------------------------------------


def established_families(x: dict) -> list[tuple[str, ...]]:
    """Families of each law or mechanism that a verdict establishes."""
    from mmrjax.effects import BY_NAME

    if x["verdict"] == "mechanism":
        return [tuple(x["mechanism"]["families"])]
    if x["verdict"] not in ("named", "class"):
        return []
    listed = {tuple(e["class"]): tuple(e.get("families", ())) for e in x.get("effects", ())}
    members = [tuple(dict.fromkeys(BY_NAME[n].family() for n in c if n in BY_NAME)) for c in x["classes"]]
    return [listed.get(tuple(c)) or families for c, families in zip(x["classes"], members, strict=True)]


def same_mechanism(family: str, truth: dict, loosely: bool = False) -> bool:
    """True if a family is the mechanism of a truth: the balance it enters, and its driver.

    Args:
        loosely: True to identify drivers that settled runs vary by the same columns, and balances of
            one equation.
    """
    from mmrjax.effects import BY_NAME
    from mmrjax.effects.base import EQUATION as WORDS

    if truth["class"] and not loosely:
        return family == BY_NAME[truth["class"]].family()
    what, _, driver = family.partition(" that changes with ")
    what = what.removesuffix(" that is the same share everywhere")
    if truth["class"]:
        own = BY_NAME[truth["class"]]
        drivers, enters = {own.driver}, own.family().partition(" that ")[0]
    else:
        drivers = set(DRIVERS[truth["name"]])
        shown = truth.get("channel") or truth["balance"]
        enters = WORDS.get(shown, f"reading of {shown.replace('_', ' ')}")
    if loosely:
        drivers |= {v for same in SAME_DRIVER if same & drivers for v in same}
        equation = {word: EQUATION.get(balance, balance) for balance, word in WORDS.items()}
        what, enters = equation.get(what, what), equation.get(enters, enters)
    return what == enters and driver in drivers


def mechanism_right(x: dict, loosely: bool = False) -> bool:
    """True if a law or a mechanism is established, and each of them has the mechanism of a truth."""
    found = established_families(x)
    return bool(found) and not mechanism_wrong(x, loosely)


def mechanism_wrong(x: dict, loosely: bool = False) -> bool:
    """True if an established one has the mechanism of no truth, alone or among indistinguishable ones."""
    return any(
        not any(same_mechanism(f, t, loosely) for f in those for t in x["truth"]) for those in established_families(x)
    )


def in_place(x: dict, alike: bool = False) -> bool:
    """True if a drift, a cluster or an event is placed correctly.

    That is over the right variable in the right equation, or by an event that shares half of its rows or of its time
    with the truth.

    Args:
        alike: True to accept variables and events that these data cannot distinguish from the reported one.
    """
    truth = x["truth"][0]
    where = truth["where"]
    right = truth["balance"] == "sensor" or _equation(x) == _equation_of(truth)
    over = {"order": ("order", "row"), "time": ("time",)}.get(where.get("variable", ""), (where.get("variable"),))
    over = (*over, truth.get("name", "").split(".")[0])  # of a condition with all rows shifted
    variables = {x["where"][1], *(x.get("variables_alike", ()) if alike else ())} if x["where"] else set()
    if x["verdict"] in WITHOUT_NAME and right and variables & set(over):
        return True
    for event in (*(x.get("events") or ()), *((x.get("events_alike") or ()) if alike else ())):
        if not isinstance(event, dict):
            continue
        if {"rows", "samples"} & set(event) and where.get("rows"):
            found, true = set(event.get("rows", event.get("samples"))), set(where["rows"])
            if len(found & true) >= 0.5 * len(found | true):
                return True
        ends = event.get("window") or event.get("time") or (event.get("start"), event.get("stop"))
        if where.get("window") and isinstance(ends, list | tuple) and len(ends) == 2 and None not in ends:
            (a, b), (c, d) = ends, where["window"]
            if min(b, d) - max(a, c) >= 0.5 * (max(b, d) - min(a, c)):
                return True
    return False


def sigmas(truth: dict) -> float:
    """Sigmas of an effect after the base is refitted. By the loop's own base if known."""
    left = truth.get("sigmas_left")
    return truth["sigmas"] if left is None else left


# --- of all lines -----------------------------------------------------------------------------------


class Figures:
    """Lines of text, one for each figure."""

    def __init__(self, lines: list[dict]) -> None:
        self.lines, self.out = lines, []

    def of(self, *kinds: str) -> list[dict]:
        """Judged cases of these kinds."""
        return [x for x in self.lines if x["kind"] in kinds and "verdict" in x]

    def say(self, what: str, those: Sequence[dict], hit: Callable[[dict], object]) -> None:
        """Adds a share, if there is any case."""
        if those:
            self.out.append(f"{what:76s} {interval(sum(bool(hit(x)) for x in those), len(those))}")

    def note(self, text: str) -> None:
        """Adds a line."""
        self.out.append(text)


def findings(f: Figures) -> None:
    """Each effect separately: established, tentative, right or wrong, and whether the written model predicts.

    By kind, and for kinds with both tables with stated sds and tables without, by that.
    """
    known = [x for x in f.lines if "verdict" in x and "effects" in x]
    for kind in dict.fromkeys(x["kind"] for x in known):
        every = [x for x in known if x["kind"] == kind]
        ways = dict.fromkeys(x.get("made", {}).get("stated", True) for x in every)
        for stated in ways:
            those = [x for x in every if x.get("made", {}).get("stated", True) == stated]
            what = kind + (f", sds {'' if stated else 'not '}stated" if len(ways) > 1 else "")
            _found(f, what, those)
            _written(f, those)


def _found(f: Figures, what: str, those: Sequence[dict]) -> None:
    """Findings of these cases, of one kind."""
    count = max((len(x.get("truth", ())) for x in those), default=0)
    if count == 0:
        f.say(f"{what}: rejected (goal <= 5 %)", those, false_finding)
        f.say("  something established (goal <= 1 %)", those, established_families)
        f.say("  something tentative", those, lambda x: wrong(x, "tentative"))
        for name in sorted({x.get("stratum", "") for x in those}):
            stratum(f, f"rejected, stratum {name}", [x for x in those if x.get("stratum", "") == name])
        return
    if all(t["class"] for x in those for t in x["truth"]):
        strong = [x for x in those if all(sigmas(t) >= 5 for t in x["truth"])]
        f.say(
            f"{what}, >= 5 sigma left: every truth established (goal >= 93 %)",
            strong,
            lambda x: all_in(x, "established"),
        )
        f.say("  established or tentative", strong, lambda x: all_in(x, "established", "tentative"))
    else:
        f.say(f"{what}: nothing found", those, lambda x: x["verdict"] == "none")
    f.say("  something wrong established (goal <= 3 %)", those, lambda x: wrong(x, "established"))
    f.say("  something wrong tentative", those, lambda x: wrong(x, "tentative"))
    free = [x for x in those if x["truth"][0].get("best_other", np.inf) >= MIMIC]
    if len(free) < len(those):
        f.say("  the same without a mimic: wrong established", free, lambda x: wrong(x, "established"))
        f.say("  wrong tentative", free, lambda x: wrong(x, "tentative"))


def _written(f: Figures, those: Sequence[dict]) -> None:
    """Predictions of the written model, for held-out data and for runs at other conditions."""
    from calibration.discovery.prediction import WORSE

    def kept(x: dict) -> bool:
        return bool(x.get("written", True)) and "gain" in x

    further = [x for x in those if "elsewhere" in x]
    f.say(
        f"  elsewhere not below the refit by more than {WORSE:g} nat per reading (goal >= 98 %)",
        further,
        lambda x: not kept(x) or not x["elsewhere"] or x["elsewhere"]["gain"][0] >= -WORSE,
    )
    added = [x for x in further if kept(x) and x["elsewhere"]]
    f.say("    of those with effects written", added, lambda x: x["elsewhere"]["gain"][0] >= -WORSE)
    f.say(
        "    a channel's error rises there by more than a tenth",
        added,
        lambda x: any(after > 1.1 * before for before, after, *_ in x["elsewhere"]["rms_sigma"].values()),
    )
    scored = [x for x in those if x["effects"] and "gain" in x]  # no hold-out for histories here
    f.say("  effects found and not written", scored, lambda x: not kept(x))


def wrong(x: dict, standing: str) -> bool:
    """True if the class of an effect of this standing contains no truth."""
    truths = {t["class"] for t in x["truth"]}
    return any(e["standing"] == standing and not truths & set(e["class"]) for e in x["effects"])


def all_in(x: dict, *standings: str) -> bool:
    """True if each truth is in the class of an effect of one of these standings."""
    classes = [e["class"] for e in x["effects"] if e["standing"] in standings]
    return all(any(t["class"] in c for c in classes) for t in x["truth"])


def mechanisms(f: Figures) -> None:
    """Right and wrong mechanisms, of laws and others, by kind. The levels that verdicts reach."""
    known = [x for x in f.lines if "verdict" in x]
    for kind in dict.fromkeys(x["kind"] for x in known):
        those = [x for x in known if x["kind"] == kind and x.get("truth")]
        those = [x for x in those if all(t["class"] or t.get("name") in DRIVERS for t in x["truth"])]
        those = [x for x in those if all(sigmas(t) >= 5 for t in x["truth"])]
        foreign = any(not t["class"] for x in those for t in x["truth"])
        goals = ("85", "3") if foreign else ("97", "3")
        f.say(f"{kind}: right mechanism established (goal >= {goals[0]} %)", those, mechanism_right)
        f.say("  counting indistinguishable balances and drivers", those, lambda x: mechanism_right(x, True))
        f.say(f"  wrong mechanism (goal <= {goals[1]} %)", those, mechanism_wrong)
        f.say("  wrong, counting indistinguishable ones", those, lambda x: mechanism_wrong(x, True))
        if foreign:
            one = [x for x in those if _one_driver(x["truth"][0])]
            f.say("  one driver: right mechanism established", one, mechanism_right)
            f.say("  one driver: right, counting indistinguishable ones", one, lambda x: mechanism_right(x, True))
            f.say("  one driver: wrong mechanism", one, mechanism_wrong)
        if those:
            f.note(f"  levels: {dict(Counter(x['verdict'] for x in those))}")


def _one_driver(truth: dict) -> bool:
    return truth["name"] in ONE_DRIVER or len(DRIVERS.get(truth["name"], ())) == 1


def clean(f: Figures, kinds: Sequence[str]) -> None:
    """False findings, by stratum and by property. A stratum with too many is marked."""
    for kind in kinds:
        f.say(f"{kind}: a false finding (goal <= 5 %)", f.of(kind), false_finding)
    wide = f.of("clean_wide")
    for name in dict.fromkeys(sorted(x.get("stratum", "") for x in wide)):
        stratum(f, f"stratum {name}", [x for x in wide if x.get("stratum") == name])
    for name, edges in BINS:
        for low, high in itertools.pairwise(edges):
            inside = [x for x in wide if any(low <= v < high or v == high == edges[-1] for v in values(x, name))]
            stratum(f, f"{name} {low:g} to {high:g}", inside)


def values(x: dict, name: str) -> list[float]:
    """Values of a property of a case. A property of a surface has one for each configuration."""
    made = x.get("made", {})
    if name in ("adhesion", "V_s"):
        return [s[name] for s in made.get("surface", {}).values()]
    if name == "rows":
        return [made["rows"]] if "rows" in made else []
    return [made["robot"][name]] if name in made.get("robot", {}) else []


def stratum(f: Figures, what: str, those: list[dict]) -> None:
    """False findings of a part of the clean cases, marked if they are significantly too many."""
    if not those:
        return
    hits = sum(map(false_finding, those))
    mark = "  ABOVE 5 %" if wilson(hits, len(those))[0] > FALSE else ""
    few = "  (few)" if len(those) < STRATUM else ""
    f.note(f"  {what:74s} {interval(hits, len(those))}{mark}{few}")


def noise(f: Figures) -> None:
    """Figures of noise that differs from the stated one."""
    those = f.of("noise")
    f.say("noise half or twice: a located finding (goal <= 5 %)", those, located)
    told = [x for x in those if x.get("noise_factor") is not None]
    f.say("  a factor is reported", those, lambda x: x in told)
    f.say("  and is right within 20 %", told, lambda x: abs(x["noise_factor"] / x["made"]["noise"] - 1) < 0.2)


def library(f: Figures, kind: str = "library") -> None:
    """Effects of the library, by the sigmas that a refit of the base leaves."""
    those = f.of(kind)
    for low, high, goal in ((5, 6, "92"), (6, 7, ""), (7, 99, "98")):
        some = [x for x in those if low <= sigmas(x["truth"][0]) < high]
        span = f"{low} to {high}" if high < 99 else f">= {low}"
        f.say(f"{kind}, {span} sigma left: class right" + (f" (goal >= {goal} %)" if goal else ""), some, contains)
        f.say("  something found", some, false_finding)
    strong = [x for x in those if sigmas(x["truth"][0]) >= 5]
    f.say(
        f"{kind}, >= 5 sigma left: a single name that is given is right (goal >= 97 %)",
        [x for x in strong if single(x)],
        contains,
    )
    alone = [x for x in strong if len(x["truth"][0].get("class_oracle", ())) == 1]
    f.say("  single name right, where noise-free data leave one", alone, lambda x: contains(x) and single(x))
    f.say("  unnamed", strong, lambda x: x["verdict"] in WITHOUT_NAME)
    f.say("  two or more effects named", strong, lambda x: len(x["classes"]) > 1)
    weak = [x for x in those if sigmas(x["truth"][0]) < 5]
    f.say(f"{kind}, weaker: a wrong name or class", weak, lambda x: x["classes"] and not contains(x))
    held = [x for x in strong if contains(x)]
    if held:
        ideal = [len(x["truth"][0].get("class_oracle", ())) for x in held]
        mean = np.mean([len(x["classes"][0]) for x in held])
        f.note(f"  members of the class: mean {mean:.2f} (noise-free {np.mean(ideal):.2f})")


def variants(f: Figures) -> None:
    """Other forms of a library effect."""
    those = [x for x in f.of("variants") if x["truth"][0]["sigmas"] >= 5]
    f.say("another form: a wrong single name (goal <= 5 %)", those, lambda x: single(x) and not contains(x))
    f.say("  the cause's family is named (goal >= 85 %)", those, family_right)
    f.say("  the class holds the cause", those, contains)
    f.say("  or unnamed in the right equation", those, lambda x: contains(x) or placed(x))
    f.say("  nothing found", those, lambda x: x["verdict"] == "none")


def outside(f: Figures, kind: str) -> None:
    """Effects that the library does not contain."""
    those = [x for x in f.of(kind) if x["truth"][0]["sigmas"] >= 7.5]
    free = [x for x in those if x["truth"][0].get("best_other", np.inf) >= MIMIC]
    mimics = [x for x in those if x["truth"][0].get("best_other", np.inf) < MIMIC]
    f.say(f"{kind} >= 8 sigma, no mimic: wrong single name (goal <= 3 %)", free, single)
    f.say("  any library name (goal <= 6 %)", free, lambda x: x["classes"])
    f.say("  unnamed in the right equation (goal >= 95 %)", free, placed)
    f.say("  nothing found", free, lambda x: x["verdict"] == "none")
    f.say(
        "  unnamed in the very balance",
        free,
        lambda x: x["verdict"] in WITHOUT_NAME and x["where"] and x["where"][0] == x["truth"][0]["balance"],
    )
    f.say(
        "  the very balance among the indistinguishable ones",
        free,
        lambda x: x["verdict"] in WITHOUT_NAME and x["where"] and x["truth"][0]["balance"] in x["where"][2],
    )
    f.say(f"{kind}, with a mimic: a library name", mimics, lambda x: x["classes"])
    f.say("  unnamed in the right equation", mimics, placed)
    by_name(f, free, placed)


def by_name(f: Figures, those: Sequence[dict], hit: Callable[[dict], object]) -> None:
    """For each effect with errors, its rate of right verdicts, and the other verdicts."""
    for name in sorted({x["truth"][0]["name"] for x in those}):
        some = [x for x in those if x["truth"][0]["name"] == name]
        other = Counter(str(x["classes"]) if x["classes"] else x["verdict"] for x in some if not hit(x))
        if other:
            f.note(f"    {name}: right {len(some) - other.total()} of {len(some)}; {dict(other)}")


def several(f: Figures) -> None:
    """Two and three effects at once."""
    for kind, goal in (("pairs", "goal >= 92 %"), ("triples", "goal >= 75 %"), ("compensating", "")):
        those = f.of(kind)
        if kind != "compensating":
            those = [x for x in those if all(t["sigmas"] >= 7.2 for t in x["truth"])]
        f.say(f"{kind} >= 8 sigma each given the others: all classes ({goal})", those, everything)
        f.say("  something found", those, false_finding)
        f.say("  more effects than there are", those, lambda x: len(x["classes"]) > len(x["truth"]))
        f.say("  a class that holds none of them", those, lambda x: any(
            not {t["class"] for t in x["truth"]} & set(c) for c in x["classes"]))  # fmt: skip


def placed_kinds(f: Figures, kinds: Sequence[str]) -> None:
    """Figures of drifts, clusters and events."""
    for kind in kinds:
        those = [x for x in f.of(kind) if x["truth"][0]["sigmas"] >= 7.5]
        f.say(f"{kind} >= 8 sigma: found and placed (goal >= 90 %)", those, lambda x: in_place(x, alike=True))
        f.say("  and reported first among indistinguishable ones", those, in_place)
        f.say("  something found", those, false_finding)
        f.say("  a library name", those, lambda x: x["classes"])
        f.say(
            "  no finding, and rows or samples set aside", those, lambda x: x["verdict"] == "none" and x["outliers"]
        )


def coverage(f: Figures) -> None:
    """Coverage of the truth by 95 % intervals: of base parameters, and of amplitudes."""
    those = [x for x in f.of("coverage") if "deviates" in x]
    names = dict.fromkeys(n for x in those for n in x["deviates"])
    whole = [d for x in those for d in x["deviates"].values()]
    f.say(
        "coverage: the truth is in the class, or nothing is missing and no finding",
        f.of("coverage"),
        lambda x: "deviates" in x,
    )
    if whole:
        f.note(f"{'coverage of 95 % intervals, all base parameters (goal 92 to 98 %)':76s} {_covered(whole)}")
    for name in names:
        some = [x["deviates"][name] for x in those if name in x["deviates"]]
        f.note(f"  {name:74s} {_covered(some)}  mean {np.mean(some):+.2f}, sd {np.std(some):.2f}")
    some = [x["amplitude_deviate"] for x in those if x.get("amplitude_deviate") is not None]
    if some:
        what = "coverage of 95 % intervals, amplitudes (goal 92 to 98 %)"
        f.note(f"{what:76s} {_covered(some)}  mean {np.mean(some):+.2f}")


def _covered(deviates: Sequence[float]) -> str:
    return interval(int(np.sum(np.abs(deviates) <= 1.96)), len(deviates))


def ends(f: Figures) -> None:
    """Skipped cases with reasons, errors, time, outliers."""
    skipped = Counter((x["kind"], str(x["skipped"])) for x in f.lines if x.get("skipped"))
    for (kind, why), count in sorted(skipped.items()):
        f.note(f"skipped: {kind}: {why}: {count}")
    errors = Counter((x["kind"], x["error"][:110]) for x in f.lines if "error" in x)
    for (kind, why), count in sorted(errors.items()):
        f.note(f"error: {kind}: {why}: {count}")
    judged = [x for x in f.lines if "verdict" in x]
    if judged:
        seconds = [x["seconds"] for x in judged]
        f.note(
            f"{len(judged)} cases; seconds a case: median {np.median(seconds):.2f}, mean {np.mean(seconds):.2f}, "
            f"most {max(seconds):.0f}; memory {max(x.get('memory', 0) for x in judged) / 1e9:.1f} GB"
        )
