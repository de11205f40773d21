"""The report: one HTML page, made from a run folder's files and needing nothing else."""

from splatsoil.report.page import write_report

__all__ = ["write_report"]
