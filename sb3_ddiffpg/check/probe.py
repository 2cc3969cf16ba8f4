"""Random steps in an environment, of which the algorithm's own parts say what they make."""

import re
import warnings
from collections import Counter
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout
from io import StringIO
from pathlib import Path
from typing import Any

import gymnasium as gym
import numpy as np
from gymnasium import spaces
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.env_checker import check_env as check_by_sb3
from stable_baselines3.common.preprocessing import is_image_space
from stable_baselines3.common.vec_env import DummyVecEnv, VecEnv, VecEnvWrapper

from sb3_ddiffpg.buffers.feature_choice import travels
from sb3_ddiffpg.buffers.features import ModeFeatures, declared_mode_features
from sb3_ddiffpg.buffers.hindsight import METHOD, goals_differ
from sb3_ddiffpg.buffers.returns import discounted_returns
from sb3_ddiffpg.buffers.success import NO_KEY, SUCCESS_KEYS, GoalWatch, read_success
from sb3_ddiffpg.check.findings import Cells, ChosenFeatures, EnvCheck, SuccessSignal
from sb3_ddiffpg.common.scales import may_choose, review_scales, settle_features
from sb3_ddiffpg.ddiffpg.ddiffpg import DDiffPG
from sb3_ddiffpg.envs import make_vec_env
from sb3_ddiffpg.exploration import cells as cells_module
from sb3_ddiffpg.utils.rng import preserved_rng
from sb3_ddiffpg.utils.vec_envs import env_attribute, labels_routes

# It goes on until so many episodes have ended, but not for more than so many times the steps
_LEAST_EPISODES, _MOST_TIMES = 5, 10
_NEVER = 10**9
# Colours of a terminal, in gymnasium's warnings
_COLOUR = re.compile(r"\x1b\[[0-9;]*m")


class _Listener(BaseCallback):
    """
    Takes note of what the steps say that the algorithm does not keep.

    :param watch: Follows the episodes, as training does
    """

    def __init__(self, watch: GoalWatch) -> None:
        super().__init__()
        self.watch = watch
        self.keys = SUCCESS_KEYS if watch.success_key is None else (watch.success_key,)
        #: By key how often it was said, how often it was True, and how often of that in mid-episode
        self.said, self.true, self.mid_episode = Counter[str](), Counter[str](), Counter[str]()
        #: Of episodes that ended by themselves, and of those that a time limit ended
        self.lengths: list[int] = []
        self.cut_off: list[int] = []
        self.labels = Counter[str]()
        #: Keys of ``info`` that are True or False
        self.candidates: dict[str, None] = {}

    def _on_step(self) -> bool:
        dones, infos = self.locals["dones"], self.locals["infos"]
        self.watch.observe(infos)
        for env, (done, info) in enumerate(zip(dones, infos, strict=True)):
            for key in self.keys:
                said = read_success(info, key)
                self.said[key] += said is not None
                self.true[key] += bool(said)
                self.mid_episode[key] += bool(said and not done)
            truths = {key for key, value in info.items() if isinstance(value, (bool, np.bool_))}
            self.candidates |= dict.fromkeys(sorted(truths - {"TimeLimit.truncated", *self.keys}))
            if done:
                if (label := self.watch.so_far(env, info).label) is not None:
                    self.labels[label] += 1
                by_limit = info.get("TimeLimit.truncated", False)
                (self.cut_off if by_limit else self.lengths).append(int(self.watch.steps[env]))
                self.watch.end(env)
        return True


def check_env(
    env: gym.Env | VecEnv | str,
    steps: int = 2000,
    seed: int = 0,
    env_kwargs: dict[str, Any] | None = None,
    **arguments: Any,
) -> EnvCheck:
    """
    Take random steps, and say what DDiffPG makes of them: what counts as a success, where modes differ, how places are told
    apart, which values there are. All judgements are those of the parts that train. The environment is reset and stepped.

    :param env: A single environment, vectorised ones, or the id of one
    :param steps: How many at least; more if episodes are long
    :param seed: Of environments and actions
    :param env_kwargs: Arguments of ``gym.make``, if ``env`` is an id
    :param arguments: Of ``DDiffPG``, such as ``mode_features`` or ``success_key``, as they are to be in training
    :return: What was found; printed, it is a page
    :raises ValueError: If ``env`` is none of these, an argument cannot work, or the environment cannot be trained on
    """
    if not isinstance(steps, int) or steps < 1:
        raise ValueError(f"steps: {steps!r} given; accepted are whole numbers from 1 up")
    if not isinstance(env, (str, gym.Env, VecEnv)):
        raise ValueError(f"env: {env!r} given; accepted are a gymnasium.Env, a VecEnv and the id of an environment")
    if env_kwargs and not isinstance(env, str):
        raise ValueError(f"env_kwargs: {env_kwargs} given; accepted beside an env that is made already are none")
    with preserved_rng(), warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        with _opened(env, seed, env_kwargs or {}) as opened:
            return _probe(env, opened, steps, seed, env_kwargs or {}, arguments, caught)


@contextmanager
def _opened(env: Any, seed: int, env_kwargs: dict[str, Any]) -> Iterator[Any]:
    """The environment, which is closed if it was made here."""
    if not isinstance(env, str):
        yield env
        return
    try:
        made = make_vec_env(env, 1, seed=seed, env_kwargs=env_kwargs)
    except (gym.error.Error, ImportError, TypeError) as error:
        given = f" with {env_kwargs}" if env_kwargs else ""
        said = " ".join([str(error), *getattr(error, "__notes__", ())])
        raise ValueError(f"env: {env!r} cannot be made{given}: {said}") from error
    try:
        yield made
    finally:
        made.close()


def _probe(
    given: Any,
    env: Any,
    steps: int,
    seed: int,
    env_kwargs: dict[str, Any],
    arguments: dict[str, Any],
    caught: list[warnings.WarningMessage],
) -> EnvCheck:
    policy = arguments.pop("policy", None) or policy_for(env.observation_space)
    limit = _limit(env)
    n_envs = getattr(env, "num_envs", 1)
    # So large that no episode is stored in parts, and so patient that nothing is learned
    room = {"buffer_size": _MOST_TIMES * steps + 2 * n_envs * (limit or 1)}
    waits = {"learning_starts": _NEVER, "recluster_freq": _NEVER, "device": "cpu", "seed": seed, "verbose": 0}
    try:
        model = DDiffPG(policy, env, **{**arguments, **room, **waits})
        walked = model.get_env()
        assert walked is not None
        listener = _Listener(GoalWatch(walked.num_envs, model.success_key, labels_routes(walked)))
        model.learn(steps, callback=listener)
        while len(listener.lengths) + len(listener.cut_off) < _LEAST_EPISODES and model.num_timesteps < _MOST_TIMES * steps:
            model.learn(steps, callback=listener, reset_num_timesteps=False)
    except AssertionError as error:  # SB3's, of spaces
        raise ValueError(str(error)) from error
    model.replay_buffer.judge_by_returns()
    if (hindsight := model.replay_buffer.hindsight) is not None:
        hindsight.judge(model.replay_buffer)
    by_episodes = _Walked(model, walked)
    review_scales(model)
    parting = may_choose(model) and len(model.replay_buffer.trajectories(success=True)) >= model.mode_settings.min_size
    settle_features(model)
    return EnvCheck(
        env=_name(given),
        spaces=(_text(model.observation_space), _text(model.action_space)),
        policy=policy if isinstance(policy, str) else policy.__name__,
        is_image=is_image_space(model.observation_space),
        n_steps=by_episodes.n_steps,
        lengths=(*listener.lengths, *listener.cut_off),
        limit=limit or max(listener.cut_off, default=None),
        declared_limit=limit is not None,
        success=_success(model, listener),
        relabels=_relabels(model),
        features=by_episodes.features(parting),
        cells=by_episodes.cells(caught),
        rewards=by_episodes.rewards,
        returns=by_episodes.returns(),
        gamma=model.gamma,
        support=None if model.value_range.adapts else model.critic_settings.support,
        listed=tuple(map(str, env_attribute(walked, "listed_modes") or ())),
        labels=dict(listener.labels),
        wrappers=tuple(_changing_wrappers(walked)),
        warned=tuple(_warned(caught, given, env, env_kwargs, model.replay_buffer.success_rule.has_key)),
        code=_code(given, policy, env_kwargs, arguments, model.replay_buffer.success_rule.has_key),
    )


class _Walked:
    """
    What is stored of the random steps.

    :param model: That took them
    :param env: In these
    """

    def __init__(self, model: DDiffPG, env: VecEnv) -> None:
        self.model, self.env, self.buffer = model, env, model.replay_buffer
        self.rows = np.concatenate(self.buffer.episodes())
        self.n_steps = len(self.rows)
        rewards = self.buffer.training_rewards(self.rows)
        self.rewards = float(rewards.min()), float(rewards.max())

    def returns(self) -> tuple[float, float]:
        """
        :return: The smallest and the largest that were met, as training takes them; of episodes that have not ended as if
            they went on
        """
        values = self.model.value_range
        if values.low is not None and values.high is not None:
            return values.low, values.high
        ends = []
        for rows in self.buffer.episodes():
            rewards = self.model.reward_scale * self.buffer.training_rewards(rows)
            returns = discounted_returns(rewards, self.model.gamma, "ends" if self.buffer.dones[rows[-1]] else "goes on")
            ends += [float(returns.min()), float(returns.max())]
        return min(ends), max(ends)

    def _paths(self, features: ModeFeatures) -> list[np.ndarray]:
        """Of all episodes, [length + 1, dim] each."""
        paths = []
        for rows in self.buffer.episodes():
            here, last = self.buffer.read_observations(rows)[0], self.buffer.read_observations(rows[-1:])[1]
            paths.append(np.concatenate([features.of_tensors(each).cpu().numpy() for each in (here, last)]))
        return paths

    def features(self, parting: bool) -> ChosenFeatures:
        """
        :param parting: Whether goal-reached episodes could be asked where they part
        :return: In which part of the observation modes differ, and why
        """
        model, chosen = self.model, self.buffer.features
        selection = model.resolved_features
        declared = declared_mode_features(self.env)
        if model.mode_features is not None:
            source = "given"
        elif declared is not None:
            source = "achieved_goal" if env_attribute(self.env, "mode_features") is None else "declared"
        else:
            source = "whole" if selection is None else "found"
        named, far = _names(model.observation_space), travels(self._paths(chosen)).tolist()
        if isinstance(selection, str) or callable(selection):
            prefix = selection if isinstance(selection, str) else "value"
            return ChosenFeatures(source, selection, tuple(f"{prefix}[{k}]" for k in range(chosen.dim)), tuple(far), {}, False)
        indices = range(chosen.dim) if selection is None else np.asarray(selection).tolist()
        others: dict[str, float] = {}
        if selection is not None and not is_image_space(model.observation_space):
            whole = travels(self._paths(ModeFeatures(model.observation_space))).tolist()
            others = {named[k]: each for k, each in enumerate(whole) if k not in indices}
        return ChosenFeatures(
            source, selection, tuple(named[k] for k in indices), tuple(far), others, source == "found" and parting
        )

    def cells(self, caught: list[warnings.WarningMessage]) -> Cells:
        """
        :param caught: What was warned of, of which what the cells say of themselves is taken out
        :return: By which cells places are told apart
        """
        grid = self.model.bonus.grid
        of_cells = [each for each in caught if Path(each.filename) == Path(cells_module.__file__)]
        for each in of_cells:
            caught.remove(each)
        if grid.edges is None:
            return Cells(None, 0, not grid.adapts, None)
        n_seen = grid.count(self.buffer.positions(self.buffer.nexts, "next_observations", self.rows))
        return Cells(tuple(grid.edges.tolist()), n_seen, not grid.adapts, str(of_cells[-1].message) if of_cells else None)


def _success(model: DDiffPG, listener: _Listener) -> SuccessSignal:
    rule_key = next((key for key in listener.keys if listener.said[key]), None)
    said, true = (0, 0) if rule_key is None else (listener.said[rule_key], listener.true[rule_key])
    return SuccessSignal(
        key=rule_key,
        only_true=bool(said) and said == true and said < model.replay_buffer.size(),
        n_steps=said,
        n_mid_episode=0 if rule_key is None else listener.mid_episode[rule_key],
        n_counted=len(model.replay_buffer.trajectories(success=True)),
        asked_for=None if rule_key is not None else model.success_key,
        stands_in=not model.replay_buffer.goals_are_told and model.success_key is None,
        candidates=tuple(listener.candidates),
    )


def _relabels(model: DDiffPG) -> bool | None:
    """Whether other goals are learned from; None where goals do not differ, or there are none."""
    buffer = model.replay_buffer
    return buffer.has_hindsight if goals_differ(buffer) else None


def policy_for(space: spaces.Space) -> str:
    """
    :param space: Of observations
    :return: Name of the policy that sees them
    """
    if isinstance(space, spaces.Dict):
        return "MultiInputPolicy"
    return "CnnPolicy" if is_image_space(space) and "CnnPolicy" in DDiffPG.policy_aliases else "MlpPolicy"


# ---------------------------------------------------------------------- questions to environments


def _limit(env: Any) -> int | None:
    spec = env.spec if isinstance(env, gym.Env) else env_attribute(env, "spec")
    limit = getattr(spec, "max_episode_steps", None)
    if limit is not None:
        return int(limit)
    name = "_max_episode_steps"  # of gymnasium's TimeLimit around an environment that is not registered
    if not isinstance(env, gym.Env):
        return env_attribute(env, name)
    return env.get_wrapper_attr(name) if env.has_wrapper_attr(name) else None


def _changing_wrappers(env: Any) -> Iterator[str]:
    """Names of those by which the observation is another one, the innermost first."""
    around = []
    while isinstance(env, VecEnvWrapper):
        around.append((env, env.observation_space != env.venv.observation_space or getattr(env, "norm_obs", False)))
        env = env.venv
    inside: Any = env.envs[0] if isinstance(env, DummyVecEnv) else None
    while isinstance(inside, gym.Wrapper):
        changes = isinstance(inside, gym.ObservationWrapper) or inside.observation_space != inside.env.observation_space
        around.append((inside, changes))  # type: ignore[arg-type]
        inside = inside.env
    for wrapper, changes in reversed(around):
        if changes:
            yield type(wrapper).__name__


def _name(given: Any) -> str:
    if isinstance(given, str):
        return given
    spec = given.spec if isinstance(given, gym.Env) else env_attribute(given, "spec")
    inner = given.unwrapped if isinstance(given, gym.Env) else given
    return type(inner).__name__ if spec is None else str(spec.id)


def _names(space: spaces.Space) -> list[str]:
    """Of the components of a whole observation, as ``ModeFeatures`` lays them one after the other."""
    dim = ModeFeatures(space).dim
    if is_image_space(space):
        return [f"part {k}" for k in range(dim)]
    if not isinstance(space, spaces.Dict):
        return [str(k) for k in range(dim)]
    sizes = {key: ModeFeatures(each).dim for key, each in sorted(space.spaces.items())}
    keys = [f"{key}[{k}]" for key, size in sizes.items() for k in range(size)]
    return [f"{k} ({key})" for k, key in enumerate(keys)] if len(keys) == dim else [str(k) for k in range(dim)]


def _text(space: spaces.Space) -> str:
    if isinstance(space, spaces.Dict):
        return "{" + ", ".join(f"{key}: {_text(each)}" for key, each in space.spaces.items()) + "}"
    if not isinstance(space, spaces.Box):
        return str(space)
    low, high = float(np.min(space.low)), float(np.max(space.high))
    alike = (space.low == low).all() and (space.high == high).all()
    kind = " (an image)" if is_image_space(space) else "" if alike else " (the widest of different ranges)"
    return f"{tuple(map(int, space.shape))} numbers in [{low:.4g}, {high:.4g}]{kind}"


def _warned(
    caught: list[warnings.WarningMessage], given: Any, env: Any, env_kwargs: dict[str, Any], key_was_told: bool
) -> Iterator[str]:
    """What was warned of, and what SB3's checker says of a single environment."""
    texts = [str(each.message) for each in caught if _matters(each) and not (key_was_told and NO_KEY in str(each.message))]
    before = len(caught)
    single = gym.make(given, **env_kwargs) if isinstance(given, str) else env
    if isinstance(single, gym.Env):
        try:
            with redirect_stdout(StringIO()):  # it says that it takes it for a goal environment
                check_by_sb3(single, skip_render_check=True)
        except Exception as error:  # of whatever it calls
            # It asks goal environments behind wrappers what these do not know
            if not (isinstance(error, AttributeError) and METHOD in str(error)):
                texts.append(f"SB3's env_checker: {error}")
        finally:
            if single is not env:
                single.close()
        texts += [f"SB3's env_checker: {each.message}" for each in caught[before:] if _matters(each)]
    yield from dict.fromkeys(" ".join(_COLOUR.sub("", each).split()) for each in texts)


def _matters(warning: warnings.WarningMessage) -> bool:
    silent = DeprecationWarning, PendingDeprecationWarning, ResourceWarning, ImportWarning
    # SB3 asks every environment whose id it is given for pictures
    return not issubclass(warning.category, silent) and "render_mode='rgb_array'" not in str(warning.message)


def _code(given: Any, policy: Any, env_kwargs: dict[str, Any], arguments: dict[str, Any], has_key: bool) -> str:
    """
    Lines that train, as they can be run; an environment that is made already is called ``env`` in them. A key that no step
    had is left out.
    """
    arguments = {name: value for name, value in arguments.items() if name != "success_key" or has_key}
    more = "".join(f", {name}={value!r}" for name, value in arguments.items())
    named = f'"{policy}"' if isinstance(policy, str) else policy.__name__
    lines = ["from sb3_ddiffpg import DDiffPG"]
    if isinstance(given, str):
        kwargs = "".join(f", {name}={value!r}" for name, value in env_kwargs.items())
        lines += ["from sb3_ddiffpg.envs import make_vec_env", "", f'env = make_vec_env("{given}", n_envs=8, seed=0{kwargs})']
    return "\n".join([*lines, f"model = DDiffPG({named}, env, seed=0, verbose=1{more})", "model.learn(100_000)"])
