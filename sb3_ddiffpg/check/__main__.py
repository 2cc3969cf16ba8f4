"""What DDiffPG makes of an environment: ``python -m sb3_ddiffpg.check ENV``."""

from sb3_ddiffpg.check.command import main

if __name__ == "__main__":
    main()
