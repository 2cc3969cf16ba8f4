"""Where and with what a training ran."""

import os
import platform
import subprocess
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import torch as th

PACKAGES = (
    *("sb3_ddiffpg", "stable_baselines3", "rl_zoo3", "torch", "gymnasium", "gymnasium_robotics", "mujoco", "pybullet"),
    *("numpy", "scipy", "numba"),
)


def git_commit() -> str | None:
    """
    :return: The commit of this package's checkout, marked where files differ from it; None if it is installed without one
    """
    try:
        # Or it is somebody else's checkout, into which this was installed
        _git("ls-files", "--error-unmatch", Path(__file__).name)
        return _git("describe", "--always", "--dirty")
    except (OSError, subprocess.CalledProcessError):
        return None


def _git(*words: str) -> str:
    done = subprocess.run(["git", "-C", Path(__file__).parent, *words], capture_output=True, text=True, check=True)
    return done.stdout.strip()


def machine() -> dict[str, Any]:
    """
    :return: System, processor, cores that this process may use, threads of PyTorch, accelerator
    """
    return {
        "system": f"{platform.system()} {platform.machine()}",
        "processor": _processor(),
        "cores": len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count(),
        "torch_threads": th.get_num_threads(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()


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
