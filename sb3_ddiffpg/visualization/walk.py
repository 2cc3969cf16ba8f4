"""One episode under a mode's command, watched step by step: its pictures, and what the critics expect along the way."""

from dataclasses import dataclass
from typing import Any

import numpy as np

from sb3_ddiffpg.evaluation.task import Task

_BATCH = 64


@dataclass(frozen=True)
class Walk:
    """
    An episode.

    :param frames: Shape [T, height, width, 3], even in height and width; None if it was not filmed
    :param rate: Frames in a second
    :param values: What each mode's critics expect at each step, shape [T, M]
    """

    frames: np.ndarray | None
    rate: int
    values: np.ndarray


def walk(model: Any, task: Task, mode: str | None, seed: int, filmed: bool = True, max_steps: int = 400) -> Walk:
    """
    :param model: A DDiffPG
    :param task: Where
    :param mode: The mode to command
    :param seed: Of the environment
    :param filmed: Whether to take a picture at each step
    :param max_steps: The episode is left after so many
    :return: What was seen
    :raises ValueError: If the environment draws no pictures, and is to be filmed
    """
    env = task.make(1, seed, **({"render_mode": "rgb_array"} if filmed else {}))
    try:
        observation, state = env.reset(), None
        observations, done = [observation], False
        frames = [_picture(env, task)] if filmed else []
        while not done and len(observations) < max_steps:
            action, state = model.predict(observation, state, mode=mode)
            observation, _, dones, _ = env.step(action)
            done = bool(dones[0])
            if not done:  # then the next episode has begun
                observations.append(observation)
                frames += [_picture(env, task)] if filmed else []
        metadata: Any = getattr(env, "metadata", None) or {}
    finally:
        env.close()
    return Walk(np.stack(frames) if filmed else None, int(metadata.get("render_fps", 20)), _values(model, observations))


def _picture(env: Any, task: Task) -> np.ndarray:
    picture = env.get_images()[0]
    if not isinstance(picture, np.ndarray) or picture.ndim != 3:
        raise ValueError(f"{task.id} gives no picture of shape [height, width, 3]")
    height, width = (size - size % 2 for size in picture.shape[:2])  # what the codec wants
    return picture[:height, :width]


def _values(model: Any, observations: list[Any]) -> np.ndarray:
    if not len(getattr(model, "modes", ())):
        return np.zeros((len(observations), 0))
    found = []
    for begin in range(0, len(observations), _BATCH):
        part = observations[begin : begin + _BATCH]
        together = (
            {key: np.concatenate([each[key] for each in part]) for key in part[0]}
            if isinstance(part[0], dict)
            else np.concatenate(part)
        )
        found.append(model.mode_values(together))
    return np.concatenate(found)
