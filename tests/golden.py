"""
What short trainings leave behind, as hashes: two versions of this package that compute the same have the same.

``python tests/golden.py write FILE`` notes them, ``python tests/golden.py compare FILE`` says which differ. They are equal
only on the same kind of processor with the same libraries, which the file names.
"""

import argparse
import hashlib
import json
import platform
import warnings
from concurrent.futures import ProcessPoolExecutor
from pathlib import Path
from typing import Any

SEEDS = (0, 1, 2)
NOVELTY = ("counts", "rnd")
MAZE = ["#######", "#g.r.g#", "#######"]
COMMON: dict[str, Any] = dict(
    learning_starts=800,
    batch_size=128,
    gamma=0.97,
    reward_scale=5,
    buffer_size=12_000,
    gradient_steps=1,
    verbose=0,
    device="cpu",
)
#: DDiffPG with everything on that the defaults leave off
ALL = dict(
    explore_past_modes=False,
    new_way_coef=1.0,
    mode_intrinsic_coef=0.1,
    exploration_n_steps=3,
    exploration_gamma=0.95,
    backup_embedding="masked",
    n_action_gradient_steps=3,
    action_optimizer="normalized",
    qf_learning_rate=2e-3,
    max_successes_per_mode=20,
    replay_buffer_kwargs={"compared_length": 6.0},
)
VARIANTS: dict[str, tuple[str, dict[str, Any]]] = {
    "ddiffpg": ("ddiffpg", {}),
    "ddiffpg, all": ("ddiffpg", ALL),
    "ddiffpg, scalar": ("ddiffpg", {"n_atoms": 1}),
    "ddiffpg, normalized": ("ddiffpg", {"normalize": True}),
    "dipo": ("dipo", {}),
    "diffusion_ql": ("diffusion_ql", {}),
    "consistency_ac": ("consistency_ac", {}),
    "rpg": ("rpg", {}),
    "sac_c51": ("sac_c51", {"n_steps": 3}),
    "td3_c51": ("td3_c51", {"n_steps": 3}),
}


def machine() -> dict[str, str]:
    """What the last bit depends on."""
    import numpy as np
    import torch as th

    model = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    return {
        "processor": model[0].partition(":")[2].strip() if model else platform.processor(),
        "kernels": th.backends.cpu.get_cpu_capability(),
        "torch": th.__version__,
        "numpy": np.__version__,
    }


def train(variant: str, novelty: str, seed: int, n_steps: int = 20_000) -> Any:
    """
    :param variant: One of ``VARIANTS``
    :param novelty: The novelty measure
    :param seed: Of everything
    :param n_steps: Environment steps
    :return: The trained model
    """
    import torch as th
    from stable_baselines3.common.vec_env import VecNormalize

    from sb3_ddiffpg import DDiffPG
    from sb3_ddiffpg.baselines import BASELINES
    from sb3_ddiffpg.envs import make_vec_env

    th.set_num_threads(1)
    algo, settings = VARIANTS[variant]
    settings = {**COMMON, "novelty": novelty, **settings}
    env: Any = make_vec_env("PointMazeV1-v0", n_envs=16, seed=seed, maze_map=MAZE)
    if settings.pop("normalize", False):
        env = VecNormalize(env, norm_reward=False)
    algorithms: dict[str, Any] = {"ddiffpg": DDiffPG, **BASELINES}
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        model = algorithms[algo]("MlpPolicy", env, seed=seed, policy_kwargs={"net_arch": [32, 32]}, **settings)
        return model.learn(n_steps)


def digest(model: Any) -> str:
    """
    :param model: A trained model
    :return: Hash of its networks, of what the optimisers have gathered and of its target actions
    """
    import numpy as np
    import torch as th

    found = hashlib.sha256()

    def add(value: Any) -> None:
        if isinstance(value, th.Tensor):
            value = value.detach().cpu().numpy()
        if isinstance(value, np.ndarray):
            found.update(np.ascontiguousarray(value).tobytes())
        elif isinstance(value, dict):
            for key in sorted(value, key=str):
                add(value[key])
        elif isinstance(value, list | tuple):
            for each in value:
                add(each)

    add(model.policy.state_dict())
    add(model.actor.optimizer.state_dict()["state"])
    add(model.policy.critics.optimizer.state_dict()["state"])
    buffer = model.replay_buffer
    add(buffer.actions[: buffer.pos])
    add(buffer.rewards[: buffer.pos])
    if type(model).__name__ in ("DDiffPG", "DIPO"):
        add(_targets(buffer))
    return found.hexdigest()[:16]


def _targets(buffer: Any) -> list[Any]:
    if not buffer.mode_rows:  # of one group: the other one is never used
        return [buffer.exploratory_target_actions[: buffer.pos]]
    return [buffer.target_actions[: buffer.pos], buffer.exploratory_target_actions[: buffer.pos]]


def result(variant: str, novelty: str, seed: int, n_steps: int = 20_000) -> dict[str, Any]:
    """
    :param variant: One of ``VARIANTS``
    :param novelty: The novelty measure
    :param seed: Of everything
    :param n_steps: Environment steps
    :return: The hash, and the names of the modes, which say more when it differs
    """
    model = train(variant, novelty, seed, n_steps)
    return {"hash": digest(model), "modes": [mode.name for mode in getattr(model, "modes", [])]}


def all_results(n_steps: int, seeds: tuple[int, ...] = SEEDS) -> dict[str, dict[str, Any]]:
    """
    :param n_steps: Environment steps of each
    :param seeds: Which of them
    :return: By name
    """
    cases = [(variant, novelty, seed) for variant in VARIANTS for novelty in NOVELTY for seed in seeds]
    with ProcessPoolExecutor(2) as pool:
        found = list(pool.map(result, *zip(*cases, strict=True), [n_steps] * len(cases)))
    return {f"{variant}, {novelty}, seed {seed}": each for (variant, novelty, seed), each in zip(cases, found, strict=True)}


def main() -> None:
    """The command line."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("action", choices=["write", "compare"])
    parser.add_argument("file", type=Path)
    parser.add_argument("--n-steps", type=int, default=20_000)
    parser.add_argument("--seeds", type=int, nargs="+", default=list(SEEDS))
    known = parser.parse_args()
    found = all_results(known.n_steps, tuple(known.seeds))
    if known.action == "write":
        known.file.write_text(json.dumps({"machine": machine(), "n_steps": known.n_steps, "results": found}, indent=1) + "\n")
        return
    noted = json.loads(known.file.read_text())
    if noted["machine"] != machine():
        print(f"Noted on {noted['machine']}, this is {machine()}: hashes may differ")
    differ = {name: (noted["results"][name], each) for name, each in found.items() if noted["results"][name] != each}
    for name, (before, now) in differ.items():
        print(f"{name}: {before} -> {now}")
    print(f"{len(found) - len(differ)} of {len(found)} as noted")
    raise SystemExit(bool(differ))


if __name__ == "__main__":
    main()
