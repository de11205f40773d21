"""Soil properties from photographs of a tool moving through it."""
