"""Programs on disk whose equations leave arguments out: each reads its own."""

import numpy as np
import pytest
from numpy.testing import assert_array_equal
from test_programs import folder  # noqa: F401 (a fixture)

from mmrjax.compile import programs


def one_of(numbers, which):
    """Twice one of some arrays."""
    return 2 * numbers[which]


one_of.__module__ = "mmrjax.one_of"  # of what is kept by name


@pytest.mark.parametrize("others", [2, 3])
def test_programs_that_read_other_arguments_are_not_one(folder, others):  # noqa: F811
    """What is compiled of the first and of the second array is the same text but for the arguments that neither reads."""
    kept = programs.Programs(one_of)
    pair = [np.array([1.0, 2.0]), np.array([5.0, 7.0])]
    for arrays, which in ((pair, 0), (pair, 1), ([pair[0], np.arange(float(others))], 0)):
        arguments = (arrays, which), {}
        assert_array_equal(kept.of(arguments)(arguments), 2 * arrays[which])


def test_options_that_the_compiler_does_not_have_are_left_out(folder):  # noqa: F811
    kept = programs.Programs(one_of, {"xla_no_such_option": 1})
    arguments = ([np.array([1.0, 2.0])], 0), {}
    assert_array_equal(kept.of(arguments)(arguments), [2.0, 4.0])
