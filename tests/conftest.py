"""Settings for all tests."""

import torch as th

# Small networks and two test processes: more threads than one only get into each other's way
th.set_num_threads(1)
