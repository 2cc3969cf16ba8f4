"""A recorded training for Hugging Face: a model card, and a file of the model that runs no code when it is read."""

import argparse
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import yaml

from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm
from sb3_ddiffpg.experiments.ablations import load_to_act, register
from sb3_ddiffpg.experiments.store import Recorded, read_training

try:
    from huggingface_hub import EvalResult, HfApi, ModelCard, ModelCardData
    from huggingface_hub.utils import validate_repo_id
except ImportError as error:
    raise ImportError(
        f"the Hugging Face hub is an extra ({error}); install it with: pip install 'sb3_ddiffpg[hub]'"
    ) from error

TEMPLATE = Path(__file__).parents[1] / "visualization" / "templates" / "model_card.md"
#: The model without code
SAFE_MODEL = "model.safetensors"


def write_card(folder: Path, repo_id: str) -> Path:
    """
    :param folder: Of a complete training
    :param repo_id: Where it will be, ``OWNER/NAME``
    :return: The card, ``README.md`` in that folder; the model lies beside it as ``model.safetensors`` too
    """
    run = _read(folder)
    found = run.evaluation
    model = load_to_act(run.trial.algo, folder / "model.zip")
    if isinstance(model, ActorCriticAlgorithm):
        model.export(folder / SAFE_MODEL)
    data = ModelCardData(
        model_name=f"{run.trial.algo} in {run.trial.env}",
        library_name="stable-baselines3",
        license="mit",
        tags=["reinforcement-learning", "deep-reinforcement-learning", "stable-baselines3", run.trial.algo, run.trial.env],
        eval_results=[
            EvalResult(
                task_type="reinforcement-learning",
                dataset_type=run.trial.env,
                dataset_name=run.trial.env,
                metric_type=name,
                metric_value=round(float(value), 4),
            )
            for name, value in (
                ("success_rate", found.uncommanded.success_rate),
                ("modes_in_20_episodes", found.expected_modes()),
                ("commanded_modes", found.commanded_modes),
            )
        ],
    )
    card = ModelCard.from_template(
        data,
        template_path=str(TEMPLATE),
        algo=run.trial.algo,
        class_name=type(model).__name__,
        package=_package(model),
        normalized=(folder / "vecnormalize.pkl").is_file(),
        env=run.trial.env,
        repo_id=repo_id,
        evaluation=str(found),
        modes=[each.mode for each in found.commanded],
        safe=isinstance(model, ActorCriticAlgorithm),
        settings=yaml.safe_dump(run.trial.hyperparams, sort_keys=False).strip(),
        record=run.record,
    )
    path = folder / "README.md"
    card.save(path)
    return path


def upload(folder: Path, repo_id: str, api: Any = None) -> str:
    """
    :param folder: Of a complete training; its card is written first
    :param repo_id: Where to, ``OWNER/NAME``; made if there is none
    :param api: An ``HfApi``; with the user's own token when None
    :return: Address of what was uploaded
    :raises OSError: If that cannot be; the card is there
    """
    card = write_card(folder, repo_id)
    api = api or HfApi()
    files = ["README.md", SAFE_MODEL, "model.zip", "evaluation*.json", "curve.csv", "config.yml", "vecnormalize.pkl"]
    what: dict[str, Any] = dict(folder_path=folder, allow_patterns=files, commit_message="A recorded training")
    try:
        api.create_repo(repo_id, exist_ok=True)
        return str(api.upload_folder(repo_id=repo_id, **what))
    except Exception as error:  # of the network, the token or the hub, and of any of its libraries
        raise OSError(f"{card} is written, but not uploaded to {repo_id}: {error!r}") from error


def _package(model: Any) -> str:
    """From where its class is imported."""
    module = type(model).__module__
    return module.split(".")[0] if not module.startswith("sb3_ddiffpg.baselines") else "sb3_ddiffpg.baselines"


def _read(folder: Path) -> Recorded:
    run = read_training(folder)
    if not (folder / "model.zip").is_file():
        raise ValueError(f"{folder} given; accepted is the folder of a training that has left a model.zip: not a union's")
    return run


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """
    :param parser: Of the command line
    """
    parser.add_argument("folder", type=Path, help="of a complete training")
    parser.add_argument("--repo-id", required=True, metavar="OWNER/NAME")


def prepare(given: argparse.Namespace) -> Callable[[], None]:
    """
    :param given: The command line
    :return: What does it
    :raises ValueError: If it asks for what there is not
    """
    register()
    _read(given.folder)
    try:
        validate_repo_id(given.repo_id)
    except ValueError as error:
        raise ValueError(f"--repo-id: {error}") from None
    if "/" not in given.repo_id:
        raise ValueError(f"--repo-id: {given.repo_id!r} given; accepted is OWNER/NAME")
    return partial(_work, given)


def _work(given: argparse.Namespace) -> None:
    work = upload if given.command == "upload" else write_card
    print(f"wrote {work(given.folder, given.repo_id)}")
