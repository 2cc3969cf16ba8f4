"""Where and with what a training ran."""

import platform
import subprocess
from pathlib import Path
from typing import Any

import torch as th

from sb3_ddiffpg.utils.processors import n_processors


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
        "cores": n_processors(),
        "torch_threads": th.get_num_threads(),
        "gpu": th.cuda.get_device_name() if th.cuda.is_available() else None,
    }


def _processor() -> str:
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        return next(line.split(":")[1].strip() for line in lines if line.startswith("model name"))
    except (OSError, StopIteration):
        return platform.processor()
