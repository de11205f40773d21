"""The soil: its strength, the library of effects, and the law that both the solver and element tests run."""
