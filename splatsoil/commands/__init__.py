"""The command line's subcommands, one module each: a frozen dataclass of options and a function that acts on it.

What they share: ``_options`` (parser, help), ``_output`` (JSON, tables, progress), ``_folder`` (a run folder's files),
``_model`` (a run as a model), ``_stages`` (fit, compare, diagnose), ``_resources`` (memory, time), ``_crew`` (helpers).
"""
