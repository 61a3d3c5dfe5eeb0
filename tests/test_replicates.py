"""One minimum of bootstrap tables: what the command makes is enough for every kind of evidence."""

import pytest

from calibration.discovery.settings import SHARES, fewest_replicates
from calibration.inference.observers import Histories, SettledRuns
from sweeps import config


@pytest.mark.parametrize("kind", [Histories, SettledRuns])
def test_the_fewest_tables_let_every_kind_of_evidence_count(kind):
    fewest, smallest = fewest_replicates(kind), min(SHARES[kind.evidence])
    assert 1 / (1 + fewest) <= smallest < 1 / fewest


def test_the_option_says_the_minimum():
    field = config.Loop.model_fields["replicates"]
    least = next(m.ge for m in field.metadata if hasattr(m, "ge"))
    assert fewest_replicates(SettledRuns) <= least <= fewest_replicates(Histories)
    assert str(fewest_replicates(Histories)) in str(field.description)
