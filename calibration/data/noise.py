"""Standard deviations of the measured channels: from the file's columns, as stated, or to be estimated."""

from __future__ import annotations

import dataclasses
import math
import re

import numpy as np

from calibration.data.errors import BadConfiguration, BadData, choices
from calibration.data.runs import CHANNELS, DEVIATIONS, MM, RPM, Runs

#: Factor to SI of each channel's sd column, and the unit that `--noise` takes beside %.
TO_SI = (1.0, RPM, MM)
UNITS = ("A", "rpm", "mm/s")
#: Names that `--noise` takes for the channels.
WORDS = {"current": 0, "motor_speed": 1, "speed": 2, "total_current": 0}

#: Shares of the reading that the estimate starts from and does not fall below [-].
START, FLOOR = 0.02, 1e-3


@dataclasses.dataclass(frozen=True)
class Noise:
    """Where the sds come from, and what they are.

    Attributes:
        sd: [A, rad/s, m/s], shape (rows, 3); the first guess where estimated.
        estimated: whether a channel's sd is to be estimated from the misfit, shape (3,).
        source: one word a channel: `columns`, `stated` or `estimated`.
    """

    sd: np.ndarray
    estimated: np.ndarray
    source: tuple[str, str, str]


def parse(text: str) -> dict[int, tuple[float, bool]]:
    """`current=2%,motor_speed=0.5%,speed=1%` (or `current=0.05A,motor_speed=30rpm,speed=5mm/s`).

    Returns:
        Channel → (number, whether it is a share of the reading); absolute ones in SI.

    Raises:
        BadConfiguration: an unknown channel, no positive number, or another unit.
    """
    found: dict[int, tuple[float, bool]] = {}
    for part in text.split(","):
        name, _, value = part.strip().partition("=")
        if name not in WORDS:
            raise BadConfiguration(f"--noise {part.strip()}: no such channel; {choices(name, list(WORDS)[:3])}")
        channel = WORDS[name]
        match = re.fullmatch(r"\s*([-+0-9.eE]+)\s*(%|A|rpm|mm/s)\s*", value)
        unit = UNITS[channel]
        form = f"expected a positive number with % or {unit}, e.g. {name}=2% or {name}=0.1{unit}"
        try:
            size = float(match[1]) if match else math.nan
        except ValueError:
            size = math.nan
        if match is None or not size > 0 or math.isinf(size) or match[2] not in ("%", unit):
            raise BadConfiguration(f"--noise {part.strip()}: {form}")
        relative = match[2] == "%"
        found[channel] = (size / 100 if relative else size * TO_SI[channel], relative)
    return found


def of(runs: Runs, stated: str | None = None) -> Noise:
    """Noise of a table: `stated` channels as stated, else the file's sd columns, else to be estimated.

    An estimated channel has an sd proportional to its reading, one share for all rows. A reading of zero
    gets the share of the channel's largest reading a hundredth. Histories pass through zero while their
    instruments stay as they are: there a share is of the channel's root mean square, one sd for all rows.

    Raises:
        BadConfiguration: as `parse`.
        BadData: a channel that reads zero everywhere and has no stated sd.
    """
    shares = parse(stated) if stated else {}
    measured = np.abs(runs.measured())
    sd, source = np.empty_like(measured), []
    for k, column in enumerate(DEVIATIONS):
        if k not in shares and runs.has(column):
            sd[:, k] = runs[column] * TO_SI[k]
            source.append("columns")
            continue
        size, relative = shares.get(k, (START, True))
        largest = measured[:, k].max()
        if relative and largest == 0:
            raise BadData(
                f"{runs.source}: {CHANNELS[k]} reads 0 in every row; state its sd, e.g. --noise in {UNITS[k]}"
            )
        if runs.has("time_s"):
            reading = np.full(len(runs), np.sqrt(np.mean(measured[:, k] ** 2)))
        else:
            reading = np.maximum(measured[:, k], 0.01 * largest)
        sd[:, k] = size * reading if relative else size
        source.append("stated" if k in shares else "estimated")
    return Noise(sd, np.array([s == "estimated" for s in source]), tuple(source))  # type: ignore[arg-type]


#: What the loop takes the sd of a channel to be where neither the file nor the user says: averages of at least
#: three repeats, printed to 0.05 A, 10 rpm and 10 mm/s, as in Tables A1 and A2.
ASSUMED = "current=2%,motor_speed=0.5%,speed=1%"


def assumed(runs: Runs, stated: str | None = None, factor: float = 1.0) -> Noise:
    """As `of`, with `ASSUMED` times `factor` where a channel's sd would have to be estimated.

    Raises:
        BadConfiguration, BadData: as `of`.
    """
    known = of(runs, stated)
    if not known.estimated.any():
        return known
    guess = of(runs, ASSUMED)
    sd = np.where(known.estimated, factor * guess.sd, known.sd)
    words = tuple("assumed" if e else w for e, w in zip(known.estimated, known.source, strict=True))
    return Noise(sd, np.zeros(3, bool), words)  # type: ignore[arg-type]
