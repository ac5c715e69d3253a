"""Parts of the program that a person runs: configs, plugins, run directories, figures and the command line."""
