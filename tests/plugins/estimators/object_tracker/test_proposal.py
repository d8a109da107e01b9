"""Where things are looked for that nobody clicked."""

from __future__ import annotations

import numpy as np

from hoigs.plugins.estimators.object_tracker.proposal import with_everybody


def test_things_are_looked_for_where_nobody_is_lost() -> None:
    """Somebody whose mask is lost moves, and would be taken for a thing."""
    people = [np.zeros((10, 33, 4)) for _ in range(2)]
    for person in people:
        person[:, 0, 3] = 0.9
    people[1][6:] = np.nan
    assert with_everybody(10, people) == [0, 1, 2, 3, 4, 5]
    people[1][2:] = np.nan  # two frames tell too little
    assert with_everybody(10, people) == list(range(10)) == with_everybody(10, ())
