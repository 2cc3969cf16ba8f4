"""A training that is killed with SIGKILL, again and again, at moments it does not choose."""

import os
import random
import subprocess
import sys
import time

import pytest

# More of them: KILLS=200 make slow
N_KILLS = int(os.environ.get("KILLS", "6"))
SAVE_FREQ = 400
SCRIPT = f"""
import sys
import torch as th
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.logger import Logger
from sb3_ddiffpg import DDiffPG
from sb3_ddiffpg.callbacks.checkpoint import RunCheckpointCallback
from sb3_ddiffpg.saving.checkpoint import checkpoint_files
from sb3_ddiffpg.envs import make_vec_env

class Says(BaseCallback):
    def _on_step(self):
        print(self.num_timesteps, flush=True)
        return True

th.set_num_threads(1)
env = make_vec_env("PointMazeV1-v0", 4, seed=0, max_episode_steps=40)
folder = sys.argv[1]
if checkpoint_files(folder):
    model = DDiffPG.resume(folder, env)
else:
    model = DDiffPG("MlpPolicy", env, learning_starts=100, batch_size=32, policy_kwargs={{"net_arch": [16]}}, seed=0)
model.set_logger(Logger(None, []))
print(model.num_timesteps, flush=True)
model.learn(10**8, callback=[Says(), RunCheckpointCallback(folder, save_freq={SAVE_FREQ})])
"""


@pytest.mark.slow
def test_every_restart_goes_on(tmp_path):
    """What is lost is never more than the steps between two checkpoints."""
    rng = random.Random(0)
    reached = 0
    for kill in range(N_KILLS):
        process = subprocess.Popen([sys.executable, "-c", SCRIPT, str(tmp_path)], stdout=subprocess.PIPE, text=True)
        begins = int(process.stdout.readline())
        assert begins >= reached - SAVE_FREQ - 4, f"kill {kill}: {reached} steps were done, it goes on at {begins}"
        assert begins or reached <= SAVE_FREQ
        steps, last = rng.uniform(0.0, 3 * SAVE_FREQ), begins
        while last < begins + steps:
            last = int(process.stdout.readline())
        time.sleep(rng.uniform(0.0, 0.05))  # not only where it has just said something
        process.kill()
        said = process.communicate()[0].split("\n")[:-1]  # the last may be half a line
        reached = max([reached, begins, *map(int, said)])
    assert reached > SAVE_FREQ
