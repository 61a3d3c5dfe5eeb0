"""Tables and documents as files."""

import csv

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from calibration.data import runs as records
from calibration.data import writing
from tests.commands import read_json


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
    found = read_json(tmp_path / "r.json")
    assert found == {"a": [1.5, None], "b": {"c": None}, "d": [3, True], "e": None}


def test_a_table_is_parquet_too_with_every_digit(tmp_path):
    from pyarrow import parquet

    columns = {"a": np.array([1 / 3, np.nan]), "word": np.array(["x", "y"])}
    writing.write_table(tmp_path / "t.csv", columns, "parquet")
    found = parquet.read_table(tmp_path / "t.parquet")
    assert_array_equal(found["a"].to_numpy(), columns["a"])
    assert found["word"].to_pylist() == ["x", "y"] and (tmp_path / "t.csv").read_text().startswith(
        "a,word\n0.333333333,x"
    )


def test_results_are_frames_of_every_library():
    table = {"a": np.array([0.5, 2.0]), "word": np.array(["x", "y"])}
    for frame in (writing.to_pandas(table), writing.to_polars(table)):
        assert list(frame.columns) == ["a", "word"] and frame["a"].to_numpy().tolist() == [0.5, 2.0]
    assert writing.to_xarray(table)["a"].values.tolist() == [0.5, 2.0]
    runs = records.read_runs("measured")
    dataset = writing.to_xarray(runs)
    units = {name: dataset[name].attrs.get("units") for name in dataset}
    assert units["motor_speed_rpm"] == "rpm" and units["speed_mm_s"] == "mm/s" and units["configuration"] is None
    assert writing.to_pandas(runs)["supply_voltage_V"].tolist() == runs["supply_voltage_V"].tolist()
    again = records.read_runs(writing.to_polars(runs))
    assert_array_equal(again.measured(), runs.measured())
    with pytest.raises(TypeError, match="expected a result with a table, got int"):
        writing.to_pandas(3)
