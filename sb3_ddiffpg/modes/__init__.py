"""The modes: who they are, what became of them, and how they are found."""

from sb3_ddiffpg.modes.history import ModeEvent, ModeHistory, ModeState
from sb3_ddiffpg.modes.mode import Mode, ModeTable, Outcome

__all__ = ["Mode", "ModeEvent", "ModeHistory", "ModeState", "ModeTable", "Outcome"]
