"""Callbacks inside callbacks."""

from stable_baselines3.common.callbacks import (
    BaseCallback,
    CallbackList,
)


def nested_callbacks(callback: BaseCallback | None) -> list[BaseCallback]:
    """
    :param callback: A callback, perhaps with others inside; None: none
    :return: It and those inside, a list itself not counted
    """
    if callback is None:
        return []
    if isinstance(callback, CallbackList):
        return [each for child in callback.callbacks for each in nested_callbacks(child)]
    children = (getattr(callback, name, None) for name in ("callback", "callback_on_new_best"))
    return [callback, *(each for child in children if isinstance(child, BaseCallback) for each in nested_callbacks(child))]
