"""Files without code: plain values and arrays, written whole or not at all."""

from sb3_ddiffpg.serialization.safetensors_tree import DamagedError

__all__ = ["DamagedError"]
