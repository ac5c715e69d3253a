"""``python -m sparserob`` is the command ``sparserob``; the package to import is ``sparserob_core``."""


def __getattr__(name: str) -> object:
    if name.startswith("__"):
        raise AttributeError(name)
    raise AttributeError(
        f"sparserob has no {name}: the package to import is sparserob_core, as import sparserob_core as sr"
    )


if __name__ == "__main__":
    from sparserob_core.experiment.cli.main import main

    main()
