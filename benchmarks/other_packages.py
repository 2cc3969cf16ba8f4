"""
Environments of other packages, each in a virtual environment of its own with the pinned versions of ``packages/ROW.txt``: a
training of a few thousand steps with DDiffPG's default settings in each. It made the rows of docs/guides/environments.md.

Usage: ``python benchmarks/other_packages.py [ROW ...] [--steps 4000] [--folder DIR] [--installed]``
"""

import argparse
import os
import subprocess
import sys
import time
import venv
from importlib.metadata import version
from pathlib import Path

HERE = Path(__file__).resolve().parent
# Row -> what is trained in: id with the module that registers it, and arguments of gym.make
ROWS: dict[str, dict[str, dict[str, str]]] = {
    "gymnasium-robotics": {
        "gymnasium_robotics:FetchReach-v4": {},
        "gymnasium_robotics:HandReach-v3": {},
        "gymnasium_robotics:FrankaKitchen-v1": {},
        "gymnasium_robotics:AdroitHandDoor-v1": {},
        "gymnasium_robotics:PointMaze_UMaze-v3": {},
        "gymnasium_robotics:AntMaze_UMaze-v5": {},
    },
    "gymnasium": {"LunarLanderContinuous-v3": {}, "BipedalWalker-v3": {}, "Hopper-v5": {}, "Ant-v5": {}},
    "dm_control": {"shimmy:dm_control/point_mass-easy-v0": {}, "shimmy:dm_control/reacher-easy-v0": {}},
    "metaworld": {"metaworld:Meta-World/MT1": {"env_name": "reach-v3"}},
    "panda-gym": {"panda_gym:PandaReach-v3": {}, "panda_gym:PandaPush-v3": {}},
    "gym-pusht": {"gym_pusht:gym_pusht/PushT-v0": {}},
    "highway-env": {"highway_env:parking-v0": {}, "highway_env:racetrack-v1": {}},
}
ROWS["dm_control-newest"] = ROWS["dm_control"]
# SB3 takes no dict within a dict
FLATTENED = ("gymnasium_robotics:FrankaKitchen-v1",)
PACKAGES = (
    *("mujoco", "gymnasium-robotics", "box2d", "dm-control", "shimmy", "metaworld", "panda-gym", "pybullet", "gym-pusht"),
    "highway-env",
)


def main() -> None:
    """Make the environments that are asked for, and train in each."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("rows", nargs="*", metavar="ROW", help=", ".join(ROWS))
    parser.add_argument("--steps", type=int, default=4_000)
    parser.add_argument("--folder", type=Path, default=Path("logs/packages"), help="of the virtual environments, which stay")
    parser.add_argument("--installed", action="store_true", help="train with this Python and what is installed for it")
    given = parser.parse_args()
    for row in given.rows or ROWS:
        if row not in ROWS:
            parser.error(f"ROW: {row!r} given; accepted are {', '.join(ROWS)}")
        if given.installed:
            train(row, given.steps)
        else:
            python = install(given.folder / row, HERE / "packages" / f"{row}.txt")
            again = [python, "-W", "ignore", __file__, row, "--steps", str(given.steps), "--installed"]
            subprocess.run(again, check=True, env={**os.environ, "PYTHONPATH": str(HERE.parent), "OMP_NUM_THREADS": "1"})


def install(folder: Path, requirements: Path) -> str:
    """
    :param folder: Where the virtual environment goes; one that is there is used again
    :param requirements: What is installed in it
    :return: Its Python
    """
    python = folder / "bin" / "python"
    if not python.exists():
        venv.create(folder, with_pip=True)
    subprocess.run([python, "-m", "pip", "install", "--quiet", "-r", requirements], check=True)
    return str(python.absolute())


def train(row: str, steps: int) -> None:
    """
    :param row: Of the table
    :param steps: Of each training
    """
    import numpy as np
    from gymnasium.wrappers import FlattenObservation

    from sb3_ddiffpg import DDiffPG
    from sb3_ddiffpg.envs import make_vec_env
    from sb3_ddiffpg.utils.versions import versions

    there = [f"{name} {number}" for name, number in versions().items() if name in ("python", "gymnasium", "stable_baselines3")]
    for name in PACKAGES:
        try:
            there.append(f"{name} {version(name)}")
        except ImportError:
            continue
    print(f"{row}: {', '.join(there)}", flush=True)
    for env_id, env_kwargs in ROWS[row].items():
        wrapper = FlattenObservation if env_id in FLATTENED else None
        env = make_vec_env(env_id, 4, seed=0, wrapper_class=wrapper, **env_kwargs)
        policy = "MultiInputPolicy" if hasattr(env.observation_space, "spaces") else "MlpPolicy"
        started = time.perf_counter()
        model = DDiffPG(policy, env, seed=0, device="cpu").learn(steps)
        taken = time.perf_counter() - started
        actions, _ = model.predict(env.reset(), deterministic=True)
        assert np.isfinite(actions).all() and model._n_updates > 0
        shown = f"{model.num_timesteps} steps, {model._n_updates} updates, {len(model.modes)} modes, {taken:.0f} s"
        print(f"  {env_id}: {env.observation_space.__class__.__name__}, {shown}", flush=True)
        env.close()


if __name__ == "__main__":
    sys.exit(main())
