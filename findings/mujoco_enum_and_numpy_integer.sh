#!/bin/sh
# From mujoco 3.12 on `enum == number` is False for a NumPy integer of the same value, while `number == enum` is True; up to 3.11
# both are. `number in (enum, ...)` asks the former: by that gymnasium-robotics 1.4.2 raises a bare AssertionError in its Fetch, Hand
# and Kitchen tasks.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
said=""
for number in 3.11.0 3.12.0; do
    "$folder/venv/bin/pip" install --quiet numpy==2.4.6 mujoco==$number
    said="$said$("$folder/venv/bin/python" - <<'PYTHON'
import mujoco

model = mujoco.MjModel.from_xml_string("<mujoco><worldbody><body><freejoint/><geom size='1'/></body></worldbody></mujoco>")
number, enum = model.jnt_type[0], mujoco.mjtJoint.mjJNT_FREE
print(mujoco.__version__, bool(number == enum), bool(enum == number), end="; ")
PYTHON
)"
done
echo "mujoco, number == enum, enum == number: $said"
test "$said" = "3.11.0 True True; 3.12.0 True False; "
