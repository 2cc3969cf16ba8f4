"""The soak itself takes half an hour (``make soak``); that it would notice a leak is tested here."""

import pytest
from soak import ALLOWED, N_SAMPLES, grown


@pytest.mark.parametrize("name", ALLOWED)
def test_what_grows_is_told(name):
    flat = [dict.fromkeys(ALLOWED, 100.0) for _ in range(N_SAMPLES)]
    assert grown(flat) == []
    leaking = [sample | {name: 100.0 + i} for i, sample in enumerate(flat)]
    assert len(grown(leaking)) == 1 and grown(leaking)[0].startswith(f"{name}: 114.5 in the second quarter, 134.5")
    filling = [sample | {name: min(100.0, 10.0 * i)} for i, sample in enumerate(flat)]
    assert grown(filling) == []
