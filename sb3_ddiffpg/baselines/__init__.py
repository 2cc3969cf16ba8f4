"""The algorithms beside which DDiffPG stands, on the same critics, exploration bonus, buffer and denoiser."""

from sb3_ddiffpg.baselines.consistency_ac import ConsistencyAC
from sb3_ddiffpg.baselines.diffusion_ql import DiffusionQL
from sb3_ddiffpg.baselines.dipo import DIPO
from sb3_ddiffpg.baselines.rpg import RPG
from sb3_ddiffpg.baselines.sac_c51 import SACC51
from sb3_ddiffpg.baselines.td3_c51 import TD3C51
from sb3_ddiffpg.common.actor_critic import ActorCriticAlgorithm

#: By their names in the zoo
BASELINES: dict[str, type[ActorCriticAlgorithm]] = {
    "consistency_ac": ConsistencyAC,
    "diffusion_ql": DiffusionQL,
    "dipo": DIPO,
    "rpg": RPG,
    "sac_c51": SACC51,
    "td3_c51": TD3C51,
}

__all__ = ["BASELINES", "DIPO", "RPG", "SACC51", "TD3C51", "ConsistencyAC", "DiffusionQL"]
