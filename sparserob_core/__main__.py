"""``python -m sparserob_core`` is the command ``sparserob``."""

from sparserob_core.experiment.cli.main import main

if __name__ == "__main__":
    main()
