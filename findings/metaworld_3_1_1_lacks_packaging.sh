#!/bin/sh
# metaworld 3.1.1 cannot be imported where it was installed alone: it uses gymnasium.envs.mujoco, which imports packaging, and
# requires gymnasium without the extra "mujoco" that would bring it.
set -eu
folder=$(mktemp -d)
trap 'rm -rf "$folder"' EXIT
python3.11 -m venv "$folder/venv"
"$folder/venv/bin/pip" install --quiet metaworld==3.1.1 gymnasium==1.4.0
said=$("$folder/venv/bin/python" -c "import metaworld" 2>&1 | tail -1)
"$folder/venv/bin/pip" install --quiet packaging==26.3
then=$("$folder/venv/bin/python" -c "import metaworld; print('imported')" 2>&1 | tail -1)
echo "metaworld 3.1.1, gymnasium 1.4.0: $said; with packaging 26.3: $then"
test "$said; $then" = "ModuleNotFoundError: No module named 'packaging'; imported"
