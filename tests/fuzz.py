"""
The tests of ``test_hostile_input.py``, with inputs that a fuzzer makes out of what they reach in the code. Needs ``pip install
atheris``; an input that fails is written to a file ``crash-*``, one that takes too long to ``timeout-*``.

    python tests/fuzz.py                                    # names of the tests
    python tests/fuzz.py a_maze_of_any_rows -runs=100000    # libFuzzer's options: -max_total_time=3600, -timeout=60, ...
"""

import sys
import warnings
from pathlib import Path

import atheris

sys.path.insert(0, str(Path(__file__).parent / "saving"))

# Numba compiles ``dtw`` and must see it as it is
with atheris.instrument_imports(include=["sb3_ddiffpg"], exclude=["sb3_ddiffpg.clustering.dtw"]):
    import test_hostile_input

TESTS = {name.removeprefix("test_"): test for name, test in vars(test_hostile_input).items() if hasattr(test, "hypothesis")}


def main() -> None:
    """Read the command line and fuzz until told to stop."""
    if len(sys.argv) < 2 or sys.argv[1] not in TESTS:
        sys.exit("\n".join(["Accepted are", *TESTS]))
    name, *options = sys.argv[1:]
    warnings.simplefilter("ignore")
    limits = ["-timeout=60", "-rss_limit_mb=4096", "-max_len=4096", "-len_control=0"]  # short ones make no input
    TESTS[name].hypothesis.fuzz_one_input(bytes(4096))  # what is made once takes longer than an input may
    atheris.Setup([sys.argv[0], *limits, *options], TESTS[name].hypothesis.fuzz_one_input)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
