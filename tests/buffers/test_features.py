"""What the networks see of an observation."""

import numpy as np
import pytest
import torch as th
from environments import TwoEnds, small_model
from gymnasium import spaces
from hypothesis import given
from hypothesis import strategies as st

from sb3_ddiffpg.networks.extractors import ScaledFlattenExtractor


@given(st.floats(-100, 100), st.floats(1e-2, 100), st.floats(0.1, 20), st.floats(0, 1))
def test_bounds_come_to_lie_where_they_are_told(low, width, half_width, share):
    """And what is between them in proportion; a component without bounds passes."""
    space = spaces.Box(np.array([low, -np.inf], np.float32), np.array([low + width, np.inf], np.float32))
    seen = ScaledFlattenExtractor(space, half_width)(th.tensor([[low + share * width, low]], dtype=th.float32))
    # Single precision is all that an observation has
    assert seen[0, 0].item() == pytest.approx(half_width * (2 * share - 1), abs=1e-4 * half_width * (1 + abs(low) / width))
    assert seen[0, 1].item() == np.float32(low)


def test_a_model_is_told_by_its_policys_arguments():
    for kwargs, seen in (({}, [2.0, -1.0]), ({"half_width": 8}, [8.0, -4.0])):
        model = small_model(TwoEnds(), policy_kwargs={"net_arch": [16], "features_extractor_kwargs": kwargs})
        for extractor in (model.actor.features_extractor, model.policy.critic_features_extractor):
            np.testing.assert_allclose(extractor(th.tensor([[2.0, -1.0]])), [seen])  # TwoEnds' bounds are -2 and 2
    for wrong in (0.0, -1.0, np.inf, np.nan, "wide"):
        with pytest.raises(ValueError, match=r"features_extractor_kwargs\['half_width'\] must be positive"):
            small_model(TwoEnds(), policy_kwargs={"features_extractor_kwargs": {"half_width": wrong}})
