"""A policy as one ONNX file: it acts without torch, gymnasium and this package, with normalisation and bounds inside."""

import copy
import json
import logging
import math
import os
import warnings
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from importlib.metadata import version
from pathlib import Path
from typing import Any

import numpy as np
import torch as th
from gymnasium import spaces
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

from sb3_ddiffpg.ddiffpg.policies import DETERMINISTIC_SAMPLES, DiffusionPolicy
from sb3_ddiffpg.networks.critics import ALL_GROUPS
from sb3_ddiffpg.utils.disk import written_whole
from sb3_ddiffpg.utils.rng import preserved_rng

#: Of an output that onnxruntime gives beside that of torch, actions in [-1, 1]
TOLERANCE = 1e-4
#: Names of inputs and output. Of a dict of observations each part is an input of its own, ``observation.KEY``
OBSERVATION, MODE, NOISE, ACTION = "observation", "mode", "noise", "action"
# Observations with which a file is tried before it is written
N_TRIED = 8


class _Normalization(nn.Module):
    """
    What ``VecNormalize`` does to one array of observations.

    :param statistics: Running mean and variance
    :param env: Says how far from 0 is the same
    """

    mean: th.Tensor
    deviation: th.Tensor

    def __init__(self, statistics: Any, env: VecNormalize) -> None:
        super().__init__()
        self.register_buffer("mean", th.as_tensor(statistics.mean, dtype=th.float64))
        self.register_buffer("deviation", th.as_tensor(np.sqrt(statistics.var + env.epsilon), dtype=th.float64))
        self.clip = float(env.clip_obs)

    def forward(self, observations: th.Tensor) -> th.Tensor:
        """
        :param observations: [N, ...]
        :return: The same shape, float32
        """
        return ((observations.double() - self.mean) / self.deviation).clamp(-self.clip, self.clip).float()


class PolicyGraph(nn.Module):
    """
    From observations as the environment gives them, a mode and noise to actions in the environment's units: of K for each
    observation that which the mode's critics like best.

    :param policy: A ``DiffusionPolicy``
    :param normalizer: Of the observations that the policy was trained on; None: they are as they are
    :param mode: Index of the only mode; None: the mode is an input
    """

    embeddings: th.Tensor
    low: th.Tensor
    range: th.Tensor

    def __init__(self, policy: DiffusionPolicy, normalizer: VecNormalize | None, mode: int | None = None) -> None:
        super().__init__()
        self.actor, self.critics, self.mode = policy.actor, policy.critics, mode
        self.critic_features_extractor, self.n_modes = policy.critic_features_extractor, policy.n_modes
        embeddings = policy.mode_embeddings[1:]
        nobody = embeddings.new_zeros(1, embeddings.shape[1])  # no mode leaves the choice to the policy
        self.register_buffer("embeddings", th.cat((nobody, embeddings)).clone())
        space: Any = policy.action_space
        self.register_buffer("low", th.as_tensor(space.low))
        self.register_buffer("range", th.as_tensor(space.high - space.low))
        self.normalizations = nn.ModuleDict()
        if normalizer is not None and normalizer.norm_obs:
            statistics = normalizer.obs_rms if isinstance(normalizer.obs_rms, dict) else {OBSERVATION: normalizer.obs_rms}
            keys = normalizer.norm_obs_keys or [OBSERVATION]
            self.normalizations.update({key: _Normalization(statistics[key], normalizer) for key in keys})

    def forward(self, observations: dict[str, th.Tensor], mode: th.Tensor | None, noise: th.Tensor) -> th.Tensor:
        """
        :param observations: By key, ``"observation"`` alone where they are no dict, each [N, ...]
        :param mode: Index of each row's mode, -1 for none, int64, [N]; None where the mode is no input
        :param noise: What is denoised, [N, K, n_draws, action_chunk * action_dim]
        :return: Actions, [N, *action_space.shape], or those of the next steps, [N, action_chunk, *action_space.shape]
        """
        n, n_samples = noise.shape[:2]
        seen = {
            key: self.normalizations[key](each) if key in self.normalizations else each for key, each in observations.items()
        }
        is_dict = isinstance(self.actor.observation_space, spaces.Dict)
        if mode is None:
            index = -1 if self.mode is None else self.mode
            mode = th.full((n,), index, device=noise.device)
        obs = seen if is_dict else seen[OBSERVATION]
        condition = self.actor.condition(obs, self.embeddings[mode + 1])
        features = self.actor.extract_features(obs, self.critic_features_extractor)
        condition, features = (each[:, None].expand(-1, n_samples, -1).flatten(0, 1) for each in (condition, features))
        actions = self.actor.diffusion.denoise(condition, noise=noise.flatten(0, 1).transpose(0, 1))
        values = self.critics.values_by(ALL_GROUPS, features, actions).unflatten(1, (n, n_samples))  # [G, N, K]
        anybody = values[1:].amax(dim=0) if self.n_modes else values[0]
        own = values.gather(0, (mode + 1).clamp(min=0)[None, :, None].expand(1, n, n_samples))[0]
        best = th.where((mode < 0)[:, None], anybody, own).argmax(dim=1)
        chosen = actions.unflatten(0, (n, n_samples)).gather(1, best[:, None, None].expand(n, 1, actions.shape[1]))[:, 0]
        shape = self.low.shape if self.actor.action_chunk == 1 else (self.actor.action_chunk, *self.low.shape)
        return self.low + 0.5 * (chosen.unflatten(1, shape) + 1.0) * self.range


class _SiLU(nn.Module):
    """``torch.nn.SiLU`` without a sigmoid: onnxruntime's is 1e-6 off, of which denoising makes 1e-4."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        return x / (1.0 + th.exp(-x))


class _Mish(nn.Module):
    """``torch.nn.Mish`` without a hyperbolic tangent, for the same reason."""

    def forward(self, x: th.Tensor) -> th.Tensor:
        power = th.exp(x.clamp(max=20.0))  # beyond, x itself to the last digit
        n = power * (power + 2.0)
        return x * n / (n + 2.0)


_EXACT: dict[type[nn.Module], type[nn.Module]] = {nn.SiLU: _SiLU, nn.Mish: _Mish}


def with_exact_activations(graph: PolicyGraph) -> PolicyGraph:
    """
    :param graph: A policy
    :return: A copy, which onnxruntime computes as exactly as torch
    """
    copied = copy.deepcopy(graph, {id(part.optimizer): None for part in (graph.actor, graph.critics)})
    for module in list(copied.modules()):
        for name, child in list(module.named_children()):
            if type(child) in _EXACT:
                setattr(module, name, _EXACT[type(child)]())
    return copied


class _Flat(nn.Module):
    """The same with one argument for each input of the file, in their order."""

    def __init__(self, policy: PolicyGraph, keys: Sequence[str]) -> None:
        super().__init__()
        self.policy, self.keys = policy, list(keys)

    def forward(self, *inputs: th.Tensor) -> th.Tensor:
        observations = dict(zip(self.keys, inputs, strict=False))
        mode, noise = (None, inputs[-1]) if self.policy.mode is not None else inputs[-2:]
        return self.policy(observations, mode, noise)


def export_onnx(model: Any, path: str | os.PathLike, mode: int | None = None) -> None:
    """
    See ``DDiffPG.export_onnx``.

    :param model: A DDiffPG
    :param path: Of the file
    :param mode: Index of the only mode; None: all, chosen by an input
    :raises ImportError: If the extra is not installed
    :raises RuntimeError: If onnxruntime does not compute what torch does
    """
    try:
        import onnxruntime  # noqa: F401
        import onnxscript  # noqa: F401
    except ImportError as error:
        raise ImportError(f"ONNX is an extra ({error}); install it with: pip install 'sb3_ddiffpg[onnx]'") from error
    policy = model.policy
    policy.set_training_mode(False)
    with preserved_rng():
        graph = PolicyGraph(policy, model.get_vec_normalize_env(), mode)
        inputs = _example(graph)
        content = _exported(with_exact_activations(graph), inputs)
        for key, value in _metadata(model, mode).items():
            content.model.metadata_props[key] = value
        with written_whole(Path(path)) as unfinished:
            content.save(unfinished, external_data=False)
            _compare(graph, inputs, unfinished)


def _example(graph: PolicyGraph) -> dict[str, th.Tensor]:
    """Inputs of the file, by name, in their order."""
    space, diffusion = graph.actor.observation_space, graph.actor.diffusion
    parts = space.spaces if isinstance(space, spaces.Dict) else {None: space}
    inputs: dict[str, th.Tensor] = {}
    for key, part in parts.items():
        drawn = np.stack([np.asarray(part.sample()) for _ in range(N_TRIED)]).astype(part.dtype)
        inputs[OBSERVATION if key is None else f"{OBSERVATION}.{key}"] = th.as_tensor(drawn)
    if graph.mode is None:
        inputs[MODE] = th.arange(N_TRIED) % (graph.n_modes + 1) - 1
    inputs[NOISE] = th.randn(N_TRIED, 2, diffusion.n_draws, diffusion.denoiser.action_dim)
    return inputs


def _keys(inputs: dict[str, th.Tensor]) -> list[str]:
    return [name.partition(".")[2] or name for name in inputs if name.startswith(OBSERVATION)]


def _exported(graph: PolicyGraph, inputs: dict[str, th.Tensor]) -> Any:
    rows, samples = th.export.Dim("n", min=1), th.export.Dim("k", min=1)
    shapes: list[dict[int, Any]] = [{0: rows} for _ in inputs]
    shapes[-1] = {0: rows, 1: samples}
    with warnings.catch_warnings(), _quiet("torch.onnx"):
        warnings.simplefilter("ignore")  # of what it has installed, and of names of axes
        return th.onnx.export(
            _Flat(graph, _keys(inputs)).eval(),
            tuple(each.to(graph.low.device) for each in inputs.values()),
            input_names=list(inputs),
            output_names=[ACTION],
            dynamic_shapes=(tuple(shapes),),
            dynamo=True,
            verbose=False,
            external_data=False,
        )


@contextmanager
def _quiet(name: str) -> Iterator[None]:
    logger = logging.getLogger(name)
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        yield
    finally:
        logger.setLevel(before)


def _compare(graph: PolicyGraph, inputs: dict[str, th.Tensor], path: Path) -> None:
    import onnxruntime

    session = onnxruntime.InferenceSession(path.read_bytes(), providers=["CPUExecutionProvider"])
    # One action each: two that are liked alike could change places by a rounding
    inputs = {**inputs, NOISE: inputs[NOISE][:, :1]}
    (found,) = session.run([ACTION], {name: each.numpy() for name, each in inputs.items()})
    with th.no_grad():
        expected = _Flat(graph, _keys(inputs))(*(each.to(graph.low.device) for each in inputs.values())).cpu().numpy()
    apart = np.abs(found - expected) / (graph.range.cpu().numpy() / 2)
    if not apart.max() < TOLERANCE:
        raise RuntimeError(
            f"onnxruntime's actions differ from torch's by up to {apart.max():.2g} of [-1, 1]: nothing is written"
        )


# ---------------------------------------------------------------------- what the file says of itself


def _metadata(model: Any, mode: int | None) -> dict[str, str]:
    """Values are JSON; a number that is unknown, or a bound that there is none of, is null."""
    modes = list(model.modes) if mode is None else [model.modes[mode]]
    said = {
        "sb3_ddiffpg": version("sb3_ddiffpg"),
        "modes": [
            {
                "name": each.name,
                "success_rate": _number(each.success_rate),
                "mean_return": _number(each.mean_return),
                "mean_length": _number(each.mean_length),
            }
            for each in modes
        ],
        "observation_space": _space(model.observation_space),
        "action_space": _space(model.action_space),
        "n_diffusion_steps": model.policy.actor.n_diffusion_steps,
        "action_chunk": model.policy.action_chunk,
        "deterministic_noise": model.policy.fixed_noise(DETERMINISTIC_SAMPLES).transpose(0, 1).tolist(),
    }
    return {key: json.dumps(value, allow_nan=False) for key, value in said.items()}


def _number(value: float) -> float | None:
    return float(value) if math.isfinite(value) else None


def _space(space: spaces.Space) -> dict[str, Any]:
    if isinstance(space, spaces.Dict):
        return {key: _space(each) for key, each in space.spaces.items()}
    about: dict[str, Any] = {"shape": list(space.shape or ()), "dtype": str(np.dtype(space.dtype))}
    if isinstance(space, spaces.Box):
        for name in ("low", "high"):
            bounds = getattr(space, name)
            alike = bounds.size and (bounds == bounds.flat[0]).all()
            about[name] = _number(bounds.flat[0]) if alike else [_number(each) for each in bounds.ravel()]
    return about
