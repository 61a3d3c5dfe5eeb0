"""Tables and documents as files."""

import csv
import json

import numpy as np

from calibration.data import writing


def test_numbers_keep_nine_digits_and_what_is_not_finite_is_left_empty(tmp_path):
    writing.write_table(
        tmp_path / "t.csv", {"a": np.array([1 / 3, np.nan, -np.inf]), "word": np.array(["x", "y", "z"])}
    )
    rows = list(csv.reader((tmp_path / "t.csv").read_text(encoding="utf-8").splitlines()))
    assert rows == [["a", "word"], ["0.333333333", "x"], ["", "y"], ["", "z"]]


def test_what_is_not_finite_is_null(tmp_path):
    content = {
        "a": np.array([1.5, np.nan]),
        "b": {"c": np.float64(np.inf)},
        "d": (np.int64(3), True),
        "e": float("nan"),
    }
    writing.write_json(tmp_path / "r.json", content)
    found = json.loads((tmp_path / "r.json").read_text(encoding="utf-8"))
    assert found == {"a": [1.5, None], "b": {"c": None}, "d": [3, True], "e": None}
