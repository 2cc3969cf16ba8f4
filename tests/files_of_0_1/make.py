"""
How the files in this folder were made, by version 0.1.0 (commit cb786e4): of each algorithm a .zip, a safe file, a checkpoint,
a replay buffer, and what the model did.

``PYTHONPATH=<checkout of cb786e4> python make.py FOLDER``
"""

import shutil
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import numpy as np
from sb3_ddiffpg.checkpoints import RunCheckpointCallback, checkpoint_files
from sb3_ddiffpg.schedules import LateLinearSchedule

from sb3_ddiffpg import DDiffPG, __version__
from sb3_ddiffpg.baselines import BASELINES
from sb3_ddiffpg.envs import make_vec_env

MAZE = ["#######", "#g.r.g#", "#######"]
COMMON: dict[str, Any] = dict(
    learning_rate=LateLinearSchedule(1e-3),
    learning_starts=400,
    batch_size=64,
    gamma=0.97,
    buffer_size=1_200,
    gradient_steps=1,
    novelty_kwargs={"table_size": 64},
    seed=0,
    device="cpu",
    policy_kwargs={"net_arch": [8, 8]},
)
OWN: dict[str, dict[str, Any]] = {
    "ddiffpg": dict(
        v_max=10,
        reward_scale=5,
        intrinsic_coef=0.1,
        exploration_n_steps=3,
        explore_past_modes=False,
        new_way_coef=1.0,
        switch_modes=0.3,
        mode_trials=4000,
        min_mode_size=3,
        action_lr=0.2,
        action_optimizer="normalized",
        n_action_gradient_steps=3,
        replay_buffer_kwargs={"compared_length": 6.0, "min_direct": 4},
    ),
    "ddiffpg_rnd": dict(novelty="rnd", novelty_kwargs={"net_arch": [8, 8]}, twin_target="elementwise", episodic_novelty=False),
    "dipo": dict(action_lr=0.2, n_diffusion_steps=3, v_max=10, reward_scale=5),
    "diffusion_ql": dict(n_candidates=4, v_max=10),
    "consistency_ac": dict(n_steps=3, normalize_intrinsic=False),
    "rpg": dict(n_steps=2, latent_dim=3, intrinsic_coef=0.1, v_max=10),
    "sac_c51": dict(n_atoms=1, intrinsic_clip=5.0),
    "td3_c51": dict(policy_delay=2, target_policy_noise=0.2, target_noise_clip=0.5),
}


def main(folder: Path) -> None:
    """Write them all."""
    assert __version__ == "0.1.0"
    algorithms: dict[str, Any] = {"ddiffpg": DDiffPG, "ddiffpg_rnd": DDiffPG, **BASELINES}
    for name, own in OWN.items():
        place = folder / name
        place.mkdir(parents=True, exist_ok=True)
        env = make_vec_env("PointMazeV1-v0", n_envs=8, seed=0, maze_map=MAZE)
        with warnings.catch_warnings(), tempfile.TemporaryDirectory() as scratch:
            warnings.simplefilter("ignore")
            model = algorithms[name]("MlpPolicy", env, **{**COMMON, **own})
            model.learn(12_000, RunCheckpointCallback(scratch, save_freq=8_000, keep=1))
            shutil.copy(checkpoint_files(scratch)[0], place / "checkpoint_000000012000.safetensors")
        model.save(place / "model.zip")
        model.export(place / "model.safetensors", optimizers=True)
        model.save_replay_buffer(place / "replay_buffer.pkl")
        observations = np.random.default_rng(0).uniform(-4, 4, (16, *env.observation_space.shape)).astype(np.float32)
        modes = [mode.name for mode in getattr(model, "modes", [])]
        actions = {"none": model.predict(observations, deterministic=True)[0]}
        actions |= {mode: model.predict(observations, deterministic=True, mode=mode)[0] for mode in modes}
        np.savez(place / "acts.npz", observations=observations, **actions)
        print(name, modes)


if __name__ == "__main__":
    main(Path(sys.argv[1]))
