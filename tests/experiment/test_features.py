"""Labels of features."""

from __future__ import annotations

from itertools import product

import numpy as np

from splatsoil.experiment.features import Layout, Site


def test_a_part_of_the_data_is_what_one_instrument_says_in_one_stage() -> None:
    """Against every pair of features; a stage that comes back is the same stage."""
    channels, stages = ("left", "right", "left", "force"), ("pushing", "pause", "pause", "pushing", "withdrawal")
    sites = tuple(Site(channel, float(k), 0.0) for k, channel in enumerate(channels))
    regions = np.full((len(stages), len(sites)), "berm")
    layout = Layout(tuple(map(float, range(len(stages)))), sites, "frame", "grey levels", stages, regions)
    for (t, s), (u, r) in product(product(range(len(stages)), range(len(sites))), repeat=2):
        same = stages[t] == stages[u] and channels[s] == channels[r]
        assert (layout.parts[t, s] == layout.parts[u, r]) == same
