"""A model that always takes the best of some actions, wherever a model is asked for."""

from typing import Any


class BestOf:
    """
    Acts like a model, by ``predict(..., n_samples=...)``: in ``evaluate_modes``, ``run_episodes``, ``evaluate_policy`` and
    ``Replanner``.

    :param model: A DDiffPG
    :param n_samples: Actions for each observation, of which that is taken which the mode's critics like best
    :raises ValueError: If ``n_samples`` is less than 1
    """

    def __init__(self, model: Any, n_samples: int) -> None:
        if n_samples < 1:
            raise ValueError(f"n_samples: {n_samples!r} given; accepted are whole numbers from 1 up")
        self.model, self.n_samples = model, n_samples

    def __getattr__(self, name: str) -> Any:
        if name == "model":  # not there yet, as when it is copied
            raise AttributeError(name)
        return getattr(self.model, name)

    def predict(self, *args: Any, **kwargs: Any) -> Any:
        """
        See ``DDiffPG.predict``.

        :param args: Observations and what else there may be
        :param kwargs: The same by name
        :return: The actions and the state for the next call
        """
        return self.model.predict(*args, n_samples=self.n_samples, **kwargs)
