"""Schedules that Stable-Baselines3 and its zoo have not."""

from sb3_ddiffpg.serialization.codec import registered


@registered("sb3_ddiffpg.schedules.LateLinearSchedule", objects=True)
class LateLinearSchedule:
    """
    Constant for the first part of the training, then linear to zero: explore at full speed, end without dips.

    :param value: The constant value
    :param constant_part: Part of the training, from 0 to 1, after which it falls
    :raises ValueError: If ``constant_part`` is not in [0, 1)
    """

    def __init__(self, value: float, constant_part: float = 0.7) -> None:
        if not 0.0 <= constant_part < 1.0:
            raise ValueError(f"constant_part must be in [0, 1), got {constant_part}")
        self.value, self.constant_part = value, constant_part

    def __call__(self, progress_remaining: float) -> float:
        """
        :param progress_remaining: From 1 (beginning) to 0
        :return: The value there
        """
        return self.value * min(1.0, progress_remaining / (1.0 - self.constant_part))

    def __repr__(self) -> str:
        return f"LateLinearSchedule(value={self.value}, constant_part={self.constant_part})"
