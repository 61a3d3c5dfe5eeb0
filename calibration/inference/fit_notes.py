"""Remarks on a table or a fit, as data: names, tests and numbers. `mmrjax.describe` writes their sentences."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterable
from typing import Any, NamedTuple

from calibration.data import Json
from calibration.described import describe


@dataclasses.dataclass(frozen=True, init=False)
class Remark:
    """A remark on a table or a result, as data. `mmrjax.describe` writes its sentence.

    Attributes:
        code: code of its sentence in `calibration/words`.
        values: values in the sentence, by name. Each is an attribute too.
    """

    code: str
    values: Json = dataclasses.field(hash=False)

    def __init__(self, code: str, **values: Any) -> None:
        vars(self).update(code=code, values=values)

    def __getattr__(self, name: str) -> Any:
        if name in vars(self).get("values", ()):
            return self.values[name]
        raise AttributeError(f"remark {vars(self).get('code')}: no value {name}")


#: Remarks as results hold them: those of `calibration/data` are sentences already.
Notes = tuple[Remark | str, ...]


def remarks_with_codes(remarks: Iterable[Remark | str], *codes: str) -> list[Remark]:
    """Remarks that have one of these codes."""
    return [x for x in remarks if isinstance(x, Remark) and x.code in codes]


def progress_remark(name: str, *about: object) -> Remark:
    """Remark on the next step of a long computation: a row of `step_words.STEPS`, and the values for its sentence in
    order.
    """
    return Remark("step", name=name, about=about)


class DependentPair(NamedTuple):
    """Two parameters that the data determine only in combination.

    Attributes:
        one, other: names of the two parameters.
        correlation: correlation of their posterior.
        form: form of the combination: their `ratio`, their `product`, or `linear`: `one` + `weight` · `other`.
        weight: weight of `other` [unit of one / unit of other]. Negative if the difference is determined.
    """

    one: str
    other: str
    correlation: float
    form: str
    weight: float

    def to_json(self) -> dict[str, object]:
        """Entry of `together` in result.json."""
        return {"a": self.one, "b": self.other, "correlation": self.correlation, "determined": describe(self)}


def determination(name: str, is_held: bool, pairs: Iterable[DependentPair]) -> Remark:
    """Remark on the determination of a parameter by the data.

    Args:
        is_held: True if only its prior determines it.
        pairs: all pairs that data determine only in combination.
    """
    others = tuple(p.other if p.one == name else p.one for p in pairs if name in (p.one, p.other))
    return Remark("determined", held=is_held, others=others)


# --- adequacy of a fit ----------------------------------------------------------------------------------


class AdequacyFinding(NamedTuple):
    """Finding of an adequacy test. Among equal p-values, the order of the fields decides.

    Attributes:
        channel: channel of the residuals, "" if all.
        what: `repeats` or `stated` (residuals exceed the scatter of repeats or the stated noise), `follow` a
            variable, or `remember` the previous sample.
        variable: column, or name of the variable.
    """

    channel: str = ""
    what: str = ""
    variable: str = ""
