"""Experiments: observed features with labels, their noise, and what a model predicts for them."""

from splatsoil.experiment.base import Candidate, Experiment
from splatsoil.experiment.features import Layout, Site

__all__ = ["Candidate", "Experiment", "Layout", "Site"]
