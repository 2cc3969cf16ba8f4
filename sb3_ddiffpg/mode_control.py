"""The part of DDiffPG that finds, keeps, names and chooses modes."""

import time
from typing import Any

import numpy as np
from stable_baselines3.common.logger import Logger

from sb3_ddiffpg.behavior import Behavior
from sb3_ddiffpg.buffers import ModeReplayBuffer
from sb3_ddiffpg.clustering import cluster
from sb3_ddiffpg.history import ModeEvent, ModeHistory, succeed
from sb3_ddiffpg.interrupts import uninterrupted
from sb3_ddiffpg.modes import Mode, ModeTable, check_name
from sb3_ddiffpg.policies import DiffusionPolicy
from sb3_ddiffpg.reclustering import Reclustering, find_modes
from sb3_ddiffpg.trajectories import NO_MODE
from sb3_ddiffpg.visits import VisitMap


class ModeControl:
    """
    What a model does with its modes, apart from training them. A mix-in of :class:`~sb3_ddiffpg.DDiffPG`, which holds the
    attributes.
    """

    policy: DiffusionPolicy
    replay_buffer: ModeReplayBuffer
    logger: Logger
    num_timesteps: int
    lifetime_steps: int
    mode_history: ModeHistory
    visits: VisitMap | None
    min_mode_size: int
    max_modes: int
    mode_patience: int
    mode_trials: int
    min_return_ratio: float
    reset_new_critics: bool
    distance_threshold: float | None
    linkage: str
    control: str | None
    _modes: list[Mode]
    _next_mode_number: int
    _behavior: Behavior

    @property
    def modes(self) -> ModeTable:
        """The modes discovered so far: iterate, index by name or number, or print."""
        embeddings = self.policy.mode_embeddings[1:].cpu().numpy().copy()
        for mode, embedding in zip(self._modes, embeddings, strict=True):
            mode.embedding = embedding
        return ModeTable(self._modes)

    # ------------------------------------------------------------------ finding

    def recluster(self) -> list[ModeEvent]:
        """
        Algorithm 2 of the paper: cluster the goal-reached trajectories, let the new modes inherit from the old ones, and
        assign the failed trajectories.

        :return: What happened: births, splits, merges and retirements
        """
        started = time.perf_counter()
        with uninterrupted():
            found = find_modes(
                self.replay_buffer,
                self._modes,
                self._cluster,
                self.min_mode_size,
                self.max_modes,
                self.mode_patience,
                self.mode_trials,
                births=self._exploration_share() > 0,
                min_return_ratio=self.min_return_ratio,
            )
            events = self._replace_modes(found)
            found.describe(self._modes, self.replay_buffer)
            self.mode_history.note(self.lifetime_steps, self._modes)
            if self.visits is not None:
                self.visits.note(self.lifetime_steps)
        self.logger.record("modes/n_modes", len(self._modes))
        for mode in self._modes:
            self.logger.record(f"modes/{mode.name}/n_trajectories", mode.n_trajectories)
            self.logger.record(f"modes/{mode.name}/success_rate", mode.success_rate)
        self.logger.record("time/recluster", time.perf_counter() - started)
        return events

    def _exploration_share(self) -> float:
        raise NotImplementedError

    def _cluster(self, distances: np.ndarray) -> np.ndarray:
        if self.max_modes == 1:
            return np.zeros(len(distances), dtype=int)  # clustering off: whatever reaches the goal is the one mode
        labels = cluster(distances, self.distance_threshold, self.linkage, self.max_modes, self.min_mode_size)
        return np.random.permutation(labels) if self.control == "random_clusters" else labels

    def _replace_modes(self, found: Reclustering) -> list[ModeEvent]:
        """Let buffer, policy, table and environments follow a re-clustering."""
        parents, kept = found.inheritance.parents, found.inheritance.kept
        self.replay_buffer.assign_modes(
            found.successes, found.labels, found.failures, found.failure_labels, parents, found.abandoned
        )
        self.policy.inherit(parents, kept, self.reset_new_critics)
        modes, events = succeed(self._modes, found.inheritance, self.lifetime_steps, self._next_mode_number)
        self._hold(modes)
        self.mode_history.events += events
        return events

    def _hold(self, modes: list[Mode]) -> None:
        """These are the modes now."""
        indices = {mode.number: index for index, mode in enumerate(modes)}
        self._behavior.follow([indices.get(mode.number) for mode in self._modes])
        self._modes = modes
        self._next_mode_number = max([self._next_mode_number, *(number + 1 for number in indices)])
        self.replay_buffer.frozen_modes = {index for index, mode in enumerate(modes) if mode.frozen}

    # ------------------------------------------------------------------ keeping

    def rename_mode(self, mode: str | int | Mode, name: str) -> None:
        """
        Give a mode a name that says what it does. It keeps it through re-clusterings, saving and resuming.

        :param mode: Name, index or record of the mode
        :param name: Letters, digits, spaces and ``_.+-``, up to 24 of them, not digits alone and without ``_`` in front
        :raises ValueError: If there is no such mode, or another has that name or may be born with it
        """
        record = self._modes[ModeTable(self._modes).index(mode)]
        if any(name == other.name for other in self._modes if other is not record):
            raise ValueError(f"name={name!r} is another mode's; the modes are {ModeTable(self._modes).names}")
        check_name(name, record.number)
        if name != record.name:
            self._note("renamed to", record, name)
            record.name = name

    def freeze_mode(self, mode: str | int | Mode, frozen: bool = True) -> None:
        """
        Keep a mode whatever a re-clustering finds: it is not merged, retired or crowded out, and its goal-reached
        trajectories are the last to leave the buffer. It goes on learning.

        :param mode: Name, index or record of the mode
        :param frozen: False takes it back
        :raises ValueError: If there is no such mode
        """
        record = self._modes[ModeTable(self._modes).index(mode)]
        if record.frozen != frozen:
            record.frozen = frozen
            self._note("frozen" if frozen else "released", record)
            self._hold(self._modes)

    def delete_mode(self, mode: str | int | Mode) -> None:
        """
        Forget a mode, with its critics and its embedding. Its trajectories serve exploration from now on. While training
        explores, the same way may be discovered again, as another mode.

        :param mode: Name, index or record of the mode
        :raises ValueError: If there is no such mode
        """
        index = ModeTable(self._modes).index(mode)
        stay = [each for each in range(len(self._modes)) if each != index]
        new_index = np.array([stay.index(each) if each in stay else NO_MODE for each in range(len(self._modes))] + [NO_MODE])
        with uninterrupted():
            successes, failures = (self.replay_buffer.trajectories(success) for success in (True, False))
            abandoned = [trajectory for trajectory in successes if trajectory.mode == index]
            successes = [trajectory for trajectory in successes if trajectory.mode != index]
            labels = [new_index[np.array([t.mode for t in part], dtype=int)] for part in (successes, failures)]
            self.replay_buffer.assign_modes(successes, labels[0], failures, labels[1], list(stay), abandoned)
            self.policy.inherit(stay, [True] * len(stay))
            self._note("deleted", self._modes[index])
            self._hold([self._modes[each] for each in stay])

    def _note(self, kind: str, mode: Mode, other: str | None = None) -> None:
        self.mode_history.events.append(ModeEvent(self.lifetime_steps, kind, mode.number, mode.name, other))

    # ------------------------------------------------------------------ choosing

    def mode_values(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> np.ndarray:
        """
        What each mode's critics expect from here: the discounted, scaled return of following the mode, as the mean over
        actions drawn from the policy of the smaller of the twins' values.

        :param observation: One observation or a batch of N, normalised if the model was trained so
        :param n_actions: Actions drawn for each mode
        :return: Shape [M] or [N, M], in the order of ``modes``
        :raises ValueError: If there is no mode yet, or ``n_actions`` is less than 1
        """
        if not self._modes:
            raise ValueError("There is no mode yet whose value could be told")
        if n_actions < 1:
            raise ValueError(f"n_actions must be at least 1, got {n_actions}")
        self.policy.set_training_mode(False)
        tensors, is_batch = self.policy.obs_to_tensor(observation)
        values = self.policy.group_values(tensors, n_actions)[1:].T.cpu().numpy()  # row 0 of the groups explores
        return values if is_batch else values[0]

    def best_mode(self, observation: np.ndarray | dict[str, np.ndarray], n_actions: int = 8) -> Any:
        """
        The mode from which its critics expect most here, see :meth:`mode_values`. Exploration is none.

        :param observation: One observation or a batch of N
        :param n_actions: Actions drawn for each mode
        :return: Its name, or a list of N names
        :raises ValueError: If there is no mode yet
        """
        values = self.mode_values(observation, n_actions)
        names = [mode.name for mode in self._modes]
        best = values.argmax(axis=-1)
        return names[int(best)] if best.ndim == 0 else [names[index] for index in best]
