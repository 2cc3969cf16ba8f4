#!/bin/sh
# The wheel of panda-gym 3.0.7 lacks colored_cube.png, which PandaFlip-v3 loads: the task cannot be made. PandaReach-v3 can.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet panda-gym==3.0.7 pybullet==3.2.7 gymnasium==1.4.0
"$folder/venv/bin/python" -W ignore - <<'PYTHON' > "$folder/said"
from importlib.metadata import files

import gymnasium as gym
import panda_gym  # registers

print("pictures in the wheel:", sum(each.suffix == ".png" for each in files("panda-gym")))
for name in ("PandaReach-v3", "PandaFlip-v3"):
    try:
        gym.make(name).reset(seed=0)
        print(name, "made")
    except Exception as error:
        print(name, type(error).__name__, error)
PYTHON
grep -v "^argv\|^pybullet" "$folder/said" | tee "$folder/found"
test "$(cat "$folder/found")" = "pictures in the wheel: 0
PandaReach-v3 made
PandaFlip-v3 error Error loading texture"
