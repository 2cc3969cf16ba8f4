"""The commands of the zoo from a checkout: ``python -m sb3_ddiffpg.zoo train --env PointMazeV1-v0``."""

from sb3_ddiffpg.zoo.commands import main

if __name__ == "__main__":
    main()
