"""The command line's subcommands, one module each: a frozen dataclass of options and a function that acts on it."""
