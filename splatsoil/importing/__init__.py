"""Measurement sets out of what other programs and instruments recorded."""
