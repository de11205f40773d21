"""Criticism: is the model adequate, where is it not, and which effect is missing?

It knows experiments (`splatsoil.experiment`) and nothing of pictures, sand or solvers.
"""
