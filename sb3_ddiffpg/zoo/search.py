"""What the zoo's ``-optimize`` samples for each algorithm."""

from typing import Any

import optuna

from sb3_ddiffpg.zoo.settings import ALGO


def convert_params(sampled_params: dict[str, Any]) -> dict[str, Any]:
    """
    :param sampled_params: What Optuna sampled
    :return: Constructor arguments
    """
    hyperparams = dict(sampled_params)
    hyperparams["gamma"] = 1 - hyperparams.pop("one_minus_gamma")
    hyperparams["batch_size"] = 2 ** hyperparams.pop("batch_size_pow")
    return hyperparams


def sample_params(
    algo: str, trial: optuna.Trial, n_actions: int, n_envs: int, additional_args: dict[str, Any]
) -> dict[str, Any]:
    """
    Hyperparameters of one trial. The networks stay those of the YAML file.

    :param algo: Name of the algorithm in the zoo
    :param trial: Optuna's trial
    :param n_actions: Not used
    :param n_envs: Not used
    :param additional_args: Not used
    :return: Constructor arguments of the algorithm
    """
    sampled = {
        "learning_rate": trial.suggest_float("learning_rate", 1e-4, 3e-3, log=True),
        "qf_learning_rate": trial.suggest_float("qf_learning_rate", 1e-4, 3e-3, log=True),
        "one_minus_gamma": trial.suggest_float("one_minus_gamma", 0.003, 0.05, log=True),
        "batch_size_pow": trial.suggest_int("batch_size_pow", 7, 12),
        "tau": trial.suggest_float("tau", 0.005, 0.1, log=True),
        "gradient_steps": trial.suggest_int("gradient_steps", 1, 8, log=True),
        "novelty.coef": trial.suggest_float("novelty.coef", 1e-3, 1.0, log=True),
    }
    if algo in (ALGO, "dipo"):
        learning_rate, n_steps = "target_action.learning_rate", "target_action.n_steps"
        sampled[learning_rate] = trial.suggest_float(learning_rate, 0.01, 0.5, log=True)
        sampled[n_steps] = trial.suggest_int(n_steps, 1, 20, log=True)
    if algo == ALGO:
        sampled["modes.n_steps"] = trial.suggest_int("modes.n_steps", 1, 5)
        sampled["modes.mask_prob"] = trial.suggest_float("modes.mask_prob", 0.1, 0.8)
        sampled["recluster_freq"] = trial.suggest_categorical("recluster_freq", [25, 50, 100, 200])
    else:
        sampled["n_steps"] = trial.suggest_int("n_steps", 1, 5)
    if algo in ("diffusion_ql", "consistency_ac", "dipo"):
        sampled["n_diffusion_steps"] = trial.suggest_int("n_diffusion_steps", 2, 10)
    if algo == "sac_c51":
        sampled["entropy_learning_rate"] = trial.suggest_float("entropy_learning_rate", 1e-4, 1e-2, log=True)
    if algo == "td3_c51":
        sampled["policy_delay"] = trial.suggest_int("policy_delay", 1, 2)
    hyperparams = convert_params(sampled)
    # What was sampled are the exponents; show the values too
    for name in ("gamma", "batch_size"):
        trial.set_user_attr(name, hyperparams[name])
    return hyperparams
