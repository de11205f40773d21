"""Inverse problem: search, posterior and model criticism, and the database of evaluations."""
