"""How an algorithm is saved, shared, loaded and resumed."""

import contextlib
import io
import pathlib
import zipfile
from collections import defaultdict
from collections.abc import Iterable
from typing import Annotated, Any, ClassVar, TypeVar

import torch as th
from msgspec import Meta
from stable_baselines3.common.off_policy_algorithm import OffPolicyAlgorithm
from stable_baselines3.common.save_util import load_from_zip_file, recursive_getattr
from stable_baselines3.common.type_aliases import GymEnv, MaybeCallback, TensorDict
from stable_baselines3.common.vec_env import VecEnv

from sb3_ddiffpg.networks.extractors import unknown_to_0_1
from sb3_ddiffpg.saving._legacy import parameters_of_0_1
from sb3_ddiffpg.saving.checkpoint import InterruptedRun, read_checkpoint
from sb3_ddiffpg.saving.model import KIND, ModelTree, build_model, model_tree
from sb3_ddiffpg.saving.records import declared, episodes_tree, parts_tree
from sb3_ddiffpg.serialization.safetensors_tree import Count, convert, read, write
from sb3_ddiffpg.utils.disk import missed_if_full
from sb3_ddiffpg.utils.signals import handlers_restored

SelfSavable = TypeVar("SelfSavable", bound="SavableAlgorithm")


class SavableAlgorithm(OffPolicyAlgorithm):
    """
    An ``OffPolicyAlgorithm`` that can be exported without code and resumed in the middle of a run.

    A subclass declares its counters, its parts and what is not pickled in class attributes, beside those of the classes above
    it: ``_counters``, ``_parts``, ``_unsaved``, ``_only_to_train`` and ``episode_part``.
    """

    resolved_features: Any
    #: What the environment declared when the model was made; novelty is counted in these cells
    novelty_cell_size: float | None
    #: What a file says of the parts, until these are made
    saved_parts: dict[str, Any] | None = None
    #: Parts whose ``state_dict`` says what of them is no parameter: name in a file, and attribute
    _parts: ClassVar[dict[str, str]] = {}
    #: The part that drives the episodes in progress, if there is one
    episode_part: ClassVar[str | None] = None
    #: Attributes that are made anew, and parts with parameters without which the model acts as before
    _unsaved: ClassVar[dict[str, None]] = dict.fromkeys(("interrupted", "_saves_to_act", "until_learn_ends", "in_file"))
    _only_to_train: ClassVar[dict[str, None]] = {}
    interrupted: InterruptedRun | None = None
    _learn_began_at = 0  # in environment steps; SB3's ``_num_timesteps_at_start`` moves when a run is resumed
    run_id: str
    _steps_before = 0  # of earlier calls of ``learn`` that counted from 0
    #: Networks of the policy that follow others slowly and only train: what they follow, by name
    target_networks: ClassVar[dict[str, str]] = {}
    _saves_to_act = False
    #: Steps of the whole run, as ``learn`` was told; 0: of each call
    horizon = 0
    #: While it is made of a file: the file's arrays, by part; None for one of one's own
    in_file: dict[str, dict[str, Any] | None] | None = None
    #: Of ``learn``, for callbacks: what they hold is given back however it ends
    until_learn_ends: contextlib.ExitStack
    #: Attributes that are plain values, and their types
    _counters: ClassVar[dict[str, Any]] = {
        "num_timesteps": Count,
        "_total_timesteps": Count,
        "_num_timesteps_at_start": Count,
        "_learn_began_at": Count,
        "_steps_before": Count,
        "run_id": str,
        "_episode_num": Count,
        "_n_updates": Count,
        "next_review": Count,
        "horizon": Count,
        "features_found": bool,
        "features_settled": bool,
        "_current_progress_remaining": Annotated[float, Meta(ge=-(2.0**53), le=1.0)],
        "env_spec": str | None,
        "is_normalized": bool,
        "_warned_support": bool,
        "_warned_cut_values": bool,
    }

    @property
    def lifetime_steps(self) -> int:
        """Environment steps of all training so far, also where ``learn`` has counted anew."""
        return self._steps_before + self.num_timesteps

    def learn(
        self: SelfSavable,
        total_timesteps: int,
        callback: MaybeCallback = None,
        log_interval: int = 4,
        tb_log_name: str = "run",
        reset_num_timesteps: bool = True,
        progress_bar: bool = False,
    ) -> SelfSavable:
        """
        See SB3's ``learn``. The first call after ``resume`` does what was left of the interrupted one.
        """
        if self.interrupted is not None:
            done = self.num_timesteps - self._learn_began_at
            total_timesteps, reset_num_timesteps = max(0, total_timesteps - done), False
        else:
            self._learn_began_at = 0 if reset_num_timesteps else self.num_timesteps
        with handlers_restored(), contextlib.ExitStack() as self.until_learn_ends:
            super().learn(total_timesteps, callback, log_interval, tb_log_name, reset_num_timesteps, progress_bar)
        self.interrupted = None  # there may have been no step left to do
        return self

    def _update_current_progress_remaining(self, num_timesteps: int, total_timesteps: int) -> None:
        if self.horizon:
            num_timesteps, total_timesteps = self.lifetime_steps, self.horizon
        super()._update_current_progress_remaining(num_timesteps, total_timesteps)
        # The last rollout may go beyond the end, where a schedule would give a learning rate below zero
        self._current_progress_remaining = max(0.0, self._current_progress_remaining)

    def dump_logs(self) -> None:
        """See SB3; a full disk does not end the training."""
        with missed_if_full("Logs"):
            super().dump_logs()

    def save(
        self,
        path: str | pathlib.Path | io.BufferedIOBase,
        exclude: Iterable[str] | None = None,
        include: Iterable[str] | None = None,
        to_train: bool = True,
    ) -> None:
        """
        See SB3.

        :param path: Path to the file
        :param exclude: Attributes to leave out
        :param include: Attributes to save though they are usually left out
        :param to_train: Whether what only training needs is saved: what the optimisers have gathered, target networks, and
            what is known of where it has been. Without it the file is a third as large or less, and training that goes on
            from it begins with fresh ones
        """
        attributes = (recursive_getattr(self, name) for name in self._get_torch_save_params()[0])
        left_out = [each for each in attributes if isinstance(each, th.optim.Optimizer) and not to_train]
        states = [optimizer.state for optimizer in left_out]
        try:
            self._saves_to_act = not to_train
            self.saved_parts = {**parts_tree(self, to_train), "episodes": episodes_tree(self)}
            for optimizer in left_out:
                optimizer.state = defaultdict(dict)
            super().save(path, exclude, include)
        finally:
            self._saves_to_act, self.saved_parts = False, None
            for optimizer, state in zip(left_out, states, strict=True):
                optimizer.state = state

    def get_parameters(self) -> dict[str, dict]:
        """See SB3."""
        parameters = super().get_parameters()
        if self._saves_to_act:
            targets = tuple(f"{name}." for name in self.target_networks)
            parameters["policy"] = {name: each for name, each in parameters["policy"].items() if not name.startswith(targets)}
            parameters = {
                name: each for name, each in parameters.items() if name not in declared(type(self), "_only_to_train")
            }
        return parameters

    def set_parameters(
        self, load_path_or_dict: str | TensorDict, exact_match: bool = True, device: th.device | str = "auto"
    ) -> None:
        """
        See SB3. A target network of which nothing is given begins as a copy of what it follows, if all of that is given; and
        what only training needs stays as it is where all of it is left out.
        """
        parameters = read_parameters(self, load_path_or_dict, device)
        super().set_parameters(parameters, exact_match, device)

    @classmethod
    def load(
        cls: type[SelfSavable],
        path: str | pathlib.Path | io.BufferedIOBase,
        env: GymEnv | None = None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        print_system_info: bool = False,
        force_reset: bool = True,
        safe: bool = False,
        **kwargs: Any,
    ) -> SelfSavable:
        """
        See SB3. **A .zip file runs code that it holds when it is loaded: load only those whose maker you trust.**
        ``safe=True`` reads what ``export`` wrote, which cannot run anything.

        :param path: Path to the file
        :param env: To train on; None: the model only acts
        :param device: Device on which the model computes
        :param custom_objects: Replacements for what cannot be loaded; of a safe file, the arguments that are code
        :param print_system_info: Whether to print the system that a .zip was saved on, and this one
        :param force_reset: Whether the environments are reset before training
        :param safe: Whether the file is one that ``export`` wrote
        :param kwargs: Other values of constructor arguments
        :return: The model
        :raises ValueError: If ``safe`` and the file is something else or damaged, or does not fit
        """
        _check_kind(path, safe)
        if safe:
            tree = read(pathlib.Path(path), KIND)  # type: ignore[arg-type]
            return build_model(cls, tree, env, device, custom_objects, **kwargs)
        try:
            return super().load(path, env, device, custom_objects, print_system_info, force_reset, **kwargs)
        except (ValueError, TypeError, AttributeError, LookupError) as error:
            error.add_note(
                f"Raised while {path} was loaded as a {cls.__name__}: what another algorithm saved, its class loads"
            )
            raise

    def export(self, path: str | pathlib.Path, optimizers: bool = False) -> None:
        """
        Save the model without code, for ``load(path, safe=True)``: weights and settings in one safetensors file.

        :param path: Path to the file
        :param optimizers: Whether what the optimisers have gathered goes with it, so that training goes on smoothly
        :raises OSError: If the file cannot be written; what was there before still is
        """
        write(pathlib.Path(path), KIND, model_tree(self, optimizers))

    @classmethod
    def resume(
        cls: type[SelfSavable],
        path: str | pathlib.Path,
        env: GymEnv | None,
        device: th.device | str = "auto",
        custom_objects: dict[str, Any] | None = None,
        **kwargs: Any,
    ) -> SelfSavable:
        """
        Go on with a run from what a ``RunCheckpointCallback`` wrote: the same ``learn`` with the same callbacks does what was
        left of it, bit for bit on a CPU where the environments can be saved (those of this package can; others begin new
        episodes).

        :param path: Of a checkpoint, or of the folder, of which the newest is taken that is whole
        :param env: Made as the run's
        :param device: Device on which the model computes
        :param custom_objects: Arguments that are code: no checkpoint holds them
        :param kwargs: Other values of constructor arguments
        :return: The model
        :raises FileNotFoundError: If there is no checkpoint
        :raises ValueError: If none is whole, or it does not fit
        """
        if env is None:
            raise ValueError("env=None given; accepted are the environments to go on in, made as the run's")
        _, checkpoint = read_checkpoint(path)
        n_envs, n_given = convert(checkpoint.model, ModelTree, "model").n_envs, env.num_envs if isinstance(env, VecEnv) else 1
        if n_given != n_envs:
            raise ValueError(f"env: {n_given} environments given; accepted are {n_envs}, as many as the run has")
        model = build_model(cls, checkpoint.model, env, device, custom_objects, **kwargs)
        model.interrupted = InterruptedRun(checkpoint.run)
        try:
            model.interrupted.restore_buffer_and_environments(model)
        except (TypeError, AttributeError, LookupError, ArithmeticError, MemoryError) as error:
            raise ValueError(f"checkpoint: it does not fit the model that its settings make: {error!r}") from error
        return model

    def _get_torch_save_params(self) -> tuple[list[str], list[str]]:
        names = ["policy", "actor.optimizer", "policy.critics.optimizer", *declared(type(self), "_only_to_train")]
        return [name for name in names if recursive_getattr(self, name) is not None], []

    def _excluded_save_params(self) -> list[str]:
        return [*super()._excluded_save_params(), *declared(type(self), "_unsaved")]


def _check_kind(path: Any, safe: bool) -> None:
    """A file is either what ``save`` wrote or what ``export`` did."""
    if not isinstance(path, str | pathlib.Path) or not pathlib.Path(path).is_file():
        return
    if safe and zipfile.is_zipfile(path):
        raise ValueError(
            f"path: {path} was written by save, and may hold code: load it without safe=True if you trust its maker"
        )
    with open(path, "rb") as file:
        is_exported = file.read(9)[8:] == b"{"  # safetensors: the length of a header, and JSON
    if is_exported and not safe:
        raise ValueError(f"path: {path} was written by export: load it with safe=True")


def read_parameters(model: SavableAlgorithm, given: str | TensorDict, device: th.device | str) -> dict[str, Any]:
    """
    :param model: That is to get them
    :param given: Path of a .zip file, or parameters by part, of this version or of 0.1
    :param device: Where tensors of a file go
    :return: All of the model's. A target network of which nothing is given begins as a copy of what it follows, if all of that
        is given; and what only training needs stays as it is where all of it is left out
    """
    parameters: Any = given
    if not isinstance(parameters, dict):
        _, parameters, _ = load_from_zip_file(parameters, device=device, load_data=False)
    parameters = parameters_of_0_1(parameters)
    policy = parameters.get("policy") or {}
    own = model.policy.state_dict().keys() - (unknown_to_0_1(model.policy).keys() - policy.keys())
    for target, online in model.target_networks.items():
        followed = [name for name in own if name.startswith(f"{online}.")]
        if set(followed) <= set(policy) and not any(name.startswith(f"{target}.") for name in policy):
            copies = {f"{target}{name[len(online) :]}": policy[name] for name in followed}
            policy = {**policy, **copies}
    parameters = {**parameters, **({"policy": policy} if policy else {})}
    left_out = declared(type(model), "_only_to_train")
    if policy and not set(left_out) & set(parameters):
        current = model.get_parameters()
        parameters.update({name: current[name] for name in left_out if name in current})
    return parameters
