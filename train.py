"""Train an agent with the RL zoo: ``python train.py --env PointMazeV1-v0``."""

import sys

from sb3_ddiffpg.zoo import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
