"""The soak itself takes half an hour (``make soak``); that it would notice a leak is tested here."""

import mmap

import numpy as np
import psutil
import pytest
from soak import ALLOWED, N_SAMPLES, grown, memory_mb


@pytest.mark.parametrize("name", ALLOWED)
def test_what_grows_is_told(name):
    flat = [dict.fromkeys(ALLOWED, 100.0) for _ in range(N_SAMPLES)]
    assert grown(flat) == []
    leaking = [sample | {name: 100.0 + i} for i, sample in enumerate(flat)]
    assert len(grown(leaking)) == 1 and grown(leaking)[0].startswith(f"{name}: 114.5 in the second quarter, 134.5")
    filling = [sample | {name: min(100.0, 10.0 * i)} for i, sample in enumerate(flat)]
    assert grown(filling) == []


@pytest.mark.skipif(not psutil.LINUX, reason="elsewhere, a process's shared memory is not told apart")
def test_memory_is_data_not_files(tmp_path):
    process, megabytes = psutil.Process(), 64
    path = tmp_path / "library"
    path.write_bytes(bytes(megabytes * 2**20))
    before = memory_mb(process)
    mapped = np.memmap(path, mode="r")
    assert mapped.max() == 0  # all of its pages are in memory now
    assert memory_mb(process) - before < megabytes / 4
    data = mmap.mmap(-1, len(mapped), flags=mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS)  # an array's could come from a freed one's
    np.frombuffer(data, dtype=np.uint8).fill(1)
    assert memory_mb(process) - before > megabytes * 3 / 4
    del mapped
