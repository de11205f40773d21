"""The subcommands of the command line, one module each: a frozen dataclass of options and a function ``run``.

Shared modules: ``_options`` (parser, help), ``_output`` (JSON, tables, progress), ``_model`` (a run folder and its
model), ``_stages`` (fit, compare, diagnose), ``_resources`` (memory, time), ``_workers`` (worker processes) and
``_laboratory`` (laboratory tests).
"""
