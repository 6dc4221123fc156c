"""4D volumes and decisions on flight plans, compared with an independent oracle."""

import airspace_oracle
import pytest
from depth import examples


@pytest.mark.parametrize("batch", range(4))
def test_overlaps_of_random_volumes_equal_those_of_the_oracle(batch):
    count = examples(2500, 100)
    seeds = range(batch * count, (batch + 1) * count)
    assert [(seed, found) for seed in seeds if (found := airspace_oracle.pair_deviation(seed))] == []
    assert count / 6 < sum(airspace_oracle.overlaps(seed) for seed in seeds) < count * 4 / 5


@pytest.mark.parametrize("batch", range(4))
def test_decisions_of_random_histories_equal_those_of_the_oracle(batch):
    count = examples(500, 30)
    seeds = range(batch * count, (batch + 1) * count)
    assert [(seed, found) for seed in seeds if (found := airspace_oracle.history_deviation(seed))] == []


def test_random_histories_reach_every_rule():
    reached = airspace_oracle.histories_reach(range(120))
    assert min(reached.values()) > 0, reached
