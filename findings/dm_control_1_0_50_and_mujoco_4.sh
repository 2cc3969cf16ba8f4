#!/bin/sh
# dm_control 1.0.50 declares mujoco>=3.17.0, so that pip installs mujoco 4.0.0 beside it, with which no task can be loaded:
# MjModel has no flex_vertedge any more. With 3.17.0 they load.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
for number in 4.0.0 3.17.0; do
    "$folder/venv/bin/pip" install --quiet dm_control==1.0.50 mujoco==$number
    "$folder/venv/bin/pip" check
    MUJOCO_GL=disable "$folder/venv/bin/python" - <<'PYTHON' | tee -a "$folder/said"
from importlib.metadata import version

from dm_control import suite

try:
    found = suite.load("cartpole", "balance").reset().step_type.name
except AttributeError as error:
    found = f"AttributeError: {error}"
print(f"dm_control {version('dm_control')}, mujoco {version('mujoco')}: {found}")
PYTHON
done
test "$(cat "$folder/said")" = "dm_control 1.0.50, mujoco 4.0.0: AttributeError: 'MjModel' object has no attribute 'flex_vertedge'
dm_control 1.0.50, mujoco 3.17.0: FIRST"
