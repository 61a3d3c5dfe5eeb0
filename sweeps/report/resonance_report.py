"""Report of a resonance map: speeds to avoid, the map, natural frequencies and all confirmed peaks."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable

import numpy as np

from calibration.data import Columns, Json
from calibration.data.robot_file import RobotFile
from mmrjax.errors import count_noun
from mmrjax.model.quantities import MM
from mmrjax.model.robot import Robot
from mmrjax.model.signals import STATUSES
from mmrjax.undercarriage.modes import Mode
from mmrjax.undercarriage.ripple_peaks import (
    MATTERS,
    PERIODS,
    SIGNALS,
    TAIL,
    ModeCrossing,
    PassingParts,
    Resonance,
    RipplePeak,
    group_resonances,
    strongest_resonances,
)
from sweeps.report import catalogue, run_tables
from sweeps.report.document import Cell, Document, Section, remarks

RANGES_IN_SENTENCE = 3  # most ranges to avoid in a sentence


#: Status of a run that is too slow for its ripple to be evaluated.
TOO_SLOW = "too_slow"


@dataclasses.dataclass(frozen=True)
class ResonanceResult:
    """Result of `resonance`.

    Attributes:
        configuration, slope_deg, surface: configuration, slope and surface of the map.
        passing: source of the excitation.
        robot: robot that was simulated.
        table: one row for each run, as in `points.csv`.
        modes: modes by payload [kg].
        peaks, crossings: peaks and crossings at every payload.
    """

    configuration: str
    slope_deg: float
    surface: str
    passing: PassingParts
    robot: Robot
    table: Columns
    modes: dict[float, list[Mode]]
    peaks: list[RipplePeak]
    crossings: list[ModeCrossing]

    @property
    def resonances(self) -> list[Resonance]:
        """Peaks over the payloads. Peaks without a mode are not confirmed by one."""
        return group_resonances(self.peaks)

    @property
    def strong_peaks(self) -> list[RipplePeak]:
        """Peaks of the strongest resonances."""
        kinds = {(r.mode, r.order, r.signal) for r in strongest_resonances(self.resonances)}
        return [p for p in self.peaks if (p.mode, p.order, p.signal) in kinds]

    @property
    def is_evaluated(self) -> np.ndarray:
        """True for rows whose ripple is evaluated."""
        return np.isfinite(self.table["reaction_ripple_percent"])

    @property
    def speeds(self) -> tuple[float, float]:
        """Smallest and largest evaluated speed [m/s], NaN without one."""
        speed = self.table["speed_mean_mm_s"][self.is_evaluated] * MM
        return (float(speed.min()), float(speed.max())) if len(speed) else (float("nan"), float("nan"))

    @property
    def statuses(self) -> dict[str, int]:
        """Number of runs with each status, zeros included."""
        return {s: int(np.sum(self.table["status"] == s)) for s in (*STATUSES, TOO_SLOW)}

    @property
    def ranges_to_avoid(self) -> list[tuple[float, float, list[Resonance]]]:
        """Ranges of speed to avoid [m/s], lowest first, each for one mode and order, with its resonances."""
        by_mode: dict[tuple[str, int], list[Resonance]] = {}
        for r in strongest_resonances(self.resonances):
            by_mode.setdefault((r.mode, r.order), []).append(r)
        ranges = [(min(r.avoid[0] for r in x), max(r.avoid[1] for r in x), x) for x in by_mode.values()]
        return sorted(ranges, key=lambda x: x[0])

    @property
    def unsettled_ranges(self) -> list[tuple[float, float]]:
        """Ranges of speed in which a run did not settle [m/s], each up to half way to the neighbouring runs."""
        ranges = []
        speed = self.run_speeds * MM
        for payload in self.modes:
            rows = np.flatnonzero((self.table["payload_kg"] == payload) & np.isfinite(speed))
            rows = rows[np.argsort(speed[rows])]
            x = speed[rows]
            edges = np.concatenate([x[:1], (x[1:] + x[:-1]) / 2, x[-1:]])
            is_unsettled = self.table["status"][rows] != "converged"
            ranges += [(edges[k], edges[k + 1]) for k in np.flatnonzero(is_unsettled)]
        return _merge_ranges(ranges)

    @property
    def run_speeds(self) -> np.ndarray:
        """Speed of every run [mm/s]. Missing ones follow from the voltage by a line through the others, NaN if there
        are too few.
        """
        speed, voltage = self.table["speed_mean_mm_s"], self.table["supply_voltage_V"]
        if self.is_evaluated.sum() < 2:
            return speed
        line = np.polyfit(voltage[self.is_evaluated], speed[self.is_evaluated], 1)
        return np.where(self.is_evaluated, speed, np.polyval(line, voltage))

    @property
    def quiet_ranges(self) -> list[tuple[float, float]]:
        """Ranges of speed [m/s] without peaks to avoid at any payload, in which every run settles."""
        low, high = self.speeds
        gaps = []
        for begin, end in _merge_ranges([*((a, b) for a, b, _ in self.ranges_to_avoid), *self.unsettled_ranges]):
            if begin > low:
                gaps.append((low, min(begin, high)))
            low = max(low, end)
        return [*gaps, (low, high)] if low < high else gaps

    def statement(self) -> str:
        """Speeds to avoid, in one sentence."""
        return " ".join(self.sentences)

    @property
    def sentences(self) -> list[str]:
        """Sentences on speeds to avoid, the most important first."""
        low, high = self.speeds
        if not np.isfinite(low):
            return [f"No run of {self.configuration} travels (see status)."]
        sentences = []
        ranges_to_avoid = self.ranges_to_avoid
        unsettled_ranges = self.unsettled_ranges
        excitation = self.passing.name
        with_mode, without_mode = (
            [r for r in ranges_to_avoid if bool(r[2][0].mode) is expects_mode] for expects_mode in (True, False)
        )
        if with_mode:
            payload_phrase = "" if len(self.modes) == 1 else "at least at one payload: "
            sentences.append(f"Avoid {payload_phrase}{_ranges_in_words(with_mode, excitation)}.")
        elif not without_mode:
            largest = ", ".join(
                f"{s.label} {ripple_percent(float(np.nanmax(self.table[f'{n}_ripple_percent'])))}"
                for n, s in SIGNALS.items()
            )
            sentences.append(
                f"No speed to avoid between {span_text(low, high)} mm/s: no ripple peak is at a natural "
                f"frequency (largest ripple: {largest})."
            )
        if without_mode:
            verb_phrase = "Ripple also peaks" if with_mode else "Ripple peaks"
            sentences.append(
                f"{verb_phrase}, without a natural frequency nearby, at {_ranges_in_words(without_mode, excitation)}."
            )
        # modes that amplify, but vary by an octave in frequency with the position of the belt
        varying = [m for modes in self.modes.values() for m in modes if m.amplifies and not m.resonant]
        for name in dict.fromkeys(m.name for m in varying):
            modes_of_name = [m for m in varying if m.name == name]
            lowest, highest = min(m.low for m in modes_of_name), max(m.high for m in modes_of_name)
            sentences.append(
                f"{name.capitalize()} has no single frequency: {span_text(lowest, highest, 1)} Hz, depending on the "
                "belt's position."
            )
        if unsettled_ranges:
            sentences.append(f"Not every run settles at {', '.join(span_text(*x) for x in unsettled_ranges)} mm/s.")
        if ranges_to_avoid or unsettled_ranges:
            quiet_text = ", ".join(span_text(*x) for x in self.quiet_ranges)
            sentences.append(
                f"Speeds without these problems: {quiet_text} mm/s."
                if quiet_text
                else "No speed is without these problems."
            )
        if excitation == "teeth":
            sentences.append(
                "Without grousers on the ground, the belt's teeth cause the ripple, one every "
                f"{self.passing.travel / MM:.2f} mm of travel."
            )
        return sentences

    def to_json(self) -> Json:
        """`result.json`."""
        return {
            "schema": "mmrjax.resonance/2",
            "statement": self.statement(),
            "configuration": self.configuration,
            "slope_deg": self.slope_deg,
            "surface": self.surface,
            "passing": {"of": self.passing.name, "pitch_m": self.passing.pitch, "travel_m": self.passing.travel},
            "runs": len(self.table["status"]),
            "statuses": self.statuses,
            "speeds_m_s": self.speeds,
            "modes": [
                {"payload_kg": payload, **m._asdict(), "resonant": m.resonant}
                for payload, members in self.modes.items()
                for m in members
            ],
            "peaks": [p._asdict() for p in self.peaks],
            "crossings": [c._asdict() for c in self.crossings],
            "resonances": [r._asdict() for r in self.resonances],
            "avoid": [
                {"low_m_s": low, "high_m_s": high, "mode": members[0].mode, "order": members[0].order,
                 "ripple": {r.signal: r.ripple for r in members}, "rise": {r.signal: r.rise for r in members}}
                for low, high, members in self.ranges_to_avoid
            ],
            "quiet_m_s": self.quiet_ranges,
            "restless_m_s": self.unsettled_ranges,
        }  # fmt: skip


def _merge_ranges(ranges: Iterable[tuple[float, float]]) -> list[tuple[float, float]]:
    """Merges overlapping ranges, lowest first."""
    merged: list[tuple[float, float]] = []
    for low, high in sorted(ranges):
        if merged and low <= merged[-1][1]:
            merged[-1] = merged[-1][0], max(merged[-1][1], high)
        else:
            merged.append((low, high))
    return merged


def ripple_percent(value: float) -> str:
    """Ripple [%] as text for a sentence."""
    return "under 0.01 %" if value < 0.01 else f"{value:.0f} %" if value >= 10 else f"{value:.2g} %"


def _ranges_in_words(ranges: list[tuple[float, float, list[Resonance]]], excitation: str) -> str:
    """Ranges to avoid, the lowest speed first. Only the strongest if there are many."""
    strongest = sorted(ranges, key=lambda r: -max(x.rise for x in r[2]))[:RANGES_IN_SENTENCE]
    texts = []
    for low, high, members in sorted(strongest, key=lambda r: r[0]):
        mode, order = members[0].mode, members[0].order
        hertz = span_text(min(r.frequencies[0] for r in members), max(r.frequencies[1] for r in members), 1) + " Hz"
        cause = f"{mode} at {hertz} meets " * bool(mode) + (f"{order} × {excitation}" if order else hertz)
        ripple_text = ", ".join(f"{SIGNALS[r.signal].label} {ripple_percent(100 * r.ripple)}" for r in members)
        texts.append(f"{span_text(low, high)} mm/s ({cause}, ripple up to: {ripple_text})")
    more = len(ranges) - len(strongest)
    return "; ".join([*texts, *[f"{more} more on the map"] * bool(more)])


def span_text(low: float, high: float, unit: float = MM) -> str:
    """`low-high` in a unit, or one number if both print the same."""
    ends = f"{low / unit:.0f}", f"{high / unit:.0f}"
    return ends[0] if ends[0] == ends[1] else f"{ends[0]}-{ends[1]}"


_TOO_SLOW_MEANING = "travels, but fewer than {} {} passed. Use a longer --duration"
#: Most peaks that are not folded.
UNFOLDED = 30


def resonance_document(result: ResonanceResult, file: RobotFile) -> Document:
    """Report of a resonance map."""
    (first, *others), passing = result.sentences, result.passing
    lead = (
        f"**{result.configuration}**, slope {result.slope_deg:g}°, {result.surface}; {result.is_evaluated.size} runs."
    )
    values = passing.name, 1000 * passing.travel
    figure = catalogue.figure("resonance.map", result, finding=result.statement(), words=values)
    endings = run_tables.endings_table(
        result.statuses, meanings={TOO_SLOW: _TOO_SLOW_MEANING.format(PERIODS, passing.name)}
    )
    strong_peaks = result.strong_peaks
    peaks = [
        (
            Cell(SIGNALS[p.signal].label, "bad" if p in strong_peaks else ""), p.payload, p.speed / MM,
            f"{p.low / MM:.0f} to {p.high / MM:.0f}", 100 * p.ripple, 100 * p.rise, p.order or "none", p.frequency,
            p.mode or "none",
        )
        for p in result.peaks
    ]  # fmt: skip
    frequencies = [
        (
            payload, m.name,
            *(
                Cell(x, "" if m.resonant else "none")
                for x in (
                    m.frequency, f"{m.low:.1f} to {m.high:.1f}", m.natural, m.damping, 100 * m.share,
                    100 * m.positions,
                )
            ),
        )
        for payload, modes in result.modes.items()
        for m in modes
    ]  # fmt: skip
    mode_blocks = catalogue.note("resonance.modes"), catalogue.table("resonance.frequencies", frequencies)
    peaks_note = catalogue.note("resonance.peaks", passing.name, 100 * MATTERS)
    folded = count_noun(len(peaks), "peak") if len(peaks) > UNFOLDED else ""
    return Document(
        "Which speeds to avoid",
        first,
        (
            run_tables.note_on_robot(file, "track", lead),
            *remarks(others),
            figure if result.is_evaluated.any() else catalogue.note("resonance.still"),
        ),
        (
            Section("Natural frequencies", mode_blocks, "modes"),
            Section("Peaks of ripple against speed", (peaks_note,), "peaks"),
            Section("", (catalogue.table("resonance.peaks_found", peaks),), folded=folded),
            Section("How the runs ended", (catalogue.note("resonance.ended", 100 * TAIL), endings), "ended"),
        ),
    )
