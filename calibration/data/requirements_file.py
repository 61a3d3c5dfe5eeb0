"""Requirements as TOML files: limits on a robot's performance over an envelope of use. Names include units."""

from __future__ import annotations

from dataclasses import dataclass, replace
from importlib import resources
from itertools import product
from pathlib import Path
from typing import Any

from calibration.data import Json
from calibration.data.input_errors import BadConfiguration, stated_as, stated_number, stated_word
from calibration.data.input_files import toml_content, toml_text
from mmrjax.derived.requirements import QUANTITIES
from mmrjax.model.paper_tables import BENCH, SURFACES
from mmrjax.model.quantities import AXES, CONDITIONS, Quantity

SCHEMA = "mmrjax.requirements/1"
#: The packaged file: the paper's aims.
PAPER = "paper"

Range = tuple[float, float]

#: Ranges of an envelope: least and greatest value, and unit.
RANGES: dict[str, tuple[float, float, str]] = {
    "payload_kg": (*CONDITIONS["payload"].range, "kg"),
    "slope_deg": (0.0, CONDITIONS["slope_deg"].range[1], "deg"),
    "state_of_charge": (0.0, 1.0, ""),
    "supply_voltage_V": (1.0, CONDITIONS["voltage"].range[1], "V"),
    "ambient_C": (-50.0, 80.0, "°C"),
}
#: Keys of an envelope.
KEYS = ("configuration", "surface", "battery", *RANGES)
#: Message on an unknown name.
NO_KEY = "no such key"
#: Uses of the battery, for the endurance.
DUTIES = ("standing", "driving")
#: Smallest and largest limit of a requirement, in the unit of its name.
STATED = (0.0, 1e6)
#: Key for the tread of stairs, and its smallest and largest value [mm].
STAIRS, TREAD, TREADS = "stairs_rise_mm", "tread_mm", (10.0, 5000.0)
#: Word for the rating of the part as limit, and the quantities for which parts have ratings.
RATED = "rated"
RATINGS = ("winding_C", "motor_speed_rpm", "gearbox_speed_rpm", "gearbox_Nm")


@dataclass(frozen=True)
class Envelope:
    """Ranges of the conditions under which a requirement must be met.

    Attributes:
        configuration: name of the configuration. Empty: the first one of the robot.
        surface: surface of Table 5.
        battery: True on the battery, False on the external supply.
        payload_kg, slope_deg, state_of_charge, supply_voltage_V: ranges, units as named.
        ambient_C: ambient temperature [°C]. None: that of the robot.
    """

    configuration: str = ""
    surface: str = BENCH
    battery: bool = True
    payload_kg: Range = (0.0, 0.0)
    slope_deg: Range = (0.0, 0.0)
    state_of_charge: Range = (1.0, 1.0)
    supply_voltage_V: Range | None = None
    ambient_C: Range | None = None

    @property
    def charge(self) -> Range:
        """Range of the state of charge or, with an external supply, of its voltage."""
        return self.state_of_charge if self.battery else (self.supply_voltage_V or (0.0, 0.0))

    @property
    def charge_end(self) -> float:
        """State of charge at the end of the battery's use: the lower end of its range. 0 if its range is a single
        number.
        """
        low, high = self.state_of_charge
        return low if low < high else 0.0

    def meets(self, other: Envelope) -> bool:
        """True if two envelopes have conditions in common."""
        if (self.configuration, self.surface, self.battery) != (other.configuration, other.surface, other.battery):
            return False
        pairs = [(getattr(self, key), getattr(other, key)) for key in RANGES]
        return all(a is None or b is None or (a[0] <= b[1] and b[0] <= a[1]) for a, b in pairs)


@dataclass(frozen=True)
class Requirement:
    """One requirement: a quantity with a limit.

    Attributes:
        name: name of the quantity, one of `QUANTITIES`.
        limit: limit in the unit of the name. None: the rating of the part.
        least: True if the quantity must be at least the limit, False if at most.
        envelope: conditions under which it has to be met.
        share: for endurance, share of the time that the robot drives. 0: it stands.
        tread_mm: for the rise of stairs, their tread [mm].
        source: origin of the requirement.
    """

    name: str
    limit: float | None
    least: bool
    envelope: Envelope
    share: float = 0.0
    source: str = ""
    tread_mm: float = 0.0

    @property
    def quantity(self) -> Quantity:
        """The quantity that is required."""
        return QUANTITIES[self.name]

    @property
    def sense(self) -> str:
        """`least` or `most`."""
        return "least" if self.least else "most"


@dataclass(frozen=True)
class Requirements:
    """A file of requirements.

    Attributes:
        source: name of the file.
        envelope: default envelope that the file states.
        each: requirements, in the order of the file.
        text: content of the file.
    """

    source: str
    envelope: Envelope
    each: tuple[Requirement, ...]
    text: str = ""


def load_requirements(path: Path | None) -> Requirements:
    """Requirements of a file or, without a file, the aims of the paper.

    Raises:
        BadConfiguration: there is no such file, or as in `parse_requirements`.
    """
    if path is None or str(path) == PAPER:
        packaged = resources.files("calibration") / "data" / "aims" / f"{PAPER}.toml"
        return parse_requirements(packaged.read_text("utf-8"), f"{PAPER}.toml")
    if not path.is_file():
        raise BadConfiguration(f"{path}: no such file; expected a TOML file (docs/howto/requirements.md)")
    return parse_requirements(toml_text(path, path), path.name)


def parse_requirements(text: str, where: str) -> Requirements:
    """Requirements from the text of a file.

    The file states quantities by name. The value of each is a number (the smallest or largest allowed value,
    depending on the quantity), a table, or a list of tables. For some quantities it may be "rated" (the rating of the
    part). A table has `least`, `most`, `source`, and keys of the envelope for this requirement only. For endurance it
    also states `duty` (standing, or driving at full voltage for a `share` of the time).

    `[envelope]` applies to all requirements: payload_kg, slope_deg, state_of_charge or supply_voltage_V, ambient_C
    (a number or [least, greatest]), surface, configuration, and battery.

    Raises:
        BadConfiguration: the text is not TOML or has no requirement. A key is unknown or lacks its unit. A value is
            not a finite number, or a range is empty. Requirements contradict one another or the envelope.
    """
    content = toml_content(text, where)
    schema = content.pop("schema", SCHEMA)
    if schema != SCHEMA:
        raise BadConfiguration(f"{where}, schema: got {schema!r}; expected {SCHEMA}")
    place = f"{where}, envelope"
    table = stated_as(content.pop("envelope", {}), dict, place, f"a table of {', '.join(KEYS)}")
    envelope = _updated_envelope(Envelope(), table, place)
    requirements: list[Requirement] = []
    for name, value in content.items():
        stated_word(name, (*QUANTITIES, "envelope"), f"{where}, {name}", NO_KEY)
        entries = value if isinstance(value, list) else [value]
        if not entries:
            raise BadConfiguration(
                f"{where}, {name}: got an empty list; expected a number or tables with least or most"
            )
        for k, entry in enumerate(entries, 1):
            place = f"{where}, {name} {k}" if len(entries) > 1 else f"{where}, {name}"
            requirements += _requirements_of_entry(name, entry, envelope, place)
    if not requirements:
        raise BadConfiguration(f"{where}: contains no requirement; expected one of {', '.join(QUANTITIES)}")
    _check_consistent(requirements, envelope, where)
    return Requirements(where, envelope, tuple(requirements), text)


def _parse_range(value: Any, where: str, low: float, high: float, unit: str) -> Range:
    ends = value if isinstance(value, list) else [value, value]
    if len(ends) != 2:
        raise BadConfiguration(f"{where}: got {value}; expected a number or [least, greatest]")
    first, last = (stated_number(x, where, low, high, unit) for x in ends)
    if first > last:
        raise BadConfiguration(f"{where}: got {value}, an empty range; expected [least, greatest]")
    return first, last


def _updated_envelope(base: Envelope, stated: Json, where: str) -> Envelope:
    """Envelope with the stated values in place of those of `base`."""
    envelope: Json = {}
    for key, value in stated.items():
        key_path = f"{where}.{key}"
        stated_word(key, KEYS, f"{where}, {key}", NO_KEY)
        if key in RANGES:
            envelope[key] = _parse_range(value, key_path, *RANGES[key])
        elif key == "battery":
            envelope[key] = stated_as(value, bool, key_path, "true or false")
        elif key == "surface":
            envelope[key] = stated_word(value, SURFACES, key_path, f"got {value!r}")
        else:
            envelope[key] = stated_as(value, str, key_path, "the name of a configuration")
    contradicting = next((key for key in ("battery", "state_of_charge") if envelope.get(key)), None)
    if "supply_voltage_V" in envelope:
        if contradicting is not None:
            raise BadConfiguration(
                f"{where}: {contradicting} and supply_voltage_V contradict each other; give one of them"
            )
        envelope["battery"] = False
    elif "state_of_charge" in envelope and not envelope.setdefault("battery", True):
        raise BadConfiguration(f"{where}: state_of_charge needs the battery; got battery = false")
    merged = replace(base, **envelope)
    if not merged.battery and merged.supply_voltage_V is None:
        raise BadConfiguration(f"{where}: battery = false needs supply_voltage_V, which is missing")
    return merged


def _requirements_of_entry(name: str, value: Any, envelope: Envelope, where: str) -> list[Requirement]:
    """Requirements of one entry: at least, at most, or both."""
    quantity = QUANTITIES[name]
    is_endurance = name == "endurance_min"
    table = value if isinstance(value, dict) else {"least" if quantity.least else "most": value}
    further_keys = {"endurance_min": ("duty", "share"), STAIRS: (TREAD,)}.get(name, ())
    for key in table:
        if key in ("duty", "share") and not is_endurance:
            raise BadConfiguration(f"{where}: duty and share can be used only with endurance_min")
        stated_word(key, ("least", "most", "source", *KEYS, *further_keys), f"{where}, {key}", NO_KEY)
        if key in AXES and key not in quantity.axes:
            raise BadConfiguration(f"{where}, {key}: {quantity.label} does not depend on it; remove it")
    limits = {sense: _parse_limit(table[sense], where, quantity) for sense in ("least", "most") if sense in table}
    if not limits:
        raise BadConfiguration(f"{where}: expected least, most or both [{quantity.unit}]")
    source = stated_as(table.get("source", ""), str, f"{where}, source", "text")
    tread = 0.0
    if name == STAIRS:
        if TREAD not in table:
            raise BadConfiguration(
                f"{where}: stairs without a tread; expected a table such as {{ least = 170, {TREAD} = 290 }}"
            )
        tread = stated_number(table[TREAD], f"{where}, {TREAD}", *TREADS, "mm")
    envelope = _updated_envelope(envelope, {key: table[key] for key in KEYS if key in table}, where)
    if is_endurance and not envelope.battery:
        raise BadConfiguration(f"{where}: endurance needs the battery, but the envelope sets supply_voltage_V")
    if name == "speed_end_of_charge_m_s":
        if not envelope.battery:
            raise BadConfiguration(
                f"{where}: an end of charge needs the battery, but the envelope sets another supply"
            )
        envelope = replace(envelope, state_of_charge=(envelope.charge_end, envelope.charge_end))
    share = _parse_share(table.get("duty"), table.get("share"), where)
    return [
        Requirement(name, limit, sense == "least", envelope, share, source, tread) for sense, limit in limits.items()
    ]


def _parse_limit(value: Any, where: str, quantity: Quantity) -> float | None:
    if value == RATED:
        if quantity.column not in RATINGS:
            raise BadConfiguration(
                f"{where}: got {RATED!r}; expected a number; only {', '.join(RATINGS)} have a rating"
            )
        return None
    limits = RANGES["slope_deg"][:2] if quantity.unit == "deg" else STATED
    return stated_number(value, where, *limits, quantity.unit)


def _parse_share(duty: Any, share: Any, where: str) -> float:
    if duty is not None:
        stated_word(duty, DUTIES, f"{where}, duty", f"got {duty!r}")
    if share is None:
        return 1.0 if duty == "driving" else 0.0
    share_value = stated_number(share, f"{where}, share", 0.0, 1.0, "")
    if duty == "standing" and share_value > 0:
        raise BadConfiguration(f"{where}: duty standing and a share of {share_value:g} contradict each other")
    return share_value


#: Quantities that are computed as another quantity, at a certain point of the envelope.
_SAME = {"speed_end_of_charge_m_s": "speed_m_s", "gearbox_speed_rpm": "motor_speed_rpm"}


def _check_consistent(requirements: list[Requirement], envelope: Envelope, where: str) -> None:
    limits = [(r, r.limit) for r in requirements if r.limit is not None]
    for (a, least), (b, most) in product(limits, limits):
        subject_a, subject_b = ((_SAME.get(r.name, r.name), r.share, r.tread_mm) for r in (a, b))
        if a.least and not b.least and least > most and subject_a == subject_b and a.envelope.meets(b.envelope):
            unit = a.quantity.unit
            raise BadConfiguration(
                f"{where}: {a.name} at least {least:g} {unit} and {b.name} at most {most:g} {unit} contradict "
                "each other"
            )
    for r, limit in limits:
        key = r.name
        range_ = {"payload_kg": envelope.payload_kg, "slope_deg": envelope.slope_deg}.get(key)
        if r.name == "winding_C":
            key, range_ = "ambient_C", r.envelope.ambient_C
        if range_ is not None and limit < range_[1] and (r.least or key == "ambient_C"):
            raise BadConfiguration(
                f"{where}: {r.name} of at {r.sense} {limit:g} contradicts the envelope, whose {key} goes up to "
                f"{range_[1]:g}"
            )
