"""Model criticism: Bayesian comparison of models of an experiment, and predictive checks.

It depends on `splatsoil.experiment` only, not on pictures, soil or solvers.
"""
