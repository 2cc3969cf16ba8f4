"""Going from place to place without any other aim, to learn how."""

from typing import Any

import numpy as np

#: How far away the next place is, at most, and how long it may take to come there, in places
REACH = 5
#: Deviations of the noise on actions, of which each way has one
NOISES = (0.0, 0.1, 0.3)


class Wanderer:
    """
    Acts like a model: goes to some place nearby, and when it is there, or has tried for long enough, to the next one. There
    may be walls between.

    :param planner: A ``ModePlanner`` that knows some places
    """

    def __init__(self, planner: Any) -> None:
        self.planner = planner

    def predict(self, observation: Any, state: Any = None, episode_start: Any = None, **kwargs: Any) -> tuple[np.ndarray, Any]:
        """
        :param observation: Batch of N observations
        :param state: What the previous call returned: where each goes, for how many steps more, and with how much noise
        :param episode_start: Which environments begin an episode, shape [N]
        :param kwargs: Not used
        :return: The actions and the state for the next call
        """
        planner, graph = self.planner, self.planner.graph
        original = planner.original(observation)
        positions = planner.senses.places(original) / planner.scale
        n = len(positions)
        targets, left, noise = (positions.copy(), np.zeros(n), np.zeros(n)) if state is None else state
        arrived = np.linalg.norm(targets - positions, axis=1) < 0.5 * graph.spacing
        for i in np.flatnonzero(np.asarray(episode_start, dtype=bool) | arrived | (left <= 0)):
            near = graph.around(positions[i], REACH * graph.spacing)
            targets[i] = graph.positions[np.random.choice(near) if len(near) else np.random.randint(len(graph))]
            left[i], noise[i] = REACH * planner.crossing, np.random.choice(NOISES)
        actions = planner.act(original, targets - positions, noise)
        return planner.model.policy.unscale_action(actions), (targets, left - 1, noise)
