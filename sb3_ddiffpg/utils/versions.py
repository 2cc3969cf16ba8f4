"""Versions of the packages on which results depend."""

import platform
from importlib.metadata import PackageNotFoundError, version

PACKAGES = (
    *("sb3_ddiffpg", "stable_baselines3", "rl_zoo3", "torch", "gymnasium", "gymnasium_robotics", "mujoco", "pybullet"),
    *("numpy", "scipy", "numba"),
)


def versions() -> dict[str, str]:
    """
    :return: Of Python and the packages that decide on a result
    """
    found = {"python": platform.python_version()}
    for name in PACKAGES:
        try:
            found[name] = version(name)
        except PackageNotFoundError:
            continue
    return found
