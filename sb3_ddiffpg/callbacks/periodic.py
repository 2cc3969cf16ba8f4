"""What is done every so many environment steps."""

from typing import Any

from stable_baselines3.common.callbacks import BaseCallback

from sb3_ddiffpg.serialization.safetensors_tree import convert


class _PeriodicCallback(BaseCallback):
    """After every so many environment steps, at the end of a rollout."""

    def __init__(self, name: str, period: int) -> None:
        super().__init__()
        if period < 1:
            raise ValueError(f"{name} must be at least 1, got {period}")
        self._period = period
        self._next = 0
        self._resumed = False

    def _on_training_start(self) -> None:
        if not self._resumed:
            self._next = self.model.num_timesteps + self._period
        self._resumed = False

    def state_dict(self) -> dict[str, Any]:
        """
        :return: What a resumed run must know, for ``load_state_dict``
        """
        return {"next": self._next}

    def load_state_dict(self, state: Any) -> None:
        """
        :param state: What ``state_dict`` gave
        :raises ValueError: If it is something else
        """
        self._next = convert(state.get("next"), int, "callback.next")
        self._resumed = True

    def _on_step(self) -> bool:
        return True

    def _on_rollout_end(self) -> None:
        if self.num_timesteps >= self._next:
            self._next = self.num_timesteps + self._period
            self._on_period()

    def _on_period(self) -> None:
        raise NotImplementedError
