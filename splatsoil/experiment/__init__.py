"""Experiments: observed features with labels, their noise, and a model's predictions."""

from splatsoil.experiment.base import Candidate, Experiment, Run
from splatsoil.experiment.features import Layout, Site

__all__ = ["Candidate", "Experiment", "Layout", "Run", "Site"]
