"""Film a trained agent: ``python record_video.py --env PointMazeV1-v0 --mode 0 -n 200``."""

import sys

from sb3_ddiffpg.zoo import main

if __name__ == "__main__":
    main(["record_video", *sys.argv[1:]])
