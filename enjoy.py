"""Watch a trained agent, commanded to one of its modes if asked: ``python enjoy.py --env PointMazeV1-v0 --mode 0``."""

import sys

from sb3_ddiffpg.zoo import main

if __name__ == "__main__":
    main(["enjoy", *sys.argv[1:]])
